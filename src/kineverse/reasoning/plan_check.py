"""Independent check of unlocking plans by evaluation of the constraints, without code of the planner."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from kineverse.intervals.arithmetic import RealInterval
from kineverse.model.constraint import Constraint
from kineverse.model.model_view import ModelView
from kineverse.state import StateLike
from kineverse.symbols import Symbol

from .constraint_ranges import NOTHING, SLOW, ConstraintRanges
from .point_evaluation import settle_point, start_point, value_at

if TYPE_CHECKING:
    from .unlocking_plan import UnlockingPlan, UnlockingStep

SAMPLES = 21
"""Number of positions along a move at which a constraint is evaluated that intervals do not decide."""
_NARROWEST = 1e-7
"""Width of an interval around a threshold that is not divided any further [m] or [rad]."""
_MOST_INTERVALS = 400

_Point = dict[Symbol, float]


def plan_violations(model: ModelView, plan: UnlockingPlan, state: StateLike | None = None) -> list[str]:
    """Return the violations of constraints along a plan, and the goals that it misses; none if it is right.

    Each move is enclosed in intervals from its start to its target, which are halved until they decide.
    Within each, constraints on speeds have to admit a small speed of the one coordinate, but for 0.1 µm
    around a threshold. Constraints on positions hold at the end of each move, and if they are violated on the
    way, the violation decreases.

    Parameters
    ----------
    model
        The model.
    plan
        The plan.
    state
        Positions at the start, as they were given to the planner.
    """
    ranges = ConstraintRanges(model)
    point = start_point(model, state)
    settle_point(model, point)
    for row in ranges.rows.values():
        point = {**{s: s.value or 0.0 for s in row.symbols if s not in point}, **point}
    found: list[str] = []
    for number, step in enumerate(plan.steps, 1):
        about = f"move {number}, {step.coordinate}"
        if abs(point[step.coordinate] - step.start) > NOTHING * (1 + abs(step.start)):
            found.append(f"{about}: it begins at {step.start:g}, and not at {point[step.coordinate]:g}")
        found += dict.fromkeys(f"{about}: {name}" for name in _check_step(model, ranges, point, step))
    if plan.verdict == "found":
        for symbol, value in plan.goal.items():
            if abs(point[symbol] - value) > NOTHING * (1 + abs(value)):
                found.append(f"{symbol} ends at {point[symbol]:g}, and not at {value:g}")
    return found


def _check_step(
    model: ModelView, ranges: ConstraintRanges, point: _Point, step: UnlockingStep
) -> Iterator[str]:
    """Yield the constraints that a move violates, and set the point to its end."""
    forward = SLOW if step.target > step.start else -SLOW
    speed = step.coordinate.derivative()
    names = {**dict.fromkeys(ranges.about(speed)), **dict.fromkeys(ranges.about(step.coordinate))}
    undecided = list[str]()
    for name in names:
        row = ranges.rows[name]
        if row.order == 0 or (row.order == 1 and speed in row.expression.symbols):
            answer = _is_violated(ranges, name, point, step, forward)
            if answer and row.order:
                yield name
            elif answer is not False:
                undecided.append(name)
    if not undecided:
        point[step.coordinate] = step.target
        settle_point(model, point)
    else:
        yield from _check_samples(model, ranges, undecided, point, step, forward)


def _is_violated(
    ranges: ConstraintRanges, name: str, point: _Point, step: UnlockingStep, forward: float
) -> bool | None:
    """Return whether a constraint is violated in a part of a move, None if intervals do not decide it."""
    coordinate = step.coordinate
    box: dict[Symbol, RealInterval] = {s: (x, x) for s, x in point.items() if not s.order}
    box[coordinate.derivative()] = forward, forward
    waiting, count = [(min(step.start, step.target), max(step.start, step.target))], 0
    while waiting:
        low, high = waiting.pop()
        box[coordinate] = low, high
        least, most = ranges.excess(name, box)
        count += 1
        if least > NOTHING:
            return True
        if most > NOTHING:
            if count > _MOST_INTERVALS:
                return None
            if high - low > _NARROWEST:
                middle = (low + high) / 2
                waiting += [(low, middle), (middle, high)]
            elif not ranges.rows[name].order:
                return None
    return False


def _check_samples(
    model: ModelView,
    ranges: ConstraintRanges,
    names: list[str],
    point: _Point,
    step: UnlockingStep,
    forward: float,
) -> Iterator[str]:
    """Yield the constraints that samples along a move violate, and set the point to its end."""
    speed, rows = step.coordinate.derivative(), {name: ranges.rows[name] for name in names}
    before = {name: _excess(row, point) for name, row in rows.items() if not row.order}
    last = dict(before)
    for n in range(SAMPLES):
        share = n / (SAMPLES - 1)
        point[step.coordinate] = step.start + share * (step.target - step.start)
        settle_point(model, point)
        moving = {**{s: 0.0 if s.order else x for s, x in point.items()}, speed: forward}
        for name, row in rows.items():
            if row.order == 1:
                if n < SAMPLES - 1 and _excess(row, moving) > NOTHING:
                    yield name
            else:
                now = _excess(row, point)
                # A coordinate that comes back from beyond a lock may pass its margin, see position_lock.
                entered = last[name] == 0 and step.coordinate in row.expression.symbols
                if now > last[name] + NOTHING and not entered:
                    yield name
                last[name] = now
    for name, most in before.items():
        if last[name] > most + NOTHING:
            yield name


def _excess(row: Constraint, point: _Point) -> float:
    value = value_at(row.expression, point)
    return max(value_at(row.lower, point) - value, value - value_at(row.upper, point), 0.0)
