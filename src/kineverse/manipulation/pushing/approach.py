"""Planned approaches of pushes: paths without collisions to where a pusher faces a contact point."""

from __future__ import annotations

import math

import numpy as np

from kineverse.control import Goal
from kineverse.planning import Path, Planner
from kineverse.state import State

from .push_controller import Pushing

_STANDOFF = 0.03
_TILT = math.radians(60.0)
"""Largest angle between the pusher's axis and the direction of the push."""
_CONFIGURATIONS = 48


def plan_push_approach(
    pushing: Pushing, state: State, *, points: int = 4, seconds: float = 0.5, seed: int = 0
) -> tuple[Path, int]:
    """Return a path of the robot to a contact point, and the index of the point.

    Coordinates that rates drive, such as those of a base on rolling wheels, stand still. Without a way the
    path is that of the last point, and says why.
    """
    model, tool = pushing.model, pushing.tool
    moving = [s.position for s in pushing.speeds if s.position != pushing.coordinate]
    free = [s for s in moving if s in model.degrees_of_freedom and s not in model.rates]
    planner = Planner(model, free, rules=pushing.scene.rules, leave_out=pushing.leave_out)
    planner.place(state)
    tip, axis = tool.locate_tip(model), tool.point_axis(model)
    at = pushing.surface.at(state)
    path: Path | None = None
    chosen, goal = -1, None
    for chosen in pushing.rank(state)[:points]:
        point, normal = at.points[chosen], at.normals[chosen]
        goal = Goal(tip, point + _STANDOFF * normal, name="tip")
        found = planner.solutions(goal, _CONFIGURATIONS, seconds=seconds, seed=seed)
        if not len(found):
            continue
        states = [state.updated(dict(zip(planner.symbols, q, strict=True))) for q in found.tolist()]
        facing = np.array([-normal @ axis(at_goal) for at_goal in states])
        good = found[facing > math.cos(_TILT)]
        here = state.vector(planner.symbols)
        ends = [planner.space.nearest_turn(q, here) for q in (good if len(good) else found)]
        path = planner.plan(None, ends, seconds=seconds, seed=seed)
        if path.found:
            break
    if path is None:
        path = planner.plan(None, [goal] if goal else [], seconds=seconds, seed=seed)  # says why
    return path, chosen
