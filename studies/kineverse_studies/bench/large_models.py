"""Models of thousands of operations and documents of a million nodes."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count
from time import perf_counter

import numpy as np

from kineverse._gc import no_collection
from kineverse.articulations import Revolute
from kineverse.expressions import Expression
from kineverse.formats.document import from_bytes, read_operations, to_bytes, to_json
from kineverse.model import Diff, Model, Operation, Pose, ReadRecorder, Writes
from kineverse.model.frame import WORLD
from kineverse.symbols import position

from .harness import Contender, time_calls

TO_EMPTY, TO_LARGE = "append an operation to an empty model", "append it to a large model"
REPLACE = "replace an operation that others read"
COPY = "copy a large model, per operation"
RELEVANT, RELEVANT_NEW = "constraints_for a pose", "constraints_for a new expression"

READERS = 7
"""Number of operations that read the writes of the replaced one."""

_AXES = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
_APPENDED = 100
_QUERIES = 100


@dataclass(frozen=True)
class Measured(Operation):
    """Operation that writes a number."""

    name: str
    value: float

    def apply(self, model: ReadRecorder) -> Writes:
        """Write the number."""
        return Writes(data={self.name: self.value})


@dataclass(frozen=True)
class Doubled(Operation):
    """Operation that reads a number and writes its double."""

    name: str
    of: str

    def apply(self, model: ReadRecorder) -> Writes:
        """Write twice the number that is read."""
        return Writes(data={self.name: 2.0 * model.data[self.of]})


def make_large_model(operations: int) -> Model:
    """Return a model of chains of joints with a constraint each, and of numbers that depend on one number."""
    model = Model()
    with model.edit() as edit:
        edit.apply(Measured("source", 1.0))
        for k in range(READERS):
            edit.apply(Doubled(f"reader {k}", "source"))
        for k in range(operations - READERS - 1):
            edit.apply(_chain_joint(k))
        for k in range(operations - len(model.constraints)):
            q = position(f"joint {k}")
            edit.constrain(f"near {k}", -0.5, q, 0.5)
    return model


def _chain_joint(number: int) -> Revolute:
    """Return a joint in one of many chains of eight."""
    parent = WORLD if number % 8 == 0 else f"link {number - 1}"
    return Revolute(
        name=f"joint {number}",
        parent=parent,
        child=f"link {number}",
        origin=Pose((1.0, 0.0, 0.0, 0.1, 0.0, 1.0, 0.0, 0.2, 0.0, 0.0, 1.0, 0.3)),
        axis=_AXES[number % 3],
        lower=-1.0,
        upper=1.0,
    )


def large_model_contenders(large: Model) -> Iterator[Contender]:
    """Yield the edits and queries of a large model; appending is also measured on an empty model."""
    yield Contender(TO_EMPTY, time_calls(_append_operations, _APPENDED, Model))
    yield Contender(TO_LARGE, time_calls(_append_operations, _APPENDED, large.copy))

    values = count(2)

    def replace_source() -> None:
        with large.edit() as edit:
            edit.replace("measured source", Measured("source", float(next(values))))

    yield Contender(REPLACE, time_calls(replace_source))

    yield Contender(COPY, time_calls(lambda: large.copy() and None, len(large.history.tags)))

    ends = range(7, len(large.frames), 8)
    poses = [large.fk(f"link {k}") for k in ends[:_QUERIES]]
    numbers = count()

    def query_poses() -> None:
        for pose in poses:
            large.constraints_for(pose)

    def make_expressions() -> list[Expression]:
        number = float(next(numbers))
        return [pose[0, 3] + number for pose in poses]

    def query_expressions(expressions: list[Expression]) -> None:
        for expression in expressions:
            large.constraints_for(expression)

    yield Contender(RELEVANT, time_calls(query_poses, len(poses)))
    yield Contender(RELEVANT_NEW, time_calls(query_expressions, len(poses), make_expressions))


def _append_operations(model: Model) -> None:
    """Append operations, each in a separate edit."""
    for k in range(_APPENDED):
        name = f"appended {k}"
        with model.edit() as edit:
            edit.apply(Revolute(name=name, parent=WORLD, child=name, lower=-1.0, upper=1.0))


def count_reruns(large: Model) -> int:
    """Return the number of operations that run when the one that others read is replaced."""
    diffs: list[Diff] = []
    listener = large.listen(diffs.append)
    with large.edit() as edit:
        edit.replace("measured source", Measured("source", -1.0))
    listener.close()
    return diffs[0].reruns


NODES_PER_CONSTRAINT = 9
"""Number of nodes that one constraint adds to a document."""


@dataclass(frozen=True, slots=True)
class DocumentTimes:
    """Size and times of one document."""

    nodes: int
    written: float  # times [s] to write a model as text, to read it, and of both for msgpack
    read: float
    packed: float
    unpacked: float


def make_document_model(nodes: int) -> Model:
    """Return a model of constraints on two coordinates each, with about ``nodes`` nodes as a document."""
    model = Model()
    with model.edit() as edit, no_collection():
        for i in range(max(nodes // NODES_PER_CONSTRAINT, 1)):
            a, b = position(f"door{i}/hinge"), position(f"door{i}/handle")
            edit.constrain(f"door{i}/lock", -1.0, np.sin(a) * b + np.cos(b) * (0.1 + i) * a, 1.0)
    return model


def read_document(text: str) -> Model:
    """Return the model of a document, with all operations applied."""
    model = Model()
    with model.edit() as edit, no_collection():
        for tag, operation in read_operations(text):
            edit.apply(operation, tag)
    return model


def time_document(nodes: int) -> DocumentTimes:
    """Measure once the times of a document of about ``nodes`` nodes."""
    model = make_document_model(nodes)
    with no_collection():
        times = [perf_counter()]
        text = to_json(model)
        times.append(perf_counter())
        read_document(text)
        times.append(perf_counter())
        data = to_bytes(model)
        times.append(perf_counter())
        from_bytes(data)
        times.append(perf_counter())
    return DocumentTimes(
        text.count("\n[") - 1, *(after - before for before, after in itertools.pairwise(times))
    )
