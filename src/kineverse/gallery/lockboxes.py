"""Lockboxes: boxes of parts that lock each other, from the thesis, from seeds, and the Chinese rings.

>>> import kineverse as kv
>>> model = kv.load("lockboxes/thesis")
>>> model.degrees_of_freedom[:2]
(lockbox/a, lockbox/b)

``lockboxes/rings-7`` is the puzzle of seven rings, ``lockboxes/17`` a random box. Each part is a slider.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import reduce
from operator import and_, or_
from types import MappingProxyType
from typing import Literal, NamedTuple, TypeAlias

import numpy as np

from kineverse.articulations.mechanisms.mechanism import STEEL, box_shape
from kineverse.errors import InvalidValueError, UnknownNameError
from kineverse.expressions.expression import Expression
from kineverse.gallery import is_seed
from kineverse.logic import less
from kineverse.model.basic_operations import AddFrame, Constrain
from kineverse.model.body import Body
from kineverse.model.constraint import Constraint
from kineverse.model.frame import WORLD, Frame
from kineverse.model.model import Model
from kineverse.model.operation import Operation
from kineverse.spatial import translation
from kineverse.symbols import position

Join: TypeAlias = Callable[[Expression, Expression], Expression]

_MOST_RINGS = 99
_PARTS = (5, 41)  # range of the number of parts of a box that is given by its seed alone
_NEGATED = 0.25  # share of negated conditions in such a box


class Condition(NamedTuple):
    """Comparison of a part with a threshold: beyond it, or below it."""

    part: str
    threshold: float
    beyond: bool = True


@dataclass(frozen=True, slots=True)
class Slider:
    """Slider of a lockbox, shut at 0, and its lock."""

    upper: float = 1.0  # upper limit [m]
    groups: tuple[tuple[Condition, ...], ...] = ()  # conditions of the lock
    speed: float = 0.4  # largest, in either direction [m/s]
    back: float = 0.4
    blocks: Literal["forward", "both"] = "forward"


@dataclass(frozen=True, slots=True)
class Lockbox:
    """Parts by name, and the positions at which the box is open [m]."""

    parts: Mapping[str, Slider]
    goal: Mapping[str, float]


def _all_of(*conditions: Condition) -> tuple[tuple[Condition], ...]:
    return tuple((condition,) for condition in conditions)


THESIS = Lockbox(
    MappingProxyType(
        {
            "a": Slider(1.2, _all_of(Condition("b", 0.4), Condition("c", 0.6)), blocks="both"),
            "b": Slider(0.7, _all_of(Condition("d", 0.8)), 0.1, 0.1),
            "c": Slider(0.8, _all_of(Condition("d", 0.5), Condition("e", 1.0)), 0.1, 0.1),
            "d": Slider(0.9, _all_of(Condition("e", 0.9)), 0.1, 0.1),
            "e": Slider(1.1, _all_of(Condition("f", 1.2)), 0.1, 0.1),
            "f": Slider(10.0),
        }
    ),
    MappingProxyType({"a": 1.2}),
)
"""Lockbox of the thesis behind the 2020 paper: f, e, d, then b and c, then a."""


def make_rings(count: int) -> Lockbox:
    """Return the Chinese rings: a ring moves while the one before it is on, and all before that are off.

    All rings are on at the start, at 0, and the goal is to take off all.
    """
    if count < 1:
        raise InvalidValueError(f"There is at least one ring, not {count}.")
    parts = {}
    for k in range(count):
        before = [Condition(f"ring_{j}", 0.5, j < k - 1) for j in range(k)]
        parts[f"ring_{k}"] = Slider(groups=_all_of(*before), blocks="both")
    return Lockbox(MappingProxyType(parts), dict.fromkeys(parts, 1.0))


def draw_lockbox(
    parts: int, seed: int, *, negated: float = 0.0, blocks: Literal["forward", "both"] = "forward"
) -> Lockbox:
    """Return a random box whose longest chain of locks has at least a third of the parts, all shut at first.

    The parts of the chain need each other one by one. Apart from that, locks have up to two conditions on
    earlier parts, of which three in ten are alternatives; so a box without negations can be opened. Negated
    conditions are about any part, so a box with them may have no solution.
    """
    if parts < 3 or not 0 <= negated <= 1:
        raise InvalidValueError(
            f"A random lockbox has at least 3 parts and a share of negations within 0 and 1, not {parts} "
            f"and {negated!r}."
        )
    rng = np.random.default_rng(seed)
    names = [f"part_{k}" for k in range(parts)]
    length = int(rng.integers(math.ceil(parts / 3), parts + 1))
    inner = 1 + rng.permutation(parts - 2)[: max(length - 2, 0)]
    chain = [0, *sorted(inner.tolist()), parts - 1]
    before = dict(zip(chain[1:], chain, strict=False))
    drawn = {names[0]: Slider()}
    for k in range(1, parts):
        needed = before.get(k, int(rng.integers(k)))
        groups = [[Condition(names[needed], _threshold(rng))]]
        others = [j for j in rng.permutation(parts).tolist() if j not in (k, needed)]
        for _ in range(int(rng.integers(3))):
            opposite = bool(rng.random() < negated)
            other = next((j for j in others if opposite or j < k), None)
            if other is None:
                continue
            others.remove(other)
            condition = Condition(names[other], _threshold(rng), not opposite)
            if len(groups) > 1 and rng.random() < 0.3:
                groups[-1].append(condition)
            else:
                groups.append([condition])
        drawn[names[k]] = Slider(groups=tuple(map(tuple, groups)), blocks=blocks)
    return Lockbox(MappingProxyType(drawn), {names[-1]: 1.0})


def draw_tangled_lockbox(parts: int, seed: int) -> Lockbox:
    """Return a random box with up to three conditions a part on any others, on either side.

    Locks may depend on each other in circles, and half of them block both directions, so that the box may
    have no solution.
    """
    rng = np.random.default_rng(seed)
    names = [f"part_{k}" for k in range(parts)]
    drawn = {}
    for k, name in enumerate(names):
        others = [j for j in rng.permutation(parts).tolist() if j != k]
        groups: list[tuple[Condition, ...]] = []
        for j in others[: int(rng.integers(4))]:
            condition = Condition(names[j], round(float(rng.uniform(0.2, 0.8)), 1), bool(rng.random() < 0.5))
            if groups and rng.random() < 0.3:
                groups[-1] += (condition,)
            else:
                groups.append((condition,))
        drawn[name] = Slider(groups=tuple(groups), blocks="both" if rng.random() < 0.5 else "forward")
    return Lockbox(MappingProxyType(drawn), {names[-1]: 1.0})


def _threshold(rng: np.random.Generator) -> float:
    return round(float(rng.uniform(0.2, 0.8)), 2)


def remove_locks(box: Lockbox) -> Lockbox:
    """Return the parts of a box without their locks."""
    return Lockbox({name: replace(part, groups=()) for name, part in box.parts.items()}, box.goal)


def make_lockbox_model(box: Lockbox, prefix: str | None = "lockbox", join: Join = and_) -> Model:
    """Return the model of a box."""
    model = Model()
    with model.edit() as edit:
        for operation in make_operations(box, prefix, join):
            edit.apply(operation)
    return model


def make_operations(box: Lockbox, prefix: str | None = None, join: Join = and_) -> Iterator[Operation]:
    """Yield the operations of a box, see :func:`make_lockbox_model`."""
    full = {name: f"{prefix}/{name}" if prefix else name for name in box.parts}
    q = {name: position(path) for name, path in full.items()}
    for k, (name, part) in enumerate(box.parts.items()):
        path, here = full[name], q[name]
        at = translation(0.1 * k, here, 0.0)
        body = Body((box_shape((0.08, 0.2, 0.04), (0.0, 0.0, 0.0), STEEL),))
        yield AddFrame(path, Frame.from_transform(WORLD, at), body)
        limits = Constraint.from_expressions(0.0, here, part.upper)
        yield Constrain(f"{path}/position", limits)
        open_ = make_condition(part, q, join)
        forward = part.speed if open_ is None else open_ * part.speed
        backward = part.back if open_ is None or part.blocks == "forward" else open_ * part.back
        speeds = Constraint.from_expressions(-backward, here.derivative(), forward)
        yield Constrain(f"{path}/velocity", speeds)


def make_condition(part: Slider, q: Mapping[str, Expression], join: Join = and_) -> Expression | None:
    """Return the condition under which a part is free, None if it always is."""

    def holds(c: Condition) -> Expression:
        return less(c.threshold, q[c.part]) if c.beyond else less(q[c.part], c.threshold)

    free = [reduce(or_, map(holds, group)) for group in part.groups]
    return reduce(join, free) if free else None


def example_boxes() -> tuple[str, ...]:
    """Return names of boxes as examples."""
    return ("thesis", "rings-7", *map(str, range(5)))


def find_lockbox(name: str) -> Lockbox | None:
    """Return the box with a name: ``thesis``, ``rings-N`` or a seed; None if there is none."""
    if name == "thesis":
        return THESIS
    rings = name.removeprefix("rings-")
    if rings != name and is_seed(rings) and 1 <= int(rings) <= _MOST_RINGS:
        return make_rings(int(rings))
    if not is_seed(name):
        return None
    seed = int(name)
    return draw_lockbox(int(np.random.default_rng(seed).integers(*_PARTS)), seed, negated=_NEGATED)


def has_lockbox(name: str) -> bool:
    """Return whether there is a box with a name."""
    return find_lockbox(name) is not None


def lockbox_operations(name: str, prefix: str | None = None) -> Iterator[Operation]:
    """Yield the operations of the box with a name."""
    box = find_lockbox(name)
    if box is None:
        raise UnknownNameError(
            f"There is no lockbox {name!r}: there are 'thesis', 'rings-1' to 'rings-{_MOST_RINGS}', and one "
            "for each seed, a whole number from 0 on, such as 'lockboxes/17'."
        )
    yield from make_operations(box, prefix)
