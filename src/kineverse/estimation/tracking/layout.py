"""Layout of coordinates, tangent directions and independent groups."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate, pairwise

import numpy as np

from kineverse.compile import CompiledFunction, compile  # noqa: A004
from kineverse.errors import InvalidValueError
from kineverse.expressions.expression import Expression, array, as_expression
from kineverse.model.constraint import Constraint
from kineverse.symbols import Symbol

from .gaussian import TangentIndices
from .measurements import MeasurementModel
from .tangent import TangentSpace, connected_components


@dataclass(frozen=True, eq=False)
class CoordinateGroup:
    """Coordinates that share observations or limits, and nothing with others.

    Attributes
    ----------
    coordinates, tangent
        Its symbols.
    x, t
        Where they are among all coordinates and in the whole tangent.
    seen
        The numbers of its observations.
    limits
        The numbers of its curved limits.
    driven
        Where in its tangent are speeds of which no coordinate is the position, such as angular velocities.
    """

    coordinates: tuple[Symbol, ...]
    tangent: tuple[Symbol, ...]
    x: TangentIndices
    t: TangentIndices
    seen: tuple[int, ...]
    limits: tuple[int, ...]
    driven: TangentIndices

    @property
    def own(self) -> TangentIndices:
        """Which of its coordinates each direction of its tangent is; -1 if none."""
        speeds = [x.derivative() for x in self.coordinates]
        driven = set(self.driven.tolist())
        return np.array([-1 if k in driven else speeds.index(v) for k, v in enumerate(self.tangent)])

    def own_place(self, k: int) -> int:
        """Return which direction of its tangent is its coordinate of a number; -1 if none."""
        speed = self.coordinates[k].derivative()
        return self.tangent.index(speed) if speed in self.tangent else -1

    @property
    def by_speeds(self) -> bool:
        """Whether some of its coordinates move by such speeds."""
        return len(self.driven) > 0


@dataclass(frozen=True, eq=False)
class Layout:
    """How the state of a tracker is arranged.

    Attributes
    ----------
    chart
        Coordinates and tangent.
    observations
        What is observed.
    limits
        The curved limits: those that are not bounds of one free coordinate alone.
    known
        What is handed in: coordinates that are measured elsewhere, and parameters.
    groups
        In the order of their first observation.
    """

    chart: TangentSpace
    observations: tuple[MeasurementModel, ...]
    limits: tuple[Constraint, ...]
    known: tuple[Symbol, ...]
    groups: tuple[CoordinateGroup, ...]

    @cached_property
    def group_of(self) -> tuple[int, ...]:
        """The number of each observation's group."""
        found = {i: number for number, group in enumerate(self.groups) for i in group.seen}
        return tuple(found[i] for i in range(len(self.observations)))

    @cached_property
    def inputs(self) -> tuple[Symbol, ...]:
        """What is evaluated at."""
        return (*self.chart.coordinates, *self.known)

    @cached_property
    def value_slices(self) -> tuple[slice, ...]:
        """Where each observation's value is: rotation row by row, then position, or a vector."""
        return self._slices[0]

    @cached_property
    def slope_slices(self) -> tuple[slice, ...]:
        """Where each observation's derivatives are, rows by columns of its group's tangent."""
        return self._slices[1]

    @cached_property
    def limit_slices(self) -> tuple[slice, ...]:
        """Where each curved limit's value, bounds and derivatives are."""
        return self._slices[2]

    @cached_property
    def seen_slices(self) -> tuple[slice, ...]:
        """Where each observation is in a reading: 4×4 row by row, or a vector."""
        return _consecutive_slices(16 if one.is_pose else one.size for one in self.observations)

    @cached_property
    def white_slices(self) -> tuple[slice, ...]:
        """Where what whitens each observation is in a reading."""
        return _consecutive_slices(one.size**2 for one in self.observations)

    @cached_property
    def _slices(self) -> tuple[tuple[slice, ...], tuple[slice, ...], tuple[slice, ...]]:
        at = 0
        found: tuple[list[slice], list[slice], list[slice]] = [], [], []
        sizes = []
        for one, number in zip(self.observations, self.group_of, strict=True):
            width = len(self.groups[number].tangent)
            sizes += [(0, 12 if one.is_pose else one.size), (1, one.size * width)]
        for number in range(len(self.limits)):
            group = next(g for g in self.groups if number in g.limits)
            sizes.append((2, 3 + len(group.tangent)))
        for kind, size in sizes:
            found[kind].append(slice(at, at + size))
            at += size
        return tuple(found[0]), tuple(found[1]), tuple(found[2])

    def compiled(self) -> CompiledFunction:
        """Return values and derivatives of all observations, and of limits, as one function."""
        parts: list[Expression] = []
        for one, number in zip(self.observations, self.group_of, strict=True):
            value = self.chart.plain(one.value)
            parts += [
                _flatten_pose(value) if one.is_pose else value,
                self._slope(one, value, self.groups[number]),
            ]
        for number, limit in enumerate(self.limits):
            group = next(g for g in self.groups if number in g.limits)
            slopes = self.chart.gradient(limit.expression)
            columns = [slopes.get(v, as_expression(0.0)) for v in group.tangent]
            parts.append(array([limit.expression, limit.lower, limit.upper, *columns]))
        return compile(np.concatenate(parts), self.inputs)

    def _slope(self, one: MeasurementModel, value: Expression, group: CoordinateGroup) -> Expression:
        """Return the derivatives of a value, one column after the other in each row, flat.

        Those of a pose are the geometric Jacobian: velocity of the origin and angular velocity.
        """
        gradient = self.chart.gradient(value)
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


def _flatten_pose(pose: Expression) -> Expression:
    return array([*pose[:3, :3].reshape(9), *pose[:3, 3]])


def build_layout(
    chart: TangentSpace,
    observations: tuple[MeasurementModel, ...],
    limits: tuple[Constraint, ...],
    known: Sequence[Symbol],
) -> Layout:
    """Return the arrangement of observations and limits, in groups.

    Raises
    ------
    InvalidValueError
        If an observation depends on nothing that could be estimated.
    """
    speeds = {x: frozenset(chart.row(x)) for x in chart.coordinates}
    watched: list[frozenset[Symbol]] = []
    for one in observations:
        symbols = [s for s in chart.plain(one.value).symbols if s in speeds]
        if not symbols:
            raise InvalidValueError(
                f"'{one.label}' does not move with any coordinate that is estimated: nothing can be learnt "
                "from observing it."
            )
        watched.append(frozenset().union(*(speeds[s] for s in symbols)))
    limited = [frozenset[Symbol]().union(*(speeds[s] for s in c.symbols if s in speeds)) for c in limits]
    # What a rate looks at is carried along with what it moves.
    rated = [
        frozenset().union(
            speeds[x], *(speeds[s] for e in chart.rates[x].values() for s in e.symbols if s in speeds)
        )
        for x in chart.coordinates
        if x in chart.rates
    ]
    groups = []
    for union in connected_components([*watched, *limited, *rated]):
        tangent = tuple(v for v in chart.tangent if v in union)
        coordinates = tuple(x for x in chart.coordinates if speeds[x] & union)
        own = {x.derivative() for x in coordinates if x not in chart.by_speeds}
        groups.append(
            CoordinateGroup(
                coordinates,
                tangent,
                np.array([chart.coordinates.index(x) for x in coordinates]),
                np.array([chart.tangent.index(v) for v in tangent]),
                tuple(i for i, w in enumerate(watched) if w & union),
                tuple(i for i, w in enumerate(limited) if w & union),
                np.array([k for k, v in enumerate(tangent) if v not in own], dtype=np.int64),
            )
        )
    return Layout(chart, observations, limits, tuple(known), tuple(groups))
