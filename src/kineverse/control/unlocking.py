"""Tasks that unlock: goals along the trends of locks, weighted by the demand for them (2020 paper, III-C).

The rows of the controller are the facts: a locked speed is 0. Each lock between here and the goal adds a soft
goal along the unit vector of its condition's trend, for as long as it is shut and something demanded needs
it. No order is planned: it follows from the state.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Literal, TypeAlias

import casadi as ca

from kineverse._checks import finite_number
from kineverse.errors import InvalidValueError
from kineverse.expressions.expression import (
    NO_NODES,
    Expression,
    ExpressionLike,
    array,
    as_expression,
    binary,
    from_casadi,
)
from kineverse.expressions.functions import absolute, sqrt
from kineverse.expressions.graph import lower
from kineverse.model.constraint import Constraint
from kineverse.model.model_view import ModelView
from kineverse.symbols import Symbol

from .tasks import Goal

Way: TypeAlias = Literal[1, -1]
Claims: TypeAlias = dict[tuple[Symbol, Way], Expression]

_SHUT = 1e-6  # speed [m/s] or distance [m] up to which a lock counts as shut
_TINY = 1e-9
_DAMPING = 0.01  # weight of the speeds of keys, so that one that nothing needs any more stops
_SWEEPS = 3  # passes of demand over locks that depend on each other in circles; one is enough for others


@dataclass(frozen=True)
class LockSide:
    """Direction in which a constraint holds a coordinate, and the trend of the condition that frees it."""

    name: str  # of the constraint, with the side
    coordinate: Symbol
    way: Way  # direction that is held
    room: Expression  # speed or distance that is left in this direction, positive if the lock is open
    trend: Mapping[Symbol, Expression]  # gradient of the room by key, trends of logic included

    def behind(self, margins: Mapping[Symbol, float]) -> LockSide:
        """Return the side at a state in which each key is a margin back along the trend.

        A lock that is open there stays open while its keys move by less than their margins.
        """
        signs = {key: slope / (absolute(slope) + _TINY) for key, slope in self.trend.items()}
        back: dict[Symbol, Expression] = {key: key - margins[key] * sign for key, sign in signs.items()}
        trend = {key: slope.substitute(back) for key, slope in self.trend.items()}
        return LockSide(self.name, self.coordinate, self.way, self.room.substitute(back), trend)


def find_lock_sides(model: ModelView, goals: Iterable[Symbol]) -> list[LockSide]:
    """Find the sides of all locks that goals depend on: those on the goals, on their keys, and so on."""
    result: list[LockSide] = []
    waiting = list(dict.fromkeys(goals))
    seen = set(waiting)
    while waiting:
        coordinate = waiting.pop(0)
        for name, constraint in model.constraints_for([coordinate]).items():
            held = constraint.expression
            if isinstance(held, Symbol) and constraint.order <= 1 and held.position == coordinate:
                result += _sides(name, constraint, held)
        keys = [key for side in result for key in side.trend if key not in seen]
        waiting += dict.fromkeys(keys)
        seen.update(keys)
    return result


def _sides(name: str, constraint: Constraint, held: Symbol) -> Iterator[LockSide]:
    coordinate = held.position
    offset = as_expression(0.0) if constraint.order else held
    ends: tuple[tuple[Way, str, Expression], ...]
    ends = (1, "upper", constraint.upper), (-1, "lower", constraint.lower)
    for way, side, bound in ends:
        speeds = {s: slope for s, slope in bound.gradient().items() if s.order == 1}
        trend = {s.position: way * slope for s, slope in speeds.items() if s.position != coordinate}
        if trend:
            # Without gradients of their own, since weights have no use for them.
            columns = lower([way * (bound - offset), *trend.values()])
            room, *slopes = (from_casadi(column[0], (), NO_NODES) for column in columns)
            result = dict(zip(trend, slopes, strict=True))
            yield LockSide(f"{name} {side}", coordinate, way, room, result)


def unlock(
    model: ModelView,
    goal: Mapping[Symbol, float] | Mapping[str, float],
    *,
    rate: float = 0.4,
    margin: float = 0.02,
    tolerance: float = 0.005,
    demand: bool = True,
) -> tuple[Goal, ...]:
    """Return tasks that move coordinates to positions, and what locks them out of the way first.

    There is a goal for each coordinate, and one for each side of a lock c that the way there depends on:
    ``Σ D(c)[q̇]·q̇ / |D(c)| = rate``, with D(c) the trend of the lock's bound. It has weight 0 unless the lock
    is shut and demanded. The goals are demanded until they are reached, and the keys of a demanded lock that
    is shut are demanded in turn; keys that nothing needs stand still.

    A lock counts as shut until its keys are a margin beyond their thresholds, so that it does not chatter. If
    locks want a key on different sides, the one with the fewest unmet conditions wins, and one that is open
    keeps its keys until the coordinate that it held is where it was demanded.

    Parameters
    ----------
    model
        A model or a snapshot.
    goal
        Positions to reach, by coordinate or its name [m] or [rad].
    rate
        Rate along a trend [m/s] or [rad/s], as far as limits allow.
    margin
        Distance of keys beyond their thresholds [m] or [rad], but at most a twentieth of their range.
    tolerance
        Distance from the goal at which it counts as reached.
    demand
        False to pursue every lock that is shut.

    Raises
    ------
    InvalidValueError
        For no goal, and numbers that are not finite or not positive.

    Examples
    --------
    >>> model = kv.Model()
    >>> with model.edit() as edit:
    ...     edit.apply(kv.articulations.DoorWithHandle(name="room", parent="world"))
    'door with handle room'
    >>> tasks = kv.control.unlock(model, {"room/door": 1.0})
    >>> controller = kv.control.Controller(model, tasks, dt=0.05, tier="interpreter")
    >>> state = model.default_state()
    >>> for _ in range(200):
    ...     state = model.integrate(state, controller.step(state).speeds, controller.dt)
    >>> round(state["room/door"], 1)
    1.0
    """
    for what, number in (("rate", rate), ("margin", margin), ("tolerance", tolerance)):
        if not (finite_number(number) or 0.0) > 0:
            raise InvalidValueError(f"The {what} of unlocking is a positive number, not {number!r}.")
    goals = _check_goals(model, goal)
    result = _sort_sides(find_lock_sides(model, goals), goals)
    margins = {key: _margin(model, key, margin) for side in result for key in side.trend}
    order = [side.behind(margins) for side in result]
    tasks = [Goal(q, value, name=f"reach {q}", gain=2.0, weight=10.0) for q, value in goals.items()]
    wanted: Claims = {}
    for q, value in goals.items():
        wanted[q, 1] = _is_less(q, value - tolerance)
        wanted[q, -1] = _is_less(value + tolerance, q)
    shut = [_is_less(side.room, _SHUT) for side in order]
    needs = _pass_demand(order, shut, wanted) if demand else [as_expression(1.0)] * len(order)
    states = list(zip(order, shut, needs, strict=True))
    scores = [_score(*pair, number) for number, pair in enumerate(zip(result, order, needs, strict=True))]
    claims = _collect_claims(result, order, scores)
    for (side, is_shut, need), score in zip(states, scores, strict=True):
        trend = {q: slope * _wins(q, slope, score, claims) for q, slope in side.trend.items()}
        length = sqrt(sum((s * s for s in trend.values()), as_expression(_TINY**2)))
        along = sum((q.derivative() * (s / length) for q, s in trend.items()), as_expression(0.0))
        tasks.append(Goal(along, rate, name=f"unlock {side.name}", weight=need * is_shut))
    keys = dict.fromkeys(key for side in order for key in side.trend if key not in goals)
    if keys:
        still = array([key.derivative() for key in keys])
        tasks.append(Goal(still, name="stand still", weight=_DAMPING))
    return tuple(tasks)


def _margin(model: ModelView, key: Symbol, most: float) -> float:
    own = (c for c in model.constraints_for([key]).values() if bool(c.expression == key))
    constant = (c for c in own if not c.lower.symbols and not c.upper.symbols)
    return min([most, *(0.05 * (float(c.upper) - float(c.lower)) for c in constant)])


def _score(side: LockSide, behind: LockSide, need: Expression, number: int) -> Expression:
    """Return the priority of a side: 1 if its lock is open, less the more of its conditions are unmet."""
    unmet = sum((_is_less(_TINY, absolute(s)) for s in behind.trend.values()), as_expression(0.0))
    return need * (1 + 1e-4 * number) / (1 + _is_less(side.room, _SHUT) * unmet)


def _collect_claims(sides: list[LockSide], behind: list[LockSide], scores: list[Expression]) -> Claims:
    """Return the highest score that wants each coordinate in each direction.

    A shut lock claims the keys that it lacks, an open one all of its keys.
    """
    claims: Claims = {}
    for side, back, score in zip(sides, behind, scores, strict=True):
        is_open = 1 - _is_less(side.room, _SHUT)
        for q, slope in side.trend.items():
            wanted = back.trend[q] + is_open * slope
            for way in (1, -1):
                _add_claim(claims, (q, way), score * _is_less(_TINY, way * wanted))
    return claims


def _wins(q: Symbol, slope: Expression, score: Expression, claims: Claims) -> Expression:
    """Return 1 if no opposite claim on a coordinate is higher, else 0."""
    opposed = _is_less(_TINY, slope) * claims[q, -1] + _is_less(slope, -_TINY) * claims[q, 1]
    return 1 - _is_less(score, opposed)


def _pass_demand(sides: list[LockSide], shut: list[Expression], wanted: Claims) -> list[Expression]:
    """Return the demand for each side: that for its coordinate, which is passed on while it is shut."""
    known = dict(wanted)
    needs = [as_expression(0.0) for _ in sides]
    for _ in range(_SWEEPS if _has_circle(sides) else 1):
        for k, (side, is_shut) in enumerate(zip(sides, shut, strict=True)):
            needs[k] = known.get((side.coordinate, side.way), as_expression(0.0))
            passed = needs[k] * is_shut
            for q, slope in side.trend.items():
                for way in (1, -1):
                    _add_claim(known, (q, way), passed * _is_less(_TINY, way * slope))
    return needs


def _sort_sides(sides: list[LockSide], goals: Iterable[Symbol]) -> list[LockSide]:
    """Return the sides so that those of a coordinate follow those that need it, circles excepted."""
    keys: dict[Symbol, dict[Symbol, None]] = {}
    for side in sides:
        keys.setdefault(side.coordinate, {}).update(dict.fromkeys(side.trend))
    done: dict[Symbol, None] = {}
    for goal in goals:
        _visit(goal, keys, done)
    place = {q: -k for k, q in enumerate(done)}
    return sorted((s for s in sides if s.coordinate in place), key=lambda s: place[s.coordinate])


def _visit(start: Symbol, keys: Mapping[Symbol, Mapping[Symbol, None]], done: dict[Symbol, None]) -> None:
    """Append the coordinates that a coordinate depends on, and the coordinate after them."""
    seen = set(done) | {start}
    stack = [(start, iter(keys.get(start, {})))]
    while stack:
        here, rest = stack[-1]
        following = next((q for q in rest if q not in seen), None)
        if following is None:
            done.setdefault(here)
            stack.pop()
        else:
            seen.add(following)
            stack.append((following, iter(keys.get(following, {}))))


def _has_circle(sides: list[LockSide]) -> bool:
    """Return whether a side comes after one of a coordinate that it needs."""
    passed = set[Symbol]()
    for side in sides:
        passed.add(side.coordinate)
        if not passed.isdisjoint(side.trend):
            return True
    return False


def _is_less(a: ExpressionLike, b: ExpressionLike) -> Expression:
    """Return 1 where a < b, else 0; without a trend, for which weights have no use."""
    return binary(ca.OP_LT, as_expression(a), as_expression(b))


def _add_claim(claims: Claims, key: tuple[Symbol, Way], claim: Expression) -> None:
    claims[key] = binary(ca.OP_FMAX, claims[key], claim) if key in claims else claim


def _check_goals(model: ModelView, goal: Mapping[Symbol, float] | Mapping[str, float]) -> dict[Symbol, float]:
    if not goal:
        raise InvalidValueError("Unlocking has a goal, such as {'garage/door': 1.5}.")
    result: dict[Symbol, float] = {}
    for name, value in goal.items():
        symbol, number = model.degree_of_freedom(name), finite_number(value)
        if number is None:
            raise InvalidValueError(f"The goal of '{name}' is a finite number, not {value!r}.")
        result[symbol] = number
    return result
