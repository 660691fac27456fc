"""Tangent space of the state manifold.

Surprise first: these need not be the model's free speeds. A base on two wheels moves with two speeds and is
off in three ways, as nobody knows where it began. So coordinates are their own tangent, but for those that
are too many: where nothing that is seen changes in directions that the rates q̇ = R(q) u do not go, the speeds
are the tangent. A quaternion's length is such a direction.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from kineverse.expressions.expression import Expression, array, as_expression
from kineverse.lie import Array
from kineverse.model.rate_nodes import to_plain
from kineverse.model.rates import Rates
from kineverse.symbols import Symbol

SpeedRow = Mapping[Symbol, Expression]


@dataclass(frozen=True)
class TangentSpace:
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
        return self.rates.resolve(to_plain(expression))

    def row(self, coordinate: Symbol) -> SpeedRow:
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


def build_tangent_space(
    rates: Rates, values: Sequence[Expression], known: Iterable[Symbol], default: Mapping[Symbol, float]
) -> TangentSpace:
    """Return the chart of the coordinates that values depend on, and of what their rates look at.

    Parameters
    ----------
    rates
        The model's table.
    values
        What is seen, in plain coordinates.
    known
        What is handed in.
    default
        A place at which values can be asked for.
    """
    known = set(known)
    wanted = [s for value in values for s in value.symbols if _is_coordinate(s, known)]
    found: set[Symbol] = set()
    while wanted:
        x = wanted.pop()
        if x in found:
            continue
        found.add(x)
        looked_at = {s for entry in rates.get(x, {}).values() for s in entry.symbols}
        wanted += [s for s in looked_at if _is_coordinate(s, known)]
    coordinates = tuple(sorted(found, key=lambda s: s.sort_key))
    by_speeds: set[Symbol] = set()
    for block in _blocks(coordinates, rates):
        if all(x in rates for x in block) and _are_too_many(block, rates, values, default):
            by_speeds.update(block)
    tangent = {v for x in coordinates for v in (rates[x] if x in by_speeds else [x.derivative()])}
    in_order = tuple(sorted(tangent, key=lambda s: s.sort_key))
    return TangentSpace(coordinates, in_order, rates, frozenset(by_speeds))


def _is_coordinate(symbol: Symbol, known: set[Symbol]) -> bool:
    return symbol.has_derivative and symbol.order == 0 and symbol not in known


def connected_components(items: Sequence[frozenset[Symbol]]) -> list[set[Symbol]]:
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
    return [
        [x for x in coordinates if rows[x] & union] for union in connected_components(list(rows.values()))
    ]


def _are_too_many(
    block: list[Symbol], rates: Rates, values: Sequence[Expression], default: Mapping[Symbol, float]
) -> bool:
    """Whether nothing that is seen changes in directions in which these coordinates do not move."""
    zero = as_expression(0.0)
    speeds = sorted({v for x in block for v in rates[x]}, key=lambda s: s.sort_key)
    matrix = array([[rates[x].get(v, zero) for v in speeds] for x in block])
    seen = [value for value in values if not set(block).isdisjoint(value.symbols)]
    random = np.random.default_rng(0)
    for _ in range(_PLACES):
        place = {x: default.get(x, 0.0) + random.uniform(-0.3, 0.3) for x in block}
        around = _evaluate_at(matrix, place, default)
        left, singular, _ = np.linalg.svd(around)
        rank = int((singular > 1e-9).sum())
        if rank < len(speeds) or rank == len(block):
            return False
        for direction in left[:, rank:].T:
            ahead, behind = (
                {x: place[x] + h * d for x, d in zip(block, direction.tolist(), strict=True)}
                for h in (_STEP, -_STEP)
            )
            for value in seen:
                change = np.abs(
                    _evaluate_at(value, ahead, default) - _evaluate_at(value, behind, default)
                ).max()
                if not change < _STILL * _STEP:
                    return False
    return True


_PLACES = 2
_STEP, _STILL = 1e-4, 1e-5


def _evaluate_at(
    expression: Expression, place: Mapping[Symbol, float], default: Mapping[Symbol, float]
) -> Array:
    values = {s: place.get(s, default.get(s, s.value or 0.0)) for s in expression.symbols}
    found: Array = expression(values)
    return found
