"""Online identification, warm-started from the previous result."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import cache, partial

import numpy as np
import numpy.typing as npt

from kineverse._runtime import CallLock, one_at_a_time
from kineverse.errors import InvalidValueError, ShapeError
from kineverse.estimation.linear_algebra import singularity_named, squared_errors
from kineverse.estimation.noise import Outliers, as_outliers
from kineverse.lie import Array

from .curve import CURVE
from .joint_identification import Families, family_weights, resolve_noise
from .joint_values import is_screw
from .kinematic_graph.pairwise import SURPRISE_DEVIATIONS
from .least_squares import InitialGuess
from .model_check import fit_of_curve, is_doubtful, solve_joints, weigh_and_check, without_curve
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
from .outlier_rejection import RowIndices
from .result import Fit, IdentificationResult, LazyFit, classify_inliers, project_observations
from .solver import solver


class ObservationBuffer:
    """Growing buffer of observations. Its arrays double in size when they are full."""

    def __init__(self) -> None:
        self._arrays: dict[str, Array] = {}
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def add(self, one: Observations) -> None:
        """Append an observation."""
        new = {name: array for name, array in vars(one).items() if name in _FIELDS and array is not None}
        if not self._arrays:
            self._arrays = {name: np.empty_like(array) for name, array in new.items()}
        shapes = [{name: array.shape[1:] for name, array in some.items()} for some in (new, self._arrays)]
        if shapes[0] != shapes[1]:
            raise ShapeError("Poses and positions do not mix, nor a parent that is the world with another.")
        for name, array in new.items():
            if len(self._arrays[name]) == self._count:
                # Observations that were returned earlier keep the old array.
                old = self._arrays[name]
                self._arrays[name] = np.concatenate([old, np.empty_like(old)])
            self._arrays[name][self._count] = array[0]
        self._count += 1

    @property
    def all(self) -> Observations:
        """All observations so far."""
        arrays = {name: array[: self._count] for name, array in self._arrays.items()}
        return Observations(parent_covariance=arrays.pop("parent_covariance", None), **arrays)


_FIELDS = tuple(field.name for field in fields(Observations))


def warm_start(
    data: IdentificationData, known: FamilySolutions, weights: FamilyWeights, renew: bool = False
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
        scored = solver.continue_from(scale_noise(observations, one.noise.factors), *start, first)
        solutions[name] = NoiseSolution(scored, one.noise)
    return score_solutions(data, solutions, inliers, weights, renew)


def is_surprised(data: IdentificationData, one: FamilySolution, count: int) -> bool:
    """Return True if observations from ``count`` on contain outliers, or have a χ² too large for noise."""
    new = len(data.observations) - count
    if np.count_nonzero(one.inliers >= count) < new:
        return True
    solution = one.scored.solution
    residuals, covariance = solution.residuals[-new:], solution.covariance[-new:]
    squares = float(squared_errors(residuals, covariance).sum())
    return squares > residuals.size + SURPRISE_DEVIATIONS * math.sqrt(2.0 * residuals.size)


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


# A family with a smaller probability is not updated until the number of observations has doubled.
_NEGLIGIBLE = 1e-6
# A family with a smaller probability than the first is updated after this relative increase of observations.
_UNLIKELY, _MORE = 0.01, 0.125


class Identifier:
    """Online identification of the joint between two parts.

    The result is that of :func:`.identify` for all poses so far, at a fraction of the cost: each family
    starts from its previous solution. A family below 1 % is updated after an eighth more observations, or
    when a new pose is improbable under the best family; its fit uses all poses in any case. A family below
    one in a million is left out of the result until the number of observations has doubled.

    Parameters
    ----------
    parent_covariance, child_covariance
        Default covariances of the errors of poses, (6, 6).
    families, noise, outliers
        As for :func:`.identify`. A new pose is classified when it arrives. All poses are classified again
        when their number has doubled.
    sequential
        True if the poses arrive in temporal order, see :func:`.identify`.
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
        self._buffer = ObservationBuffer()
        self._solutions: FamilySolutions = {}
        # Log odds of each family against the best one at its last update.
        self._odds: dict[FamilyName, float] = {}
        self._result: IdentificationResult | None = None
        self._full_count, self._noise_count, self._count, self._unit = 0, 0, 0, 1.0
        # Last check of the most probable family, and the solution of the curve at that time.
        self._check: _Check | None = None

    def __len__(self) -> int:
        return len(self._buffer)

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
        if len(self._buffer) and stated != self._stated:
            raise InvalidValueError(
                "Some poses have a covariance and others have none. Give all one, or noise= for the rest."
            )
        self._buffer.add(one)
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
        if len(self._buffer) < 2:
            count = "is one pose" if len(self._buffer) else "are no poses"
            raise InvalidValueError(f"There {count} so far. A motion takes at least two.")
        if self._result is None:
            self._result = self._identify()
        return self._result

    @singularity_named()
    def _identify(self) -> IdentificationResult:
        observations = self._buffer.all
        if not without_curve(self._weights):
            data = prepare_data(observations, self._stated, self._outliers, self._sequential)
            return weigh_and_check(data, {}, self._weights)[0]
        deferred: FamilySolutions = {}
        # A few observations do not determine which of them are outliers.
        growth = 2.0 if self._outliers is None else 1.0 + _MORE
        if len(observations) >= growth * self._full_count:
            self._full_count = self._noise_count = len(observations)
            data = prepare_data(observations, self._stated, self._outliers, self._sequential)
            self._unit = data.unit
            known = solve_joints(data, self._weights)
            self._check = None
        else:
            data = prepare_data(observations, self._stated, self._outliers, self._sequential, self._unit)
            known, deferred = self._update_families(data)
        result = weigh_families(data, known | deferred, self._weights)
        self._count = len(observations)
        likely = {name: p for name, p in result.probabilities.items() if p > _NEGLIGIBLE}
        best = max(likely.values())
        self._solutions, self._odds = {}, {}
        for name, one in (known | deferred).items():
            if (p := likely.get(one.scored.solution.motion.name)) is not None:
                self._solutions[name], self._odds[name] = one, math.log(p / best)
        lazy_fits = {fit.family: fit for fit in result.lazy_fits}
        for name, one in deferred.items():
            fit = lazy_fits[one.scored.solution.motion.name]
            compute = partial(_deferred_fit, data, name, one, self._weights)
            lazy_fits[fit.family] = fit._replace(compute=partial(_with_probability, compute, fit.probability))
        result = replace(result, lazy_fits=tuple(lazy_fits.values()))
        check, best_family = self._check, result.lazy_fits[0].family
        is_recent = check is not None and len(observations) < (1.0 + _MORE) * check.count
        if check is not None and is_recent and not check.is_doubted and check.family == best_family:
            return result if check.curve is None else _with_curve(data, result, check, self._weights)
        if not is_doubtful(data, result, known):
            self._check = _Check(best_family, len(observations))
            return result
        if check is not None:
            # The families below one in a million may be those that a larger noise makes probable.
            known = solve_joints(data, self._weights)
        result, curve = weigh_and_check(data, known, self._weights, None if check is None else check.curve)
        probabilities = result.probabilities
        best_family = next((fit.family for fit in result.lazy_fits if fit.family != CURVE), "")
        odds = probabilities.get(CURVE, 0.0) / max(probabilities.get(best_family, 0.0), 1e-300)
        self._check = _Check(best_family, len(observations), bool(result.reason), curve, odds)
        return result

    def _update_families(self, data: IdentificationData) -> tuple[FamilySolutions, FamilySolutions]:
        best = max(self._odds, key=self._odds.__getitem__)
        count = len(self._buffer)
        renew = not data.stated and count >= (1.0 + _MORE) * self._noise_count
        deferred = {
            name: one
            for name, one in self._solutions.items()
            if not renew and self._odds[name] < math.log(_UNLIKELY) and count < (1.0 + _MORE) * one.count
        }
        due = {name: one for name, one in self._solutions.items() if name not in deferred}
        known = warm_start(data, due, self._weights, renew)
        if renew:
            self._noise_count = count
            return known, {}
        leading = max(known, key=lambda name: self._log_posterior(name, known[name]))
        if deferred or not data.stated:
            if leading != best or is_surprised(data, known[best], self._count):
                self._noise_count = count
                return warm_start(data, self._solutions, self._weights, renew=not data.stated), {}
        # Their odds against the best family stay as they were.
        top = self._log_posterior(leading, known[leading])
        for name, one in deferred.items():
            more = top + self._odds[name] - self._log_posterior(name, one)
            scored = one.scored._replace(log_evidence=one.scored.log_evidence + more)
            deferred[name] = replace(one, scored=scored)
        return known, deferred

    def _log_posterior(self, name: FamilyName, one: FamilySolution) -> float:
        return one.log_evidence + one.log_prior + math.log(self._weights[name])


@dataclass(frozen=True)
class _Check:
    """Check of the most probable family."""

    family: str  # most probable family but the curve
    count: int  # number of observations
    is_doubted: bool = False  # True if there was a reason why the best family was not sure
    curve: FamilySolution | None = None  # solution of the curve; None if none was fitted
    odds: float = 0.0  # odds of the curve against that family


def _with_curve(
    data: IdentificationData, result: IdentificationResult, check: _Check, weights: FamilyWeights
) -> IdentificationResult:
    """Return a result with a curve at the odds of its last check. Its fit uses all observations."""
    share = check.odds * result.lazy_fits[0].probability
    total = 1.0 + share
    p = share / total
    fits = [LazyFit(CURVE, p, partial(fit_of_curve, data, {}, weights, check.curve, p))]
    for family, q, compute in result.lazy_fits:
        fits.append(LazyFit(family, q / total, partial(_with_probability, compute, q / total)))
    return replace(result, lazy_fits=tuple(sorted(fits, key=lambda fit: -fit.probability)))


def _with_probability(compute: Callable[[], Fit], probability: float) -> Fit:
    return replace(compute(), probability=probability)


def _deferred_fit(
    data: IdentificationData, name: FamilyName, one: FamilySolution, weights: FamilyWeights
) -> Fit:
    return weigh_families(data, warm_start(data, {name: one}, weights), weights).best
