"""Random edits of a loaded model: operations are replaced or removed, and the edit is undone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from random import Random
from typing import Any

from msgspec import structs

import kineverse as kv
from kineverse.model.body import Pose
from kineverse.model.operation import BODIES, DATA, FRAMES, Cell, map_expressions
from kineverse.model.read_recorder import ReadRecorder

ATTEMPTS = 2
_NUMBERS = (1.0, -0.5, 1e-9, 1e200, 0)


@dataclass(frozen=True)
class SetWrites(kv.Operation):
    """Operation with given writes."""

    content: tuple[tuple[Cell, Any], ...]

    def apply(self, model: ReadRecorder) -> kv.model.Writes:
        """Write the content."""
        return kv.model.Writes.from_cells(dict(self.content))


def apply_random_edits(model: kv.Model, seed: int, check: Callable[[], object]) -> None:
    """Apply some random edits to a model, and undo those that it accepts.

    Parameters
    ----------
    model
        The model, which is unchanged afterwards.
    seed
        Seed of the random choices.
    check
        Called after each accepted edit; raises if an invariant of the model is violated.
    """
    random = Random(seed)
    for _ in range(ATTEMPTS):
        tags = model.history.tags
        if not tags:
            return
        tag = random.choice(tags)
        old = model.history.operation(tag)
        try:
            with model.edit() as edit:
                if random.random() < 0.2:
                    edit.remove(tag)
                else:
                    edit.replace(
                        tag, SetWrites(_change_writes(dict(model.history.entry(tag).writes), random))
                    )
        except kv.KineverseError:
            continue
        check()
        removed = tag not in model.history.tags
        with model.edit() as edit:
            if removed:
                _reinsert(edit, old, tag, tags)
            else:
                edit.replace(tag, old)


def _reinsert(edit: kv.model.Edit, old: kv.Operation, tag: str, tags: list[str]) -> None:
    """Insert a removed operation at its former place."""
    place = tags.index(tag)
    if place:
        edit.insert(old, tag, after=tags[place - 1])
    elif len(tags) > 1:
        edit.insert(old, tag, before=tags[1])
    else:
        edit.apply(old, tag)


def _change_writes(writes: dict[Cell, Any], random: Random) -> tuple[tuple[Cell, Any], ...]:
    """Return the writes of an operation, most of them with changed values."""
    return tuple(
        ((kind, name), _change_value(kind, value, random) if random.random() < 0.8 else value)
        for (kind, name), value in writes.items()
        if random.random() < 0.95
    )


def _change_value(kind: str, value: Any, random: Random) -> Any:
    """Return a value of one kind with a changed expression, pose or shape."""
    number = random.choice(_NUMBERS)
    symbol = random.choice((kv.position("a"), kv.velocity("b"), kv.position("new")))
    more = random.choice((number, number, symbol, symbol * number))
    if kind == FRAMES:
        moved: Any = Pose.from_matrix(kv.translation(0.5, 0, number if number < 1e100 else 0))
        if random.random() < 0.3:
            moved = kv.translation(more, 0, 0)
        return replace(value, factors=(*value.factors, moved))
    if kind == BODIES:
        return structs.replace(value, visuals=())
    if kind == DATA and random.random() < 0.5:
        return random.choice((number, more, None, "text", (1.0, (symbol,)), symbol))
    return map_expressions(kind, value, lambda e: e + more if not e.shape else e)
