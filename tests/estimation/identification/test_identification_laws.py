"""Invariances of identification: frames, order of poses, exchange of parent and child."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from synthetic_recordings import Recording, angle_between, off_axis, recording, transform

from hypothesis_profiles import attempts
from kineverse.estimation import IdentificationResult, Identifier, identify
from kineverse.estimation.identification.model_selection import solve_families
from kineverse.estimation.identification.observations import check_observations

MOVING = ("prismatic", "revolute")
FAMILIES = ("rigid", "prismatic", "revolute", "planar")


def identify_data(data: Recording) -> IdentificationResult:
    return identify(data.parent, data.child, noise=data.covariance, families=FAMILIES)


def seeded(family: str, seed: int, count: int = 12) -> Recording:
    return recording(family, count=count, position=0.02, orientation=0.03, seed=seed)


def some_pose(seed: int) -> np.ndarray:
    random = np.random.default_rng(seed)
    return transform(Rotation.random(random_state=random), random.normal(0, 2.0, 3))


@settings(max_examples=attempts(4, long=6))
@given(st.integers(0, 10**6), st.sampled_from(MOVING))
def test_identify_is_invariant_to_the_observers_pose(seed: int, family: str) -> None:
    data = seeded(family, seed)
    before, elsewhere = identify_data(data), some_pose(seed + 1)
    turn = np.kron(np.eye(2), elsewhere[:3, :3])
    after = identify(
        elsewhere @ data.parent,
        elsewhere @ data.child,
        noise=turn @ data.covariance @ turn.T,
        families=FAMILIES,
    )
    same_joint(before, after, family)


@settings(max_examples=attempts(4, long=6))
@given(st.integers(0, 10**6), st.sampled_from(MOVING))
def test_identify_is_equivariant_to_the_childs_frame(seed: int, family: str) -> None:
    data, change = seeded(family, seed), np.eye(4)
    change[:3, :3] = some_pose(seed)[:3, :3]
    before = identify_data(data)
    after = identify(data.parent, data.child @ change, noise=data.covariance, families=FAMILIES)
    same_joint(before, after, family)
    np.testing.assert_allclose(
        before[family].parameters["reference"] @ change, after[family].parameters["reference"], atol=1e-3
    )


@settings(max_examples=attempts(4, long=6))
@given(st.integers(0, 10**6), st.sampled_from(MOVING))
def test_identify_is_invariant_to_the_order_of_poses(seed: int, family: str) -> None:
    data = seeded(family, seed)
    order = np.random.default_rng(seed).permutation(len(data.parent))
    before = identify_data(data)
    after = identify(data.parent[order], data.child[order], noise=data.covariance, families=FAMILIES)
    same_joint(before, after, family)
    np.testing.assert_allclose(before[family].joint_values[order], after[family].joint_values, atol=1e-3)


def same_joint(before: IdentificationResult, after: IdentificationResult, family: str) -> None:
    for fit in before:
        assert after[fit.family].probability == pytest.approx(fit.probability, abs=0.02)
    one, other = before[family], after[family]
    assert angle_between(one.parameters["axis"], other.parameters["axis"]) < 0.05 * one.deviation("axis.x")
    np.testing.assert_allclose(np.linalg.norm(one.range), np.linalg.norm(other.range), rtol=0.01)


@pytest.mark.parametrize("family", MOVING)
def test_exchanging_parent_and_child_inverts_the_model(family: str) -> None:
    data = seeded(family, 5, count=20)
    fit = identify_data(data)[family]
    other = identify(data.child, data.parent, noise=data.covariance, families=FAMILIES)[family]
    inverse = np.linalg.inv(other.parameters["reference"])
    axis = inverse[:3, :3] @ other.parameters["axis"]
    assert angle_between(axis, fit.parameters["axis"]) < fit.deviation("axis.x")
    if family == "revolute":
        point = inverse[:3, :3] @ other.parameters["point"] + inverse[:3, 3]
        assert off_axis(fit.parameters["point"], fit.parameters["axis"], point) < fit.deviation("point.x")


@pytest.mark.parametrize("family", ["revolute", pytest.param("prismatic", marks=pytest.mark.long)])
def test_the_likelihood_has_all_true_poses_as_unknowns(family: str) -> None:
    data = seeded(family, 9, count=5)
    covariance = data.covariance
    ours = solve_families(check_observations(data.parent, data.child, covariance, covariance), [family])[
        family
    ].solution
    deviation = np.sqrt(np.diag(covariance))

    def errors(unknown: np.ndarray) -> np.ndarray:
        count = len(data.parent)
        left = transform(Rotation.from_rotvec(unknown[:3]), unknown[3:6])
        right = transform(Rotation.from_rotvec(unknown[6:9]), unknown[9:12])
        values = unknown[12 : 12 + count]
        parents, result = unknown[12 + count :].reshape(count, 6), []
        for k in range(count):
            twist = np.zeros(6)
            twist[5 if family == "revolute" else 2] = values[k]
            there = transform(Rotation.from_rotvec(parents[k, 3:]), parents[k, :3])
            motion = transform(Rotation.from_rotvec(twist[3:]), twist[:3])
            for noisy_pose, true in ((data.parent[k], there), (data.child[k], there @ left @ motion @ right)):
                turned = Rotation.from_matrix(noisy_pose[:3, :3] @ true[:3, :3].T).as_rotvec()
                result.append(np.concatenate([noisy_pose[:3, 3] - true[:3, 3], turned]) / deviation)
        return np.concatenate(result)

    start = [
        *Rotation.from_matrix(data.left[:3, :3]).as_rotvec(),
        *data.left[:3, 3],
        *Rotation.from_matrix(data.right[:3, :3]).as_rotvec(),
        *data.right[:3, 3],
        *data.values[:, 0],
    ]
    for pose in data.true_parent:
        start += [*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_rotvec()]
    theirs = least_squares(errors, start, x_scale="jac")
    axis = Rotation.from_rotvec(theirs.x[:3]).as_matrix()[:, 2]
    # They do not know that levers are within reach, which hardly matters.
    beforehand = ours.motion.prior().residuals
    assert ours.cost - beforehand @ beforehand == pytest.approx(2 * theirs.cost, rel=1e-3)
    assert angle_between(axis, ours.motion.left[:3, 2]) < 3e-3


@pytest.mark.parametrize("family", MOVING)
def test_identifier_agrees_with_identify(family: str) -> None:
    data = seeded(family, 2, count=14)
    identifier = Identifier(noise=data.covariance, families=FAMILIES)
    for a, b in zip(data.parent, data.child, strict=True):
        identifier.add(a, b)
        if len(identifier) > 4:
            assert identifier.result.best.probability > 0.0
    whole = identify_data(data)
    one, other = identifier.result[family], whole[family]
    assert one.log_evidence == pytest.approx(other.log_evidence, abs=0.02)
    assert angle_between(one.parameters["axis"], other.parameters["axis"]) < 0.05 * other.deviation("axis.x")


def test_identifier_does_not_drift_over_many_warm_starts() -> None:
    data = recording("revolute", count=127, position=0.02, orientation=0.03, seed=3)
    identifier = Identifier(noise=data.covariance, families=["revolute"])
    for a, b in zip(data.parent, data.child, strict=True):
        identifier.add(a, b)
        if len(identifier) >= 64:
            assert identifier.result
    one, other = (
        identifier.result["revolute"],
        identify(data.parent, data.child, noise=data.covariance)["revolute"],
    )
    assert angle_between(one.parameters["axis"], other.parameters["axis"]) < 0.05 * other.deviation("axis.x")
