"""Start states of skills: where a robot stands free."""

from __future__ import annotations

from collections.abc import Iterable

from kineverse.geometry import Rule, Scene
from kineverse.model.frame import is_of_robot
from kineverse.model.model_view import ModelView
from kineverse.state import State


def find_free_state(
    model: ModelView, robot: str, states: Iterable[State], margin: float = 0.0, rules: Iterable[Rule] = ()
) -> tuple[State | None, str]:
    """Return the first of some states in which a robot touches nothing, and its contact in the first."""
    scene = Scene(model)
    own = [body for body in scene.bodies if is_of_robot(body, robot)]
    others = [body for body in scene.bodies if not is_of_robot(body, robot)]
    near = scene.watch(own, others, radius=max(margin, 0.0), rules=rules) if own and others else None
    contact = None
    for state in states:
        if near is None:
            return state, ""
        scene.update(state)
        pair = next(iter(near()), None)
        touches = pair is not None and pair.distance < margin
        if contact is None:
            contact = f"{pair.a} and {pair.b}" if touches and pair is not None else ""
        if not touches:
            return state, contact
    return None, contact or ""
