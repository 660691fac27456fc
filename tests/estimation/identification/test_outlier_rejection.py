"""Outlier rejection in identification."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic_recordings import Array, Recording, angle_between, recording, transform

from kineverse.errors import InvalidValueError
from kineverse.estimation import IdentificationResult, Identifier, Outliers, identify, pose_covariance

TOLD = ("revolute", "prismatic", "rigid", "screw")


def with_wrong(data: Recording, fraction: float, seed: int) -> tuple[Array, Array]:
    """Return poses of the child, some of them anywhere within two metres, and which."""
    random, count = np.random.default_rng(seed), round(fraction * len(data.child))
    wrong = np.sort(random.choice(len(data.child), count, replace=False))
    child = data.child.copy()
    anywhere = transform(Rotation.random(count, random_state=random), random.uniform(-1.0, 1.0, (count, 3)))
    child[wrong] = data.parent[wrong] @ anywhere
    return child, wrong


def record_joint(
    family: str, seed: int, count: int = 20, noise: tuple[float, float] = (0.01, 0.03)
) -> Recording:
    return recording(family, count=count, position=noise[0], orientation=noise[1], seed=seed)


# How many of so many recordings are typed right, at least: 97 % where a fifth is wrong.
CASES = [
    (0.2, 2, 8),
    *(pytest.param(*case, marks=pytest.mark.long) for case in ((0.05, 2, 8), (0.2, 3, 12), (0.4, 2, 7))),
]


@pytest.mark.parametrize(("fraction", "repeats", "least"), CASES)
def test_identify_with_outliers_agrees_with_the_inliers_alone(
    fraction: float, repeats: int, least: int
) -> None:
    right, off, off_without = 0, [], []
    for family in TOLD:
        for seed in range(repeats):
            data = record_joint(family, seed)
            child, wrong = with_wrong(data, fraction, seed + 100)
            identified = identify(data.parent, child, noise=data.covariance, outliers=True)
            right += identified.best.family == family
            fit = identified[family]
            if family != "rigid":
                good = np.setdiff1d(np.arange(20), wrong)
                without = identify(
                    data.parent[good], child[good], noise=data.covariance, families=[family]
                ).best
                off.append(angle_between(fit.parameters["axis"], data.axis))
                off_without.append(angle_between(without.parameters["axis"], data.axis))
    assert right >= least
    assert np.sqrt(np.mean(np.square(off))) < 1.3 * np.sqrt(np.mean(np.square(off_without)))


@pytest.mark.parametrize(
    "family",
    [
        "rigid",
        "prismatic",
        "revolute",
        "screw",
        *(pytest.param(family, marks=pytest.mark.long) for family in ("spherical", "free")),
    ],
)
def test_outliers_option_changes_nothing_without_outliers(family: str) -> None:
    data = record_joint(family, 3)
    before = identify(data.parent, data.child, noise=data.covariance)
    after = identify(data.parent, data.child, noise=data.covariance, outliers=True)
    assert after.best.family == before.best.family == family
    assert after.best.outliers == ()
    one, other = before[family], after[family]
    np.testing.assert_array_equal(one.covariance, other.covariance)
    np.testing.assert_array_equal(one.joint_values, other.joint_values)
    # All that were right is a little less probable than if they could not be wrong.
    assert other.log_evidence == pytest.approx(one.log_evidence + 20 * math.log(0.95))
    assert other.probability == pytest.approx(one.probability, abs=0.02)


def test_one_gross_error_makes_no_joint_of_a_part_at_rest() -> None:
    # A screw leads through any two poses: that of the part, and the wrong one.
    data = record_joint("rigid", 3, count=30)
    child, wrong = with_wrong(data, 1 / 30, 5)
    identified = identify(data.parent, child, noise=data.covariance, outliers=True)
    assert identified.best.family == "rigid"
    assert identified.best.outliers == tuple(wrong)


@pytest.fixture(scope="module")
def hinge() -> tuple[Recording, Array, Array, IdentificationResult]:
    data = record_joint("revolute", 1)
    child, wrong = with_wrong(data, 0.2, 7)
    return data, child, wrong, identify(data.parent, child, noise=data.covariance, outliers=True)


def test_outliers_are_listed_and_ignored(hinge) -> None:
    data, child, wrong, identified = hinge
    fit = identified.best
    assert fit.outliers == tuple(wrong)
    np.testing.assert_array_equal(fit.inliers, np.setdiff1d(np.arange(20), wrong))
    without = identify(data.parent[fit.inliers], child[fit.inliers], noise=data.covariance).best
    np.testing.assert_allclose(fit.range, without.range, atol=1e-3)
    np.testing.assert_allclose(fit.rms, without.rms, rtol=1e-3)
    np.testing.assert_allclose(fit.covariance, without.covariance, rtol=0.02, atol=1e-9)
    # An outlier has the nearest pose of the joint.
    assert fit.joint_values.shape == fit.deviations.shape == (20, 1)
    assert np.linalg.norm(fit.residuals[wrong], axis=1).min() > 0.2
    assert np.linalg.norm(fit.residuals[fit.inliers], axis=1).max() < 0.2
    assert (fit.deviations > 0.0).all()


def test_evidence_includes_the_density_of_the_outliers(hinge) -> None:
    data, child, _, identified = hinge
    fit = identified.best
    without = identify(data.parent[fit.inliers], child[fit.inliers], noise=data.covariance)
    usual = Outliers()
    joint_prior = 16 * math.log(1 - usual.fraction) + 4 * (
        math.log(usual.fraction) + usual.log_uniform_density
    )
    assert fit.log_evidence == pytest.approx(without["revolute"].log_evidence + joint_prior, abs=0.01)
    # A free joint explains everything; a rigid one with outliers almost everywhere is not allowed.
    assert identified["free"].outliers == identified["rigid"].outliers == ()
    assert identified["free"].log_evidence < fit.log_evidence - 100
    every_pose_an_inlier = identify(data.parent, child, noise=data.covariance)
    assert every_pose_an_inlier["free"].probability > 0.99 or every_pose_an_inlier.is_ambiguous


@pytest.mark.parametrize("family", ["revolute", "prismatic", "rigid"])
def test_outliers_among_positions_are_found(family: str) -> None:
    for seed in range(3):
        data = record_joint(family, seed, noise=(0.005, 0.03))
        child, wrong = with_wrong(data, 0.2, seed)
        points = (np.linalg.inv(data.parent) @ child)[:, :3, 3]
        points[:] = (np.linalg.inv(data.true_parent) @ child)[:, :3, 3]
        identified = identify(None, points, noise=pose_covariance(0.005, 0.03)[:3, :3], outliers=True)
        assert identified.best.family == family
        # Of a place anywhere one may happen to be on the joint.
        assert len(set(identified.best.outliers) ^ set(wrong)) <= 1


@pytest.mark.sampled(2)
@pytest.mark.parametrize("family", TOLD)
def test_outliers_are_found_with_unknown_noise(family: str) -> None:
    data = record_joint(family, 2)
    child, wrong = with_wrong(data, 0.2, 2)
    identified = identify(data.parent, child, outliers=True)
    assert identified.best.family == family
    assert identified.best.outliers == tuple(wrong)
    assert identified.noise == pytest.approx((0.01, 0.03), rel=0.5)


def test_outliers_are_found_in_millimetres() -> None:
    data = record_joint("revolute", 4)
    child, wrong = with_wrong(data, 0.2, 4)
    parent = data.parent.copy()
    for poses in (parent, child):
        poses[:, :3, 3] *= 1000.0
    for outliers in (True, Outliers(reach=2000.0)):
        identified = identify(parent, child, noise=pose_covariance(10.0, 0.03), outliers=outliers)
        assert (identified.best.family, identified.best.outliers) == ("revolute", tuple(wrong))


def test_half_of_the_observations_as_outliers_is_no_explanation() -> None:
    """Motion about four axes in turn is no hinge with mostly wrong observations."""
    several = [record_joint("revolute", seed, count=5) for seed in range(4)]
    parent, child = (np.concatenate([getattr(s, part) for s in several]) for part in ("parent", "child"))
    identified = identify(parent, child, noise=several[0].covariance, outliers=True)
    assert identified["revolute"].outliers == identified["rigid"].outliers == ()
    assert identified.best.family == "free"


def test_identifier_finds_outliers() -> None:
    data = record_joint("revolute", 5, count=30)
    child, wrong = with_wrong(data, 0.2, 5)
    identifier = Identifier(noise=data.covariance, outliers=True)
    for a, b in zip(data.parent, child, strict=True):
        identifier.add(a, b)
        if len(identifier) in (16, 23, 30):
            identified = identifier.result
            assert identified.best.family == "revolute"
    whole = identify(data.parent, child, noise=data.covariance, outliers=True).best
    assert identified.best.outliers == whole.outliers == tuple(wrong)
    assert angle_between(
        identified.best.parameters["axis"], whole.parameters["axis"]
    ) < 0.1 * whole.deviation("axis.x")


def test_invalid_outlier_models_are_refused() -> None:
    data = record_joint("rigid", 0)
    with pytest.raises(InvalidValueError, match="Outliers are True, False or Outliers"):
        identify(data.parent, data.child, noise=data.covariance, outliers=0.2)  # type: ignore[arg-type]
