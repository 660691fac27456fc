"""Identification while poses come in."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial

import numpy as np
import numpy.typing as npt

from kineverse.errors import ValueRejectedError
from kineverse.estimation.tracking.outliers import Outliers, as_outliers

from .continuing import caught_up, is_surprised
from .family import Family
from .fit import Fit, Found, Offer
from .gathered import Gathered
from .identify import Explained, Families, Sight, explained, family_weights, noise_of, sight_of, weighed
from .observations import observations

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
        self._seen = Gathered()
        self._known: dict[str | Family, Explained] = {}
        # By the family, the logarithm of how probable it was beside the best one when it was looked at.
        self._odds: dict[str | Family, float] = {}
        self._found: Found | None = None
        self._whole, self._count, self._unit, self._scale = 0, 0, 1.0, 1.0

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
        self._seen.add(one)
        self._stated = stated
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
        seen = self._seen.all
        resting: dict[str | Family, Explained] = {}
        if len(seen) >= 2 * self._whole:
            self._whole = len(seen)
            sight = sight_of(seen, self._stated, self._outliers, self._ordered)
            self._unit = sight.unit
            known = explained(sight, self._weights)
        else:
            sight = sight_of(seen, self._stated, self._outliers, self._ordered, self._unit)
            known, resting = self._looked_at(sight)
        found = weighed(sight, known | resting, self._weights)
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

    def _looked_at(self, sight: Sight) -> tuple[dict[str | Family, Explained], dict[str | Family, Explained]]:
        """Return what families make of all that was seen, and what those made of less that may rest."""
        best = max(self._odds, key=self._odds.__getitem__)
        rest = {name: one for name, one in self._known.items() if sight.stated and self._may_rest(name, one)}
        due = {name: one for name, one in self._known.items() if name not in rest}
        known = caught_up(sight, due, self._scale, self._weights)
        leading = max(known, key=lambda name: self._log(name, known[name]))
        if rest and (leading != best or is_surprised(sight, known[best], self._count)):
            return known | caught_up(sight, rest, self._scale, self._weights), {}
        # Beside the best one they are as probable as they were.
        top = self._log(leading, known[leading])
        for name, one in rest.items():
            more = top + self._odds[name] - self._log(name, one)
            rated = one.known._replace(log_evidence=one.known.log_evidence + more)
            rest[name] = replace(one, known=rated)
        return known, rest

    def _may_rest(self, name: str | Family, one: Explained) -> bool:
        return self._odds[name] < math.log(_UNLIKELY) and len(self._seen) < (1.0 + _MORE) * one.count

    def _log(self, name: str | Family, one: Explained) -> float:
        return one.known.log_evidence + one.log_belief + math.log(self._weights[name])


def _offered(offer: Offer, late: Mapping[str, Callable[[float], Fit]]) -> Offer:
    make = late.get(offer.family)
    return offer if make is None else offer._replace(make=partial(make, offer.probability))


def _late(
    sight: Sight,
    name: str | Family,
    one: Explained,
    scale: float,
    weights: Mapping[str | Family, float],
    probability: float,
) -> Fit:
    """Return the fit of a family that rested, by all that was seen."""
    fit = weighed(sight, caught_up(sight, {name: one}, scale, weights), weights).best
    return replace(fit, probability=probability)
