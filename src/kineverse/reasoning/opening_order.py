"""Opening order of a goal, derived from interlocks."""

from __future__ import annotations

from kineverse.errors import ModelError
from kineverse.symbols import Symbol

from .interlock import Interlocks


def opening_order(found: Interlocks, goal: Symbol | str) -> tuple[Symbol, ...]:
    """Return the coordinates that interlocks on a goal depend on, directly or not: keys first, the goal last.

    The order does not say in which direction a key has to move, nor whether it has to move at all: that
    depends on the state.

    Raises
    ------
    ModelError
        If coordinates lock each other in a cycle, which the message lists.
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
