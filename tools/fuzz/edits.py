"""What somebody does with a model that was loaded: exchange what others were made from, and take it back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from random import Random
from typing import Any

import kineverse as kv
from kineverse.model.body import Pose
from kineverse.model.operation import BODIES, DATA, FRAMES, Cell, map_expressions
from kineverse.model.read_recorder import ReadRecorder

ATTEMPTS = 2
_NUMBERS = (1.0, -0.5, 1e-9, 1e200, 0)


@dataclass(frozen=True)
class Rewritten(kv.Operation):
    """Writes what it is told to write."""

    content: tuple[tuple[Cell, Any], ...]

    def apply(self, model: ReadRecorder) -> kv.model.Writes:
        """Write it."""
        return kv.model.Writes.from_cells(dict(self.content))


def edits(model: kv.Model, seed: int, whole: Callable[[], object]) -> None:
    """Try some edits of a model, each of which it takes or refuses, and take them back.

    Parameters
    ----------
    model
        The model, as which it is left.
    seed
        Of the choice.
    whole
        Called after each edit that was taken; raises if anything is wrong with the model.
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
                    edit.replace(tag, Rewritten(_changed(dict(model.history.entry(tag).writes), random)))
        except kv.KineverseError:
            continue
        whole()
        removed = tag not in model.history.tags
        with model.edit() as edit:
            if removed:
                _put_back(edit, old, tag, tags)
            else:
                edit.replace(tag, old)


def _put_back(edit: kv.model.Edit, old: kv.Operation, tag: str, tags: list[str]) -> None:
    """Insert an operation where it was among the tags."""
    place = tags.index(tag)
    if place:
        edit.insert(old, tag, after=tags[place - 1])
    elif len(tags) > 1:
        edit.insert(old, tag, before=tags[1])
    else:
        edit.apply(old, tag)


def _changed(writes: dict[Cell, Any], random: Random) -> tuple[tuple[Cell, Any], ...]:
    """Return what an operation wrote, most of it with something else in it."""
    return tuple(
        ((kind, name), _other(kind, value, random) if random.random() < 0.8 else value)
        for (kind, name), value in writes.items()
        if random.random() < 0.95
    )


def _other(kind: str, value: Any, random: Random) -> Any:
    number = random.choice(_NUMBERS)
    symbol = random.choice((kv.position("a"), kv.velocity("b"), kv.position("new")))
    more = random.choice((number, number, symbol, symbol * number))
    if kind == FRAMES:
        moved: Any = Pose.from_matrix(kv.translation(0.5, 0, number if number < 1e100 else 0))
        if random.random() < 0.3:
            moved = kv.translation(more, 0, 0)
        return replace(value, factors=(*value.factors, moved))
    if kind == BODIES:
        return replace(value, visuals=())
    if kind == DATA and random.random() < 0.5:
        return random.choice((number, more, None, "text", (1.0, (symbol,)), symbol))
    return map_expressions(kind, value, lambda e: e + more if not e.shape else e)
