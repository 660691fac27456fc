"""What families make of more observations, from what they made of those before."""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping

import numpy as np

from .beside import are_right, beside
from .family import Family
from .identify import Explained, Sight, explained_by
from .motion import Member
from .native import solver
from .observations import Observations
from .outlying import Rows
from .pairs import UNLIKELY
from .refining import Rated
from .solving import Solution, Start
from .turning import is_screw


def caught_up(
    sight: Sight,
    known: Mapping[str | Family, Explained],
    scale: float,
    weights: Mapping[str | Family, float],
) -> dict[str | Family, Explained]:
    """Return what families make of all that was seen, each from where it was.

    Parameters
    ----------
    sight
        What was seen.
    known
        What they made of the first observations.
    scale
        By how much standard deviations of the noise were scaled.
    weights
        How probable families are beforehand.
    """
    right = {name: _right(sight, one, scale) for name, one in known.items()}
    most_alike = functools.cache(_most_alike)  # most families are by the same ones
    found = {}
    for name, one in known.items():
        seen = sight.seen if len(right[name]) == len(sight.seen) else sight.seen.at(right[name])
        found[name] = _continued(seen, one.known.solution, most_alike(seen, len(one.right)), sight.ordered)
    return explained_by(sight, found, right, weights)


def is_surprised(sight: Sight, one: Explained, count: int) -> bool:
    """Return whether a family finds observations from a number on wrong, or improbable by their size."""
    new = len(sight.seen) - count
    if np.count_nonzero(one.right >= count) < new:
        return True
    solution = one.known.solution
    residuals, covariance = solution.residuals[-new:], solution.covariance[-new:]
    squares = float(np.sum(residuals * np.linalg.solve(covariance, residuals[:, :, None])[:, :, 0]))
    return squares > residuals.size + UNLIKELY * math.sqrt(2.0 * residuals.size)


def _continued(seen: Observations, before: Solution[Member], alike: Rows, ordered: bool) -> Rated:
    """Return the solution of a family for more observations than it was found from."""
    known = len(before.values)
    # What looks alike has joint values that are near.
    values = np.concatenate([before.values, before.values[alike]])
    if ordered and is_screw(before.motion):
        for k in range(known, len(values)):
            values[k] += math.tau * np.round((values[k - 1] - values[k]) / math.tau)
    parent = np.concatenate([before.parent, seen.parent[known:]])
    return solver.continued(seen, Start(before.motion, values), parent, before.belief, known)


def _most_alike(seen: Observations, known: int) -> Rows:
    """Return which of the first observations looks most like each of the others."""
    old, new = seen.relative[None, :known], seen.relative[known:, None]
    alike: Rows = np.argmin(np.sum((old - new) ** 2, axis=(2, 3)), axis=1)
    return alike


def _right(sight: Sight, one: Explained, scale: float) -> Rows:
    """Return the numbers of what is right: of what was, and of what came and is where it may be expected."""
    new, solution = np.arange(one.count, len(sight.seen)), one.known.solution
    if sight.outliers is None or solution.motion.joints == sight.seen.rows:
        return np.concatenate([one.right, new])
    came = beside(solution.motion, solution.values, sight.seen.at(new))
    by_parameters = solution.motion.at(came.values).by_parameters
    # What is not known of the joint yet is no error of what was seen.
    unknown = solver.evidence(solution).covariance
    covariance = came.covariance + by_parameters @ unknown @ np.swapaxes(by_parameters, 1, 2)
    came_right = are_right(came.residuals, scale**2 * covariance, sight.outliers, sight.stated)
    return np.concatenate([one.right, new[came_right]])
