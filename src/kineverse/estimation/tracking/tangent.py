"""Tangent space of the state manifold.

Its directions need not be the model's free speeds. A base on two wheels moves with two speeds, but its pose
is uncertain in three directions. So each coordinate has its own tangent direction, except for redundant
coordinates: where no prediction changes in the directions that the rates q̇ = R(q) u exclude, the speeds u
span the tangent. The length of a quaternion is such a direction.
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
    """Estimated coordinates and their tangent directions."""

    coordinates: tuple[Symbol, ...]  # estimated coordinates, sorted
    tangent: tuple[Symbol, ...]  # tangent directions, as speeds, sorted
    rates: Rates  # rate table of the model
    by_speeds: frozenset[Symbol]  # coordinates whose tangent directions are speeds other than their own

    def resolve(self, expression: Expression) -> Expression:
        """Substitute dependent coordinates and rate nodes of an expression."""
        return self.rates.resolve(to_plain(expression))

    def rate_row(self, coordinate: Symbol) -> SpeedRow:
        """Return the rate of a coordinate by each tangent direction."""
        if coordinate in self.by_speeds:
            return self.rates[coordinate]
        return {coordinate.derivative(): as_expression(1.0)}

    def gradient(self, expression: Expression) -> dict[Symbol, Expression]:
        """Return the derivatives of a resolved expression in the tangent directions."""
        result: dict[Symbol, Expression] = {}
        for key, entry in expression.gradient(heuristic=False).items():
            coordinate = key.position
            row = self.rate_row(coordinate) if coordinate in self.coordinates else {}
            for speed, rate in row.items():
                term = entry * rate if coordinate in self.by_speeds else entry
                result[speed] = result[speed] + term if speed in result else term
        return result


def build_tangent_space(
    rates: Rates, values: Sequence[Expression], inputs: Iterable[Symbol], default: Mapping[Symbol, float]
) -> TangentSpace:
    """Collect the coordinates that values and their rates depend on, with their tangent directions."""
    inputs = set(inputs)
    wanted = [s for value in values for s in value.symbols if _is_coordinate(s, inputs)]
    result: set[Symbol] = set()
    while wanted:
        x = wanted.pop()
        if x in result:
            continue
        result.add(x)
        dependencies = {s for entry in rates.get(x, {}).values() for s in entry.symbols}
        wanted += [s for s in dependencies if _is_coordinate(s, inputs)]
    coordinates = tuple(sorted(result, key=lambda s: s.sort_key))
    by_speeds: set[Symbol] = set()
    for block in _blocks(coordinates, rates):
        if all(x in rates for x in block) and _are_redundant(block, rates, values, default):
            by_speeds.update(block)
    tangent = {v for x in coordinates for v in (rates[x] if x in by_speeds else [x.derivative()])}
    in_order = tuple(sorted(tangent, key=lambda s: s.sort_key))
    return TangentSpace(coordinates, in_order, rates, frozenset(by_speeds))


def _is_coordinate(symbol: Symbol, inputs: set[Symbol]) -> bool:
    return symbol.has_derivative and symbol.order == 0 and symbol not in inputs


def connected_components(items: Sequence[frozenset[Symbol]]) -> list[set[Symbol]]:
    """Return the unions of sets that share elements, in order of first occurrence."""
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


def _are_redundant(
    block: list[Symbol], rates: Rates, values: Sequence[Expression], default: Mapping[Symbol, float]
) -> bool:
    """Return True if no value changes in directions that the rates of these coordinates exclude."""
    zero = as_expression(0.0)
    speeds = sorted({v for x in block for v in rates[x]}, key=lambda s: s.sort_key)
    matrix = array([[rates[x].get(v, zero) for v in speeds] for x in block])
    dependent = [value for value in values if not set(block).isdisjoint(value.symbols)]
    random = np.random.default_rng(0)
    for _ in range(_SAMPLES):
        point = {x: default.get(x, 0.0) + random.uniform(-0.3, 0.3) for x in block}
        rate_matrix = _evaluate_at(matrix, point, default)
        left, singular, _ = np.linalg.svd(rate_matrix)
        rank = int((singular > 1e-9).sum())
        if rank < len(speeds) or rank == len(block):
            return False
        for direction in left[:, rank:].T:
            ahead, behind = (
                {x: point[x] + h * d for x, d in zip(block, direction.tolist(), strict=True)}
                for h in (_STEP, -_STEP)
            )
            for value in dependent:
                change = np.abs(
                    _evaluate_at(value, ahead, default) - _evaluate_at(value, behind, default)
                ).max()
                if not change < _CONSTANT * _STEP:
                    return False
    return True


_SAMPLES = 2
_STEP, _CONSTANT = 1e-4, 1e-5


def _evaluate_at(
    expression: Expression, point: Mapping[Symbol, float], default: Mapping[Symbol, float]
) -> Array:
    values = {s: point.get(s, default.get(s, s.value or 0.0)) for s in expression.symbols}
    result: Array = expression(values)
    return result
