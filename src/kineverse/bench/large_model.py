"""A model of thousands of operations, and what edits of it cost."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count

from kineverse.articulations import Revolute
from kineverse.expressions import Expression
from kineverse.model import Diff, Effects, Model, Operation, Pose, Reader
from kineverse.model.frame import WORLD
from kineverse.symbols import position

from .timing import Contender, timed

TO_EMPTY, TO_LARGE = "append an operation to an empty model", "append it to a large model"
REPLACE = "replace an operation that others read"
COPY = "copy a large model, per operation"
RELEVANT, RELEVANT_NEW = "constraints_for a pose", "constraints_for a new expression"

READERS = 7
"""How many operations read what the replaced one wrote."""

_AXES = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
_APPENDED = 100
_ASKED = 100


@dataclass(frozen=True)
class Measured(Operation):
    """Writes a number."""

    name: str
    value: float

    def apply(self, model: Reader) -> Effects:
        """Write it."""
        return Effects(data={self.name: self.value})


@dataclass(frozen=True)
class Doubled(Operation):
    """Reads a number of another operation, and writes its double."""

    name: str
    of: str

    def apply(self, model: Reader) -> Effects:
        """Read and write."""
        return Effects(data={self.name: 2.0 * model.data[self.of]})


def large_model(operations: int) -> Model:
    """Return a model of chains of joints, each with a constraint; and numbers that depend on one of them."""
    model = Model()
    with model.edit() as edit:
        edit.apply(Measured("source", 1.0))
        for k in range(READERS):
            edit.apply(Doubled(f"reader {k}", "source"))
        for k in range(operations - READERS - 1):
            edit.apply(_joint(k))
        for k in range(operations - len(model.constraints)):
            q = position(f"joint {k}")
            edit.constrain(f"near {k}", -0.5, q, 0.5)
    return model


def _joint(number: int) -> Revolute:
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


def on_large(large: Model) -> Iterator[Contender]:
    """Yield what is done with it, and the same with an empty one where that is to be no different."""
    yield Contender(TO_EMPTY, timed(_append, _APPENDED, Model))
    yield Contender(TO_LARGE, timed(_append, _APPENDED, large.copy))

    values = count(2)

    def replaced() -> None:
        with large.edit() as edit:
            edit.replace("measured source", Measured("source", float(next(values))))

    yield Contender(REPLACE, timed(replaced))

    yield Contender(COPY, timed(lambda: large.copy() and None, len(large.history.tags)))

    ends = range(7, len(large.frames), 8)
    poses = [large.fk(f"link {k}") for k in ends[:_ASKED]]
    asked = count()

    def relevant() -> None:
        for pose in poses:
            large.constraints_for(pose)

    def new() -> list[Expression]:
        number = float(next(asked))
        return [pose[0, 3] + number for pose in poses]

    def relevant_new(expressions: list[Expression]) -> None:
        for expression in expressions:
            large.constraints_for(expression)

    yield Contender(RELEVANT, timed(relevant, len(poses)))
    yield Contender(RELEVANT_NEW, timed(relevant_new, len(poses), new))


def _append(model: Model) -> None:
    """Append operations, each in an edit of its own."""
    for k in range(_APPENDED):
        name = f"appended {k}"
        with model.edit() as edit:
            edit.apply(Revolute(name=name, parent=WORLD, child=name, lower=-1.0, upper=1.0))


def runs_of_replacing(large: Model) -> int:
    """Return how many operations are run when the one that others read is replaced."""
    heard: list[Diff] = []
    listener = large.listen(heard.append)
    with large.edit() as edit:
        edit.replace("measured source", Measured("source", -1.0))
    listener.close()
    return heard[0].runs
