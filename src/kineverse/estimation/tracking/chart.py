"""The tangent of a state: in which directions coordinates can be off.

Surprise first: these need not be the model's free speeds. A quaternion is off in three ways, as it moves with
three speeds. But a base on two wheels, which moves with two speeds, is off in three ways, as it gets anywhere
by turning to and fro. So coordinates that are connected by their rates, q̇ = R(q) u, have as many directions
as the Lie algebra of the columns of R has at a point (Chow's theorem; Lynch and Park, Modern Robotics, 13.3).
If that are all coordinates, these are their own tangent; if it is the rank of R, the speeds are.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from kineverse.errors import ModelError
from kineverse.expressions.expression import Expression, array, as_expression
from kineverse.model.rates import Rates, plain
from kineverse.symbols import Symbol

Row = Mapping[Symbol, Expression]


@dataclass(frozen=True)
class Chart:
    """Coordinates and their tangent.

    Attributes
    ----------
    coordinates
        What the state consists of, sorted.
    tangent
        The directions in which it can be off, as speeds, sorted.
    rates
        The model's table.
    by_speeds
        The coordinates whose tangent is made of speeds that are not their own.
    """

    coordinates: tuple[Symbol, ...]
    tangent: tuple[Symbol, ...]
    rates: Rates
    by_speeds: frozenset[Symbol]

    def plain(self, expression: Expression) -> Expression:
        """Return an expression in coordinates that neither depend on others nor know their rates."""
        return self.rates.resolve(plain(expression))

    def row(self, coordinate: Symbol) -> Row:
        """Return how a coordinate moves with the tangent."""
        if coordinate in self.by_speeds:
            return self.rates[coordinate]
        return {coordinate.derivative(): as_expression(1.0)}

    def gradient(self, expression: Expression) -> dict[Symbol, Expression]:
        """Return the derivatives of a plain expression in the directions of the tangent."""
        found: dict[Symbol, Expression] = {}
        for key, entry in expression.gradient(heuristic=False).items():
            coordinate = key.position
            row = self.row(coordinate) if coordinate in self.coordinates else {}
            for speed, rate in row.items():
                term = entry * rate if coordinate in self.by_speeds else entry
                found[speed] = found[speed] + term if speed in found else term
        return found


def chart_of(rates: Rates, symbols: Iterable[Symbol], known: Iterable[Symbol]) -> Chart:
    """Return the chart of the coordinates among some symbols, and of what their rates look at.

    Raises
    ------
    ModelError
        If a part of them can be off in more ways than there are speeds, and in fewer than coordinates.
    """
    known = set(known)
    wanted = [s for s in symbols if s.has_derivative and s.order == 0 and s not in known]
    found: set[Symbol] = set()
    while wanted:
        x = wanted.pop()
        if x in found:
            continue
        found.add(x)
        looked_at = {s for entry in rates.get(x, {}).values() for s in entry.symbols}
        wanted += [s for s in looked_at if s.has_derivative and s.order == 0 and s not in known]
    coordinates = tuple(sorted(found, key=lambda s: s.sort_key))
    by_speeds: set[Symbol] = set()
    for block in _blocks(coordinates, rates):
        if any(x in rates for x in block) and not _reaches_all(block, rates):
            by_speeds.update(block)
    tangent = {
        v for x in coordinates for v in (rates[x] if x in by_speeds & rates.keys() else [x.derivative()])
    }
    return Chart(
        coordinates,
        tuple(sorted(tangent, key=lambda s: s.sort_key)),
        rates,
        frozenset(by_speeds & rates.keys()),
    )


def connected(items: Sequence[frozenset[Symbol]]) -> list[set[Symbol]]:
    """Return the unions of sets that share something, in the order in which they first occur."""
    unions: list[set[Symbol]] = []
    for item in items:
        touching = [u for u in unions if u & item]
        merged = set(item).union(*touching)
        first = unions.index(touching[0]) if touching else len(unions)
        unions = [u for u in unions if not any(u is t for t in touching)]
        unions.insert(first, merged)
    return unions


def _blocks(coordinates: tuple[Symbol, ...], rates: Rates) -> list[list[Symbol]]:
    """Return the coordinates that are connected by common speeds."""
    rows = {x: frozenset(rates[x] if x in rates else (x.derivative(),)) for x in coordinates}
    return [[x for x in coordinates if rows[x] & union] for union in connected(list(rows.values()))]


def _reaches_all(block: list[Symbol], rates: Rates) -> bool:
    """Whether speeds lead from a place of these coordinates to all places around it."""
    zero, one = as_expression(0.0), as_expression(1.0)
    rows = [rates[x] if x in rates else {x.derivative(): one} for x in block]
    speeds = sorted({v for row in rows for v in row}, key=lambda s: s.sort_key)
    fields = [[row.get(v, zero) for row in rows] for v in speeds]
    plain_rank = rank = _rank(fields)
    new = fields
    while rank < len(block):
        new = [_bracket(a, b, block) for a in new for b in fields[: len(speeds)]]
        fields = [*fields, *new]
        more = _rank(fields)
        if more == rank:
            break
        rank = more
    if rank == len(block):
        return True
    if rank > plain_rank or plain_rank < len(speeds):
        raise ModelError(
            f"The coordinates {', '.join(map(str, block))} move with {len(speeds)} speeds and can be off in "
            f"{rank} ways: a tracker has no coordinates for that."
        )
    return False


def _bracket(a: list[Expression], b: list[Expression], block: list[Symbol]) -> list[Expression]:
    """Return the Lie bracket of two fields, (∂b/∂q) a - (∂a/∂q) b."""
    along_a, along_b = array(a), array(b)
    return list(along_b.partial(block) @ along_a - along_a.partial(block) @ along_b)


def _rank(fields: list[list[Expression]]) -> int:
    """Return the most directions that fields have at some places."""
    matrix = array([array(f) for f in fields])
    random = np.random.default_rng(0)
    places = random.uniform(0.2, 1.0, (3, len(matrix.symbols)))
    return max(
        int(np.linalg.matrix_rank(matrix(dict(zip(matrix.symbols, p.tolist(), strict=True))), tol=1e-9))
        for p in places
    )
