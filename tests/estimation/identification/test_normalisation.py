"""Invariance to frames and to the unit of length."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic_recordings import JOINTS, Array, Recording, angle_between, noisy, recording, transform

import kineverse as kv
from kineverse.estimation import (
    Family,
    FamilyParameter,
    IdentificationResult,
    Identifier,
    identify,
    pose_covariance,
)
from kineverse.estimation.identification.solver import solver
from kineverse.lie import skew

# Wider than half a metre, so that all priors scale with the data.
LARGE = 3.0


def larger(poses: np.ndarray, factor: float) -> np.ndarray:
    result = poses.copy()
    result[:, :3, 3] *= factor
    return result


def identify_data(data: Recording, factor: float, families: object = None) -> IdentificationResult:
    noise = pose_covariance(0.002 * factor, 0.01)
    return identify(larger(data.parent, factor), larger(data.child, factor), noise=noise, families=families)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("family", [*JOINTS])
def test_identify_is_invariant_to_millimetres(family: str) -> None:
    data = recording(family, count=20, position=0.002, orientation=0.01, seed=3)
    assert identify_data(data, 1000.0).best.family == family


@pytest.mark.parametrize(
    "family",
    [
        "revolute",
        "screw",
        *(pytest.param(family, marks=pytest.mark.long) for family in ("prismatic", "planar")),
    ],
)
def test_lengths_of_a_fit_scale_with_the_poses(family: str) -> None:
    data = recording(family, count=20, position=0.002, orientation=0.01, seed=3)
    small, factor = identify_data(data, LARGE), 40.0
    large = identify_data(data, factor * LARGE)
    for one, other in zip(small, large, strict=True):
        assert other.probability == pytest.approx(one.probability, abs=1e-3)
    one, other = small.best, large.best
    # Densities are in metres: that of each pose, but not of the mean.
    assert other.log_evidence == pytest.approx(one.log_evidence - 57 * math.log(factor), abs=0.05)
    for name, value in one.parameters.items():
        expected = value * factor if name in ("point", "pitch") else np.array(value)
        if name == "reference":
            expected[:3, 3] *= factor
        np.testing.assert_allclose(other.parameters[name], expected, atol=1e-3 * factor)
    for name in one.coordinates:
        length = name in ("point.x", "point.y", "pitch", "child.x", "child.y", "child.z")
        grown = one.deviation(name) * (factor if length else 1.0)
        assert other.deviation(name) == pytest.approx(grown, rel=0.01), name
    np.testing.assert_allclose(other.poses, larger(one.poses, factor), atol=1e-3 * factor)
    np.testing.assert_allclose(other.rms, np.multiply(one.rms, [factor, 1.0]), rtol=1e-3)


def test_a_crane_is_identified_as_a_hinge() -> None:
    random, q = np.random.default_rng(5), kv.position("q")
    boom = kv.compile([kv.translation(3, 1, 20) @ kv.rotation_z(q) @ kv.translation(40, 0, 0)])
    data = noisy(boom.batch(np.linspace(0.0, 0.6, 25)[:, None])[0], 0.1, 0.02, random)
    identified = identify(None, data, noise=pose_covariance(0.1, 0.02))
    assert identified.best.family == "revolute"
    assert not identified.is_ambiguous
    assert np.linalg.norm(identified.best.parameters["point"][:2] - [3, 1]) < 4 * identified.best.deviation(
        "point.x"
    )
    one_by_one = Identifier(noise=pose_covariance(0.1, 0.02))
    for pose in data:
        one_by_one.add(None, pose)
        if len(one_by_one) % 6 == 0:
            assert len(one_by_one.result)
    fit = one_by_one.result.best
    assert fit.family == "revolute"
    assert np.linalg.norm(fit.parameters["point"][:2] - [3, 1]) < 4 * fit.deviation("point.x")


def test_a_custom_family_keeps_its_metres() -> None:
    random = np.random.default_rng(2)
    a, length = kv.position("a"), kv.parameter("length", 20.0)
    panel = kv.translation(0, 0, length * np.cos(a)) @ kv.rotation_y(a)
    gate = Family("gate", panel, {a: (0, 1.5)}, {length: FamilyParameter(start=20.0, deviation=5.0)})
    true = np.stack([panel({a: value, length: 17.0}) for value in np.linspace(0.1, 1.2, 15)])
    data = noisy(true, 0.05, 0.02, random)
    families = ["rigid", "prismatic", "revolute", "planar", gate]
    identified = identify(None, data, noise=pose_covariance(0.05, 0.02), families=families)
    assert identified.best.family == "gate"
    assert identified.best.parameters["length"] == pytest.approx(
        17.0, abs=4 * identified.best.deviation("length")
    )
    np.testing.assert_allclose(identified.best.poses, true, atol=0.2)


def exact_poses(kind: str, scale: float, far: float, count: int, seed: int) -> np.ndarray:
    """Return exact poses (count, 4, 4) of a joint whose lengths are of a scale, at a place as far as given."""
    rng = np.random.default_rng(seed)

    def pose(rotation: Rotation, place: np.ndarray) -> np.ndarray:
        result = np.eye(4)
        result[:3, :3], result[:3, 3] = rotation.as_matrix(), place
        return result

    left = pose(Rotation.random(random_state=rng), far * rng.normal(size=3))
    right = pose(Rotation.random(random_state=rng), scale * rng.normal(size=3))
    poses = []
    for q in rng.uniform(-1.5, 1.5, count):
        turn, free = Rotation.from_rotvec([0.0, 0.0, q]), scale * rng.uniform(-1.0, 1.0, 3)
        moved = {
            "rigid": pose(Rotation.identity(), np.zeros(3)),
            "prismatic": pose(Rotation.identity(), [0.0, 0.0, scale * q]),
            "revolute": pose(turn, np.zeros(3)),
            "screw": pose(turn, [0.0, 0.0, 0.3 * scale * q]),
            "spherical": pose(Rotation.random(random_state=rng), np.zeros(3)),
            "planar": pose(turn, [*free[:2], 0.0]),
        }[kind]
        poses.append(left @ moved @ right)
    return np.array(poses)


@pytest.mark.sampled(3)
@pytest.mark.parametrize("kind", ["rigid", "prismatic", "revolute", "screw", "spherical", "planar"])
@pytest.mark.parametrize("scale", [1.0, 3000.0, pytest.param(1e5, marks=pytest.mark.long)])
@pytest.mark.parametrize("count", [10, pytest.param(80, marks=pytest.mark.long)])
def test_family_of_exact_poses_is_found_in_any_unit(kind: str, scale: float, count: int) -> None:
    """Millimetres, and a frame far away. The noise is none, and may not be taken for less than rounding."""
    solver.prepare(wait=True)
    result = identify(None, exact_poses(kind, scale, 10.0 * scale, count, seed=count))
    assert result.best.family == kind
    assert result.noise is not None
    assert result.noise.position < 2e-3 * max(scale, 5.0)


def test_noise_beyond_what_numbers_hold_is_no_bare_error() -> None:
    poses = exact_poses("revolute", 1e5, 1e6, 20, seed=1)
    for position in (1e-6, 1.0):
        assert identify(None, poses, noise=pose_covariance(position, 1e-6)).best.family == "revolute"
    assert identify(None, poses[:, :3, 3]).best.family in ("revolute", "spherical", "planar")


# By how much differences of log evidence may change when frames are moved by half a metre: levers are within a
# metre of the child's origin, beforehand, and errors of orientations are small to first order only.
CHANGE = 1.0
# Log evidence behind the best beyond which a family does not count. A slider may be a hinge several metres away,
# and there the choice of the origin matters more.
CHANCE = 10.0

# Families and how far the child's origin is off the axis.
CASES = [
    ("revolute", 0.0),
    ("revolute", 0.4),
    ("prismatic", 0.3),
    *(pytest.param(*case, marks=pytest.mark.long) for case in (("planar", 0.3), ("spherical", 0.0))),
]


def somewhere(random: np.random.Generator) -> Array:
    return transform(Rotation.random(random_state=random), random.normal(0.0, 0.3, 3))


def moved(poses: Array, covariance: Array, frame: Array) -> tuple[Array, Array]:
    """Return poses of another frame in the same part, and their covariances."""
    by = np.tile(np.eye(6), (len(poses), 1, 1))
    by[:, :3, 3:] = -skew(poses[:, :3, :3] @ frame[:3, 3])
    return poses @ frame, by @ covariance @ np.swapaxes(by, 1, 2)


def elsewhere(data: Recording, of_parent: Array, of_child: Array) -> IdentificationResult:
    parent, parent_covariance = moved(data.parent, data.covariance, of_parent)
    child, child_covariance = moved(data.child, data.covariance, of_child)
    return identify(parent, child, parent_covariance=parent_covariance, child_covariance=child_covariance)


@pytest.mark.parametrize(("family", "radius"), CASES)
def test_evidence_does_not_depend_on_the_frames_of_the_parts(family: str, radius: float) -> None:
    data = recording(family, count=20, position=0.01, orientation=0.02, seed=4, radius=radius)
    before = elsewhere(data, np.eye(4), np.eye(4))
    assert before.best.family == family
    random = np.random.default_rng(7)
    for _ in range(2):
        after = elsewhere(data, somewhere(random), somewhere(random))
        assert after.best.family == family
        for fit in before:
            behind = before.best.log_evidence - fit.log_evidence
            if behind < CHANCE:
                now = after[family].log_evidence - after[fit.family].log_evidence
                assert now == pytest.approx(behind, abs=CHANGE), fit.family


def test_a_hinge_through_the_childs_origin_is_not_taken_for_planar() -> None:
    """Joints of robot descriptions have such frames; a planar joint would rotate about an unknown point."""
    data = recording("revolute", count=40, position=0.01, orientation=0.02, seed=1, radius=0.0)
    identified = identify(data.parent, data.child, noise=data.covariance)
    assert identified.best.family == "revolute"
    assert identified["planar"].log_evidence < identified["revolute"].log_evidence + 1.0


@pytest.mark.parametrize("family", ["planar", "free"])
def test_translations_of_a_fit_are_those_of_the_childs_origin(family: str) -> None:
    """Whichever point makes them probable: poses at joint values are the observed ones."""
    data = recording(family, count=30, position=1e-3, orientation=1e-3, seed=2)
    fit = identify(data.parent, data.child, noise=data.covariance)[family]
    assert fit.family == family
    slides = 2 if family == "planar" else 3
    np.testing.assert_allclose(fit.motion.right[:slides, 3], 0.0, atol=1e-12)
    np.testing.assert_allclose(fit.poses, data.true_relative, atol=0.012)
    np.testing.assert_allclose(fit.joint_values[:, :slides].mean(axis=0), 0.0, atol=1e-12)
    if family == "planar":
        assert angle_between(fit.parameters["normal"], data.axis) < 0.01
        height = data.left[:3, 2] @ (fit.parameters["reference"][:3, 3] - data.true_relative[0, :3, 3])
        assert abs(height) < 4.0 * fit.deviation("child.z") + 1e-3
