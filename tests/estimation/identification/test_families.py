"""Families: selection of each one, custom ones, and the operations of their fits."""

from __future__ import annotations

import numpy as np
import pytest
from synthetic_recordings import JOINTS, noisy, recording

import kineverse as kv
from kineverse.estimation import Family, FamilyParameter, IdentificationResult, identify, pose_covariance

COVARIANCE = pose_covariance(0.002, 0.01)


@pytest.mark.parametrize("family", [*JOINTS])
@pytest.mark.sampled(2)
def test_identify_selects_the_true_family(family: str) -> None:
    data = recording(family, count=30, position=0.002, orientation=0.01, seed=3)
    result = identify(data.parent, data.child, noise=COVARIANCE)
    assert result.best.family == family
    assert result.best.probability > 0.9
    assert sum(fit.probability for fit in result) == pytest.approx(1.0)


@pytest.mark.parametrize("family", [*JOINTS])
@pytest.mark.sampled(2)
def test_operation_moves_as_its_fit(family: str) -> None:
    data = recording(family, count=30, position=0.002, orientation=0.01, seed=4)
    fit = identify(data.parent, data.child, noise=COVARIANCE)[family]
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("body", parent="world", transform=np.eye(4))
        edit.apply(fit.operation("joint", parent="body", child="part"), tag="learned")
    joint, pose = model.articulations["joint"], model.fk("part", "body")
    home = dict(zip(joint.coordinates, joint.home, strict=True))
    np.testing.assert_allclose(pose(home), fit.parameters["reference"], atol=1e-9)
    if family in ("prismatic", "revolute", "screw", "cylindrical"):
        for k in (0, 7):
            values = dict(zip(joint.coordinates, fit.joint_values[k], strict=True))
            np.testing.assert_allclose(pose(values), fit.poses[k], atol=1e-9)
            assert not model.violations(values)


def test_fits_are_computed_once_and_sorted_by_probability() -> None:
    data = recording("revolute", count=12, position=0.02, orientation=0.05, seed=5)
    result = identify(data.parent, data.child, noise=data.covariance)
    assert [fit.family for fit in result] == [*result.probabilities]
    assert [fit.probability for fit in result] == sorted(result.probabilities.values(), reverse=True)
    assert result.best is result.fits[0] is result[result.best.family]
    assert len(result) == len(JOINTS) + 1  # and the curve


@pytest.mark.parametrize("pitch", [0.01, -0.03])
def test_a_screw_of_several_revolutions_is_identified(pitch: float) -> None:
    turn = kv.position("turn")
    nut = kv.translation(0.3, 0.1, 0.0) @ kv.translation(0, 0, pitch * turn) @ kv.rotation_z(turn)
    pose = kv.compile([nut @ kv.translation(0.1, 0.0, 0.0)])
    angles = np.linspace(0.0, 20.0, 60)
    data = noisy(pose.batch(angles[:, None])[0], 0.002, 0.01, np.random.default_rng(0))
    result = identify(None, data[np.random.default_rng(1).permutation(60)], noise=COVARIANCE)
    assert result.best.family == "screw"
    assert result.best.parameters["pitch"] == pytest.approx(2 * np.pi * pitch, rel=0.05)
    assert np.ptp(result.best.joint_values) == pytest.approx(20.0, abs=0.1)


LENGTH = 1.4


def garage() -> Family:
    """Return a door of unknown length that slides up along one edge and in along the other."""
    a, length = kv.position("a"), kv.parameter("length", 2.0)
    door = kv.translation(0, 0, length * np.cos(a)) @ kv.rotation_y(a)
    return Family("garage", door, {a: (0.0, 1.5)}, {length: FamilyParameter(2.0, 0.5, 0.5, 4.0)})


def door_poses(count: int, position: float, orientation: float) -> tuple[np.ndarray, np.ndarray]:
    family = garage()
    (a,), (length,) = family.joints, family.parameters
    random, values = np.random.default_rng(0), np.linspace(0.05, 1.2, count)
    poses = np.stack([family.transform({a: v, length: LENGTH}) for v in values])
    return values, noisy(poses, position, orientation, random)


@pytest.fixture(scope="module")
def result() -> IdentificationResult:
    _, poses = door_poses(20, 0.01, 0.02)
    return identify(None, poses, noise=pose_covariance(0.01, 0.02), families=["revolute", "planar", garage()])


def test_identify_selects_a_custom_family_over_a_hinge(result: IdentificationResult) -> None:
    assert result.best.family == "garage"
    assert not result.is_ambiguous
    assert result.best.is_determined


def test_a_custom_familys_parameter_is_estimated(result: IdentificationResult) -> None:
    fit = result["garage"]
    deviation = fit.deviation("length")
    assert 0.001 < deviation < 0.01
    assert abs(fit.parameters["length"] - LENGTH) < 4 * deviation


def test_joint_values_and_limits_of_a_custom_family_are_the_observed_ones(
    result: IdentificationResult,
) -> None:
    values, _ = door_poses(20, 0.01, 0.02)
    np.testing.assert_allclose(result["garage"].joint_values[:, 0], values, atol=0.05)


def test_operation_of_a_custom_family_moves_as_its_fit(result: IdentificationResult) -> None:
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(result.best.operation("door", "world", "panel"), tag="learned")
    pose = model.fk("panel")({"door": 0.5})
    expected = result.best.motion.linearise(np.array([[0.5]])).pose[0]
    np.testing.assert_allclose(pose, expected, atol=1e-12)
    assert model.violations({"door": 3.0})
    copy = kv.formats.from_bytes(kv.formats.to_bytes(model))
    np.testing.assert_allclose(copy.fk("panel")({"door": 0.5}), expected, atol=1e-12)


def test_an_invalid_family_is_refused() -> None:
    a, b = kv.position("a"), kv.position("b")
    with pytest.raises(kv.errors.UnknownNameError, match="depends on b"):
        Family("odd", kv.translation(a, b, 0), {a: (0, 1)})
    with pytest.raises(kv.errors.InvalidValueError, match="empty"):
        Family("odd", kv.translation(a, 0, 0), {a: (1, 1)})
    with pytest.raises(kv.errors.InvalidValueError, match="positive deviation"):
        Family("odd", kv.translation(a, b, 0), {a: (0, 1)}, {b: (0.0, 0.0)})
    with pytest.raises(kv.errors.ShapeError, match="4×4"):
        Family("odd", a, {a: (0, 1)})
