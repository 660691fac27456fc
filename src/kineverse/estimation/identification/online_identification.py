"""Online identification, warm-started from the previous result."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import numpy.typing as npt

from kineverse._runtime import CallLock, one_at_a_time
from kineverse.errors import InvalidValueError, ShapeError
from kineverse.estimation.linear_algebra import singularity_named, squared_errors
from kineverse.estimation.noise import Outliers, as_outliers
from kineverse.lie import Array

from .curve import CURVE
from .families import Family
from .joint_identification import Families, family_weights, resolve_noise
from .joint_values import is_screw
from .kinematic_graph.pairwise import SURPRISE_DEVIATIONS
from .least_squares import InitialGuess, Solution
from .marginal_likelihood import Scored
from .model_check import fit_of_curve, is_doubtful, solve_joints, weigh_and_check, without_curve
from .model_selection import (
    FamilySolution,
    IdentificationData,
    prepare_data,
    score_solutions,
    weigh_families,
)
from .motion_model import FamilyMember
from .noise_estimation import NoiseSolution, scale_noise
from .observations import Observations, check_observations
from .outlier_rejection import RowIndices
from .result import Fit, IdentificationResult, LazyFit, classify_inliers, project_observations
from .solver import solver


class ObservationBuffer:
    """Growing buffer of observations. Its arrays double in size when they are full."""

    def __init__(self) -> None:
        self._arrays: list[Array | None] = []
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def add(self, one: Observations) -> None:
        """Append an observation."""
        new = [one.parent, one.child, one.parent_covariance, one.child_covariance]
        if not self._arrays:
            self._arrays = [None if array is None else np.empty_like(array) for array in new]
        elif [_entry_shape(array) for array in new] != [_entry_shape(array) for array in self._arrays]:
            raise ShapeError("Poses and positions do not mix, nor a parent that is the world with another.")
        for k, (old, array) in enumerate(zip(self._arrays, new, strict=True)):
            if old is None or array is None:
                continue
            if len(old) == self._count:
                # Observations that were returned earlier keep the old array.
                self._arrays[k] = old = np.concatenate([old, np.empty_like(old)])
            old[self._count] = array[0]
        self._count += 1

    @property
    def all(self) -> Observations:
        """All observations so far."""
        parent, child, of_parent, of_child = (
            None if array is None else array[: self._count] for array in self._arrays
        )
        assert parent is not None
        assert child is not None
        assert of_child is not None  # only the covariance of the parent may be None
        return Observations(parent, child, of_parent, of_child)


def _entry_shape(array: Array | None) -> tuple[int, ...] | None:
    return None if array is None else array.shape[1:]


def warm_start(
    data: IdentificationData,
    known: Mapping[str | Family, FamilySolution],
    weights: Mapping[str | Family, float],
    renew: bool = False,
) -> dict[str | Family, FamilySolution]:
    """Return the solutions of families for all observations, starting from earlier solutions."""
    inliers = {name: _predict_inliers(data, one) for name, one in known.items()}
    nearest_of = functools.cache(_nearest_observations)  # most families have the same inliers
    found = {}
    for name, one in known.items():
        observations = (
            data.observations
            if len(inliers[name]) == len(data.observations)
            else data.observations.select(inliers[name])
        )
        nearest = nearest_of(observations, len(one.inliers))
        scaled = scale_noise(observations, one.noise.factors)
        scored = _continue_family(scaled, one.scored.solution, nearest, data.sequential)
        found[name] = NoiseSolution(scored, one.noise)
    return score_solutions(data, found, inliers, weights, renew)


def is_surprised(data: IdentificationData, one: FamilySolution, count: int) -> bool:
    """Return True if new observations contain outliers of a family, or have a χ² that is too large for noise.

    The observations from index ``count`` on are new.
    """
    new = len(data.observations) - count
    if np.count_nonzero(one.inliers >= count) < new:
        return True
    solution = one.scored.solution
    residuals, covariance = solution.residuals[-new:], solution.covariance[-new:]
    squares = float(squared_errors(residuals, covariance).sum())
    return squares > residuals.size + SURPRISE_DEVIATIONS * math.sqrt(2.0 * residuals.size)


def _continue_family(
    observations: Observations, before: Solution[FamilyMember], nearest: RowIndices, sequential: bool
) -> Scored:
    """Return the solution of a family for more observations than before."""
    known = len(before.values)
    # Similar relative poses have similar joint values.
    values = np.concatenate([before.values, before.values[nearest]])
    if sequential and is_screw(before.motion):
        for k in range(known, len(values)):
            values[k] += math.tau * np.round((values[k - 1] - values[k]) / math.tau)
    parent = np.concatenate([before.parent, observations.parent[known:]])
    return solver.continue_from(
        observations, InitialGuess(before.motion, values), parent, before.joint_prior, known
    )


def _nearest_observations(observations: Observations, known: int) -> RowIndices:
    """Return the index of the nearest of the first ``known`` relative poses, for each of the others."""
    old, new = observations.relative[None, :known], observations.relative[known:, None]
    nearest: RowIndices = np.argmin(np.sum((old - new) ** 2, axis=(2, 3)), axis=1)
    return nearest


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

    The result is that of :func:`.identify.identify` for all poses so far, at a fraction of the cost: each
    family starts from its previous solution. A family below 1 % is updated after an eighth more observations,
    or when a new pose is improbable under the best family; its fit uses all poses in any case. A family below
    one in a million is left out of the result until the number of observations has doubled.

    Parameters
    ----------
    parent_covariance, child_covariance
        Covariances of the errors of poses that have none of their own, (6, 6).
    families, noise, outliers
        As for :func:`.identify.identify`. A new pose is classified when it arrives. All poses are classified
        again when their number has doubled.
    sequential
        True if the poses arrive in temporal order, see :func:`.identify.identify`.

    Raises
    ------
    UnknownNameError
        For an unknown family.
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
        self._joint_weights = without_curve(self._weights)
        self._noise = parent_covariance, child_covariance, noise
        self._stated = True
        self._buffer = ObservationBuffer()
        self._solutions: dict[str | Family, FamilySolution] = {}
        # Log odds of each family against the best one at its last update.
        self._odds: dict[str | Family, float] = {}
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
        one = check_observations(
            None if parent_pose is None else np.asarray(parent_pose)[None],
            np.asarray(child_pose)[None],
            of_parent,
            of_child,
            fewest=1,
        )
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
            raise InvalidValueError(f"There {count} so far. How something moves takes at least two to see.")
        if self._result is None:
            self._result = self._identify()
        return self._result

    @singularity_named()
    def _identify(self) -> IdentificationResult:
        observations = self._buffer.all
        if not self._joint_weights:
            data = prepare_data(observations, self._stated, self._outliers, self._sequential)
            return weigh_and_check(data, {}, self._weights).result
        deferred: dict[str | Family, FamilySolution] = {}
        # Poses of a few observations cannot tell which of them are outliers.
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
        found = weigh_families(data, known | deferred, self._weights)
        self._count = len(observations)
        likely = {name: p for name, p in found.probabilities.items() if p > _NEGLIGIBLE}
        best = max(likely.values())
        self._solutions, self._odds = {}, {}
        for name, one in (known | deferred).items():
            if (p := likely.get(one.scored.solution.motion.name)) is not None:
                self._solutions[name], self._odds[name] = one, math.log(p / best)
        deferred_fits = {
            one.scored.solution.motion.name: partial(_deferred_fit, data, name, one, self._weights)
            for name, one in deferred.items()
        }
        found = replace(
            found,
            lazy_fits=tuple(_with_deferred_fit(lazy_fit, deferred_fits) for lazy_fit in found.lazy_fits),
        )
        check, best_family = self._check, found.lazy_fits[0].family
        if (
            check is None
            or check.is_doubted
            or check.family != best_family
            or len(observations) >= (1.0 + _MORE) * check.count
        ):
            if not is_doubtful(data, found, known):
                self._check = _Check(best_family, len(observations))
                return found
            if check is not None:
                # The families below one in a million may be those that a larger noise makes probable.
                known = solve_joints(data, self._weights)
            return self._check_best(data, known)
        return found if check.curve is None else _with_curve(data, found, check, self._weights)

    def _check_best(
        self, data: IdentificationData, known: Mapping[str | Family, FamilySolution]
    ) -> IdentificationResult:
        """Return the result with the curve, and with the reason if the best family is not sure."""
        before = None if self._check is None else self._check.curve
        result, curve = weigh_and_check(data, known, self._weights, before)
        p = result.probabilities
        best_family = next((lazy_fit.family for lazy_fit in result.lazy_fits if lazy_fit.family != CURVE), "")
        odds = p.get(CURVE, 0.0) / max(p.get(best_family, 0.0), 1e-300)
        self._check = _Check(best_family, len(data.observations), bool(result.reason), curve, odds)
        return result

    def _update_families(
        self, data: IdentificationData
    ) -> tuple[dict[str | Family, FamilySolution], dict[str | Family, FamilySolution]]:
        """Return the updated solutions, and the older ones of families whose update is deferred."""
        best = max(self._odds, key=self._odds.__getitem__)
        renew = not data.stated and len(self._buffer) >= (1.0 + _MORE) * self._noise_count
        deferred = {
            name: one for name, one in self._solutions.items() if not renew and self._is_deferred(name, one)
        }
        due = {name: one for name, one in self._solutions.items() if name not in deferred}
        known = warm_start(data, due, self._weights, renew)
        if renew:
            self._noise_count = len(self._buffer)
            return known, {}
        leading = max(known, key=lambda name: self._log_posterior(name, known[name]))
        if (deferred or not data.stated) and (
            leading != best or is_surprised(data, known[best], self._count)
        ):
            self._noise_count = len(self._buffer)
            return warm_start(data, self._solutions, self._weights, renew=not data.stated), {}
        # Their odds against the best family stay as they were.
        top = self._log_posterior(leading, known[leading])
        for name, one in deferred.items():
            more = top + self._odds[name] - self._log_posterior(name, one)
            scored = one.scored._replace(log_evidence=one.scored.log_evidence + more)
            deferred[name] = replace(one, scored=scored)
        return known, deferred

    def _is_deferred(self, name: str | Family, one: FamilySolution) -> bool:
        return self._odds[name] < math.log(_UNLIKELY) and len(self._buffer) < (1.0 + _MORE) * one.count

    def _log_posterior(self, name: str | Family, one: FamilySolution) -> float:
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
    data: IdentificationData,
    found: IdentificationResult,
    check: _Check,
    weights: Mapping[str | Family, float],
) -> IdentificationResult:
    """Return a result with a curve at the odds of its last check. Its fit uses all observations."""
    curve_share = check.odds * found.lazy_fits[0].probability
    total = 1.0 + curve_share
    p = curve_share / total
    curve = LazyFit(CURVE, p, partial(fit_of_curve, data, {}, weights, check.curve, p))
    others = [
        LazyFit(family, q / total, partial(_with_probability, compute, q / total))
        for family, q, compute in found.lazy_fits
    ]
    return replace(
        found, lazy_fits=tuple(sorted([curve, *others], key=lambda lazy_fit: -lazy_fit.probability))
    )


def _with_probability(compute: Callable[[], Fit], probability: float) -> Fit:
    return replace(compute(), probability=probability)


def _with_deferred_fit(lazy_fit: LazyFit, deferred_fits: Mapping[str, Callable[[float], Fit]]) -> LazyFit:
    compute = deferred_fits.get(lazy_fit.family)
    return lazy_fit if compute is None else lazy_fit._replace(compute=partial(compute, lazy_fit.probability))


def _deferred_fit(
    data: IdentificationData,
    name: str | Family,
    one: FamilySolution,
    weights: Mapping[str | Family, float],
    probability: float,
) -> Fit:
    """Return the fit of a family whose update was deferred, by all observations."""
    fit = weigh_families(data, warm_start(data, {name: one}, weights), weights).best
    return replace(fit, probability=probability)
