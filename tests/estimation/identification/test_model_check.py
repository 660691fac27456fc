"""Residuals that refute the stated noise, and joints without limits."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import chi2, f
from synthetic_recordings import JOINTS, recording

import kineverse as kv
from kineverse.estimation import Identifier, identify, pose_covariance
from kineverse.estimation.identification.model_selection import chi_squared_tail, f_distribution_tail
from kineverse.lie import retract


@pytest.mark.parametrize(
    ("family", "rows"),
    [
        ("revolute", 6),
        ("prismatic", 3),
        pytest.param("prismatic", 6, marks=pytest.mark.long),
        pytest.param("revolute", 3, marks=pytest.mark.long),
    ],
)
def test_noise_stated_at_half_its_size_is_a_misfit(family: str, rows: int) -> None:
    data = recording(family, count=24, position=0.006, orientation=0.02, seed=1)
    child = data.child if rows == 6 else data.child[:, :3, 3]
    identified = identify(data.parent, child, noise=pose_covariance(0.003, 0.01))
    assert identified.is_ambiguous
    assert identified.best.family == family
    assert identified.misfit == pytest.approx(2.0, rel=0.3)
    assert "times the stated noise: either the noise is larger" in str(identified)
    # The deviations are those for the larger noise.
    right = identify(data.parent, child, noise=data.covariance)[family]
    assert identified.best.deviation("axis.x") == pytest.approx(right.deviation("axis.x"), rel=0.3)


def test_a_free_motion_by_a_noise_stated_too_small_is_ambiguous() -> None:
    data = recording("spherical", count=20, position=0.009, orientation=0.03, seed=2)
    identified = identify(data.parent, data.child, noise=pose_covariance(0.003, 0.01))
    assert identified.is_ambiguous
    assert "free" in str(identified)
    assert identified.best.family == "spherical"


def test_right_noise_is_no_misfit() -> None:
    misfits = []
    for seed in range(24):
        family = ("revolute", "prismatic", "screw", "rigid", "revolute", "prismatic")[seed % 6]
        data = recording(family, count=8 + seed % 9, position=0.01, orientation=0.03, seed=seed)
        child = data.child if seed % 3 else data.child[:, :3, 3]
        identified = identify(data.parent, child, noise=data.covariance)
        if seed % 3:  # positions cannot tell a hinge from a screw
            assert not identified.reason
        if not math.isnan(identified.misfit):
            misfits.append(identified.misfit)
    assert np.median(misfits) == pytest.approx(1.0, abs=0.1)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("family", ["planar", "spherical", "cylindrical", "free"])
def test_joints_with_several_values_are_sure_if_these_lie_on_no_curve(family: str) -> None:
    data = recording(family, count=16, position=0.004, orientation=0.015, seed=0)
    identified = identify(data.parent, data.child, noise=data.covariance)
    assert (identified.best.family, identified.is_ambiguous) == (family, False)


def test_outliers_are_no_misfit() -> None:
    data = recording("revolute", count=30, position=0.004, orientation=0.015, seed=3)
    child = data.child.copy()
    child[[4, 9, 22], :3, 3] += 0.4
    assert identify(data.parent, child, noise=data.covariance).is_ambiguous
    identified = identify(data.parent, child, noise=data.covariance, outliers=True)
    assert (identified.best.family, identified.is_ambiguous) == ("revolute", False)
    assert identified.misfit == pytest.approx(1.0, abs=0.2)


def test_identifier_says_a_misfit() -> None:
    data = recording("revolute", count=20, position=0.006, orientation=0.02, seed=4)
    identifier = Identifier(noise=pose_covariance(0.003, 0.01))
    for k, (a, b) in enumerate(zip(data.parent, data.child, strict=True), start=1):
        identifier.add(a, b)
        if k in (12, 20):
            assert identifier.result.is_ambiguous
    assert identifier.result.misfit == pytest.approx(2.0, rel=0.25)
    assert identifier.result.best.family == "revolute"


@pytest.mark.parametrize("family", JOINTS)
@pytest.mark.parametrize("rows", [6, 3], ids=["poses", "positions"])
def test_operation_without_limits_has_none(family: str, rows: int) -> None:
    data = recording(family, count=20, position=0.002, orientation=0.01, seed=5)
    child = data.child if rows == 6 else data.child[:, :3, 3]
    fit = identify(data.parent, child, noise=data.covariance, families=family).best
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("body", parent="world", transform=np.eye(4))
        edit.apply(fit.operation("joint", "body", "part", as_point=True, limits=False), tag="learned")
    joint = model.articulations["joint"]
    assert not [name for name in model.constraints if name.startswith("joint")]
    assert len(joint.home) == len(joint.coordinates)


@pytest.mark.parametrize("freedom", [1.0, 5.0, 40.0, 2000.0])
def test_tail_probabilities_agree_with_scipy(freedom: float) -> None:
    for quantile in (0.5, 0.01, 1e-4):
        assert chi_squared_tail(chi2.isf(quantile, freedom), freedom) == pytest.approx(quantile, rel=0.7)
        ratio = f.isf(quantile, freedom, 30.0)
        assert f_distribution_tail(ratio, freedom, 30.0) == pytest.approx(quantile, rel=0.5)


@pytest.mark.parametrize("lever", [0.0, 0.5])
@pytest.mark.parametrize("turn", [0.2, 2.0])
def test_an_exact_hinge_is_a_hinge_and_no_curve(lever: float, turn: float) -> None:
    """Exact poses of a joint are that joint for any assumed noise, also about the origin of its frame."""
    hinge = kv.rotation_z(kv.position("q")) @ kv.translation(lever, 0, 0)
    poses = np.stack([hinge({"q": q}) for q in np.linspace(0, turn, 12)])
    for noise in (None, pose_covariance(1e-4, 1e-3), pose_covariance(0.005, 0.02)):
        identified = identify(None, poses, noise=noise)
        assert identified.best.family == "revolute"
        assert not identified.is_ambiguous


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.long) for seed in (1, 2))])
def test_parts_that_are_swapped_in_half_of_the_recording_are_no_curve(seed: int) -> None:
    """The two motions are apart. Across the gap, a curve through both is a guess."""
    door = kv.translation(0.3, 0, 0.9) @ kv.rotation_z(kv.position("q")) @ kv.translation(0.6, 0, 0)
    rng = np.random.default_rng(seed)
    poses = np.stack([door({"q": q}) for q in rng.uniform(0.0, 1.2, 30)])
    swapped = rng.random(30) < 0.5
    poses[swapped] = np.linalg.inv(poses[swapped])
    poses = retract(poses, rng.normal(size=(30, 6)) * np.array([0.005] * 3 + [0.017] * 3))
    assert identify(None, poses, noise=pose_covariance(0.005, 0.017)).is_ambiguous
