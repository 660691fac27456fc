"""Which observations are wrong altogether: looked for before an articulation is compared with others."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from kineverse.estimation.identification.identify import family_weights
from kineverse.estimation.identification.observations import Observations
from kineverse.estimation.identification.outlying import is_right
from kineverse.estimation.identification.pairs import Families, identified
from kineverse.estimation.tracking.outliers import Outliers

from .earlier import Rows, beside, squared_errors
from .misfit import Misfit

# Fewer observations do not show which of them does not belong there, nor do they if so many of them do not.
_ENOUGH, _SHARE = 5, 0.2
# On so many parts of the observations a family is tried; so often what it explains takes their place.
_STARTS, _ROUNDS = 5, 4


def credible(left: Misfit, outliers: Outliers | None) -> Rows:
    """Return the numbers of the observations that are right if the articulation is as served."""
    everything = np.arange(len(left))
    if outliers is None or not len(left):
        return everything
    squares = np.sum(left.normal**2, axis=1)
    if left.against.size:
        squares = squares + np.fmax(left.against, 0.0).max(axis=1) ** 2
    log_scale = left.log_scale + 0.5 * np.linalg.slogdet(2.0 * np.pi * left.covariances)[1]
    right = everything[is_right(squares, log_scale, outliers)]
    # More than chance makes of their fraction are no outliers, but something that is not understood.
    expected = outliers.fraction * len(left)
    usual = len(left) - len(right) <= expected + 2.0 * math.sqrt(expected)
    return right if usual else everything


def agreeing(seen: Observations, families: Families, outliers: Outliers | None) -> Rows:
    """Return the numbers of the observations by which what is there instead is to be identified.

    Each family says which observations it explains at best. Of these and of all, those are returned with
    which everything is most probable, what is left out being anywhere.
    """
    everything = np.arange(len(seen))
    if outliers is None or len(seen) < _ENOUGH:
        return everything
    kept = {tuple(_kept(seen, family, outliers)) for family in family_weights(families)}
    if kept <= {tuple(everything)}:
        return everything

    def log_density(rows: tuple[int, ...]) -> float:
        found = identified(seen.at(np.array(rows)), families)
        log = found.best.log_evidence - math.log(found.best.probability)
        return (
            log + len(rows) * math.log(1.0 - outliers.fraction) + (len(seen) - len(rows)) * _wrong(outliers)
        )

    return np.array(max(sorted({*kept, tuple(everything)}), key=log_density))


def _kept(seen: Observations, family: Any, outliers: Outliers) -> Rows:
    """Return the numbers of the observations that a family explains, or of all if it explains too few.

    Where something is far off, everything is pulled along, so the family is tried on some as well.
    """
    everything = best = np.arange(len(seen))
    random = np.random.default_rng(0)
    size = max(len(seen) // 4, _ENOUGH)
    most = 0
    for start in (everything, *(random.choice(everything, size, replace=False) for _ in range(_STARTS))):
        rows = start
        for _ in range(_ROUNDS):
            solution = beside(identified(seen.at(rows), [family]).best, seen)
            log_scale = 0.5 * np.linalg.slogdet(2.0 * np.pi * solution.covariance)[1]
            before, rows = rows, everything[is_right(squared_errors(solution), log_scale, outliers)]
            if not _enough(rows, len(seen)) or np.array_equal(rows, before):
                break
        if len(rows) == len(seen):
            return everything
        if _enough(rows, len(seen)) and len(rows) > most:
            best, most = rows, len(rows)
    return best


def _enough(kept: Rows, count: int) -> bool:
    return len(kept) >= max((1.0 - _SHARE) * count, _ENOUGH - 1)


def _wrong(outliers: Outliers) -> float:
    """Return the logarithm of the density of an observation that is wrong."""
    return math.log(outliers.fraction) + outliers.log_anywhere
