"""Accuracy of identification: Cramér-Rao bound, covariance and evidence."""

from __future__ import annotations

import math

import numpy as np
import pytest
from cramer_rao_bounds import direction_bound
from synthetic_recordings import angle_between, noisy, off_axis, recording

from kineverse.estimation import Fit, identify, pose_covariance
from kineverse.estimation.identification.families import JOINT_FAMILIES, GroupMotion
from kineverse.estimation.identification.marginal_likelihood import PerObservation, fit_joint_ranges
from kineverse.estimation.identification.model_selection import solve_families
from kineverse.estimation.identification.observations import check_observations

REPEATS = 40

# Family, how far it goes, position noise [m], orientation noise [rad], and number of observations.
CLEAR = [
    ("revolute", math.pi / 2, 0.03, math.radians(3.0), 20),
    pytest.param(("revolute", math.pi / 4, 0.001, math.radians(1.0), 10), marks=pytest.mark.long),
    pytest.param(("prismatic", 0.4, 0.03, math.radians(3.0), 20), marks=pytest.mark.long),
    ("prismatic", 0.4, 0.001, math.radians(1.0), 10),
    # A lever and precise positions: the likelihood is a thin and curved valley.
    ("revolute", math.pi / 2, 0.001, math.radians(10.0), 20),
    pytest.param(("revolute", math.pi / 2, 0.001, math.radians(10.0), 40), marks=pytest.mark.long),
]
# Shorter than the noise of an observation.
SHORT = [
    ("prismatic", 0.15, 0.03, math.radians(5.0), 60),
    pytest.param(("prismatic", 0.15, 0.03, math.radians(5.0), 100), marks=pytest.mark.long),
]


def errors(family: str, extent: float, position: float, orientation: float, count: int) -> tuple:
    """Return true errors of the axis [rad], of its place [m], bounds of the first, and the fits."""
    truth = recording(
        family, count=count, position=position, orientation=orientation, seed=8, extent=extent, radius=0.4
    )
    random = np.random.default_rng(0)
    turned, shifted, fits = [], [], []
    for _ in range(REPEATS):
        parent = noisy(truth.true_parent, position, orientation, random)
        child = noisy(truth.true_parent @ truth.true_relative, position, orientation, random)
        fit = identify(parent, child, noise=truth.covariance, families=[family])[family]
        turned.append(angle_between(fit.parameters["axis"], truth.axis))
        if family == "revolute":
            shifted.append(off_axis(truth.point, truth.axis, fit.parameters["point"]))
        fits.append(fit)
    plain = direction_bound(truth, family)
    reachable = direction_bound(truth, family, width=float(np.std(truth.values)))
    return np.array(turned), np.array(shifted), plain, reachable, fits


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def stated(fits: list[Fit], coordinate: str) -> float:
    return rms(
        np.array([[fit.deviation(f"{coordinate}.x"), fit.deviation(f"{coordinate}.y")] for fit in fits])
    )


@pytest.mark.parametrize("case", CLEAR)
def test_errors_reach_the_bound_and_match_the_covariance(case: tuple) -> None:
    turned, shifted, plain, _, fits = errors(*case)
    # The root mean square of so many two-dimensional errors is known to 8 % or so.
    assert 0.8 * plain < rms(turned) < 1.2 * plain
    assert rms(turned) == pytest.approx(math.sqrt(2) * stated(fits, "axis"), rel=0.25)
    if len(shifted):
        assert rms(shifted) == pytest.approx(math.sqrt(2) * stated(fits, "point"), rel=0.25)


@pytest.mark.parametrize("case", SHORT)
def test_errors_of_short_motions_reach_the_attainable_bound(case: tuple) -> None:
    turned, _, plain, reachable, fits = errors(*case)
    assert reachable > 1.15 * plain  # which is why the plain bound says nothing here
    assert rms(turned) < 1.25 * reachable
    assert rms(turned) == pytest.approx(math.sqrt(2) * stated(fits, "axis"), rel=0.3)


def test_a_motion_within_the_noise_is_rigid_or_ambiguous() -> None:
    """A criterion that counts joint values as parameters would say something else, with ever more poses."""
    for seed in range(3):
        data = recording("rigid", count=80, position=0.03, orientation=0.05, seed=seed)
        result = identify(data.parent, data.child, noise=data.covariance)
        assert result["rigid"].probability > 0.5
        short = recording("prismatic", count=80, position=0.03, orientation=0.02, seed=seed, extent=0.004)
        result = identify(short.parent, short.child, noise=short.covariance)
        assert result.is_ambiguous or result.best.family in ("rigid", "prismatic")
        assert not result["prismatic"].is_determined


def test_families_are_distinguished() -> None:
    wrong = 0
    for seed in range(10):
        for family, extent in (("revolute", math.pi / 4), ("prismatic", 0.4)):
            data = recording(family, count=20, position=0.01, orientation=0.03, seed=seed, extent=extent)
            wrong += identify(data.parent, data.child, noise=data.covariance).best.family != family
    assert wrong == 0


def test_rigid_evidence_agrees_with_the_integral() -> None:
    """Positions of a child that does not move, of a world that is known: a Gaussian integral in each direction."""
    random = np.random.default_rng(0)
    count, sigma = 7, 0.02
    data, covariance = random.normal(0.3, sigma, (count, 3)), sigma**2 * np.eye(3)
    problem = check_observations(None, data, covariance, covariance)
    result = solve_families(problem, ["rigid"])["rigid"].log_evidence
    grid, expected = np.linspace(0.1, 0.5, 4001), 0.0
    for axis in range(3):
        off = (data[:, axis, None] - grid) / sigma
        density = np.exp(-0.5 * np.sum(off**2, axis=0)) / (math.sqrt(2 * math.pi) * sigma) ** count
        expected += math.log(np.trapezoid(density, grid))
    assert result == pytest.approx(expected, abs=1e-6)


def test_range_evidence_agrees_with_the_integral_over_the_width() -> None:
    values, noise = np.random.default_rng(1).normal(0.0, 0.1, 30), 0.05
    motion = GroupMotion(JOINT_FAMILIES["prismatic"], 6, np.eye(4), np.eye(4))
    result = fit_joint_ranges(motion, PerObservation(values[:, None], np.full((30, 1, 1), noise**2), 0.0))
    assert result.deviations[0] == pytest.approx(0.1, rel=0.4)
    about_the_mean = 30 / (result.deviations[0] ** 2 + noise**2)
    ours = result.log_density + 0.5 * math.log(2 * math.pi / about_the_mean)
    assert ours == pytest.approx(log_integral(values, noise), abs=0.1)


def log_integral(values: np.ndarray, noise: float) -> float:
    """Return log ∫∫ Π N(x; μ, s² + noise²) dμ d(log s)."""
    widths, means = np.geomspace(1e-5, 10.0, 400), np.linspace(-0.6, 0.6, 1201)
    total = widths[:, None, None] ** 2 + noise**2
    logs = -0.5 * ((values - means[:, None]) ** 2 / total + np.log(2 * math.pi * total)).sum(axis=-1)
    return float(np.log(np.mean(np.trapezoid(np.exp(logs), means, axis=1))))


def test_noise_is_estimated_without_a_stated_covariance() -> None:
    data = recording("revolute", count=60, position=0.02, orientation=math.radians(4.0), seed=3)
    result = identify(data.parent, data.child)
    assert result.best.family == "revolute"
    assert result.noise == pytest.approx((0.02, math.radians(4.0)), rel=0.35)
    known = identify(data.parent, data.child, noise=pose_covariance(0.02, math.radians(4.0)))
    assert result.best.deviation("axis.x") == pytest.approx(known.best.deviation("axis.x"), rel=0.4)
