"""Sequential test by an e-process with Ville's bound.

If the joint is as served, ρ of each observation is standard normal. The alternatives are:

- the joint, or the child on it, is displaced: ρ = G δ + noise with an unknown δ, Gaussian with some size;
- nothing constrains the child: ρ is normal with a larger deviation;
- joint values exceed their limits, or contradict other estimates, by z standard deviations: the gain
  exp(λ z - λ²/2) has the mean 1 at a limit, and less inside.

A joint that was identified is known up to a displacement δ ~ N(0, Σ) with the covariance of its fit. Then the
density of the served joint is the mixture over δ, and a displaced joint begins with what is known of δ. The
bound holds on average over δ.

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
among several c. ε is the share of gross errors so far, between the stated one and four times as much. It
begins at the largest.

If errors are correlated and m observations are worth an independent one, see
:mod:`kineverse.estimation.correlation`, L is replaced by L^(1/m). By Hölder's inequality E[Π L_i^(1/m)] <= Π
E[L_i]^(1/m) <= 1 for m observations of any dependence. The prior weights of change points then count
independent observations.
"""

from __future__ import annotations

import math

import numpy as np

from kineverse.estimation.noise import CHI_SQUARED_6
from kineverse.lie import Array

from .residuals import SIZES, KnownResiduals

_DEVIATIONS = np.array([1.0, 3.0, 10.0, 30.0, 100.0])
_LOG_GROWN = 0.5 * np.log(1.0 + _DEVIATIONS**2)
_HALF_SHRUNK = 0.5 * (1.0 - 1.0 / (1.0 + _DEVIATIONS**2))
_SLOPES = np.array([2.0, 5.0])
# Fraction of the capital bet on each observation: against a permanent and an occasional deviation.
_STAKES = np.array([1.0 - 1e-9, 0.1])
_CUTS = np.array([1.1, 1.5, 4.0, 20.0])  # upper bounds on the gain by one observation, if there are outliers
# Largest share of outliers relative to the stated one, the number of observations that it is worth at the
# beginning, and the number after which the past is forgotten.
_MOST, _AT_FIRST, _MEMORY = 4.0, 5.0, 1000.0
_GROSS = 64.0  # square of a residual from which on it counts as an outlier: eight standard deviations
# Number of change points of a displacement, and of the newest ones, which have little evidence yet. Dropping
# some only reduces M.
_CHANGE_POINTS, _NEWEST = 6, 2
_LEAST_WEIGHT = 0.1  # least weight of a tested observation, in independent ones


class SequentialTest:
    """Sequential test of one joint, which may be known up to a displacement with a covariance (12, 12)."""

    def __init__(
        self, false_alarms: float, outlier_fraction: float = 0.0, displacement: Array | None = None
    ) -> None:
        self._threshold = -math.log(false_alarms)
        self._bet = _CensoredBet(outlier_fraction)
        # Number of independent looks so far, which orders the change points, and of those not tested yet.
        self._time, self._owed = 0.0, 0.0
        self._numbers: list[int] = []
        self.implausible_since: int | None = None
        self._displacement = _DisplacementTest(self._bet, displacement)
        self._unconstrained = _ChangePoints(len(_DEVIATIONS), self._bet)
        self._beyond = _ChangePoints(0, self._bet)

    def observe(self, residuals: KnownResiduals, row: int, number: int, looks: float) -> None:
        """Take a row as the observation with a number; of correlated ones, some are tested for all."""
        if self.implausible_since is not None:
            return
        observed = residuals.orthogonal[row], residuals.displacement_jacobian[row]
        self._owed += 1.0 / looks
        if self._owed >= _LEAST_WEIGHT or not self._numbers:
            self.add(*observed, residuals.one_sided[row], 1.0 / min(self._owed, 1.0), number)
            self._owed = 0.0
        self._bet.count(self._displacement.served_square(*observed) > _GROSS)

    def add(
        self,
        orthogonal: Array,
        displacement_jacobian: Array,
        one_sided: Array,
        looks: float = 1.0,
        number: int | None = None,
    ) -> float:
        """Add one observation; return log M."""
        index = len(self._numbers)
        self._numbers.append(index if number is None else number)
        time = self._time + 1.0 / looks if index else 1.0
        weight = math.log((time - self._time) / ((1.0 + self._time) * (1.0 + time)))
        self._time = time
        if index == 0:
            self._limited = np.logical_not(np.isneginf(one_sided))
            self._beyond = _ChangePoints(int(self._limited.sum()) * len(_SLOPES), self._bet)
        parts: list[tuple[float, float, int]] = []
        if len(orthogonal):
            served, displaced, since = self._displacement.add(
                weight, index, orthogonal, displacement_jacobian, looks
            )
            log = _HALF_SHRUNK * float(orthogonal @ orthogonal) - len(orthogonal) * _LOG_GROWN
            unconstrained = self._unconstrained.add(weight, index, log / looks - served)
            parts += [(0.5, displaced, since), (0.3, *unconstrained)]
        if self._limited.any():
            z = np.maximum(one_sided[self._limited], -1e3)
            log = np.nan_to_num(_SLOPES[:, None] * z - 0.5 * _SLOPES[:, None] ** 2, nan=0.0).ravel()
            parts.append((0.2, *self._beyond.add(weight, index, log / looks)))
        if not parts:
            return 0.0
        total = sum(p for p, _, _ in parts)
        logs = [math.log(p / total) + log for p, log, _ in parts]
        # The rest of the prior weight belongs to change points still to come.
        ratio = float(np.logaddexp.reduce([*logs, -math.log(1.0 + time)]))
        if self.implausible_since is None and ratio >= self._threshold:
            self.implausible_since = self._numbers[parts[int(np.argmax(logs))][2]]
        return ratio


class _CensoredBet:
    """Gain by one observation, censored for outliers, whose share is learned."""

    def __init__(self, outlier_fraction: float) -> None:
        self.robust = outlier_fraction > 0.0
        self._least, self._most = outlier_fraction, min(_MOST * outlier_fraction, 1.0)
        self._seen, self._outliers = _AT_FIRST, _AT_FIRST * self._most
        self._set_price()
        self._cuts = np.log(_CUTS) if self.robust else np.array([np.inf])
        stakes = _STAKES if self.robust else np.ones(1)
        with np.errstate(divide="ignore"):
            self._kept, self._staked = np.log1p(-stakes), np.log(stakes)
        self.cuts = len(self._cuts)
        self.shape = len(stakes), self.cuts

    def count(self, is_outlier: bool) -> None:
        """Count an observation, and forget old ones."""
        kept = 1.0 - 1.0 / _MEMORY
        self._seen, self._outliers = kept * self._seen + 1.0, kept * self._outliers + is_outlier
        self._set_price()

    def _set_price(self) -> None:
        share = min(max(self._outliers / self._seen, self._least), self._most)
        self._price = np.log1p(share * (_CUTS - 1.0)) if self.robust else np.zeros(1)

    def gains(self, log: Array) -> Array:
        """Return the log gain for each cut, (..., cuts), of log density ratios."""
        return np.asarray(np.minimum(log[..., None], self._cuts) - self._price)

    def stake(self, log: Array) -> Array:
        """Return the log gain for each stake and cut, (..., stakes, cuts)."""
        return self.gains(np.logaddexp(self._kept, self._staked + log[..., None]))


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
        highest = float(self._logs.max())
        mean = highest + math.log(float(np.exp(self._logs - highest).mean()))
        return mean, int(self._start.flat[np.argmax(self._best)])


class _DisplacementTest:
    """Kalman filters of displacements δ: of the served joint, and larger ones since several change points.

    A displacement that begins adds N(0, s² I), with several sizes s. The first filter is the served joint's.
    """

    def __init__(self, bet: _CensoredBet, served: Array | None) -> None:
        self._bet = bet
        self._starts = np.full(_CHANGE_POINTS, -1)
        self._logs = np.full((_CHANGE_POINTS, len(SIZES), bet.cuts), -np.inf)
        self._prior = np.square(SIZES)[:, None, None] * np.eye(12)
        self._means = np.zeros((1 + _CHANGE_POINTS * len(SIZES), 12))
        self._is_exact = served is None
        none = np.zeros((1, 12, 12)) if served is None else served[None]
        self._covariances = np.concatenate([none, np.tile(self._prior, (_CHANGE_POINTS, 1, 1))])

    def served_square(self, orthogonal: Array, displacement_jacobian: Array) -> float:
        """Return the squared Mahalanobis norm of a residual under the served joint."""
        if self._is_exact:
            return float(orthogonal @ orthogonal)
        error = orthogonal - displacement_jacobian @ self._means[0]
        spread = displacement_jacobian @ self._covariances[0] @ displacement_jacobian.T
        return float(error @ np.linalg.solve(spread + np.eye(len(error)), error))

    def add(
        self, weight: float, index: int, orthogonal: Array, displacement_jacobian: Array, looks: float
    ) -> tuple[float, float, int]:
        """Return the log density ratio of the served joint to an exact one, and as :class:`_ChangePoints`."""
        self._begin(weight, index)
        transposed = displacement_jacobian.T
        error = orthogonal - self._means @ transposed
        cross_covariance = self._covariances @ transposed
        spread = displacement_jacobian @ cross_covariance
        spread += looks * np.eye(len(orthogonal))
        information = np.linalg.inv(spread)
        squares = np.sum(error * (information @ error[..., None])[..., 0], axis=1)
        log_volume = np.linalg.slogdet(spread)[1] - len(orthogonal) * math.log(looks)
        log = 0.5 * (float(orthogonal @ orthogonal) / looks - squares - log_volume)
        self._logs += self._bet.gains((log[1:] - log[0]).reshape(_CHANGE_POINTS, -1))
        if self._bet.robust:
            information *= (squares <= CHI_SQUARED_6)[:, None, None]
        gain = cross_covariance @ information
        self._means += (gain @ error[..., None])[..., 0]
        self._covariances -= gain @ np.swapaxes(cross_covariance, 1, 2)
        highest = float(self._logs.max())
        total = float(np.exp(self._logs - highest).sum())
        mixture = highest + math.log(total / (len(SIZES) * self._bet.cuts))
        return float(log[0]), mixture, int(self._starts[np.argmax(self._logs.max(axis=(1, 2)))])

    def _begin(self, weight: float, index: int) -> None:
        """Replace the least likely of the older change points by a new one."""
        leading = np.where(self._starts <= index - _NEWEST, self._logs.max(axis=(1, 2)), np.inf)
        slot = int(np.argmin(leading))
        self._starts[slot], self._logs[slot] = index, weight
        filters = slice(1 + slot * len(SIZES), 1 + (slot + 1) * len(SIZES))
        self._means[filters] = self._means[0]
        self._covariances[filters] = self._covariances[0] + self._prior
