"""Sequential test by an e-process with Ville's bound.

Under the articulation as served, ρ of each observation is standard normal. Against it stand alternatives:

- it, or the child on it, sits elsewhere: ρ = G δ + noise with an unknown δ, believed within some size;
- nothing holds the child: ρ is normal with a larger deviation;
- joint values beyond their limits, or apart from what others say of them, by z standard deviations:
  exp(λ z - λ²/2) is 1 on average at a limit, and less inside.

Each may begin to hold at any observation j, the j-th with the weight 1/(j (j+1)). The ratio M of the
densities of all that was seen, under the mixture of alternatives and under the articulation as served, is a
supermartingale that begins at 1 if the latter is right, whatever joint values do. So by Ville's inequality
the probability that M ever reaches 1/α is at most α, however long one watches. To first order, that is: poses
are linearised around the best joint values.

Some observations may be wrong altogether, each with the probability ε, and then nothing is said about where
they are. So what an alternative wins by one observation, L, is cut off at some c: whatever happens to the
fraction ε,

    E[min(L, c)] <= (1 - ε) + ε c

and min(L, c) divided by this is a fair bet again (Huber's censored ratio). A small c costs little each time,
and finds what is a bit off, slowly; a large one finds what is far off at once. Capital is split among them.
"""

from __future__ import annotations

import math

import numpy as np

from kineverse.lie import Stack

from .known_residuals import SIZES

_DEVIATIONS = np.array([1.0, 3.0, 10.0, 30.0, 100.0])
_SLOPES = np.array([2.0, 5.0])
# The part of its capital that is bet on the next observation, by who thinks that all of them are off, and by
# who thinks that now and then one is.
_STAKES = np.array([1.0 - 1e-9, 0.1])
# Where one observation's gain is cut off if some are wrong.
_CUTS = np.array([1.5, 4.0, 20.0])
# χ² of six numbers that is exceeded once in a thousand: a displacement is not learned from what is beyond.
_LIKELY = 22.5
# As many beginnings of a displacement are followed; dropping some only makes M smaller.
_FOLLOWED = 12


class SequentialTest:
    """Follows one articulation.

    Parameters
    ----------
    false_alarms
        The probability α that an articulation which is as served is ever said not to be.
    wrong
        The probability ε that an observation is wrong altogether.

    Attributes
    ----------
    count
        Observations so far.
    stopped
        The observation, from 0, from which on it probably does not explain what is seen; None as long as it
        does. Never taken back.
    noticed
        The observation at which that was noticed.
    """

    def __init__(self, false_alarms: float, wrong: float = 0.0) -> None:
        self._threshold = -math.log(false_alarms)
        self._bet = _Bet(wrong)
        self.count = 0
        self.stopped: int | None = None
        self.noticed: int | None = None
        self._elsewhere = _Elsewhere(self._bet)
        self._loose = _Beginnings(len(_DEVIATIONS), self._bet)
        self._beyond = _Beginnings(0, self._bet)

    def add(self, normal: Stack, by_place: Stack, beyond: Stack) -> float:
        """Take one observation; return log M.

        They are rows of a :class:`kineverse.estimation.plausibility.known_residuals.KnownResiduals`, ``beyond`` of what is ``against`` it; NaN says nothing.
        """
        self.count += 1
        weight = -math.log(self.count * (self.count + 1.0))
        if self.count == 1:
            self._limited = np.logical_not(np.isneginf(beyond))
            self._beyond = _Beginnings(int(self._limited.sum()) * len(_SLOPES), self._bet)
        parts: list[tuple[float, float, int]] = []
        if len(normal):
            parts.append((0.5, *self._elsewhere.add(weight, self.count - 1, normal, by_place)))
            squares = float(normal @ normal)
            grown = 1.0 + _DEVIATIONS**2
            log = -0.5 * len(normal) * np.log(grown) + 0.5 * squares * (1.0 - 1.0 / grown)
            parts.append((0.3, *self._loose.add(weight, self.count - 1, log)))
        if self._limited.any():
            z = np.maximum(beyond[self._limited], -1e3)
            log = np.nan_to_num(_SLOPES[:, None] * z - 0.5 * _SLOPES[:, None] ** 2, nan=0.0).ravel()
            parts.append((0.2, *self._beyond.add(weight, self.count - 1, log)))
        if not parts:
            return 0.0
        total = sum(p for p, _, _ in parts)
        logs = [math.log(p / total) + log for p, log, _ in parts]
        # Of all beginnings 1/(n + 1) are still to come.
        ratio = float(np.logaddexp.reduce([*logs, -math.log(self.count + 1.0)]))
        if self.stopped is None and ratio >= self._threshold:
            self.noticed = self.count - 1
            self.stopped = parts[int(np.argmax(logs))][2]
        return ratio


class _Bet:
    """What one observation wins, if a fraction of them is wrong."""

    def __init__(self, wrong: float) -> None:
        self.robust = wrong > 0.0
        self._cuts = np.log(_CUTS) if self.robust else np.array([np.inf])
        self._price = np.log1p(wrong * (_CUTS - 1.0)) if self.robust else np.zeros(1)
        self._stakes = _STAKES if self.robust else np.ones(1)
        self.ways = len(self._cuts)
        self.shape = len(self._stakes), self.ways

    def gains(self, log: Stack) -> Stack:
        """Return log gains for each cut, (..., ways), of the logarithms of ratios of densities."""
        gains: Stack = np.minimum(log[..., None], self._cuts) - self._price
        return gains

    def staked(self, log: Stack) -> Stack:
        """Return the same for each stake too, (..., stakes, ways)."""
        with np.errstate(divide="ignore"):
            kept = np.log1p(-self._stakes)
        return self.gains(np.logaddexp(kept, np.log(self._stakes) + log[..., None]))


class _Beginnings:
    """Alternatives whose observations are independent: all beginnings are summed up exactly."""

    def __init__(self, count: int, bet: _Bet) -> None:
        self._bet = bet
        shape = (count, *bet.shape)
        self._logs = np.full(shape, -np.inf)
        self._best = np.full(shape, -np.inf)
        self._start = np.zeros(shape, dtype=int)

    def add(self, weight: float, index: int, log: Stack) -> tuple[float, int]:
        """Return the logarithm of the mixture over all, and the likeliest beginning."""
        gains = self._bet.staked(log)
        self._logs = np.logaddexp(self._logs, weight) + gains
        newer = self._best < weight
        self._start[newer] = index
        self._best = np.maximum(self._best, weight) + gains
        mean = float(np.logaddexp.reduce(self._logs, axis=None)) - math.log(gains.size)
        return mean, int(self._start.flat[np.argmax(self._best)])


class _Elsewhere:
    """Displacements δ ~ N(0, s² I) for some sizes s, followed from some beginnings each."""

    def __init__(self, bet: _Bet) -> None:
        self._bet = bet
        self._starts = np.zeros(0, dtype=int)
        self._logs = np.zeros((0, len(SIZES), bet.ways))
        self._means = np.zeros((0, len(SIZES), 12))
        self._covariances = np.zeros((0, len(SIZES), 12, 12))

    def add(self, weight: float, index: int, normal: Stack, by_place: Stack) -> tuple[float, int]:
        """Return the logarithm of the mixture over sizes and beginnings, and the likeliest beginning."""
        sizes = len(SIZES)
        self._starts = np.append(self._starts, index)
        self._logs = np.concatenate([self._logs, np.full((1, sizes, self._bet.ways), weight)])
        self._means = np.concatenate([self._means, np.zeros((1, sizes, 12))])
        prior = np.square(SIZES)[:, None, None] * np.eye(12)
        self._covariances = np.concatenate([self._covariances, prior[None]])
        error = normal - self._means @ by_place.T
        carried = self._covariances @ by_place.T
        spread = by_place @ carried + np.eye(len(normal))
        gain = np.swapaxes(np.linalg.solve(spread, np.swapaxes(carried, 2, 3)), 2, 3)
        solved = np.linalg.solve(spread, error[..., None])[..., 0]
        squares = np.sum(error * solved, axis=2)
        ratio = 0.5 * (normal @ normal - squares) - 0.5 * np.linalg.slogdet(spread)[1]
        self._logs += self._bet.gains(ratio)
        if self._bet.robust:
            gain[squares > _LIKELY] = 0.0
        self._means += (gain @ error[..., None])[..., 0]
        self._covariances -= gain @ np.swapaxes(carried, 2, 3)
        result = float(np.logaddexp.reduce(self._logs, axis=None)) - math.log(sizes * self._bet.ways)
        leading = self._logs.max(axis=(1, 2))
        best = int(self._starts[np.argmax(leading)])
        if len(self._starts) > _FOLLOWED:
            # The newest have had no time yet to show anything.
            older = np.argsort(-leading[:-3])[: _FOLLOWED - 3]
            kept = np.sort(np.append(older, np.arange(len(self._starts) - 3, len(self._starts))))
            self._starts, self._logs = self._starts[kept], self._logs[kept]
            self._means, self._covariances = self._means[kept], self._covariances[kept]
        return result, best
