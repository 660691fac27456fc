"""Operations for the tests of history, and a fold that does everything anew each time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import kineverse as kv
from kineverse.model.kinematics import ancestors
from kineverse.model.operation import KINDS
from kineverse.model.rates import Rates
from kineverse.model.read_recorder import ABSENT, Read, ReadRecorder, Reads


@dataclass(frozen=True)
class Put(kv.Operation):
    """Writes a datum."""

    name: str
    value: Any = 0

    def apply(self, model: ReadRecorder) -> kv.model.Writes:
        return kv.model.Writes(data={self.name: self.value})


@dataclass(frozen=True)
class Sum(kv.Operation):
    """Reads data that may be missing."""

    name: str
    sources: tuple[str, ...]

    def apply(self, model: ReadRecorder) -> kv.model.Writes:
        return kv.model.Writes(data={self.name: sum(model.data.get(s, 0) for s in self.sources)})


@dataclass(frozen=True)
class Next(kv.Operation):
    """Reads a datum that must be there; may be its own name."""

    name: str
    source: str

    def apply(self, model: ReadRecorder) -> kv.model.Writes:
        return kv.model.Writes(data={self.name: model.data[self.source] + 1})


@dataclass(frozen=True)
class Capped(kv.Operation):
    """Often writes the same although it reads something else."""

    name: str
    source: str

    def apply(self, model: ReadRecorder) -> kv.model.Writes:
        return kv.model.Writes(data={self.name: min(model.data.get(self.source, 0), 2)})


@dataclass(frozen=True)
class Exists(kv.Operation):
    """Looks whether a datum is there, not at its value."""

    name: str
    source: str

    def apply(self, model: ReadRecorder) -> kv.model.Writes:
        return kv.model.Writes(data={self.name: int(self.source in model.data)})


@dataclass(frozen=True)
class Count(kv.Operation):
    """Counts the frames."""

    name: str

    def apply(self, model: ReadRecorder) -> kv.model.Writes:
        return kv.model.Writes(data={self.name: len(model.frames)})


@dataclass(frozen=True)
class Listing(kv.Operation):
    """Lists data."""

    name: str

    def apply(self, model: ReadRecorder) -> kv.model.Writes:
        return kv.model.Writes(data={self.name: sum(map(len, model.data))})


@dataclass(frozen=True)
class Pick(kv.Operation):
    """Reads one thing or another, and writes under one name or another."""

    name: str
    switch: str
    source: str

    def apply(self, model: ReadRecorder) -> kv.model.Writes:
        if self.switch in model.data:
            return kv.model.Writes(data={self.name: model.data.get(self.source, 7), f"{self.name}/picked": 1})
        return kv.model.Writes(data={f"{self.name}/not": 1})


@dataclass(frozen=True)
class Fragile(kv.Operation):
    """Raises for large values."""

    name: str
    source: str

    def apply(self, model: ReadRecorder) -> kv.model.Writes:
        value = model.data.get(self.source, 0)
        if value > 3:
            raise ZeroDivisionError(f"{value} is too much")
        return kv.model.Writes(data={self.name: value})


@dataclass(frozen=True)
class Place(kv.Operation):
    """Puts a frame somewhere, again if it is there already."""

    overrides = True

    name: str
    parent: str
    offset: float = 0.0
    moving: bool = True

    def apply(self, model: ReadRecorder) -> kv.model.Writes:
        x = kv.position(self.name) if self.moving else 0
        return kv.model.Writes(frames={self.name: (self.parent, kv.translation(x, self.offset, 0))})


@dataclass(frozen=True)
class Fresh(Place):
    """Puts a frame somewhere that is not there yet."""

    overrides = False


@dataclass(frozen=True)
class Watch(kv.Operation):
    """Writes a pose."""

    name: str
    frame: str
    relative_to: str = "world"

    def apply(self, model: ReadRecorder) -> kv.model.Writes:
        return kv.model.Writes(data={f"{self.name}/pose": model.fk(self.frame, self.relative_to)[:3, 3]})


@dataclass(frozen=True)
class Limit(kv.Operation):
    """Adds a constraint under a name that depends on a datum."""

    name: str
    source: str

    def apply(self, model: ReadRecorder) -> kv.model.Writes:
        index = model.data.get(self.source, 0)
        return kv.model.Writes(constraints={f"{self.name}/{index}": (0, kv.position(self.name), 1 + index)})


@dataclass(frozen=True)
class Row(kv.Operation):
    """Says how a coordinate moves, by a datum."""

    overrides = True

    name: str
    speed: str
    source: str

    def apply(self, model: ReadRecorder) -> kv.model.Writes:
        factor = 1.0 + model.data.get(self.source, 0)
        return kv.model.Writes(rates={kv.position(self.name): {kv.velocity(self.speed): factor}})


Sequenced = tuple[str, kv.Operation]


@dataclass
class Fold:
    """A whole sequence applied to the empty model, one after the other."""

    head: dict[str, dict[str, Any]] = field(default_factory=lambda: {kind: {} for kind in KINDS})
    reads: dict[str, Reads] = field(default_factory=dict)
    seen: dict[str, dict[Any, Any]] = field(default_factory=dict)
    writers: dict[tuple[str, str], list[str]] = field(default_factory=dict)

    def value(self, cell: tuple[str, str]) -> Any:
        return self.head[cell[0]].get(cell[1], ABSENT)


def fold(sequence: Sequence[Sequenced]) -> Fold:
    """Return the fold, or raise KineverseError if something in it cannot be applied."""
    result = Fold()
    for tag, operation in sequence:
        reads = Reads()
        reader = ReadRecorder(result.value, lambda kind: sorted(result.head[kind]), reads)
        try:
            writes = operation.apply(reader).writes()
        except ZeroDivisionError as error:
            raise kv.errors.EditError(str(error)) from error
        for (kind, name), value in writes.items():
            if kind == "frames" and value.parent != "world":
                reads.add(("frames", value.parent), Read.EXISTENCE)
                if value.parent == name or value.parent not in result.head["frames"]:
                    raise kv.errors.ModelError(name)
            if name in result.head[kind] and not _may_write(operation, reads, (kind, name)):
                raise kv.errors.DuplicateNameError(name)
        seen: dict[Any, Any] = {}
        for cell, how in reads.cells.items():
            found = result.value(cell)
            seen[cell] = (how, found if how & Read.VALUE else found is ABSENT)
        for kind in reads.listings:
            seen[kind] = sorted(result.head[kind])
        result.reads[tag], result.seen[tag] = reads, seen
        for cell, value in writes.items():
            result.head[cell[0]][cell[1]] = value
            result.writers.setdefault(cell, []).append(tag)
        for name in result.head["frames"]:
            ancestors(name, result.head["frames"].__getitem__)
    Rates(dict(result.head["rates"].values()))
    return result


def _may_write(operation: kv.Operation, reads: Reads, cell: tuple[str, str]) -> bool:
    if cell[0] == "constraints":
        return False
    return cell[0] == "data" or operation.overrides or cell in reads.cells


def check(model: kv.Model, sequence: Sequence[Sequenced]) -> Fold:
    """Assert that a model is the fold of a sequence, bookkeeping included."""
    expected, history = fold(sequence), model.history
    assert history.tags == [tag for tag, _ in sequence]
    assert [history.entry(tag).operation for tag in history.tags] == [operation for _, operation in sequence]
    for kind in KINDS:
        assert history.head[kind] == expected.head[kind], kind
    assert dict(model.frames) == expected.head["frames"]
    assert dict(model.data) == expected.head["data"]
    for kind in ("frames", "constraints", "data"):
        assert list(getattr(model, kind)) == list(expected.head[kind]), f"order of {kind}"
    cells = {*expected.writers, *(c for r in expected.reads.values() for c in r.cells), *history.cells}
    for cell in cells:
        path = "/".join(cell)
        assert history.writers(path) == expected.writers.get(cell, []), path
        readers = [t for t, r in expected.reads.items() if cell in r.cells or cell[0] in r.listings]
        assert history.readers(path) == readers, path
    assert set(history.reading) <= cells
    return expected


def holds(sequence: list[Sequenced]) -> bool:
    try:
        fold(sequence)
    except kv.KineverseError:
        return False
    return True


def changed(before: Fold, after: Fold, tags: Sequence[str]) -> list[str]:
    """Return the tags whose operations see something else than before."""
    return [t for t in tags if t in before.seen and before.seen[t] != after.seen[t]]


def state_of(model: kv.Model) -> Any:
    """Return everything about a model that a refused edit must not change."""
    history = model.history
    paths = ["/".join(cell) for cell in {*history.cells, *history.reading}]
    return (
        model.snapshot(),
        model.version,
        {
            kind: list(getattr(model, kind))
            for kind in ("frames", "bodies", "articulations", "constraints", "data")
        },
        {path: (history.writers(path), history.readers(path)) for path in paths},
        model.symbols,
        model.speeds,
        {name: model.fk(name) for name in model.frames},
    )
