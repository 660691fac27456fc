"""Length scale: cranes, and poses in millimetres."""

from __future__ import annotations

import math

import numpy as np
import pytest
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
