"""Closed loops as what ties two frames together, where that says just what the loop says."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

from kineverse.loops.operation import AXES, CloseLoop
from kineverse.model.model import Model, Snapshot
from kineverse.model.operation import RATES
from kineverse.model.view import ModelView
from kineverse.symbols import Symbol

from .plan import Loop

_SAME = 1e-9


def tied(model: ModelView) -> Iterator[tuple[list[Loop], list[Symbol]]]:
    """Yield what ties the ends of loops, and the coordinates that each determines, where that is faithful.

    Points that coincide are tied by a ``connect``, and so are those in a plane that nothing leaves; frames
    that coincide by a ``weld``. A loop that says anything else, or comes from a document and is known by its
    solution only, is none of these.
    """
    snapshot = model.snapshot() if isinstance(model, Model) else model
    assert isinstance(snapshot, Snapshot)
    for entry in snapshot._entries:
        operation = entry.operation
        if not isinstance(operation, CloseLoop):
            continue
        ends = [(operation.frame, operation.to), *operation.more]
        kinds = [_kind(model, operation.mask, frame, to) for frame, to in ends]
        if any(kind is None for kind in kinds):
            continue
        names = [operation.name, *(f"{operation.name}/{k}" for k in range(1, len(ends)))]
        ties = [
            Loop(name, kind, frame, to)
            for name, kind, (frame, to) in zip(names, kinds, ends, strict=True)
            if kind is not None
        ]
        yield ties, [value[0] for (what, _), value in entry.writes.items() if what == RATES]


def _kind(model: ModelView, mask: tuple[str, ...], frame: str, to: str) -> Literal["connect", "weld"] | None:
    if set(mask) == set(AXES):
        return "weld"
    if not set(mask) <= set(AXES[:3]):
        return None
    # What the mask leaves open may not move, or the tie would hold it: a plane's normal does not.
    pose = model.rates.resolve(model.fk(frame, to))
    for k, axis in enumerate(AXES[:3]):
        if axis not in mask and (pose[k, 3].symbols or abs(float(pose[k, 3])) > _SAME):
            return None
    return "connect"
