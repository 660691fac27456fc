"""Opening order of a goal, derived from interlocks."""

from __future__ import annotations

from kineverse.errors import ModelError
from kineverse.symbols import Symbol

from .interlock import Interlocks


def opening_order(found: Interlocks, goal: Symbol | str) -> tuple[Symbol, ...]:
    """Return the coordinates that locks on a goal depend on, directly or not: keys first, the goal last.

    Surprise first: which way keys have to be moved, and whether they need to be moved at all, is for the
    state to tell; this is about what may have to come before what.

    Raises
    ------
    ModelError
        If coordinates lock each other in a circle, with the circle.
    """
    start = goal if isinstance(goal, Symbol) else Symbol(goal)
    done: dict[str, Symbol] = {}
    path: dict[str, Symbol] = {start.path: start}
    while path:
        here = next(reversed(path.values()))
        waiting = next((key for key in found.keys(here) if key.path not in done), None)
        if waiting is None:
            done[here.path] = path.pop(here.path)
        elif waiting.path in path:
            names = list(path)
            circle = [*names[names.index(waiting.path) :], waiting.path]
            raise ModelError(f"There is no order, as coordinates lock each other: {' -> '.join(circle)}.")
        else:
            path[waiting.path] = waiting
    return tuple(done.values())
