"""Length scale: cranes, and poses in millimetres."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic_recordings import JOINTS, Recording, noisy, recording

import kineverse as kv
from kineverse.estimation import (
    Family,
    FamilyParameter,
    IdentificationResult,
    Identifier,
    identify,
    pose_covariance,
)

# Wider than half a metre, so that there is no metre in what is believed of it.
LARGE = 3.0


def larger(poses: np.ndarray, factor: float) -> np.ndarray:
    result = poses.copy()
    result[:, :3, 3] *= factor
    return result


def found_of(seen: Recording, factor: float, families: object = None) -> IdentificationResult:
    noise = pose_covariance(0.002 * factor, 0.01)
    return identify(larger(seen.parent, factor), larger(seen.child, factor), noise=noise, families=families)


@pytest.mark.parametrize("family", [*JOINTS])
def test_identify_is_invariant_to_millimetres(family: str) -> None:
    seen = recording(family, count=20, position=0.002, orientation=0.01, seed=3)
    assert found_of(seen, 1000.0).best.family == family


@pytest.mark.parametrize(
    "family",
    [
        "revolute",
        "screw",
        *(pytest.param(family, marks=pytest.mark.long) for family in ("prismatic", "planar")),
    ],
)
def test_lengths_of_a_fit_scale_with_the_poses(family: str) -> None:
    seen = recording(family, count=20, position=0.002, orientation=0.01, seed=3)
    small, factor = found_of(seen, LARGE), 40.0
    large = found_of(seen, factor * LARGE)
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
    random = np.random.default_rng(5)
    q = kv.position("q")
    boom = kv.compile([kv.translation(3, 1, 20) @ kv.rotation_z(q) @ kv.translation(40, 0, 0)])
    seen = noisy(boom.batch(np.linspace(0.0, 0.6, 25)[:, None])[0], 0.1, 0.02, random)
    found = identify(None, seen, noise=pose_covariance(0.1, 0.02))
    assert found.best.family == "revolute"
    assert not found.is_ambiguous
    assert np.linalg.norm(found.best.parameters["point"][:2] - [3, 1]) < 4 * found.best.deviation("point.x")
    one_by_one = Identifier(noise=pose_covariance(0.1, 0.02))
    for pose in seen:
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
    seen = noisy(true, 0.05, 0.02, random)
    families = ["rigid", "prismatic", "revolute", "planar", gate]
    found = identify(None, seen, noise=pose_covariance(0.05, 0.02), families=families)
    assert found.best.family == "gate"
    assert found.best.parameters["length"] == pytest.approx(17.0, abs=4 * found.best.deviation("length"))
    np.testing.assert_allclose(found.best.poses, true, atol=0.2)


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
        turn = Rotation.from_rotvec([0.0, 0.0, q])
        free = scale * rng.uniform(-1.0, 1.0, 3)
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


@pytest.mark.parametrize("kind", ["rigid", "prismatic", "revolute", "screw", "spherical", "planar"])
@pytest.mark.parametrize("scale", [1.0, 3000.0, pytest.param(1e5, marks=pytest.mark.long)])
@pytest.mark.parametrize("count", [10, pytest.param(80, marks=pytest.mark.long)])
def test_family_of_exact_poses_is_found_in_any_unit(kind: str, scale: float, count: int) -> None:
    """Millimetres, and a frame far away. The noise is none, and may not be taken for less than rounding."""
    poses = exact_poses(kind, scale, 10.0 * scale, count, seed=count)
    result = identify(None, poses)
    assert result.best.family == kind
    assert result.noise is not None
    assert result.noise.position < 2e-3 * max(scale, 5.0)


def test_noise_beyond_what_numbers_hold_is_no_bare_error() -> None:
    poses = exact_poses("revolute", 1e5, 1e6, 20, seed=1)
    for position in (1e-6, 1.0):
        assert identify(None, poses, noise=pose_covariance(position, 1e-6)).best.family == "revolute"
    assert identify(None, poses[:, :3, 3]).best.family in ("revolute", "spherical", "planar")
