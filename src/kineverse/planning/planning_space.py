"""Coordinates of a planner: what moves, within which limits and under which conditions."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from kineverse.control.configuration_space import ConfigurationSpace, find_coordinates
from kineverse.errors import InvalidValueError, ShapeError
from kineverse.expressions.expression import Expression, as_expression
from kineverse.expressions.functions import maximum
from kineverse.lie import Array
from kineverse.model.constraint import Constraint
from kineverse.model.model_view import ModelView
from kineverse.model.projection import is_equality
from kineverse.state import State, as_state
from kineverse.symbols import Symbol

from .bindings import MOST_COORDINATES

_LARGEST = 1e6  # largest coordinate of a configuration [rad], [m]; edges are computed in single precision
HALF_TURN, FULL_TURN = math.pi + 0.3, math.tau + 0.3
"""Angles by which joints that turn fully may turn to either side of the start: the short way, and the long
way round as well [rad]."""
BEYOND = 2.0  # length by which coordinates without limits may exceed the start and the goals [m], [rad]
CONDITION_TOLERANCE = 1e-5  # largest excess of a constraint that counts as satisfied; float has seven digits


class PlanningSpace:
    """Coordinates that a planner moves, with the constraints of the model on them."""

    def __init__(self, model: ModelView, move: Iterable[Symbol | str] | Symbol | str | None) -> None:
        self.model = model
        self.symbols = free_coordinates(model) if move is None else _find_moving(model, move)
        if not self.symbols:
            raise InvalidValueError(
                "There is nothing to move: the model has no coordinates, or move= is empty."
            )
        if len(self.symbols) > MOST_COORDINATES:
            raise InvalidValueError(
                f"{len(self.symbols)} coordinates would move, and a planner moves {MOST_COORDINATES} at "
                "most. Choose some of them with move=, as move='robot/*'."
            )
        self._limits: list[tuple[int, Expression | float, Expression | float]] = []
        ranges = self._read_constraints()
        self.lower, self.upper = np.zeros((2, len(self.symbols)))
        self.place(model.default_state())
        self.turning = ConfigurationSpace(model, self.symbols, ranges).find_turning_candidates(ranges)

    def _read_constraints(self) -> dict[str, Constraint]:
        moved, rates = {*self.symbols}, self.model.rates
        place: dict[Expression, int] = {s: k for k, s in enumerate(self.symbols)}
        self.conditions: list[Expression] = []
        self.condition_names: list[str] = []
        self.equalities: list[Expression] = []
        ranges: dict[str, Constraint] = {}
        for name, c in self.model.plain_constraints().items():
            if any(s.order for s in c.symbols):
                continue
            low, middle, high = (rates.resolve(e) for e in (c.lower, c.expression, c.upper))
            if moved.isdisjoint({s for e in (low, middle, high) for s in e.symbols}):
                continue
            whole = Constraint(low, middle, high)
            ranges[name] = whole
            if is_equality(whole):
                self.equalities.append(middle - low)
            elif middle in moved and moved.isdisjoint({*low.symbols, *high.symbols}):
                self._limits.append((place[middle], _fold(low), _fold(high)))
            else:
                excess = [e for e in (low - middle, middle - high) if _is_bounded(e)]
                if excess:
                    worst = excess[0] if len(excess) == 1 else as_expression(maximum(*excess))
                    self.conditions.append(worst - CONDITION_TOLERANCE)
                    self.condition_names.append(name)
        for four in (record.coordinates for record in self.model.articulations.values()):
            quaternion = [
                s for s in four if s in moved and s.path.rpartition("/")[2] in ("qx", "qy", "qz", "qw")
            ]
            if len(quaternion) == 4:
                self.equalities.append(as_expression(sum((s * s for s in quaternion), as_expression(-1.0))))
        return ranges

    def place(self, state: State) -> None:
        """Set the limits to those at a state, on which they may depend."""
        self.lower[:], self.upper[:] = -math.inf, math.inf
        for k, low, high in self._limits:
            self.lower[k] = max(self.lower[k], low if isinstance(low, float) else float(low(state)))
            self.upper[k] = min(self.upper[k], high if isinstance(high, float) else float(high(state)))
        # An empty range makes every configuration invalid, and messages name it.
        self.upper[:] = np.maximum(self.lower, self.upper)

    def bounds(
        self, start: Array, points: Array, beyond: float = BEYOND, turn: float | Array = HALF_TURN
    ) -> tuple[Array, Array]:
        """Return finite bounds (n,) of a search from a start (n,) to or about configurations (N, n).

        A joint that turns fully, without limits, may turn by an angle to either side of the start [rad];
        another coordinate without limits may exceed the start and the points by a length [m], [rad].
        """
        both = np.vstack([start[None], points])
        low = np.where(self.turning, start - turn, both.min(axis=0) - beyond)
        high = np.where(self.turning, start + turn, both.max(axis=0) + beyond)
        finite = np.isfinite(self.lower), np.isfinite(self.upper)
        return np.where(finite[0], self.lower, low), np.where(finite[1], self.upper, high)

    @property
    def unlimited(self) -> tuple[Symbol, ...]:
        """Coordinates without limits that are searched about the start, such as those of a base."""
        bounded = self.turning | np.isfinite(self.lower) & np.isfinite(self.upper)
        return tuple(s for s, stays in zip(self.symbols, bounded, strict=True) if not stays)

    def nearest_turn(self, q: Array, start: Array) -> Array:
        """Return q (n,) with joints that turn fully at the turn nearest to a start (n,)."""
        return np.asarray(self.equivalents(q, start, most=1)[0])

    def equivalents(self, q: Array, start: Array, most: int = 32, turn: float = HALF_TURN) -> Array:
        """Return configurations (K, n) within bounds about a start that equal q up to full turns of joints.

        The nearest to the start come first; if there are none, q itself is returned.
        """
        if not self.turning.any():
            return q[None]
        low, high = self.bounds(start, q[None], turn=turn)
        result = q[None].copy()
        for i in np.flatnonzero(self.turning).tolist():
            first = math.ceil((low[i] - q[i]) / math.tau - 1e-9)
            last = math.floor((high[i] - q[i]) / math.tau + 1e-9)
            turned = [float(q[i]) + k * math.tau for k in range(first, last + 1)] or [float(q[i])]
            result = np.repeat(result, len(turned), axis=0)
            result[:, i] = turned * (len(result) // len(turned))
            if len(turned) > 1:
                result = result[np.argsort(np.linalg.norm(result - start, axis=1), kind="stable")[:most]]
        return result


def _fold(e: Expression) -> Expression | float:
    return e if e.symbols else float(e)


def _is_bounded(excess: Expression) -> bool:
    return bool(excess.symbols) and not (excess.is_constant and not math.isfinite(float(excess)))


def free_coordinates(model: ModelView) -> tuple[Symbol, ...]:
    """Return the independent coordinates whose speeds are free, without those of a rolling base."""
    rolling = _rolling_coordinates(model)
    return tuple(s for s in model.degrees_of_freedom if s not in rolling)


def _rolling_coordinates(model: ModelView) -> set[Symbol]:
    """Return the coordinates that fewer speeds drive, so that they do not move independently."""
    driven: dict[Symbol, set[Symbol]] = {
        x: {*row} for x, row in model.rates.items() if x not in model.rates.dependent
    }
    result: set[Symbol] = set()
    groups: list[tuple[set[Symbol], set[Symbol]]] = []
    for x, speeds in driven.items():
        joined = [g for g in groups if g[1] & speeds]
        groups = [g for g in groups if not g[1] & speeds]
        groups.append(({x}.union(*(g[0] for g in joined)), speeds.union(*(g[1] for g in joined))))
    for coordinates, speeds in groups:
        if len(speeds) < len(coordinates):
            result |= coordinates
    return result


def read_configurations(space: PlanningSpace, placed: State, Q: Any, name: str) -> Array:
    """Read configurations (N, n) from one or several vectors or states."""
    if isinstance(Q, Mapping):
        Q = [Q]
    if isinstance(Q, Sequence) and len(Q) and isinstance(Q[0], Mapping):
        Q = np.array([_read_state(space, placed, q, name) for q in Q])
    n = len(space.symbols)
    wanted = f"wanted are configurations of {n} coordinates, in the order of planner.symbols, or states"
    try:
        points = np.atleast_2d(np.asarray(Q, dtype=float))
    except (TypeError, ValueError):
        points = None
    if points is None or Q is None:
        raise InvalidValueError(f"{name} is {Q!r:.80}; {wanted}.")
    if points.ndim != 2 or points.shape[1] != n:
        raise ShapeError(f"{name} has shape {np.shape(Q)}; {wanted}.")
    if not np.isfinite(points).all():
        raise InvalidValueError(f"{name} has values that are not finite.")
    if len(points) and np.abs(points).max() > _LARGEST:
        raise InvalidValueError(
            f"{name} has values beyond {_LARGEST:g}, which have no room in single precision: check "
            "the units, or choose an origin that is nearer."
        )
    return np.ascontiguousarray(points)


def _read_state(space: PlanningSpace, placed: State, entry: Any, name: str) -> Array:
    if not isinstance(entry, Mapping):
        raise InvalidValueError(f"{name} has {entry!r:.80} among states.")
    state = read_state(space.model, entry)
    moved = {*space.symbols}
    other = [s for s, v in state.items() if not s.order and s not in moved and placed.get(s, v) != v]
    if other:
        listed = ", ".join(f"'{s}' is {state[s]:.6g} and not {placed[s]:.6g}" for s in other[:4])
        more = f", and {len(other) - 4} more" if len(other) > 4 else ""
        raise InvalidValueError(
            f"{name} differs from the placed state in coordinates that the planner does not move: "
            f"{listed}{more}. Place them first, planner.place(state), or move them as well, "
            "Planner(model, move=[...])."
        )
    return (placed | state).vector(space.symbols)


def read_state(model: ModelView, state: Any) -> State:
    """Read a state or a mapping from symbols or names."""
    return state if isinstance(state, State) else as_state(state, (*model.symbols, *model.speeds))


def _find_moving(model: ModelView, move: Iterable[Symbol | str] | Symbol | str) -> tuple[Symbol, ...]:
    result: dict[Symbol, None] = {}
    for item in (move,) if isinstance(move, Symbol | str) else tuple(move):
        chosen = find_coordinates(model, [item], "move")
        result.update(dict.fromkeys(sorted(chosen, key=lambda s: s.sort_key)))
    rolling = [s for s in result if s in _rolling_coordinates(model)]
    if rolling:
        raise InvalidValueError(
            f"move=: {', '.join(map(repr, map(str, rolling[:6])))} cannot move independently: wheels that "
            "roll drive them, and a straight line between two configurations would slip. Leave them out and "
            "place the base with place(), or give it a base that moves freely."
        )
    return tuple(result)
