"""Online identification, warm-started from the previous result."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial

import numpy as np
import numpy.typing as npt

from kineverse.errors import InvalidValueError, ShapeError
from kineverse.estimation.robust import Outliers, as_outliers
from kineverse.lie import Stack

from .custom_family import Family
from .identify import (
    Families,
    FamilySolution,
    IdentificationData,
    family_weights,
    prepare_data,
    resolve_noise,
    score_solutions,
    solve_with_inliers,
    weigh_families,
)
from .kinematic_graph.pairwise import SURPRISE_DEVIATIONS
from .maximum_likelihood import Scored
from .motion_model import FamilyMember
from .observations import Observations, check_observations
from .optimise import InitialGuess, Solution
from .outlier_rejection import RowIndices
from .projection import classify_inliers, project_observations
from .result import Fit, IdentificationResult, LazyFit
from .solver import solver
from .unwrapping import is_screw


class ObservationBuffer:
    """Observations that came one by one, in arrays that grow by doubling."""

    def __init__(self) -> None:
        self._arrays: list[Stack | None] = []
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def add(self, one: Observations) -> None:
        """Take one more.

        Raises
        ------
        ShapeError
            If it is of another kind than those before.
        """
        new = [one.parent, one.child, one.parent_covariance, one.child_covariance]
        if not self._arrays:
            self._arrays = [None if array is None else np.empty_like(array) for array in new]
        elif [_entry_shape(array) for array in new] != [_entry_shape(array) for array in self._arrays]:
            raise ShapeError("Poses and positions do not mix, nor a parent that is the world with another.")
        for k, (old, array) in enumerate(zip(self._arrays, new, strict=True)):
            if old is None or array is None:
                continue
            if len(old) == self._count:
                # What was handed out keeps the old array.
                self._arrays[k] = old = np.concatenate([old, np.empty_like(old)])
            old[self._count] = array[0]
        self._count += 1

    @property
    def all(self) -> Observations:
        """All of them."""
        parent, child, of_parent, of_child = (
            None if array is None else array[: self._count] for array in self._arrays
        )
        assert parent is not None
        assert child is not None
        assert of_child is not None  # as only that of the parent may be missing
        return Observations(parent, child, of_parent, of_child)


def _entry_shape(array: Stack | None) -> tuple[int, ...] | None:
    return None if array is None else array.shape[1:]


def warm_start(
    sight: IdentificationData,
    known: Mapping[str | Family, FamilySolution],
    scale: float,
    weights: Mapping[str | Family, float],
) -> dict[str | Family, FamilySolution]:
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
    right = {name: _predict_inliers(sight, one, scale) for name, one in known.items()}
    most_alike = functools.cache(_most_alike)  # most families are by the same ones
    found = {}
    for name, one in known.items():
        seen = sight.seen if len(right[name]) == len(sight.seen) else sight.seen.at(right[name])
        found[name] = _continued(seen, one.known.solution, most_alike(seen, len(one.right)), sight.ordered)
    return score_solutions(sight, found, right, weights)


def is_surprised(sight: IdentificationData, one: FamilySolution, count: int) -> bool:
    """Return whether a family finds observations from a number on wrong, or improbable by their size."""
    new = len(sight.seen) - count
    if np.count_nonzero(one.right >= count) < new:
        return True
    solution = one.known.solution
    residuals, covariance = solution.residuals[-new:], solution.covariance[-new:]
    squares = float(np.sum(residuals * np.linalg.solve(covariance, residuals[:, :, None])[:, :, 0]))
    return squares > residuals.size + SURPRISE_DEVIATIONS * math.sqrt(2.0 * residuals.size)


def _continued(
    seen: Observations, before: Solution[FamilyMember], alike: RowIndices, ordered: bool
) -> Scored:
    """Return the solution of a family for more observations than it was found from."""
    known = len(before.values)
    # What looks alike has joint values that are near.
    values = np.concatenate([before.values, before.values[alike]])
    if ordered and is_screw(before.motion):
        for k in range(known, len(values)):
            values[k] += math.tau * np.round((values[k - 1] - values[k]) / math.tau)
    parent = np.concatenate([before.parent, seen.parent[known:]])
    return solver.continued(seen, InitialGuess(before.motion, values), parent, before.belief, known)


def _most_alike(seen: Observations, known: int) -> RowIndices:
    """Return which of the first observations looks most like each of the others."""
    old, new = seen.relative[None, :known], seen.relative[known:, None]
    alike: RowIndices = np.argmin(np.sum((old - new) ** 2, axis=(2, 3)), axis=1)
    return alike


def _predict_inliers(sight: IdentificationData, one: FamilySolution, scale: float) -> RowIndices:
    """Return the numbers of what is right: of what was, and of what came and is where it may be expected."""
    new, solution = np.arange(one.count, len(sight.seen)), one.known.solution
    if sight.outliers is None or solution.motion.joints == sight.seen.rows:
        return np.concatenate([one.right, new])
    came = project_observations(solution.motion, solution.values, sight.seen.at(new))
    by_parameters = solution.motion.at(came.values).by_parameters
    # What is not known of the joint yet is no error of what was seen.
    unknown = solver.evidence(solution).covariance
    covariance = came.covariance + by_parameters @ unknown @ np.swapaxes(by_parameters, 1, 2)
    came_right = classify_inliers(came.residuals, scale**2 * covariance, sight.outliers, sight.stated)
    return np.concatenate([one.right, new[came_right]])


# A family that is less probable than this rests until there are twice as many observations.
_NO_CHANCE = 1e-6
# One that is less probable than this is looked at when there are more observations by this part.
_UNLIKELY, _MORE = 0.01, 0.125


class Identifier:
    """How a part moves against another, learned while it moves.

    It gives what :func:`.identify.identify` gives of all poses so far, at a fraction of the cost: each family
    goes on from where it was. A family below 1 % is compared with the others again when there are an eighth
    more observations, or when a pose is a surprise to the best one; its fit is always by all poses. One that
    has no chance rests until there are twice as many, and is not among what was found meanwhile.

    Parameters
    ----------
    covariance_a, covariance_b
        Covariances of the errors of all poses that come without their own, (6, 6).
    families, noise, outliers
        As for :func:`.identify.identify`. A pose is taken for wrong as it comes, and perhaps for right when
        there are twice as many.
    ordered
        Whether poses come in the order in which they were seen, see :func:`.identify.identify`.

    Raises
    ------
    UnknownNameError
        For a family that does not exist.
    """

    def __init__(
        self,
        *,
        parent_covariance: npt.ArrayLike | None = None,
        child_covariance: npt.ArrayLike | None = None,
        families: Families = None,
        noise: npt.ArrayLike | None = None,
        outliers: Outliers | bool | None = None,
        ordered: bool = True,
    ) -> None:
        self._ordered = ordered
        self._outliers = as_outliers(outliers)
        self._weights = family_weights(families)
        self._noise = parent_covariance, child_covariance, noise
        self._stated = True
        self._seen = ObservationBuffer()
        self._known: dict[str | Family, FamilySolution] = {}
        # By the family, the logarithm of how probable it was beside the best one when it was looked at.
        self._odds: dict[str | Family, float] = {}
        self._found: IdentificationResult | None = None
        self._whole, self._count, self._unit, self._scale = 0, 0, 1.0, 1.0

    def __len__(self) -> int:
        return len(self._seen)

    def add(
        self,
        a: npt.ArrayLike | None,
        b: npt.ArrayLike,
        parent_covariance: npt.ArrayLike | None = None,
        child_covariance: npt.ArrayLike | None = None,
    ) -> None:
        """Take notice of a pose of each part, (4, 4); of the child perhaps only its position, (3,).

        Raises
        ------
        ShapeError, InvalidValueError
            For poses or covariances that are none, or of another kind than those before; nothing has changed
            then.
        """
        of_a, of_b, noise = self._noise
        of_a, of_b, stated = resolve_noise(
            a is not None,
            of_a if parent_covariance is None else parent_covariance,
            of_b if child_covariance is None else child_covariance,
            noise,
        )
        one = check_observations(
            None if a is None else np.asarray(a)[None], np.asarray(b)[None], of_a, of_b, fewest=1
        )
        self._seen.add(one)
        self._stated = stated
        self._found = None

    @property
    def found(self) -> IdentificationResult:
        """What all poses so far tell.

        Raises
        ------
        InvalidValueError
            For fewer than two poses.
        """
        if len(self._seen) < 2:
            raise InvalidValueError(
                f"There are {len(self._seen)} poses so far. How something moves takes at least two to see."
            )
        if self._found is None:
            self._found = self._find()
        return self._found

    def _find(self) -> IdentificationResult:
        seen = self._seen.all
        resting: dict[str | Family, FamilySolution] = {}
        if len(seen) >= 2 * self._whole:
            self._whole = len(seen)
            sight = prepare_data(seen, self._stated, self._outliers, self._ordered)
            self._unit = sight.unit
            known = solve_with_inliers(sight, self._weights)
        else:
            sight = prepare_data(seen, self._stated, self._outliers, self._ordered, self._unit)
            known, resting = self._looked_at(sight)
        found = weigh_families(sight, known | resting, self._weights)
        self._scale, self._count = found.noise_scale, len(seen)
        likely = {name: p for name, p in found.probabilities.items() if p > _NO_CHANCE}
        best = max(likely.values())
        self._known, self._odds = {}, {}
        for name, one in (known | resting).items():
            if (p := likely.get(one.known.solution.motion.name)) is not None:
                self._known[name], self._odds[name] = one, math.log(p / best)
        late = {
            one.known.solution.motion.name: partial(_late, sight, name, one, self._scale, self._weights)
            for name, one in resting.items()
        }
        return replace(found, offers=tuple(_offered(offer, late) for offer in found.offers))

    def _looked_at(
        self, sight: IdentificationData
    ) -> tuple[dict[str | Family, FamilySolution], dict[str | Family, FamilySolution]]:
        """Return what families make of all that was seen, and what those made of less that may rest."""
        best = max(self._odds, key=self._odds.__getitem__)
        rest = {name: one for name, one in self._known.items() if sight.stated and self._may_rest(name, one)}
        due = {name: one for name, one in self._known.items() if name not in rest}
        known = warm_start(sight, due, self._scale, self._weights)
        leading = max(known, key=lambda name: self._log(name, known[name]))
        if rest and (leading != best or is_surprised(sight, known[best], self._count)):
            return known | warm_start(sight, rest, self._scale, self._weights), {}
        # Beside the best one they are as probable as they were.
        top = self._log(leading, known[leading])
        for name, one in rest.items():
            more = top + self._odds[name] - self._log(name, one)
            rated = one.known._replace(log_evidence=one.known.log_evidence + more)
            rest[name] = replace(one, known=rated)
        return known, rest

    def _may_rest(self, name: str | Family, one: FamilySolution) -> bool:
        return self._odds[name] < math.log(_UNLIKELY) and len(self._seen) < (1.0 + _MORE) * one.count

    def _log(self, name: str | Family, one: FamilySolution) -> float:
        return one.known.log_evidence + one.log_belief + math.log(self._weights[name])


def _offered(offer: LazyFit, late: Mapping[str, Callable[[float], Fit]]) -> LazyFit:
    make = late.get(offer.family)
    return offer if make is None else offer._replace(make=partial(make, offer.probability))


def _late(
    sight: IdentificationData,
    name: str | Family,
    one: FamilySolution,
    scale: float,
    weights: Mapping[str | Family, float],
    probability: float,
) -> Fit:
    """Return the fit of a family that rested, by all that was seen."""
    fit = weigh_families(sight, warm_start(sight, {name: one}, scale, weights), weights).best
    return replace(fit, probability=probability)
