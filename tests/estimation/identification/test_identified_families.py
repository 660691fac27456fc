"""Identification of every joint family, and the operations of the fits."""

from __future__ import annotations

import numpy as np
import pytest
from synthetic_recordings import JOINTS, noisy, recording

import kineverse as kv
from kineverse.estimation import identify, pose_covariance

COVARIANCE = pose_covariance(0.002, 0.01)


@pytest.mark.parametrize("family", [*JOINTS])
@pytest.mark.sampled(2)
def test_identify_selects_the_true_family(family: str) -> None:
    seen = recording(family, count=30, position=0.002, orientation=0.01, seed=3)
    found = identify(seen.parent, seen.child, noise=COVARIANCE)
    assert found.best.family == family
    assert found.best.probability > 0.9
    assert sum(fit.probability for fit in found) == pytest.approx(1.0)


@pytest.mark.parametrize("family", [*JOINTS])
@pytest.mark.sampled(2)
def test_operation_moves_as_its_fit(family: str) -> None:
    seen = recording(family, count=30, position=0.002, orientation=0.01, seed=4)
    fit = identify(seen.parent, seen.child, noise=COVARIANCE)[family]
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("body", parent="world", transform=np.eye(4))
        edit.apply(fit.operation("joint", parent="body", child="part"), tag="learned")
    joint = model.articulations["joint"]
    pose = model.fk("part", "body")
    home = dict(zip(joint.coordinates, joint.home, strict=True))
    np.testing.assert_allclose(pose(home), fit.parameters["reference"], atol=1e-9)
    if family in ("prismatic", "revolute", "screw", "cylindrical"):
        for k in (0, 7):
            values = dict(zip(joint.coordinates, fit.joint_values[k], strict=True))
            np.testing.assert_allclose(pose(values), fit.poses[k], atol=1e-9)
            assert not model.violations(values)


def test_fits_are_computed_once_and_sorted_by_probability() -> None:
    seen = recording("revolute", count=12, position=0.02, orientation=0.05, seed=5)
    found = identify(seen.parent, seen.child, noise=seen.covariance)
    assert [fit.family for fit in found] == [*found.probabilities]
    assert [fit.probability for fit in found] == sorted(found.probabilities.values(), reverse=True)
    assert found.best is found.fits[0] is found[found.best.family]
    assert len(found) == len(JOINTS) + 1  # and the curve


@pytest.mark.parametrize("pitch", [0.01, -0.03])
def test_a_screw_of_several_revolutions_is_identified(pitch: float) -> None:
    turn = kv.position("turn")
    nut = kv.translation(0.3, 0.1, 0.0) @ kv.translation(0, 0, pitch * turn) @ kv.rotation_z(turn)
    pose = kv.compile([nut @ kv.translation(0.1, 0.0, 0.0)])
    angles = np.linspace(0.0, 20.0, 60)
    true = pose.batch(angles[:, None])[0]
    seen = noisy(true, 0.002, 0.01, np.random.default_rng(0))
    found = identify(None, seen[np.random.default_rng(1).permutation(60)], noise=COVARIANCE)
    assert found.best.family == "screw"
    assert found.best.parameters["pitch"] == pytest.approx(2 * np.pi * pitch, rel=0.05)
    assert np.ptp(found.best.joint_values) == pytest.approx(20.0, abs=0.1)
