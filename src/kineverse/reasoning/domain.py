"""Domain of configurations: constant limits and unit quaternions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property

import numpy as np

from kineverse.intervals.arithmetic import RealInterval
from kineverse.symbols import Symbol

from .boxes import Interval
from .polynomial import Monomial, Polynomial

UnitSphere = tuple[Symbol, ...]
"""Coordinates whose squares have the sum 1, such as a unit quaternion."""

_WHOLE = Interval(-1.0, 1.0, True, True)
_ROUNDING = 1e-12
EVERYWHERE = Interval()


@dataclass(frozen=True)
class Domain:
    """Limits of coordinates, and the coordinates that form unit quaternions."""

    limits: Mapping[Symbol, Interval]  # constant limits of symbols
    spheres: tuple[UnitSphere, ...] = ()  # unit quaternions

    def limits_of(self, symbol: Symbol) -> Interval:
        """Return the interval in which a symbol lies."""
        limit = self.limits.get(symbol, EVERYWHERE)
        return limit.intersection(_WHOLE) if symbol in self._on_sphere else limit

    def sphere(self, symbols: Iterable[Symbol]) -> UnitSphere | None:
        """Return the unit quaternion to which all symbols belong, or None."""
        spheres = {self._on_sphere.get(s) for s in symbols}
        return spheres.pop() if len(spheres) == 1 else None

    def reduce(self, p: Polynomial) -> Polynomial:
        """Return the polynomial with squares of the last element of each quaternion eliminated."""
        for sphere in self.spheres:
            last = sphere[-1]
            while any(dict(m).get(last, 0) > 1 for m in p.terms):
                p = _without_square(p, sphere)
        return p

    def form_range(self, p: Polynomial) -> RealInterval | None:
        """Return the range of a quadratic form of a unit quaternion, None for other polynomials.

        Its ends are the smallest and the largest eigenvalue of the matrix of the form, in which a constant is
        a multiple of the identity.
        """
        sphere = self.sphere(p.symbols) if p.symbols else None
        if sphere is None or any(sum(power for _, power in m) not in (0, 2) for m in p.terms):
            return None
        matrix = float(p.offset) * np.eye(len(sphere))
        for monomial, factor in p.terms.items():
            if monomial:
                i, j = sphere.index(monomial[0][0]), sphere.index(monomial[-1][0])
                matrix[i, j] += float(factor) / 2
                matrix[j, i] += float(factor) / 2
        values = np.linalg.eigvalsh(matrix)
        slack = _ROUNDING * max(1.0, *map(abs, values.tolist()))
        return float(values[0]) - slack, float(values[-1]) + slack

    @cached_property
    def _on_sphere(self) -> dict[Symbol, UnitSphere]:
        return {s: sphere for sphere in self.spheres for s in sphere}


def _without_square(p: Polynomial, sphere: UnitSphere) -> Polynomial:
    last = sphere[-1]
    total: dict[Monomial, Fraction] = {}
    for monomial, factor in p.terms.items():
        powers = dict(monomial)
        parts: list[tuple[dict[Symbol, int], Fraction]] = [(powers, factor)]
        if powers.get(last, 0) > 1:
            powers[last] -= 2
            more = ({**powers, s: powers.get(s, 0) + 2} for s in sphere[:-1])
            parts += [(part, -factor) for part in more]
        for part, weight in parts:
            key = tuple(sorted(((s, n) for s, n in part.items() if n), key=lambda item: item[0].sort_key))
            total[key] = total.get(key, Fraction(0)) + weight
    return Polynomial({m: f for m, f in total.items() if f})
