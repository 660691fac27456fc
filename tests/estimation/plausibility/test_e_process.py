"""False alarm rate, densities, and agreement of the monitor with the batch check."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from observed_frames import NOISE, observe_frames, shift_origin
from scipy import integrate, stats

import kineverse as kv
from kineverse.estimation import PlausibilityMonitor, check_plausibility, identify, pose_covariance
from kineverse.estimation.identification.marginal_likelihood import GRID
from kineverse.estimation.identification.observations import check_observations
from kineverse.estimation.plausibility.alternatives import log_displacement_gain, log_evidence
from kineverse.estimation.plausibility.e_process import SequentialTest
from kineverse.estimation.plausibility.residuals import SIZES, KnownJoint, KnownResiduals, compute_residuals

DOOR, TAG = "kitchen/fridge_door", "joint kitchen/fridge_door"
HANDLE, FRIDGE = "kitchen/fridge_door_handle", "kitchen/fridge"
RUNS, LONG = 30, 40


@pytest.fixture(scope="module")
def kitchen() -> kv.Model:
    return kv.load("kitchen")


@pytest.fixture(scope="module")
def resting(kitchen: kv.Model) -> KnownResiduals:
    # A door that moves at random and often rests at its limits, in a long series of noisy observations.
    angles = np.clip(np.cumsum(np.random.default_rng(0).normal(0.0, 0.3, RUNS * LONG)) % 4.0 - 1.0, 0.0, 1.57)
    poses = observe_frames(kitchen, [HANDLE, FRIDGE], {DOOR: angles}, 1)
    return compute_residuals(
        KnownJoint(kitchen, HANDLE, FRIDGE), check_observations(poses[FRIDGE], poses[HANDLE], NOISE, NOISE)
    )


@pytest.mark.parametrize(("wrong", "stated_wrong"), [(0.0, 0.0), (0.05, 0.05), (0.1, 0.05), (0.2, 0.05)])
def test_false_alarm_rate_is_bounded(resting: KnownResiduals, wrong: float, stated_wrong: float) -> None:
    left = resting
    squares = np.sum(left.orthogonal**2, axis=1)
    assert left.orthogonal.shape == (RUNS * LONG, 5)
    assert stats.kstest(squares, stats.chi2(5).cdf).pvalue > 0.01

    # Outliers are constant, which looks most like a change of the joint.
    corrupt = np.random.default_rng(9).uniform(size=RUNS * LONG) < wrong
    wrong_by = {
        name: np.where(corrupt[:, None], 40.0, getattr(left, name)) for name in ("orthogonal", "bound_excess")
    }
    left = replace(left, **wrong_by)
    stated, alarms = 0.2, 0
    for run in range(RUNS):
        test = SequentialTest(stated, stated_wrong)
        for k in range(run * LONG, (run + 1) * LONG):
            test.observe(left, k, k, 1.0)
        alarms += test.implausible_since is not None
    assert alarms <= stats.binom(RUNS, stated).ppf(0.99)


def test_evidence_ratio_has_mean_one() -> None:
    # E[M] = 1 after one observation for any Jacobian, which is the condition of Ville's inequality.
    displacement_jacobian = np.random.default_rng(2).normal(size=(1, 12))
    grid = np.sinh(np.linspace(-7.5, 7.5, 501))
    nothing, unlimited = np.zeros((0, 12)), np.full(2, -np.inf)
    for rows in (
        [(np.array([x]), displacement_jacobian, unlimited) for x in grid],
        [(np.zeros(0), nothing, np.array([-np.inf, x])) for x in grid],
    ):
        logs = np.array([SequentialTest(1e-300).add(*row) for row in rows]) + stats.norm.logpdf(grid)
        assert integrate.trapezoid(np.exp(logs), grid) == pytest.approx(1.0, abs=1e-3)
        # With outliers of any distribution, four times as many as stated, the mean is at most 1.
        won = np.array([SequentialTest(1e-300, outlier_fraction=0.05).add(*row) for row in rows])
        mean = integrate.trapezoid(np.exp(won + stats.norm.logpdf(grid)), grid)
        assert 0.8 < 0.8 * mean + 0.2 * np.exp(won.max()) < 1.0 + 1e-3


def test_small_displacement_is_detected_with_its_change_point() -> None:
    random = np.random.default_rng(3)
    displacement_jacobian = np.concatenate([np.eye(5), np.zeros((5, 7))], axis=1) / 0.02
    noticed, beginnings = [], []
    for _ in range(9):
        test = SequentialTest(1e-3)
        for k in range(160):
            shift = displacement_jacobian[:, 0] * 0.02 * (k >= 60)
            test.add(random.normal(size=5) + shift, displacement_jacobian, np.full(2, -np.inf))
            if test.implausible_since is not None:
                break
        assert test.implausible_since is not None
        noticed.append(k)
        beginnings.append(test.implausible_since)
    assert np.median(beginnings) == pytest.approx(60, abs=4)
    assert np.median(noticed) < 100


def test_joint_is_known_with_a_covariance() -> None:
    """A joint that is displaced within its covariance raises no alarm, and later displacements do."""
    random, covariance = np.random.default_rng(5), 0.02**2 * np.eye(12)
    unlimited, alarms, exact_alarms, noticed = np.full(2, -np.inf), 0, 0, 0
    for _ in range(12):
        known, exact = SequentialTest(0.1, 0.05, covariance), SequentialTest(0.1, 0.05)
        displaced = random.multivariate_normal(np.zeros(12), covariance)
        for k in range(160):
            if k == 120:
                alarms += known.implausible_since is not None
                exact_alarms += exact.implausible_since is not None
                displaced = displaced + random.normal(0.0, 0.05, 12)
            jacobian = random.normal(size=(5, 12)) / 0.02
            residual = jacobian @ displaced + random.normal(size=5)
            for test in (known, exact):
                test.add(residual, jacobian, unlimited)
        noticed += known.implausible_since is not None
    assert alarms <= 3
    assert exact_alarms == noticed == 12


def make_bounded_slider(upper: float) -> tuple[kv.Model, KnownJoint]:
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Prismatic(name="s", parent="world", child="s", axis=(1, 0, 0), lower=0, upper=upper))
    return model, KnownJoint(model, "s", "world")


def test_log_evidence_equals_the_integral_over_joint_values() -> None:
    _, served = make_bounded_slider(2.0)
    noise, poses = pose_covariance(0.05, 0.1), np.tile(np.eye(4), (2, 1, 1))
    poses[:, :3, 3] = [[0.7, 0.03, 0.0], [1.1, -0.02, 0.05]]
    result = log_evidence(served, compute_residuals(served, check_observations(None, poses, None, noise)))

    across = stats.norm(0.0, 0.05).logpdf(poses[:, 1:3, 3]).sum() + 6 * stats.norm(0.0, 0.1).logpdf(0.0)
    values = np.linspace(0.0, 2.0, 401)
    likelihood = stats.norm(values[:, None], 0.05).pdf(poses[:, 0, 3])
    total = 0.0
    for width in GRID:
        if width < 0.01:
            # Narrower than grid and noise: both values equal the mean.
            total += integrate.trapezoid(likelihood.prod(axis=1), values) / 2.0 / len(GRID)
            continue
        prior = stats.norm(values[:, None], width).pdf(values)
        prior /= integrate.trapezoid(prior, values, axis=1)[:, None]
        each = integrate.trapezoid(prior[:, :, None] * likelihood, values, axis=1)
        total += integrate.trapezoid(each.prod(axis=1), values) / 2.0 / len(GRID)
    # Laplace's method integrates the mean to some percent.
    assert result == pytest.approx(across + np.log(total), abs=0.1)


def test_log_displacement_gain_equals_a_normal_density(resting: KnownResiduals) -> None:
    few = resting.select(slice(7))
    displacement_jacobian, rho = few.displacement_jacobian.reshape(-1, 12), few.orthogonal.ravel()
    apart = [
        stats.multivariate_normal(
            cov=np.eye(len(rho)) + s**2 * displacement_jacobian @ displacement_jacobian.T
        ).logpdf(rho)
        for s in SIZES
    ]
    expected = np.logaddexp.reduce(apart) - np.log(len(SIZES)) - stats.norm.logpdf(rho).sum()
    sizes = [s**2 * np.eye(12) for s in SIZES]
    assert log_displacement_gain(few, sizes) == pytest.approx(expected, abs=1e-6)


def test_densities_compare_with_those_of_identification() -> None:
    # With many poses the evidence of a rigid connection is its likelihood times the posterior volume.
    random, poses = np.random.default_rng(4), np.tile(np.eye(4), (200, 1, 1))
    poses[:, :3, 3] = random.normal(0.0, 0.01, (200, 3))
    noise = pose_covariance(0.01, 0.02)
    fit = identify(None, poses, noise=noise, families=["rigid"]).best
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(fit.operation("part", "world"))
    served = KnownJoint(model, "part", "world")
    there = log_evidence(served, compute_residuals(served, check_observations(None, poses, None, noise)))
    volume = 0.5 * np.linalg.slogdet(2.0 * np.pi * noise / 200)[1]
    assert fit.log_evidence == pytest.approx(there + volume, abs=0.01)


def test_monitor_agrees_with_check_plausibility(kitchen: kv.Model) -> None:
    truth = kitchen.copy()
    joint = truth.history.operation(TAG)
    assert isinstance(joint, kv.Revolute)
    with truth.edit() as edit:
        sliding = kv.Prismatic(name=DOOR, parent=joint.parent, child=joint.child, origin=joint.origin)
        edit.replace(TAG, sliding)
    frames, angles = [HANDLE, FRIDGE], np.random.default_rng(0).uniform(0.0, 0.4, 40)
    before, after = (
        observe_frames(model, frames, {DOOR: values}, 5 + k)
        for k, (model, values) in enumerate(((kitchen, angles[:20]), (truth, angles[20:])))
    )
    poses = {frame: np.concatenate([before[frame], after[frame]]) for frame in frames}
    served = kitchen.copy()
    monitor = PlausibilityMonitor(served, frames, noise=NOISE, families=["prismatic", "revolute", "free"])
    add_consistency = [monitor.update({frame: poses[frame][k] for frame in frames}) for k in range(40)]
    assert [tags for tags in add_consistency if tags] == [(TAG,)]
    whole = check_plausibility(served, poses, noise=NOISE, families=["prismatic", "revolute", "free"])
    assert monitor.implausible_since == {TAG: whole[TAG].implausible_since}
    report = monitor.report()
    assert report[TAG].probabilities == pytest.approx(whole[TAG].probabilities, abs=1e-6)

    assert report.repair(served) == (TAG,)
    for k in range(20, 40):
        assert monitor.update({frame: poses[frame][k] for frame in frames}) == ()
    assert monitor.implausible_since == {}
    assert monitor.report()["joint kitchen/fridge_joint"].count == 60


def test_repaired_joint_is_tested_with_the_covariance_of_its_fit(kitchen: kv.Model) -> None:
    """Nine observations of a small motion leave the axis uncertain, and the rest of the motion shows it."""
    truth = kitchen.copy()
    joint = truth.history.operation(TAG)
    assert isinstance(joint, kv.Revolute)
    with truth.edit() as edit:
        edit.replace(TAG, replace(joint, origin=shift_origin(joint, y=0.06)))
    angles = np.concatenate([np.linspace(0.3, 0.8, 24), np.random.default_rng(2).uniform(0.0, 1.5, 80)])
    poses = observe_frames(truth, [HANDLE], {DOOR: angles}, 8)[HANDLE]
    served, options = kitchen.copy(), {"noise": NOISE, "families": ["revolute", "free"]}
    report = check_plausibility(served, {HANDLE: poses[:24]}, **options)
    monitor = PlausibilityMonitor(served, [HANDLE], **options)
    for pose in poses[:24]:
        monitor.update({HANDLE: pose})
    assert monitor.report().repair(served) == (TAG,)
    later, exact = (
        PlausibilityMonitor(served, [HANDLE], repaired=known, **options) for known in (report, ())
    )
    for pose in poses[24:]:
        for each in (monitor, later, exact):
            each.update({HANDLE: pose})
    assert monitor.implausible_since == later.implausible_since == {}
    assert list(exact.implausible_since) == [TAG]
    after = {HANDLE: poses[24:]}
    assert check_plausibility(served, after, repaired=report, **options)[TAG].explains
    assert check_plausibility(served, after, **options).implausible
    # A displacement after the repair is noticed.
    moved = poses[24:].copy()
    moved[:, 1, 3] += 0.05
    for pose in moved:
        monitor.update({HANDLE: pose})
    assert list(monitor.implausible_since) == [TAG]


def test_monitor_window_and_refusals(kitchen: kv.Model) -> None:
    frames = [HANDLE, FRIDGE]
    monitor = PlausibilityMonitor(kitchen, frames, noise=NOISE, keep=5, families=["revolute", "free"])
    assert monitor.report()[TAG].verdict == "cannot tell"
    poses = observe_frames(kitchen, frames, {DOOR: np.linspace(0.0, 1.5, 12)}, 7)
    for k in range(10):
        monitor.update({HANDLE: poses[HANDLE][k], FRIDGE: (poses[FRIDGE][k], NOISE)})
    monitor.update({HANDLE: poses[HANDLE][10]})
    assert monitor.count == 11
    assert monitor.report()[TAG].count == 4
    for observation, error in (
        ({"kitchen/oven_door": np.eye(4)}, kv.errors.UnknownNameError),
        ({HANDLE: np.eye(3)}, kv.errors.ShapeError),
        ({HANDLE: "there"}, kv.errors.ShapeError),
        ({HANDLE: 2.0 * np.eye(4)}, kv.errors.InvalidValueError),
        ({HANDLE: (np.eye(4), np.zeros((6, 6)))}, kv.errors.InvalidValueError),
    ):
        with pytest.raises(error):
            monitor.update(observation)  # type: ignore[arg-type]
    assert monitor.count == 11
    with pytest.raises(kv.errors.UnknownNameError):
        PlausibilityMonitor(kitchen, ["nowhere"])
