"""Random operations that read from a model, and documents of their traces."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from random import Random
from typing import Any

import numpy as np

import kineverse as kv
from kineverse.expressions.expression import as_expression
from kineverse.formats.document import to_json
from kineverse.model.basic_operations import AddFrame, Constrain, SetData
from kineverse.model.frame import Frame
from kineverse.model.read_recorder import ReadRecorder
from kineverse.spatial import unit_vector

SYMBOLS = tuple(kv.position(name) for name in ("a", "b", "x"))
FRAMES = ("f", "g", "h", "p0", "p1", "world")
_KINDS = ("frames", "bodies", "articulations", "constraints", "data")
_NAMES = (*FRAMES, "n", "e", "t", "c", "p0/c", "p0/d")


@dataclass(frozen=True)
class Setting:
    """Parameter of an operation that is a record with nested values."""

    number: float
    pose: kv.model.Pose
    inside: tuple[Any, ...]


@dataclass(frozen=True)
class Rate(kv.Operation):
    """Operation that writes the rate or the expression of a coordinate."""

    coordinate: kv.Symbol
    rate: Any

    def apply(self, model: ReadRecorder) -> kv.model.Writes:
        """Write the rate."""
        return kv.model.Writes(rates={self.coordinate: self.rate})


@dataclass(frozen=True)
class Program(kv.Operation):
    """Operation that reads from a model, computes with the results, and writes them.

    ``steps`` are names of :data:`STEPS`, each with two numbers that choose names and earlier results.
    """

    name: str
    steps: tuple[tuple[str, int, int], ...]
    setting: Setting

    def apply(self, model: ReadRecorder) -> kv.model.Writes:
        """Write the last results as data, a constraint and a frame."""
        work = _Work(model)
        for step, i, j in self.steps:
            STEPS[step](work, i, j)
        last = work.at(-1)
        return kv.model.Writes(
            frames={self.name: ("world", work.pose @ kv.translation(0, last, 0))},
            constraints={f"{self.name}/c": (-1, last, 1)} if last.symbols else {},
            data={f"{self.name}/d": tuple(work.results[-3:])},
        )


class _Work:
    """Results of a program so far."""

    def __init__(self, model: ReadRecorder) -> None:
        self.model = model
        self.results: list[Any] = [as_expression(0.5), SYMBOLS[0]]
        self.pose: Any = kv.translation(0, 0, 1)

    def at(self, i: int) -> kv.Expression:
        return as_expression(self.results[i % len(self.results)])

    def keep(self, value: Any) -> None:
        if isinstance(value, (int, float, kv.Expression)) and not getattr(value, "shape", ()):
            self.results.append(value)

    def keep_pose(self, pose: kv.Expression) -> None:
        self.pose = pose
        self.keep(pose[0, 3])


Step = Callable[[_Work, int, int], None]


def _named(i: int, names: Sequence[str]) -> str:
    return names[i % len(names)]


def _datum(w: _Work, i: int, j: int) -> None:
    found = w.model.data[_named(i, ("n", "e", "t", "p0/d"))]
    for item in found if isinstance(found, tuple) else (found,):
        w.keep(item)


def _constraint(w: _Work, i: int, j: int) -> None:
    found = w.model.constraints[_named(i, ("c", "a/position", "p0/c"))]
    w.keep((found.lower, found.expression, found.upper)[j % 3])


def _articulation(w: _Work, i: int, j: int) -> None:
    found = w.model.articulations[_named(i, ("a", "b"))]
    w.keep(found.position)
    w.keep(found.home[0])
    w.keep(dict(found.dynamics).get("effort"))


def _factors(w: _Work, i: int, j: int) -> None:
    factors = w.model.frames[_named(i, FRAMES)].factors
    w.keep(len(factors))
    for factor in factors:
        if isinstance(factor, kv.Expression):
            w.keep_pose(factor)


def _exists(w: _Work, i: int, j: int) -> None:
    w.keep(2.0 if _named(j, _NAMES) in w.model.by_kind(_named(i, _KINDS)) else 1.0)


def _between(w: _Work, i: int, j: int) -> None:
    for symbol in w.model.coordinates_between(_named(i, FRAMES), _named(j, FRAMES)):
        w.keep(symbol)


def _branch(w: _Work, i: int, j: int) -> None:
    w.keep(w.at(i) + 1 if w.at(i) == w.at(j) else w.at(j) - 1)


def _gradient(w: _Work, i: int, j: int) -> None:
    for entry in w.at(i).gradient(j % 2 == 0).values():
        w.keep(entry)


STEPS: dict[str, Step] = {
    "fk": lambda w, i, j: w.keep_pose(w.model.fk(_named(i, FRAMES), _named(j, FRAMES))),
    "frame": lambda w, i, j: w.keep_pose(w.model.frames[_named(i, FRAMES)].transform),
    "factors": _factors,
    "datum": _datum,
    "constraint": _constraint,
    "articulation": _articulation,
    "body": lambda w, i, j: w.keep(len(w.model.bodies[_named(i, FRAMES)].visuals)),
    "exists": _exists,
    "names": lambda w, i, j: w.keep(len(w.model.by_kind(_named(i, _KINDS)))),
    "between": _between,
    "resolve": lambda w, i, j: w.keep(w.model.resolve(w.at(i))),
    "carry": lambda w, i, j: w.keep(w.model.carry(w.at(i))),
    "jacobian": lambda w, i, j: w.keep(w.at(i).jacobian(list(SYMBOLS))[j % 3]),
    "partial": lambda w, i, j: w.keep(w.at(i).partial(list(SYMBOLS))[j % 3]),
    "gradient": _gradient,
    "substitute": lambda w, i, j: w.keep(w.at(i).substitute({SYMBOLS[j % 3]: w.at(j)})),
    "unit": lambda w, i, j: w.keep(unit_vector(kv.array([w.at(i), w.at(j), 1.0]))[0]),
    "quaternion": lambda w, i, j: w.keep_pose(kv.quaternion(w.at(i), 0.1, w.at(j), 1.0)),
    "add": lambda w, i, j: w.keep(w.at(i) + w.at(j)),
    "times": lambda w, i, j: w.keep(w.at(i) * w.at(j)),
    "sine": lambda w, i, j: w.keep(np.sin(w.at(i))),
    "augment": lambda w, i, j: w.keep(w.at(i).augment({SYMBOLS[0].derivative(): w.at(j)})),
    "where": lambda w, i, j: w.keep(kv.where(w.at(i) < w.at(j), w.at(j), 0.5)),
    "symbols": lambda w, i, j: w.keep(float(len(w.at(i).symbols))),
    "constant": lambda w, i, j: w.keep(2 if w.at(i).is_constant else 1),
    "branch": _branch,
}  # fmt: skip


def base(random: Random) -> list[kv.Operation]:
    """Return operations for programs to read from; another seed gives other values of the same names."""
    a, b, x = SYMBOLS
    number = round(random.uniform(-1, 1), 3)
    pose = kv.model.Pose.from_matrix(kv.translation(number, 0, 1) @ kv.rotation_x(number))
    datum: Any = random.choice((number, 2, a + number, (number, b), "text", None))
    transform = random.choice((kv.rotation_y(b), kv.translation(0, x, number), kv.rotation_x(a * b)))
    lower, upper = sorted((number, random.uniform(-2, 2)))
    axis = random.choice(((1, 0, 0), (0, 0, 1), (1, 1, 0)))
    joint = kv.Revolute if random.random() < 0.7 else kv.Prismatic
    rate: Any = random.choice(({}, {b.derivative(): a + 2}, a * number, np.sin(b)))
    return [
        AddFrame("f", Frame("world", (pose,))),
        joint(
            name="a",
            parent="f",
            child="g",
            axis=axis,
            lower=lower,
            upper=upper,
            dynamics=(("effort", number),),
        ),
        AddFrame("h", Frame(random.choice(("g", "f")), (pose, transform))),
        SetData("n", number),
        SetData("e", a * number + np.sin(b)),
        SetData("t", datum),
        Constrain(
            "c", kv.Constraint.from_expressions(-1, a + number * b, random.choice((1, x, float("inf"))))
        ),
        Rate(x, rate),
    ]


def program(random: Random, name: str) -> Program:
    """Return a random program."""
    steps = [(random.choice(list(STEPS)), random.randrange(12), random.randrange(12)) for _ in range(6)]
    pose = kv.model.Pose.from_matrix(kv.translation(1, 2, 3))
    inside = random.choice(((1, "a"), ({"k": (1.0, None)},), (pose, SYMBOLS[1]), (float("inf"), 1 << 80)))
    return Program(name, tuple(steps[: random.randint(1, 6)]), Setting(0.5, pose, inside))


def model(random: Random) -> kv.Model:
    """Return a model of all base operations and programs that can be applied."""
    result = kv.Model()
    programs: list[kv.Operation] = [program(random, f"p{i}") for i in range(random.choice((1, 2, 3)))]
    for operation in [*base(random), *programs]:
        try:
            with result.edit() as edit:
                edit.apply(operation)
        except kv.KineverseError:  # it reads a name that does not exist
            continue
    return result


def document(random: Random) -> bytes:
    """Return a random model as a document, without its hash, so that it can be changed."""
    tree = json.loads(to_json(model(random)))
    del tree["sha256"]
    return json.dumps(tree).encode()
