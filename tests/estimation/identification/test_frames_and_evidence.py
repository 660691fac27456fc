"""Invariance of the evidence to the frames of the parts."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic_recordings import Array, Recording, angle_between, recording, transform

from kineverse.estimation import IdentificationResult, identify
from kineverse.lie import skew

# By how much differences of log evidence may change when frames are moved by half a metre: levers are within a
# metre of the child's origin, beforehand, and errors of orientations are small to first order only.
CHANGE = 1.0
# What is less probable than the best by this has no part in the verdict. A slider may be a hinge several metres
# away, and there it matters more what a metre is measured from.
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
    """Return poses of another frame in the same part, and what their errors are."""
    by = np.tile(np.eye(6), (len(poses), 1, 1))
    by[:, :3, 3:] = -skew(poses[:, :3, :3] @ frame[:3, 3])
    return poses @ frame, by @ covariance @ np.swapaxes(by, 1, 2)


def elsewhere(seen: Recording, of_parent: Array, of_child: Array) -> IdentificationResult:
    parent, parent_covariance = moved(seen.parent, seen.covariance, of_parent)
    child, child_covariance = moved(seen.child, seen.covariance, of_child)
    return identify(parent, child, parent_covariance=parent_covariance, child_covariance=child_covariance)


@pytest.mark.parametrize(("family", "radius"), CASES)
def test_evidence_does_not_depend_on_the_frames_of_the_parts(family: str, radius: float) -> None:
    seen = recording(family, count=20, position=0.01, orientation=0.02, seed=4, radius=radius)
    before = elsewhere(seen, np.eye(4), np.eye(4))
    assert before.best.family == family
    random = np.random.default_rng(7)
    for _ in range(2):
        after = elsewhere(seen, somewhere(random), somewhere(random))
        assert after.best.family == family
        for fit in before:
            behind = before.best.log_evidence - fit.log_evidence
            if behind < CHANCE:
                now = after[family].log_evidence - after[fit.family].log_evidence
                assert now == pytest.approx(behind, abs=CHANGE), fit.family


def test_a_hinge_through_the_childs_origin_is_not_taken_for_planar() -> None:
    """As every joint of a description has it: what slides by nothing in a plane has to say about which point."""
    seen = recording("revolute", count=40, position=0.01, orientation=0.02, seed=1, radius=0.0)
    found = identify(seen.parent, seen.child, noise=seen.covariance)
    assert found.best.family == "revolute"
    assert found["planar"].log_evidence < found["revolute"].log_evidence + 1.0


@pytest.mark.parametrize("family", ["planar", "free"])
def test_translations_of_a_fit_are_those_of_the_childs_origin(family: str) -> None:
    """Whichever point makes them probable: poses at joint values are those that were seen."""
    seen = recording(family, count=30, position=1e-3, orientation=1e-3, seed=2)
    fit = identify(seen.parent, seen.child, noise=seen.covariance)[family]
    assert fit.family == family
    slides = fit.motion.slides
    np.testing.assert_allclose(fit.motion.right[:slides, 3], 0.0, atol=1e-12)
    np.testing.assert_allclose(fit.poses, seen.true_relative, atol=0.012)
    np.testing.assert_allclose(fit.joint_values[:, :slides].mean(axis=0), 0.0, atol=1e-12)
    if family == "planar":
        assert angle_between(fit.parameters["normal"], seen.axis) < 0.01
        height = seen.left[:3, 2] @ (fit.parameters["reference"][:3, 3] - seen.true_relative[0, :3, 3])
        assert abs(height) < 4.0 * fit.deviation("child.z") + 1e-3
