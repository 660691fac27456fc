"""Sequential test by an e-process with Ville's bound.

If the joint is as served, ρ of each observation is standard normal. The alternatives are:

- the joint, or the child on it, is displaced: ρ = G δ + noise with an unknown δ, Gaussian with some size;
- nothing constrains the child: ρ is normal with a larger deviation;
- joint values exceed their limits, or contradict other estimates, by z standard deviations: the gain
  exp(λ z - λ²/2) has the mean 1 at a limit, and less inside.

Each alternative may begin at any observation j, with the prior weight 1/(j (j+1)). M is the ratio of the
density of all observations under the mixture of alternatives to that under the served joint. If the joint is
as served, M is a supermartingale that begins at 1, for any joint values. By Ville's inequality, the
probability that M ever reaches 1/α is then at most α, for any number of observations. This holds to first
order, as poses are linearised around the best joint values.

Observations may be outliers of unknown distribution, each with the probability ε. So the gain L of an
alternative by one observation is cut off at some c. For any distribution of the outliers

    E[min(L, c)] <= (1 - ε) + ε c

and min(L, c) divided by this bound is a fair bet again (Huber's censored ratio). A small c costs little per
observation and detects small deviations slowly; a large c detects gross ones at once. The capital is split
among several c.
"""

from __future__ import annotations

import math

import numpy as np

from kineverse.estimation.robust import CHI_SQUARED_6
from kineverse.lie import Array

from .known_residuals import SIZES

_DEVIATIONS = np.array([1.0, 3.0, 10.0, 30.0, 100.0])
_SLOPES = np.array([2.0, 5.0])
# Fraction of the capital bet on each observation: against a permanent and an occasional deviation.
_STAKES = np.array([1.0 - 1e-9, 0.1])
# Upper bounds on the gain by one observation, if there are outliers.
_CUTS = np.array([1.5, 4.0, 20.0])
# Number of change points of a displacement; dropping some only reduces M.
_MOST_CHANGE_POINTS = 12


class SequentialTest:
    """Sequential test of one joint.

    Parameters
    ----------
    false_alarms
        Probability α of ever rejecting a joint that is as served.
    outlier_fraction
        Probability ε of an outlier.

    Attributes
    ----------
    count
        Number of observations so far.
    implausible_since
        Most likely change point: the first observation, from 0, that the joint does not explain; None before
        rejection. A rejection is final.
    detected_at
        Observation at which the joint was rejected.
    """

    def __init__(self, false_alarms: float, outlier_fraction: float = 0.0) -> None:
        self._threshold = -math.log(false_alarms)
        self._bet = _CensoredBet(outlier_fraction)
        self.count = 0
        self.implausible_since: int | None = None
        self.detected_at: int | None = None
        self._displacement = _DisplacementTest(self._bet)
        self._unconstrained = _ChangePoints(len(_DEVIATIONS), self._bet)
        self._beyond = _ChangePoints(0, self._bet)

    def add(self, orthogonal: Array, displacement_jacobian: Array, one_sided: Array) -> float:
        """Add one observation; return log M.

        Parameters
        ----------
        orthogonal, displacement_jacobian, one_sided
            Row of a :class:`.known_residuals.KnownResiduals`; NaN is ignored.
        """
        self.count += 1
        weight = -math.log(self.count * (self.count + 1.0))
        if self.count == 1:
            self._limited = np.logical_not(np.isneginf(one_sided))
            self._beyond = _ChangePoints(int(self._limited.sum()) * len(_SLOPES), self._bet)
        parts: list[tuple[float, float, int]] = []
        if len(orthogonal):
            parts.append(
                (0.5, *self._displacement.add(weight, self.count - 1, orthogonal, displacement_jacobian))
            )
            squares = float(orthogonal @ orthogonal)
            grown = 1.0 + _DEVIATIONS**2
            log = -0.5 * len(orthogonal) * np.log(grown) + 0.5 * squares * (1.0 - 1.0 / grown)
            parts.append((0.3, *self._unconstrained.add(weight, self.count - 1, log)))
        if self._limited.any():
            z = np.maximum(one_sided[self._limited], -1e3)
            log = np.nan_to_num(_SLOPES[:, None] * z - 0.5 * _SLOPES[:, None] ** 2, nan=0.0).ravel()
            parts.append((0.2, *self._beyond.add(weight, self.count - 1, log)))
        if not parts:
            return 0.0
        total = sum(p for p, _, _ in parts)
        logs = [math.log(p / total) + log for p, log, _ in parts]
        # The prior weight 1/(n + 1) belongs to change points still to come.
        ratio = float(np.logaddexp.reduce([*logs, -math.log(self.count + 1.0)]))
        if self.implausible_since is None and ratio >= self._threshold:
            self.detected_at = self.count - 1
            self.implausible_since = parts[int(np.argmax(logs))][2]
        return ratio


class _CensoredBet:
    """Gain by one observation, censored for outliers."""

    def __init__(self, outlier_fraction: float) -> None:
        self.robust = outlier_fraction > 0.0
        self._cuts = np.log(_CUTS) if self.robust else np.array([np.inf])
        self._price = np.log1p(outlier_fraction * (_CUTS - 1.0)) if self.robust else np.zeros(1)
        self._stakes = _STAKES if self.robust else np.ones(1)
        self.cuts = len(self._cuts)
        self.shape = len(self._stakes), self.cuts

    def gains(self, log: Array) -> Array:
        """Return the log gain for each cut, (..., cuts), of log density ratios."""
        gains: Array = np.minimum(log[..., None], self._cuts) - self._price
        return gains

    def stake(self, log: Array) -> Array:
        """Return the log gain for each stake and cut, (..., stakes, cuts)."""
        with np.errstate(divide="ignore"):
            kept = np.log1p(-self._stakes)
        return self.gains(np.logaddexp(kept, np.log(self._stakes) + log[..., None]))


class _ChangePoints:
    """Alternatives with independent observations; all change points are summed exactly."""

    def __init__(self, count: int, bet: _CensoredBet) -> None:
        self._bet = bet
        shape = (count, *bet.shape)
        self._logs = np.full(shape, -np.inf)
        self._best = np.full(shape, -np.inf)
        self._start = np.zeros(shape, dtype=int)

    def add(self, weight: float, index: int, log: Array) -> tuple[float, int]:
        """Return the log of the mixture over all, and the most likely change point."""
        gains = self._bet.stake(log)
        self._logs = np.logaddexp(self._logs, weight) + gains
        newer = self._best < weight
        self._start[newer] = index
        self._best = np.maximum(self._best, weight) + gains
        mean = float(np.logaddexp.reduce(self._logs, axis=None)) - math.log(gains.size)
        return mean, int(self._start.flat[np.argmax(self._best)])


class _DisplacementTest:
    """Displacements δ ~ N(0, s² I) for several sizes s, each with several change points."""

    def __init__(self, bet: _CensoredBet) -> None:
        self._bet = bet
        self._starts = np.zeros(0, dtype=int)
        self._logs = np.zeros((0, len(SIZES), bet.cuts))
        self._means = np.zeros((0, len(SIZES), 12))
        self._covariances = np.zeros((0, len(SIZES), 12, 12))

    def add(
        self, weight: float, index: int, orthogonal: Array, displacement_jacobian: Array
    ) -> tuple[float, int]:
        """Return the log of the mixture over sizes and change points, and the most likely change point."""
        sizes = len(SIZES)
        self._starts = np.append(self._starts, index)
        self._logs = np.concatenate([self._logs, np.full((1, sizes, self._bet.cuts), weight)])
        self._means = np.concatenate([self._means, np.zeros((1, sizes, 12))])
        prior = np.square(SIZES)[:, None, None] * np.eye(12)
        self._covariances = np.concatenate([self._covariances, prior[None]])
        error = orthogonal - self._means @ displacement_jacobian.T
        cross_covariance = self._covariances @ displacement_jacobian.T
        spread = displacement_jacobian @ cross_covariance + np.eye(len(orthogonal))
        gain = np.swapaxes(np.linalg.solve(spread, np.swapaxes(cross_covariance, 2, 3)), 2, 3)
        solved = np.linalg.solve(spread, error[..., None])[..., 0]
        squares = np.sum(error * solved, axis=2)
        ratio = 0.5 * (orthogonal @ orthogonal - squares) - 0.5 * np.linalg.slogdet(spread)[1]
        self._logs += self._bet.gains(ratio)
        if self._bet.robust:
            gain[squares > CHI_SQUARED_6] = 0.0
        self._means += (gain @ error[..., None])[..., 0]
        self._covariances -= gain @ np.swapaxes(cross_covariance, 2, 3)
        result = float(np.logaddexp.reduce(self._logs, axis=None)) - math.log(sizes * self._bet.cuts)
        leading = self._logs.max(axis=(1, 2))
        best = int(self._starts[np.argmax(leading)])
        if len(self._starts) > _MOST_CHANGE_POINTS:
            # Keep the newest ones, which have little evidence yet.
            older = np.argsort(-leading[:-3])[: _MOST_CHANGE_POINTS - 3]
            kept = np.sort(np.append(older, np.arange(len(self._starts) - 3, len(self._starts))))
            self._starts, self._logs = self._starts[kept], self._logs[kept]
            self._means, self._covariances = self._means[kept], self._covariances[kept]
        return result, best
