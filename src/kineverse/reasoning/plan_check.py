"""Independent check of unlocking plans by evaluation of the constraints, without code of the planner."""

from __future__ import annotations

from collections.abc import Iterator

from kineverse.model.constraint import Constraint
from kineverse.model.model_view import ModelView
from kineverse.model.rate_nodes import to_plain
from kineverse.state import StateLike, as_state
from kineverse.symbols import Symbol

from .point_evaluation import default_point, settle_point, value_at
from .unlocking_plan import UnlockingPlan, UnlockingStep

SAMPLES = 21
"""Number of positions along a move at which the constraints are evaluated."""
_SPEED, _TINY = 1e-6, 1e-9

_Rows = dict[str, Constraint]
_Point = dict[Symbol, float]


def plan_violations(model: ModelView, plan: UnlockingPlan, state: StateLike | None = None) -> list[str]:
    """Return the violations of constraints along a plan, and the goals that it misses; none if it is right.

    Each move is sampled from its start to its target. At each position, constraints on speeds have to admit a
    small speed of the one coordinate. Constraints on positions hold at the end of each move, and if they are
    violated on the way, the violation decreases.

    Parameters
    ----------
    model
        The model.
    plan
        The plan.
    state
        Positions at the start, as they were given to the planner.
    """
    items = model.constraints.items()
    rows = {n: Constraint(to_plain(c.lower), to_plain(c.expression), to_plain(c.upper)) for n, c in items}
    point = default_point(model)
    if state is not None:
        point |= dict(as_state(state, model.symbols))
    for row in rows.values():
        point = {**{s: s.value or 0.0 for s in row.symbols if s not in point}, **point}
    found: list[str] = []
    for number, step in enumerate(plan.steps, 1):
        about = f"move {number}, {step.coordinate}"
        if abs(point[step.coordinate] - step.start) > _TINY * (1 + abs(step.start)):
            found.append(f"{about}: it begins at {step.start:g}, and not at {point[step.coordinate]:g}")
        found += dict.fromkeys(f"{about}: {name}" for name in _check_step(model, rows, point, step))
    if plan.verdict == "found":
        for symbol, value in plan.goal.items():
            if abs(point[symbol] - value) > _TINY * (1 + abs(value)):
                found.append(f"{symbol} ends at {point[symbol]:g}, and not at {value:g}")
    return found


def _check_step(model: ModelView, rows: _Rows, point: _Point, step: UnlockingStep) -> Iterator[str]:
    """Yield the constraints that a move violates, and set the point to its end."""
    forward = 1.0 if step.target > step.start else -1.0
    speed = step.coordinate.derivative()
    moved = {step.coordinate, *model.rates.dependent}
    rows = {
        name: row
        for name, row in rows.items()
        if speed in row.expression.symbols or (not row.order and not moved.isdisjoint(row.symbols))
    }
    before = {name: _excess(row, point) for name, row in rows.items() if not row.order}
    last = dict(before)
    for n in range(SAMPLES):
        share = n / (SAMPLES - 1)
        point[step.coordinate] = step.start + share * (step.target - step.start)
        settle_point(model, point)
        moving = {**{s: 0.0 if s.order else x for s, x in point.items()}, speed: forward * _SPEED}
        for name, row in rows.items():
            if row.order == 1:
                if n < SAMPLES - 1 and _excess(row, moving) > _TINY:
                    yield name
            elif not row.order:
                now = _excess(row, point)
                # A coordinate that comes back from beyond a lock may pass its margin, see position_lock.
                entered = last[name] == 0 and step.coordinate in row.expression.symbols
                if now > last[name] + _TINY and not entered:
                    yield name
                last[name] = now
    for name, most in before.items():
        if last[name] > most + _TINY:
            yield name


def _excess(row: Constraint, point: _Point) -> float:
    value = value_at(row.expression, point)
    return max(value_at(row.lower, point) - value, value - value_at(row.upper, point), 0.0)
