"""Inlier classification of observations for each joint family.

An observation is an inlier with the probability 1 - ε, else it is uniformly distributed (:class:`.Outliers`).
Outliers bias the most likely member of a family, and then inliers look like outliers. So each family is
solved from the half of the observations with the nearest neighbours, and from the inliers of the other
families. All observations are then classified and the inliers solved again until they stay the same. A weight
w divides the covariances of an observation's errors by w.

A family with outliers in half of the observations explains nothing. It is evaluated with all of them as
inliers.
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
from kineverse.estimation.noise import Outliers
from kineverse.lie import Array

from .least_squares import STEPS, InitialGuess, JointValuePrior, Solution
from .marginal_likelihood import Scored
from .motion_functions import FamilyMember
from .observations import Observations
from .solver import solver

UNEVEN = 3.0  # factor by which the noise may vary between observations if its size is estimated

RowIndices: TypeAlias = "npt.NDArray[np.int_]"
Name = TypeVar("Name")

_FEW_STEPS = 6  # of the solver in the first round
# Largest number of rounds of reclassification, and of inlier sets that are shared between families.
_ROUNDS, _SHARED = 5, 3
_NEIGHBOURS = 2  # index of the neighbour whose distance measures isolation
_LEAST_WEIGHT = 1e-7  # smallest weight
_MOST = 40  # largest number of observations for a first solution
# Least number of observations, and least share of inliers, for which outliers can be identified.
_FEWEST, _SHARE = 5, 0.5


@dataclass(frozen=True)
class _InlierHypothesis:
    """Hypothesis on the inliers among the observations."""

    inliers: npt.NDArray[np.bool_]  # mask of the inliers, (N,)
    solution: Solution[FamilyMember]
    log_density: float  # log density of all observations at the most likely joint values
    weights: Array  # weights for the next round, (N,)

    @property
    def has_enough_inliers(self) -> bool:
        return bool(self.inliers.sum() >= max(_FEWEST - 1, _SHARE * len(self.inliers) + 0.5))


def find_inliers(
    observations: Observations,
    solutions: Mapping[Name, Scored],
    outliers: Outliers,
    stated: bool,
    solve: Callable[[Observations, Name], Scored],
) -> dict[Name, RowIndices]:
    """Return the indices of the inliers under each family."""
    everything = np.arange(len(observations))
    if len(observations) < _FEWEST:
        return dict.fromkeys(solutions, everything)
    search = _InlierSearch(observations, outliers, stated)
    hypotheses = {name: search.hypothesis(one.solution) for name, one in solutions.items()}
    unsettled = [name for name, hypothesis in hypotheses.items() if not search.is_settled(hypothesis)]
    if not unsettled:
        return dict.fromkeys(solutions, everything)
    supported = Counter(tuple(h.inliers) for h in hypotheses.values() if h.has_enough_inliers)
    common = [np.flatnonzero(inliers) for inliers, _ in supported.most_common(_SHARED)]
    # Evenly spaced rows.
    subsets = [
        rows[np.unique(np.linspace(0, len(rows) - 1, _MOST).round().astype(int))]
        for rows in (densest_half(observations), *common)
    ]
    for name, hypothesis in hypotheses.items():
        if not search.is_settled(hypothesis):
            others = [search.grow(solve(observations.select(rows), name).solution, rows) for rows in subsets]
            hypotheses[name] = max([hypothesis, *others], key=lambda h: (h.has_enough_inliers, h.log_density))
    return {
        name: np.flatnonzero(hypothesis.inliers) if hypothesis.has_enough_inliers else everything
        for name, hypothesis in hypotheses.items()
    }


def densest_half(observations: Observations) -> RowIndices:
    """Return the half of the observations with the nearest neighbours. Outliers are mostly isolated."""
    variances = np.einsum("nii->ni", observations.child_covariance).mean(axis=0)
    relative = observations.relative
    place = relative[:, :3, 3] / math.sqrt(float(variances[:3].mean()))
    if observations.rows == 6:
        # The distance between rotation matrices is √2 times the angle between them.
        turn = relative[:, :3, :3].reshape(-1, 9) / math.sqrt(2.0 * float(variances[3:].mean()))
        place = np.concatenate([place, turn], axis=1)
    place = place - place.mean(axis=0)
    squares = np.sum(place**2, axis=1)
    distances = squares[:, None] + squares[None] - 2.0 * place @ place.T
    isolation = np.partition(distances, _NEIGHBOURS, axis=1)[:, _NEIGHBOURS]
    return np.sort(np.argsort(isolation, kind="stable")[: max(_FEWEST - 1, len(observations) // 2 + 1)])


def log_inlier_prior(outliers: Outliers, count: int, inliers: int, rows: int) -> float:
    """Return log((1 - ε)^r (ε u)^(n - r)) for r inliers among n observations and the outlier density u."""
    log_outliers = (count - inliers) * _log_outlier_density(outliers, rows)
    return inliers * math.log(1.0 - outliers.fraction) + log_outliers


def classify_inliers(
    residuals: Array,
    covariance: Array,
    outliers: Outliers,
    stated: bool,
    freedom: int = 0,
) -> npt.NDArray[np.bool_]:
    """Return the mask of inliers for residuals (N, m) with covariances (N, m, m), see :func:`_whiten`."""
    return is_inlier(*_whiten(residuals, covariance, stated, freedom), outliers, residuals.shape[1])


def _whiten(residuals: Array, covariance: Array, stated: bool, freedom: int) -> tuple[Array, Array]:
    """Return squared norms of the whitened residuals, and ½ log |2πS|, (N,).

    A noise that is not stated may vary between observations. With the degrees of freedom of a residual, its
    size is that of the median residual.
    """
    rows = residuals.shape[1]
    squares = np.einsum("ni,nij,nj->n", residuals, invert_matrices(covariance), residuals)
    log_scale = 0.5 * np.linalg.slogdet(math.tau * covariance)[1]
    if stated:
        return squares, log_scale
    # The median of χ² is about its degrees of freedom less 2/3, and half of the observations are inliers.
    size = float(np.median(squares)) / (freedom - 2.0 / 3.0) if freedom else 1.0
    size = max(UNEVEN**2 * size, 1e-12)
    return squares / size, log_scale + 0.5 * rows * math.log(size)


def is_inlier(squares: Array, log_scale: Array, outliers: Outliers, rows: int = 6) -> npt.NDArray[np.bool_]:
    """Return the mask of observations that are more probable as inliers than as outliers."""
    log_inlier = math.log(1.0 - outliers.fraction) - 0.5 * squares - log_scale
    return np.asarray(log_inlier > _log_outlier_density(outliers, rows))


def _log_outlier_density(outliers: Outliers, rows: int) -> float:
    anywhere = outliers.log_uniform_density if rows == 6 else -3.0 * math.log(outliers.reach)
    return math.log(outliers.fraction) + anywhere


class _InlierSearch:
    """Search for the inliers among observations."""

    def __init__(self, observations: Observations, outliers: Outliers, stated: bool) -> None:
        self.observations, self.outliers, self.stated = observations, outliers, stated

    def is_settled(self, hypothesis: _InlierHypothesis) -> bool:
        """Return True if no search is needed: all are inliers at the stated noise, or fit in any case."""
        motion = hypothesis.solution.motion
        return motion.joints == self.observations.rows or (self.stated and bool(hypothesis.inliers.all()))

    def hypothesis(self, solution: Solution[FamilyMember], weights: Array | None = None) -> _InlierHypothesis:
        covariance = solution.covariance if weights is None else solution.covariance * weights[:, None, None]
        freedom = self.observations.rows - solution.motion.joints
        squares, log_scale = _whiten(solution.residuals, covariance, self.stated or not freedom, freedom)
        log_inlier = math.log(1.0 - self.outliers.fraction) - 0.5 * squares - log_scale
        log_outlier = _log_outlier_density(self.outliers, self.observations.rows)
        log = float(np.sum(np.maximum(log_inlier, log_outlier)))
        inliers = log_inlier > log_outlier
        next_weights = np.where(inliers, 1.0, 1.0 / np.maximum(squares, 1.0))
        return _InlierHypothesis(inliers, solution, log, next_weights)

    def grow(self, subset: Solution[FamilyMember], rows: RowIndices) -> _InlierHypothesis:
        """Return the hypothesis that the solution of some of the observations leads to."""
        observations = self.observations
        difference = (observations.relative[:, None] - observations.relative[None, rows])[:, :, :3]
        values = subset.values[np.argmin(np.sum(difference**2, axis=(2, 3)), axis=1)]
        parent = observations.parent.copy()
        parent[rows] = subset.parent
        weights = np.full(len(observations), _LEAST_WEIGHT)
        weights[rows] = 1.0
        solution = self._solve(subset.motion, values, parent, weights, _FEW_STEPS)
        hypothesis = self.hypothesis(solution, weights)
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
        weighted = self.observations.scaled((1.0 / weights)[:, None, None])
        vague = JointValuePrior.vague(motion.joints)
        return solver.solve(weighted, InitialGuess(motion, values), parent, vague, steps)
