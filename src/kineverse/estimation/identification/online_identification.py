"""Online identification, warm-started from the previous result."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache, partial

import numpy as np
import numpy.typing as npt

from kineverse._runtime import CallLock, one_at_a_time
from kineverse.errors import InvalidValueError, ShapeError
from kineverse.estimation.linear_algebra import singularity_named, squared_errors
from kineverse.estimation.noise import Outliers, as_outliers

from .curve import CURVE
from .joint_identification import Families, family_weights, resolve_noise
from .least_squares import InitialGuess
from .marginal_likelihood import is_screw
from .model_check import solve_joints, weigh_and_check
from .model_selection import (
    FamilyName,
    FamilySolution,
    FamilySolutions,
    FamilyWeights,
    IdentificationData,
    prepare_data,
    score_solutions,
    weigh_families,
)
from .noise_estimation import NoiseSolution, scale_noise
from .observations import Observations, check_observations
from .outlier_rejection import RowIndices, classify_inliers
from .result import Fit, IdentificationResult, project_observations
from .solver import solver


def warm_start(
    data: IdentificationData, known: FamilySolutions, weights: FamilyWeights, renew: bool
) -> FamilySolutions:
    """Return the solutions of families for all observations, starting from earlier solutions."""
    inliers = {name: _predict_inliers(data, one) for name, one in known.items()}
    nearest_of = cache(_nearest_observations)  # most families have the same inliers
    solutions = {}
    for name, one in known.items():
        observations, rows, before = data.observations, inliers[name], one.scored.solution
        if len(rows) < len(observations):
            observations = observations.select(rows)
        # Similar relative poses have similar joint values.
        first = len(before.values)
        values = np.concatenate([before.values, before.values[nearest_of(observations, first)]])
        if data.sequential and is_screw(before.motion):
            for k in range(first, len(values)):
                values[k] += math.tau * np.round((values[k - 1] - values[k]) / math.tau)
        parent = np.concatenate([before.parent, observations.parent[first:]])
        start = InitialGuess(before.motion, values), parent, before.joint_prior
        scored = solver.continue_from(scale_noise(observations, one.noise.factors), *start)
        solutions[name] = NoiseSolution(scored, one.noise)
    return score_solutions(data, solutions, inliers, weights, renew)


def _is_surprised(data: IdentificationData, one: FamilySolution, known: int) -> bool:
    """Return True if observations after the first ``known`` have outliers, or a χ² too large for noise."""
    new = len(data.observations) - known
    if np.count_nonzero(one.inliers >= known) < new:
        return True
    solution = one.scored.solution
    squares = float(squared_errors(solution.residuals[-new:], solution.covariance[-new:]).sum())
    freedom = solution.residuals[-new:].size
    return squares > freedom + _SURPRISE * math.sqrt(2.0 * freedom)


def _nearest_observations(observations: Observations, known: int) -> RowIndices:
    old, new = observations.relative[None, :known], observations.relative[known:, None]
    return np.asarray(np.argmin(np.sum((old - new) ** 2, axis=(2, 3)), axis=1))


def _predict_inliers(data: IdentificationData, one: FamilySolution) -> RowIndices:
    """Return the indices of the inliers so far and of the new observations that match the prediction."""
    new, solution = np.arange(one.count, len(data.observations)), one.scored.solution
    if data.outliers is None or solution.motion.joints == data.observations.rows:
        return np.concatenate([one.inliers, new])
    observations = scale_noise(data.observations.select(new), one.noise.factors)
    predicted = project_observations(solution.motion, solution.values, observations)
    by_parameters = solution.motion.linearise(predicted.values).by_parameters
    # The prediction is uncertain by the parameters, too.
    unknown = solver.evidence(solution).covariance
    covariance = predicted.covariance + by_parameters @ unknown @ np.swapaxes(by_parameters, 1, 2)
    new_inliers = classify_inliers(predicted.residuals, covariance, data.outliers, data.stated)
    return np.concatenate([one.inliers, new[new_inliers]])


# A family with a smaller probability is not updated until all families are solved again.
_NEGLIGIBLE = 1e-6
# A family with a smaller probability is updated after more observations only, or if one is a surprise: its χ²
# is so many standard deviations above its mean.
_UNLIKELY, _SURPRISE = 0.02, 2.0
# Relative increase of observations after which the noise and outliers are estimated again.
_MORE = 0.125


class Identifier:
    """Online identification of the joint between two parts.

    The result is that of :func:`.identify` for all poses so far, at a fraction of the cost: each family
    starts from its previous solution. A family below 2 % keeps its odds until there are an eighth more poses,
    one that contradicts the best family, or a doubt. A family below one in a million is left out of the
    result until the number of observations has doubled.

    Parameters
    ----------
    parent_covariance, child_covariance
        Default covariances of the errors of poses, (6, 6).
    families, noise, outliers
        As for :func:`.identify`. A new pose is classified when it arrives. All poses are classified again
        after an eighth more of them.
    sequential
        True if the poses arrive in temporal order, see :func:`.identify`.

    Examples
    --------
    >>> hinge = kv.rotation_z(kv.position("q")) @ kv.translation(0.5, 0, 0)
    >>> identifier = kv.estimation.Identifier(noise=(0.001, 0.01), families=["revolute", "prismatic"])
    >>> for q in np.linspace(0, 1, 12):
    ...     identifier.add(None, hinge({"q": q}))
    >>> identifier.result.best.family
    'revolute'
    """

    def __init__(
        self,
        *,
        parent_covariance: npt.ArrayLike | None = None,
        child_covariance: npt.ArrayLike | None = None,
        families: Families = None,
        noise: npt.ArrayLike | None = None,
        outliers: Outliers | bool | None = None,
        sequential: bool = True,
    ) -> None:
        self._lock = CallLock()
        self._sequential = sequential
        self._outliers = as_outliers(outliers)
        self._weights = family_weights(families)
        self._noise = parent_covariance, child_covariance, noise
        self._stated = True
        self._added: list[Observations] = []  # the first entry may be many
        self._count = 0
        self._solutions: FamilySolutions = {}
        self._probabilities: Mapping[str, float] = {}
        self._result: IdentificationResult | None = None
        self._full_count, self._noise_count, self._unit = 0, 0, 1.0

    def __len__(self) -> int:
        return self._count

    @one_at_a_time
    def add(
        self,
        parent_pose: npt.ArrayLike | None,
        child_pose: npt.ArrayLike,
        parent_covariance: npt.ArrayLike | None = None,
        child_covariance: npt.ArrayLike | None = None,
    ) -> None:
        """Add a pose of each part, (4, 4). The child may have only a position, (3,).

        Raises
        ------
        ShapeError, InvalidValueError
            For invalid poses or covariances, and for shapes that differ from those before. The observations
            stay as they were.
        """
        default_parent, default_child, noise = self._noise
        of_parent, of_child, stated = resolve_noise(
            parent_pose is not None,
            default_parent if parent_covariance is None else parent_covariance,
            default_child if child_covariance is None else child_covariance,
            noise,
        )
        parent = None if parent_pose is None else np.asarray(parent_pose)[None]
        one = check_observations(parent, np.asarray(child_pose)[None], of_parent, of_child, fewest=1)
        if self._added:
            first = self._added[0]
            if one.rows != first.rows or (one.parent_covariance is None) != (first.parent_covariance is None):
                raise ShapeError(
                    "Poses and positions do not mix, nor a parent that is the world with another."
                )
            if stated != self._stated:
                raise InvalidValueError(
                    "Some poses have a covariance and others have none. Give all one, or noise= for the rest."
                )
        self._added.append(one)
        self._count += 1
        self._stated = stated
        self._result = None

    @property
    @one_at_a_time
    def result(self) -> IdentificationResult:
        """Result of all poses so far.

        Raises
        ------
        InvalidValueError
            For fewer than two poses.
        """
        if self._count < 2:
            count = "is one pose" if self._count else "are no poses"
            raise InvalidValueError(f"There {count} so far. A motion takes at least two.")
        if self._result is None:
            self._added = [_join(self._added)]
            self._result = self._identify(self._added[0])
        return self._result

    @singularity_named()
    def _identify(self, observations: Observations) -> IdentificationResult:
        count = len(observations)
        # A few observations do not determine which of them are outliers.
        if count >= (2.0 if self._outliers is None else 1.0 + _MORE) * self._full_count:
            self._full_count = self._noise_count = count
            data = prepare_data(observations, self._stated, self._outliers, self._sequential)
            self._unit = data.unit
            known = solve_joints(data, self._weights)
            result = weigh_and_check(data, known, self._weights)
        else:
            data = prepare_data(observations, self._stated, self._outliers, self._sequential, self._unit)
            result, known = self._continue(data)
        likely = {name: p for name, p in result.probabilities.items() if p > _NEGLIGIBLE and name != CURVE}
        kept = {name: one for name, one in known.items() if one.scored.solution.motion.name in likely}
        self._solutions, self._probabilities = kept or known, likely
        return result

    def _continue(self, data: IdentificationData) -> tuple[IdentificationResult, FamilySolutions]:
        """Return the result that continues the previous one, and the solutions.

        Unlikely families are not updated at every pose: they keep their odds to the best one.
        """
        count, known, weights = len(data.observations), self._solutions, self._weights
        renew = count >= (1.0 + _MORE) * self._noise_count
        self._noise_count = count if renew else self._noise_count
        before = {
            name: self._probabilities.get(one.scored.solution.motion.name, 1.0) for name, one in known.items()
        }
        best = max(before, key=before.__getitem__)
        likely = {name: one for name, one in known.items() if renew or before[name] > _UNLIKELY}
        solutions = warm_start(data, likely, weights, renew)
        older = {name: one for name, one in known.items() if name not in likely}

        def update() -> FamilySolutions:
            nonlocal older
            solutions.update(warm_start(data, older, weights, renew))
            older = {}
            return solutions

        if older and _is_surprised(data, solutions[best], known[best].count):
            update()
        top = solutions[best].log_evidence + solutions[best].log_prior + math.log(weights[best])
        every = dict(solutions)
        for name, one in older.items():
            log = top + math.log(before[name] / before[best] / weights[name])
            every[name] = replace(one, log_prior=log - one.log_evidence)
        result = weigh_and_check(data, every, weights, update if older else None)

        def fit(name: FamilyName, one: FamilySolution, probability: float) -> Fit:
            alone = warm_start(data, {name: one}, weights, renew)
            return replace(weigh_families(data, alone, weights).best, probability=probability)

        lazy = {each.family: each for each in result.lazy_fits}
        for name, one in older.items():
            family = one.scored.solution.motion.name
            lazy[family] = lazy[family]._replace(compute=partial(fit, name, one, lazy[family].probability))
        return replace(result, lazy_fits=tuple(lazy.values())), solutions | older


def _join(parts: Sequence[Observations]) -> Observations:
    if len(parts) == 1:
        return parts[0]
    parents = [part.parent_covariance for part in parts if part.parent_covariance is not None]
    return Observations(
        np.concatenate([part.parent for part in parts]),
        np.concatenate([part.child for part in parts]),
        np.concatenate(parents) if parents else None,
        np.concatenate([part.child_covariance for part in parts]),
    )
