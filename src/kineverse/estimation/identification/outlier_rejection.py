"""Inlier classification of observations for each joint family.

An observation is right with the probability 1 - ε, or anywhere (:class:`.Outliers`). Where some are anywhere,
the most likely member of a family is pulled to them, and what is right looks wrong. So a family begins with
all observations and forgives whatever is off, and then forgives less and less, as graduated non-convexity
does (Yang et al. 2020, with the weights of Geman and McClure): an observation with the weight w has the
covariances of its errors divided by w. What is far off in the end, that would be more probable anywhere, is
wrong. Families learn from each other: what one calls wrong another tries as well, and all try the half of
what was seen that is nearest to others.

A family that calls half of what was seen wrong explains nothing. It is judged by all of it.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TypeAlias, TypeVar

import numpy as np
import numpy.typing as npt

from kineverse.estimation.linear_algebra import invert_matrices
from kineverse.estimation.robust import Outliers
from kineverse.lie import Array

from .maximum_likelihood import Scored
from .motion_model import FamilyMember
from .observations import Observations
from .optimise import STEPS, InitialGuess, JointValuePrior, Solution
from .solver import solver

UNEVEN = 3.0
"""Where nobody knows how large the noise is, it may be this much larger here than there."""

RowIndices: TypeAlias = "npt.NDArray[np.int_]"
Name = TypeVar("Name")

# χ² of poses, and of positions, that is exceeded once in a thousand: where weights become small in the end.
_CHI_SQUARED = {6: 22.5, 3: 16.3}
# By how much less is forgiven each time, in how many steps of the solver.
_ANNEALING, _FEW_STEPS = 2.0, 6
# So often what is right is looked for again, and in so many of the ways that other families have found.
_ROUNDS, _SHARED = 5, 3
# As far as from so many neighbours something is alone.
_NEIGHBOURS = 2
# The least weight: of what is as wrong as can be.
_WRONG = 1e-7
# So many observations are enough to begin with.
_MOST = 40
# Fewer observations do not show which of them is wrong, nor do they if only half of them or less are right.
_FEWEST, _SHARE = 5, 0.5


@dataclass(frozen=True)
class _InlierHypothesis:
    """One way to take some observations for right.

    Attributes
    ----------
    right
        Which are, (N,).
    solution
        Of the family, for all observations, with covariances that are divided by weights.
    log_density
        Of all observations, with the most likely joint values.
    weights
        What observations weigh next, (N,): what is wrong draws the less the farther it is off, and just
        enough to be put to the nearest place on the joint.
    """

    inliers: npt.NDArray[np.bool_]
    solution: Solution[FamilyMember]
    log_density: float
    weights: Array

    @property
    def has_enough_inliers(self) -> bool:
        """Whether enough is right."""
        return bool(self.inliers.sum() >= max(_FEWEST - 1, _SHARE * len(self.inliers) + 0.5))


def find_inliers(
    observations: Observations,
    found: Mapping[Name, Scored],
    outliers: Outliers,
    stated: bool,
    find: Callable[[Observations, Name], Scored],
) -> dict[Name, RowIndices]:
    """Return the numbers of the observations that are right if what moves is of a family, for each.

    Parameters
    ----------
    observations
        All observations.
    found
        The families with their most likely members, by all observations.
    outliers
        How often observations are wrong, and where they are then.
    stated
        Whether the size of the noise is known; else it is estimated for each family.
    find
        Returns the most likely member of a family by some observations.
    """
    everything = np.arange(len(observations))
    if len(observations) < _FEWEST:
        return dict.fromkeys(found, everything)
    search = _InlierSearch(observations, outliers, stated)
    hypotheses = {name: search.hypothesis(known.solution) for name, known in found.items()}
    if all(search.is_settled(hypothesis) for hypothesis in hypotheses.values()):
        return dict.fromkeys(found, everything)
    hypotheses = {
        name: hypothesis if search.is_settled(hypothesis) else search.anneal(hypothesis)
        for name, hypothesis in hypotheses.items()
    }
    common = Counter(
        tuple(hypothesis.inliers) for hypothesis in hypotheses.values() if hypothesis.has_enough_inliers
    ).most_common(_SHARED)
    tried = [
        _thinned(rows)
        for rows in (_densest_half(observations), *(np.flatnonzero(right) for right, _ in common))
    ]
    for name, hypothesis in hypotheses.items():
        if not search.is_settled(hypothesis):
            others = [search.grow(find(observations.select(rows), name).solution, rows) for rows in tried]
            hypotheses[name] = max([hypothesis, *others], key=lambda w: (w.has_enough_inliers, w.log_density))
    return {
        name: np.flatnonzero(hypothesis.inliers) if hypothesis.has_enough_inliers else everything
        for name, hypothesis in hypotheses.items()
    }


def _thinned(rows: RowIndices) -> RowIndices:
    """Return some of many observations, evenly, which are enough to begin with."""
    chosen: RowIndices = rows[np.unique(np.linspace(0, len(rows) - 1, _MOST).round().astype(int))]
    return chosen


def _densest_half(observations: Observations) -> RowIndices:
    """Return the half of the observations that are nearest to others: what is anywhere is mostly alone."""
    variances = np.einsum("nii->ni", observations.child_covariance).mean(axis=0)
    relative = observations.relative
    place = relative[:, :3, 3] / math.sqrt(float(variances[:3].mean()))
    if observations.rows == 6:
        # Matrices are apart by √2 times the angle between them.
        turn = relative[:, :3, :3].reshape(-1, 9) / math.sqrt(2.0 * float(variances[3:].mean()))
        place = np.concatenate([place, turn], axis=1)
    place = place - place.mean(axis=0)
    squares = np.sum(place**2, axis=1)
    apart = squares[:, None] + squares[None] - 2.0 * place @ place.T
    alone = np.partition(apart, _NEIGHBOURS, axis=1)[:, _NEIGHBOURS]
    return np.sort(np.argsort(alone, kind="stable")[: max(_FEWEST - 1, len(observations) // 2 + 1)])


def log_inlier_prior(outliers: Outliers, count: int, right: int, rows: int) -> float:
    """Return log((1 - ε)^r (ε u)^(n - r)): that so many of all are right, and the others anywhere."""
    return right * math.log(1.0 - outliers.fraction) + (count - right) * _log_wrong(outliers, rows)


def is_inlier(squares: Array, log_scale: Array, outliers: Outliers, rows: int = 6) -> npt.NDArray[np.bool_]:
    """Return which observations are more probable to be right than wrong.

    Parameters
    ----------
    squares, log_scale
        Of whitened errors, and ½ log |2πS| of their covariances, (N,).
    outliers
        How often they are wrong, and where they are then.
    rows
        6 for poses, 3 for positions.
    """
    inliers: npt.NDArray[np.bool_] = math.log(
        1.0 - outliers.fraction
    ) - 0.5 * squares - log_scale > _log_wrong(outliers, rows)
    return inliers


def _log_wrong(outliers: Outliers, rows: int) -> float:
    anywhere = outliers.log_anywhere if rows == 6 else -3.0 * math.log(outliers.reach)
    return math.log(outliers.fraction) + anywhere


class _InlierSearch:
    """Tells right from wrong among observations."""

    def __init__(self, observations: Observations, outliers: Outliers, stated: bool) -> None:
        self.observations, self.outliers, self.stated = observations, outliers, stated

    def is_settled(self, hypothesis: _InlierHypothesis) -> bool:
        """Whether there is nothing to look for: all is right with the noise that is known, or always is."""
        motion = hypothesis.solution.motion
        return motion.joints == self.observations.rows or (self.stated and bool(hypothesis.inliers.all()))

    def hypothesis(self, solution: Solution[FamilyMember], weights: Array | None = None) -> _InlierHypothesis:
        """Return which observations are right if a solution is."""
        squares, log_scale = self._whitened_errors(solution, weights)
        log_right = math.log(1.0 - self.outliers.fraction) - 0.5 * squares - log_scale
        log_wrong = _log_wrong(self.outliers, self.observations.rows)
        log = float(np.sum(np.maximum(log_right, log_wrong)))
        right = log_right > log_wrong
        return _InlierHypothesis(right, solution, log, np.where(right, 1.0, 1.0 / np.maximum(squares, 1.0)))

    def anneal(self, hypothesis: _InlierHypothesis) -> _InlierHypothesis:
        """Return the way that is found from a first one by forgiving less and less."""
        solution, weights, likely = hypothesis.solution, None, _CHI_SQUARED[self.observations.rows]
        squares, _ = self._whitened_errors(solution, weights)
        forgiven = max(1.0, 2.0 * float(squares.max()) / likely)
        while True:
            weights = np.maximum((forgiven * likely / (squares + forgiven * likely)) ** 2, _WRONG)
            solution = self._solve(solution.motion, solution.values, solution.parent, weights, _FEW_STEPS)
            squares, _ = self._whitened_errors(solution, weights)
            if forgiven == 1.0:
                break
            forgiven = max(1.0, forgiven / _ANNEALING)
        return self._iterate(self.hypothesis(solution, weights))

    def grow(self, some: Solution[FamilyMember], rows: RowIndices) -> _InlierHypothesis:
        """Return the way that is found from the solution of some of the observations."""
        observations = self.observations
        apart = np.sum(
            (observations.relative[:, None] - observations.relative[None, rows])[:, :, :3] ** 2, axis=(2, 3)
        )
        values = some.values[np.argmin(apart, axis=1)]
        parent = observations.parent.copy()
        parent[rows] = some.parent
        weights = np.full(len(observations), _WRONG)
        weights[rows] = 1.0
        solution = self._solve(some.motion, values, parent, weights, _FEW_STEPS)
        return self._iterate(self.hypothesis(solution, weights))

    def _iterate(self, hypothesis: _InlierHypothesis) -> _InlierHypothesis:
        """Return the way with a solution by what is right, until the same is."""
        for _ in range(_ROUNDS):
            if not hypothesis.has_enough_inliers:
                break
            before, last = hypothesis, hypothesis.solution
            solution = self._solve(last.motion, last.values, last.parent, hypothesis.weights)
            hypothesis = self.hypothesis(solution, hypothesis.weights)
            if np.array_equal(hypothesis.inliers, before.inliers):
                break
        return hypothesis

    def _solve(
        self, motion: FamilyMember, values: Array, parent: Array, weights: Array, steps: int = STEPS
    ) -> Solution[FamilyMember]:
        observations, by = self.observations, (1.0 / weights)[:, None, None]
        of_parent = None if observations.parent_covariance is None else observations.parent_covariance * by
        weighted = Observations(
            observations.parent, observations.child, of_parent, observations.child_covariance * by
        )
        return solver.solve(
            weighted, InitialGuess(motion, values), parent, JointValuePrior.vague(motion.joints), steps
        )

    def _whitened_errors(
        self, solution: Solution[FamilyMember], weights: Array | None
    ) -> tuple[Array, Array]:
        """Return squares of whitened errors, and ½ log |2πS|, (N,)."""
        covariance = solution.covariance
        if weights is not None:
            covariance = covariance * weights[:, None, None]
        residuals, motion, rows = solution.residuals, solution.motion, self.observations.rows
        squares = np.einsum("ni,nij,nj->n", residuals, invert_matrices(covariance), residuals)
        log_scale = 0.5 * np.linalg.slogdet(math.tau * covariance)[1]
        if self.stated or motion.joints == rows:
            return squares, log_scale
        # The median of χ² is about its degrees of freedom less 2/3, and half of the observations are right.
        size = float(np.median(squares)) / (rows - motion.joints - 2.0 / 3.0)
        size = max(UNEVEN**2 * size, 1e-12)
        return squares / size, log_scale + 0.5 * rows * math.log(size)
