"""Identification while poses come in."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from kineverse.errors import ShapeError, ValueRejectedError
from kineverse.estimation.tracking.outliers import Outliers, as_outliers

from .beside import are_right, beside
from .family import Family
from .fit import Found
from .identify import (
    Explained,
    Families,
    Sight,
    explained,
    explained_by,
    family_weights,
    noise_of,
    sight_of,
    weighed,
)
from .motion import Member
from .native import solver
from .observations import Observations, observations
from .outlying import Rows
from .refining import Rated
from .rigid import Array
from .solving import Solution, Start
from .turning import is_screw

# A family that is less probable than this rests until there are twice as many observations.
_NO_CHANCE = 1e-6


class Identifier:
    """How a part moves against another, learned while it moves.

    It gives what :func:`.identify.identify` gives of all poses so far, at a fraction of the cost: each family
    goes on from where it was. A family that has no chance rests until there are twice as many observations,
    and is not among what was found meanwhile.

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
        covariance_a: npt.ArrayLike | None = None,
        covariance_b: npt.ArrayLike | None = None,
        families: Families = None,
        noise: npt.ArrayLike | None = None,
        outliers: Outliers | bool | None = None,
        ordered: bool = True,
    ) -> None:
        self._ordered = ordered
        self._outliers = as_outliers(outliers)
        self._weights = family_weights(families)
        self._noise = covariance_a, covariance_b, noise
        self._stated = True
        self._seen: list[Observations] = []
        self._known: dict[str | Family, Explained] = {}
        self._found: Found | None = None
        self._whole, self._unit, self._scale = 0, 1.0, 1.0

    def __len__(self) -> int:
        return len(self._seen)

    def add(
        self,
        a: npt.ArrayLike | None,
        b: npt.ArrayLike,
        covariance_a: npt.ArrayLike | None = None,
        covariance_b: npt.ArrayLike | None = None,
    ) -> None:
        """Take notice of a pose of each part, (4, 4); of the child perhaps only its position, (3,).

        Raises
        ------
        ShapeError, ValueRejectedError
            For poses or covariances that are none, or of another kind than those before; nothing has changed
            then.
        """
        of_a, of_b, noise = self._noise
        of_a, of_b, stated = noise_of(
            a is not None,
            of_a if covariance_a is None else covariance_a,
            of_b if covariance_b is None else covariance_b,
            noise,
        )
        one = observations(
            None if a is None else np.asarray(a)[None], np.asarray(b)[None], of_a, of_b, fewest=1
        )
        if self._seen:
            first = self._seen[0]
            if one.rows != first.rows or (one.parent_covariance is None) != (first.parent_covariance is None):
                raise ShapeError(
                    "Poses and positions do not mix, nor a parent that is the world with another."
                )
        self._stated = stated
        self._seen.append(one)
        self._found = None

    @property
    def found(self) -> Found:
        """What all poses so far tell.

        Raises
        ------
        ValueRejectedError
            For fewer than two poses.
        """
        if len(self._seen) < 2:
            raise ValueRejectedError(
                f"There are {len(self._seen)} poses so far. How something moves takes at least two to see."
            )
        if self._found is None:
            self._found = self._find()
        return self._found

    def _find(self) -> Found:
        seen = _joined(self._seen)
        if len(seen) >= 2 * self._whole:
            self._whole = len(seen)
            sight = sight_of(seen, self._stated, self._outliers, self._ordered)
            self._unit = sight.unit
            known = explained(sight, self._weights)
        else:
            sight = sight_of(seen, self._stated, self._outliers, self._ordered, self._unit)
            right = {name: _right(sight, one, self._scale) for name, one in self._known.items()}
            found = {
                name: _continued(sight.seen.at(right[name]), one.known.solution, self._ordered)
                for name, one in self._known.items()
            }
            known = explained_by(sight, found, right, self._weights)
        result = weighed(sight, known, self._weights)
        self._scale = result.noise_scale
        chances = {name for name, probability in result.probabilities.items() if probability > _NO_CHANCE}
        self._known = {name: one for name, one in known.items() if one.known.solution.motion.name in chances}
        return result


def _joined(parts: list[Observations]) -> Observations:
    parents = [p.parent_covariance for p in parts if p.parent_covariance is not None]
    return Observations(
        np.concatenate([p.parent for p in parts]),
        np.concatenate([p.child for p in parts]),
        np.concatenate(parents) if parents else None,
        np.concatenate([p.child_covariance for p in parts]),
    )


def _continued(seen: Observations, before: Solution[Member], ordered: bool) -> Rated:
    """Return the solution of a family for more observations than it was found from."""
    known = len(before.values)
    values: list[Array] = [before.values]
    for k in range(known, len(seen)):
        # The new joint value is near that of the observation that looks most alike.
        apart = np.sum((seen.relative[:known] - seen.relative[k]) ** 2, axis=(1, 2))
        near = before.values[int(np.argmin(apart))][None]
        if ordered and is_screw(before.motion):
            near = near + math.tau * np.round((values[-1][-1] - near) / math.tau)
        values.append(near)
    parent = np.concatenate([before.parent, seen.parent[known:]])
    return solver.continued(seen, Start(before.motion, np.concatenate(values)), parent, before.belief, known)


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
