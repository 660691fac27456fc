"""Closed loops as what ties two frames together, where that says just what the loop says."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

from kineverse.loops.operation import AXES
from kineverse.loops.record import LoopRecord, loops_of
from kineverse.model.view import ModelView

from .plan import Loop

_SAME = 1e-9


def tied(model: ModelView) -> Iterator[Loop]:
    """Yield what ties the ends of loops, and what they determine, where that is faithful.

    Points that coincide are tied by a ``connect``, and so are those in a plane that nothing leaves; frames
    that coincide by a ``weld``. A loop that says anything else is none of these.
    """
    for loop in loops_of(model):
        kind = _kind(model, loop)
        if kind is not None:
            yield Loop(loop.name, kind, loop.ends, loop.free, loop.dependent, loop.constraints)


def _kind(model: ModelView, loop: LoopRecord) -> Literal["connect", "weld"] | None:
    if set(loop.mask) == set(AXES):
        return "weld"
    if not set(loop.mask) <= set(AXES[:3]):
        return None
    # What the mask leaves open may not move, or the tie would hold it: a plane's normal does not.
    for frame, to in loop.ends:
        pose = model.rates.resolve(model.fk(frame, to))
        for k, axis in enumerate(AXES[:3]):
            if axis not in loop.mask and (pose[k, 3].symbols or abs(float(pose[k, 3])) > _SAME):
                return None
    return "connect"
