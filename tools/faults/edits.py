"""Edits that clients of a model server make, at random."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from random import Random
from typing import Any

import numpy as np

import kineverse as kv
from kineverse.model import Edit
from kineverse.model.basic_operations import SetData
from kineverse.model.read_recorder import ReadRecorder

MOST_OPERATIONS = 120
PARTS = ("part/", "part/lid")
"""Frames by which clients ask for parts."""
_HOME = {"rocker": 1.5, "coupler": -0.3}


@dataclass(frozen=True)
class Twice(kv.Operation):
    """Writes twice a datum: it has a trace."""

    name: str
    source: str

    def apply(self, model: ReadRecorder) -> kv.model.Writes:
        return kv.model.Writes(data={self.name: 2 * model.data[self.source]})


@dataclass(frozen=True)
class Capped(kv.Operation):
    """Decides by a datum: it is frozen."""

    name: str
    source: str

    def apply(self, model: ReadRecorder) -> kv.model.Writes:
        return kv.model.Writes(data={self.name: min(model.data[self.source], 2)})


@dataclass(frozen=True)
class Count(kv.Operation):
    """Counts the frames: it is frozen, and reads all of their names."""

    name: str

    def apply(self, model: ReadRecorder) -> kv.model.Writes:
        return kv.model.Writes(data={self.name: len(model.frames)})


@dataclass(frozen=True)
class Above(kv.Operation):
    """Puts a frame where another one is: it has a trace, and reads a chain of frames."""

    name: str
    frame: str

    def apply(self, model: ReadRecorder) -> kv.model.Writes:
        position = model.fk(self.frame)[:3, 3]
        return kv.model.Writes(frames={self.name: ("world", kv.translation(position))})


def build() -> kv.Model:
    """Return the model that clients begin with: a counter, data, a part, and four bars that can be closed."""
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("counter", "world", kv.translation(0, 0, 0), tag="counter")
        for name in "abcd":
            edit.write(name, 1.5, name)
        edit.add_frame("part/base", "world", kv.translation(1, 0, 0))
        hinge = {"axis": (0, 0, 1), "lower": 0.0, "upper": 1.5, "velocity": 1.0}
        edit.apply(kv.Revolute(name="part/lid", parent="part/base", child="part/lid", **hinge))
        z = (0, 0, 1)
        for name, parent, x in (("crank", "world", 0.0), ("coupler", "crank", 0.3), ("rocker", "world", 1.0)):
            edit.apply(
                kv.Revolute(
                    name=name, parent=parent, child=name, axis=z, origin=kv.translation(x, 0, 0), velocity=2.0
                )
            )
        edit.add_frame("coupler end", "coupler", kv.translation(1.0, 0, 0))
        edit.add_frame("rocker end", "rocker", kv.translation(0.5, 0, 0))
    return model


def count(model: kv.Model) -> float:
    """Return what the counter shows."""
    return float(np.asarray(model.fk("counter")({}))[0, 3])


def count_on(edit: Edit) -> None:
    """Count on by one."""
    frame = kv.model.Frame.from_transform("world", kv.translation(count(edit.model) + 1, 0, 0))  # type: ignore
    edit.replace("counter", kv.model.AddFrame("counter", frame))


def add_chain(edit: Edit, name: str) -> None:
    """Add three frames, which are there together or not at all."""
    parent = "world"
    for k in range(3):
        edit.add_frame(f"{name}/{k}", parent, kv.translation(k, 0, kv.position(name)), tag=f"{name}/{k}")
        parent = f"{name}/{k}"


def add_constraints(edit: Edit, name: str) -> None:
    """Add three constraints about a coordinate of the smaller part, together as well."""
    for k in range(3):
        edit.constrain(f"{name}/{k}", -k, kv.position("part/lid"), 2 + k, tag=f"{name}/{k}")


def remove_chain(edit: Edit, name: str) -> None:
    for k in reversed(range(3)):
        edit.remove(f"{name}/{k}")


def do_something(edit: Edit, random: Random, new: str) -> None:
    """Do one thing in an edit, if it can be done."""
    model: Any = edit.model
    history = model.history
    tags, frames = history.tags, ["world", *model.frames]
    if not tags:  # of a part
        edit.add_frame("part/base", "world", kv.translation(1, 0, 0))
        return
    tag, other = random.choice(tags), random.choice(tags)
    name, frame, parent, k = (
        random.choice("abcd"),
        random.choice(frames),
        random.choice(frames),
        random.randrange(30),
    )
    below = f"{random.choice(('part', 'more'))}/{random.randrange(6)}"
    steps: list[tuple[float, Callable[[], object]]] = [
        (2, lambda: edit.write(name, k / 4, new)),
        (2, lambda: edit.replace(random.choice("abcd"), SetData(name, k / 4))),
        (1, lambda: edit.apply(Twice(f"twice {k % 3}", name), new)),
        (1, lambda: edit.apply(Capped(f"capped {k % 3}", name), new)),
        (0.5, lambda: edit.apply(Count(f"count {k % 3}"), new)),
        (3, lambda: edit.add_frame(below, parent, kv.translation(k, 0, kv.position("q")), tag=new)),
        (2, lambda: edit.attach(frame, parent, kv.translation(0, 0, k), new)),
        (1, lambda: edit.apply(Above(below, frame), new)),
        (
            1,
            lambda: edit.constrain(
                f"range {k}", 0, kv.position(random.choice(("q", "part/lid"))), 1 + k, new
            ),
        ),
        (4 if len(tags) < MOST_OPERATIONS else 20, lambda: edit.remove(tag)),
        (1, lambda: (edit.remove(tag), edit.insert(history.entries[tag].operation, tag, before=other))),
        (1, lambda: edit.insert(SetData(name, k / 4), new, before=tag)),
        (1, lambda: edit.replace(tag, history.operation(tag))),
        (0.1, lambda: edit.close_loop("coupler end", "rocker end", ("x", "y"), "bars", "bars", home=_HOME)),
        (0.1, lambda: edit.remove("bars")),
    ]
    (step,) = random.choices([step for _, step in steps], [weight for weight, _ in steps])
    point = edit.savepoint()
    try:
        step()
    except (kv.KineverseError, KeyError):
        point.roll_back()
