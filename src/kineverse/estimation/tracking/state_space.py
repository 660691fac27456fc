"""State space: coordinates, tangent space, independent groups, and Gaussians on it in information form.

The directions of the tangent need not be the model's free speeds: a base on two wheels moves with two speeds,
but its pose is uncertain in three directions. So each coordinate has a direction, except for redundant ones,
such as the components of a quaternion: where no prediction changes in the directions that the rates
q̇ = R(q) u exclude, the speeds u span the tangent.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import accumulate, pairwise
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from kineverse.compilation import CompiledFunction, compile
from kineverse.errors import InvalidValueError
from kineverse.estimation.linear_algebra import inverse_spd, symmetric
from kineverse.expressions.expression import Expression, array, as_expression
from kineverse.lie import Array
from kineverse.model.constraint import Constraint
from kineverse.model.rates import Rates, to_plain
from kineverse.symbols import Symbol

from .measurements import MeasurementModel

if TYPE_CHECKING:
    from .observability import StaticRecord
    from .speed_process import ConditionalSpeeds


SpeedRow = Mapping[Symbol, Expression]


@dataclass(frozen=True)
class TangentSpace:
    """Estimated coordinates and their tangent directions."""

    coordinates: tuple[Symbol, ...]  # sorted
    tangent: tuple[Symbol, ...]  # tangent directions, as speeds, sorted
    rates: Rates  # of the model
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
            for speed, rate in (self.rate_row(coordinate) if coordinate in self.coordinates else {}).items():
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
    rows = {x: frozenset(rates[x] if x in rates else (x.derivative(),)) for x in coordinates}
    for union in connected_components(list(rows.values())):
        block = [x for x in coordinates if rows[x] & union]
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
        first = unions.index(touching[0]) if touching else len(unions)
        unions = [u for u in unions if not any(u is t for t in touching)]
        unions.insert(first, set(item).union(*touching))
    return unions


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
        left, singular, _ = np.linalg.svd(_evaluate_at(matrix, point, default))
        rank = int((singular > 1e-9).sum())
        if rank < len(speeds) or rank == len(block):
            return False
        for direction in left[:, rank:].T:
            change = dict(zip(block, (_STEP * direction).tolist(), strict=True))
            ahead = {x: point[x] + by for x, by in change.items()}
            behind = {x: point[x] - by for x, by in change.items()}
            for value in dependent:
                off = _evaluate_at(value, ahead, default) - _evaluate_at(value, behind, default)
                if not np.abs(off).max() < _CONSTANT * _STEP:
                    return False
    return True


_SAMPLES = 2
_STEP, _CONSTANT = 1e-4, 1e-5


def _evaluate_at(
    expression: Expression, point: Mapping[Symbol, float], default: Mapping[Symbol, float]
) -> Array:
    values = {s: point.get(s, default.get(s, s.value or 0.0)) for s in expression.symbols}
    return np.asarray(expression(values))


@dataclass(frozen=True, eq=False)
class CoordinateGroup:
    """Coordinates that share observations or limits; groups are independent of each other."""

    coordinates: tuple[Symbol, ...]
    tangent: tuple[Symbol, ...]
    x: TangentIndices  # indices into all coordinates
    t: TangentIndices  # into the whole tangent space
    observation_indices: tuple[int, ...]
    limits: tuple[int, ...]  # numbers of its curved limits
    rate_directions: TangentIndices  # tangent directions that are not speeds of its coordinates

    @property
    def coordinate_indices(self) -> TangentIndices:
        """Coordinate of each tangent direction, as an index into the group; -1 for a rate direction."""
        speeds = [x.derivative() for x in self.coordinates]
        rate_directions = set(self.rate_directions.tolist())
        return np.array([-1 if k in rate_directions else speeds.index(v) for k, v in enumerate(self.tangent)])

    def tangent_index(self, k: int) -> int:
        """Return the tangent direction of the k-th coordinate; -1 if it has none."""
        speed = self.coordinates[k].derivative()
        return self.tangent.index(speed) if speed in self.tangent else -1

    @cached_property
    def block(self) -> tuple[TangentIndices, ...]:
        """Open mesh that selects the group's block (t, t) of a matrix of the whole tangent space."""
        return np.ix_(self.t, self.t)

    @property
    def by_speeds(self) -> bool:
        """True if some of its coordinates move by rate directions."""
        return len(self.rate_directions) > 0


@dataclass(frozen=True, eq=False)
class Layout:
    """Arrangement of state, observations and inputs in vectors."""

    tangent_space: TangentSpace
    observations: tuple[MeasurementModel, ...]
    limits: tuple[Constraint, ...]  # curved limits: all but bounds on a single free coordinate
    inputs: tuple[Symbol, ...]
    groups: tuple[CoordinateGroup, ...]  # in the order of their first observation
    group_of: tuple[int, ...] = field(init=False)  # number of each observation's group
    # Positions in the output: predicted values (rotation row by row, then position, or a vector), Jacobians
    # (rows by columns of the group's tangent), and of curved limits the value, bounds and gradient.
    value_slices: tuple[slice, ...] = field(init=False)
    jacobian_slices: tuple[slice, ...] = field(init=False)
    limit_slices: tuple[slice, ...] = field(init=False)
    # Positions in a reading: of observations (4×4 row by row, or a vector), and of their whitening matrices.
    measurement_slices: tuple[slice, ...] = field(init=False)
    whitening_slices: tuple[slice, ...] = field(init=False)

    def __post_init__(self) -> None:
        number_of = {i: number for number, group in enumerate(self.groups) for i in group.observation_indices}
        group_of = tuple(number_of[i] for i in range(len(self.observations)))
        sizes = []
        for one, number in zip(self.observations, group_of, strict=True):
            sizes += [12 if one.is_pose else one.size, one.size * len(self.groups[number].tangent)]
        count = len(sizes)
        sizes += [3 + len(self._group_of_limit(number).tangent) for number in range(len(self.limits))]
        slices = _consecutive_slices(sizes)
        derived = {
            "group_of": group_of,
            "value_slices": slices[0:count:2],
            "jacobian_slices": slices[1:count:2],
            "limit_slices": slices[count:],
            "measurement_slices": _consecutive_slices(16 if o.is_pose else o.size for o in self.observations),
            "whitening_slices": _consecutive_slices(o.size**2 for o in self.observations),
        }
        for name, value in derived.items():
            object.__setattr__(self, name, value)

    @cached_property
    def arguments(self) -> tuple[Symbol, ...]:
        """Arguments of the compiled function: coordinates, then inputs."""
        return (*self.tangent_space.coordinates, *self.inputs)

    def _group_of_limit(self, number: int) -> CoordinateGroup:
        return next(group for group in self.groups if number in group.limits)

    def compile_function(self) -> CompiledFunction:
        """Compile the values and derivatives of all observations and limits as one function."""
        parts: list[Expression] = []
        for one, number in zip(self.observations, self.group_of, strict=True):
            value = self.tangent_space.resolve(one.value)
            parts.append(array([*value[:3, :3].reshape(9), *value[:3, 3]]) if one.is_pose else value)
            parts.append(self._jacobian(one, value, self.groups[number]))
        for number, limit in enumerate(self.limits):
            slopes = self.tangent_space.gradient(limit.expression)
            tangent = self._group_of_limit(number).tangent
            columns = [slopes.get(v, as_expression(0.0)) for v in tangent]
            parts.append(array([limit.expression, limit.lower, limit.upper, *columns]))
        return compile(np.concatenate(parts), self.arguments)

    def _jacobian(self, one: MeasurementModel, value: Expression, group: CoordinateGroup) -> Expression:
        """Return the Jacobian (geometric for a pose) by the group's tangent, flattened row by row."""
        gradient = self.tangent_space.gradient(value)
        columns = []
        for speed in group.tangent:
            entry = gradient.get(speed)
            if entry is None:
                columns.append(as_expression(np.zeros(one.size)))
            elif one.is_pose:
                spin = entry[:3, :3] @ value[:3, :3].T
                columns.append(array([*entry[:3, 3], spin[2, 1], spin[0, 2], spin[1, 0]]))
            else:
                columns.append(entry)
        return array(columns).T.reshape(-1)


def _consecutive_slices(sizes: Iterable[int]) -> tuple[slice, ...]:
    ends = [0, *accumulate(sizes)]
    return tuple(slice(a, b) for a, b in pairwise(ends))


def build_layout(
    tangent_space: TangentSpace,
    observations: tuple[MeasurementModel, ...],
    limits: tuple[Constraint, ...],
    inputs: Sequence[Symbol],
) -> Layout:
    """Arrange observations and limits in independent groups."""
    speeds = {x: frozenset(tangent_space.rate_row(x)) for x in tangent_space.coordinates}
    observed: list[frozenset[Symbol]] = []
    for one in observations:
        symbols = [s for s in tangent_space.resolve(one.value).symbols if s in speeds]
        if not symbols:
            raise InvalidValueError(f"'{one.label}' does not move with any estimated coordinate.")
        observed.append(frozenset().union(*(speeds[s] for s in symbols)))
    limited = [frozenset[Symbol]().union(*(speeds[s] for s in c.symbols if s in speeds)) for c in limits]
    # A rate couples the coordinates it depends on with those it moves.
    rated = []
    for x in tangent_space.coordinates:
        if x in tangent_space.rates:
            symbols = [s for e in tangent_space.rates[x].values() for s in e.symbols if s in speeds]
            rated.append(speeds[x].union(*(speeds[s] for s in symbols)))
    groups = []
    for union in connected_components([*observed, *limited, *rated]):
        tangent = tuple(v for v in tangent_space.tangent if v in union)
        coordinates = tuple(x for x in tangent_space.coordinates if speeds[x] & union)
        free = {x.derivative() for x in coordinates if x not in tangent_space.by_speeds}
        groups.append(
            CoordinateGroup(
                coordinates,
                tangent,
                np.array([tangent_space.coordinates.index(x) for x in coordinates]),
                np.array([tangent_space.tangent.index(v) for v in tangent]),
                tuple(i for i, w in enumerate(observed) if w & union),
                tuple(i for i, w in enumerate(limited) if w & union),
                np.array([k for k, v in enumerate(tangent) if v not in free], dtype=np.int64),
            )
        )
    return Layout(tangent_space, observations, limits, tuple(inputs), tuple(groups))


TangentIndices = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class QuadraticCost:
    """Quadratic cost ``cost - vectorᵀ ξ + ½ ξᵀ matrix ξ`` of steps ξ in a tangent space."""

    matrix: Array  # Λ, positive definite (t, t)
    vector: Array  # η (t,)
    cost: float  # value at ξ = 0

    @staticmethod
    def from_density(matrix: Array, vector: Array) -> QuadraticCost:
        """Make the cost with matrix Λ and vector η whose minimum is 0."""
        return QuadraticCost(matrix, vector, float(vector @ inverse_spd(matrix) @ vector) / 2)

    def with_measurements(self, measurements: Iterable[tuple[Array, Array, float]]) -> QuadraticCost:
        """Add the weighted squares of errors e - S ξ, given as (e, S, weight)."""
        matrix, vector, cost = self.matrix.copy(), self.vector.copy(), self.cost
        for error, slope, weight in measurements:
            matrix += weight * (slope.T @ slope)
            vector += weight * (slope.T @ error)
            cost += weight * float(error @ error) / 2
        return QuadraticCost(matrix, vector, cost)

    def transported(self, step: Array, transport: Array | None) -> QuadraticCost:
        """Return the cost in the tangent space at the end of a step, with the given transport Jacobian."""
        moved = self.matrix @ step
        cost = self.cost - float(self.vector @ step) + float(step @ moved) / 2
        vector = self.vector - moved
        if transport is None:
            return QuadraticCost(self.matrix, vector, cost)
        back = np.linalg.inv(transport)
        return QuadraticCost(symmetric(back.T @ self.matrix @ back), back.T @ vector, cost)

    @cached_property
    def minimum(self) -> float:
        """Minimum of the cost."""
        return self.cost - float(self.vector @ inverse_spd(self.matrix) @ self.vector) / 2

    @cached_property
    def log_determinant(self) -> float:
        """Value of log |Λ|."""
        return float(np.linalg.slogdet(self.matrix)[1])


class InformationState:
    """Estimate and a Gaussian about it in information form, not truncated at limits.

    With ξ in the tangent space at ``x``, the density is exp(-½ξᵀΛξ + ηᵀξ) up to a factor. The estimate stays
    inside the limits and the Gaussian does not, so its mean Λ⁻¹η need not be 0.
    """

    __slots__ = ("evidence", "information", "numbers", "records", "sizes", "speeds", "vector", "x")

    def __init__(
        self,
        sizes: tuple[int, int, int],
        numbers: Array | None = None,
        records: Sequence[StaticRecord | None] | None = None,
        speeds: Sequence[ConditionalSpeeds | None] | None = None,
    ) -> None:
        n, t, groups = sizes
        self.sizes = sizes
        self.records: list[StaticRecord | None] = [None] * groups if records is None else list(records)
        self.speeds: list[ConditionalSpeeds | None] = [None] * groups if speeds is None else list(speeds)
        self.numbers = np.zeros(n + t + groups + t * t) if numbers is None else numbers
        self.x = self.numbers[:n]
        self.vector = self.numbers[n : n + t]
        self.evidence = self.numbers[n + t : n + t + groups]
        self.information = self.numbers[n + t + groups :].reshape(t, t)

    def copy(self) -> InformationState:
        """Return a copy with its own arrays."""
        return self.with_numbers(self.numbers.copy())

    def with_numbers(self, numbers: Array) -> InformationState:
        """Return the same records and speeds with other numbers."""
        return InformationState(self.sizes, numbers, self.records, self.speeds)

    def group_cost(self, t: TangentIndices) -> QuadraticCost:
        """Return the quadratic cost of a group with tangent indices t."""
        return QuadraticCost.from_density(self.information[np.ix_(t, t)], self.vector[t])

    def set_group_cost(self, t: TangentIndices, quadratic: QuadraticCost) -> None:
        """Replace the quadratic cost of a group with tangent indices t."""
        self.information[np.ix_(t, t)] = quadratic.matrix
        self.vector[t] = quadratic.vector
