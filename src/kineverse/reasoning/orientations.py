"""Which coordinates are an orientation: read off how they move."""

from __future__ import annotations

from kineverse.bounds.terms import Terms
from kineverse.expressions.expression import as_expression
from kineverse.model.rates import Rates
from kineverse.symbols import Symbol

from .cases import Case
from .domain import Domain, Sphere


def orientations(rates: Rates) -> tuple[Sphere, ...]:
    """Return the coordinates whose rates keep the sum of their squares: x·ẋ + y·ẏ + z·ż + w·ẇ = 0."""
    groups: dict[frozenset[Symbol], list[Symbol]] = {}
    for coordinate in sorted(rates, key=lambda s: s.sort_key):
        groups.setdefault(frozenset(rates[coordinate]), []).append(coordinate)
    return tuple(tuple(g) for g in groups.values() if len(g) > 1 and _keep_length(g, rates))


def _keep_length(group: list[Symbol], rates: Rates) -> bool:
    for speed in rates[group[0]]:
        growth = Terms({}).of(sum((x * rates[x][speed] for x in group), as_expression(0.0)))
        exact = Case((growth,), Domain({})).value(growth).polynomial
        if exact is None or exact.terms:
            return False
    return True
