"""What is asked of a model before it is written: its frames in order, and names that are to be left out."""

from __future__ import annotations

from collections.abc import Iterable

from kineverse.errors import UnknownNameError, suggest
from kineverse.model.frame import WORLD
from kineverse.model.view import ModelView


def parents_first(model: ModelView) -> list[str]:
    """Return the names of all frames, each after its parent, in their order where that allows it."""
    frames = dict(model.frames)
    done = {WORLD: None}
    for name in frames:
        chain = []
        while name not in done:
            chain.append(name)
            name = frames[name].parent
        done |= dict.fromkeys(reversed(chain))
    return [name for name in done if name in frames]


def checked_names(leave_out: Iterable[str], model: ModelView) -> frozenset[str]:
    """Return the names of what is to be left out, if all of them exist."""
    wanted = [leave_out] if isinstance(leave_out, str) else list(leave_out)
    known = {*model.constraints, *model.articulations, *map(str, model.rates)}
    for name in wanted:
        if name not in known:
            raise UnknownNameError(
                f"{name!r} cannot be left out: it is neither a constraint nor an articulation. "
                f"{suggest(str(name), known, 'name')}"
            )
    return frozenset(wanted)
