"""Traces by grammar: reads of every kind, and writes of their results."""

from __future__ import annotations

from collections.abc import Callable
from random import Random
from typing import TYPE_CHECKING, Any

from fuzz.values import NAMES
from kineverse.model.traces.trace_queries import QUERY_KINDS as QUESTIONS

if TYPE_CHECKING:
    from .document import Table

DATA_KINDS = ("frames", "bodies", "articulations", "constraints", "data")
_CELL = {
    "frame": "frames",
    "factors": "frames",
    "body": "bodies",
    "articulation": "articulations",
    "constraint": "constraints",
    "datum": "data",
}


class Tracer:
    """Writer of traces of operations, whose nodes are not used by other operations."""

    def __init__(self, table: Table, random: Random, names: dict[str, list[str]]) -> None:
        self._table, self._random, self._names = table, random, names

    def trace(self, write: Callable[[], dict[str, Any]]) -> tuple[dict[str, Any], list[str]]:
        """Return a trace, and the cells that it reads.

        Parameters
        ----------
        write
            Function that returns writes of the last nodes of the table.
        """
        first = len(self._table.nodes)
        questions: list[Any] = []
        cells: list[str] = []
        for place in range(self._random.choice((1, 1, 2, 3, 5))):
            question, shapes, read = self._question()
            questions.append(question)
            cells += read
            for part, shape in enumerate(shapes):
                self._answer(place, part, shape)
        writes = write()
        self._table.hide(first)
        return {"questions": questions, "writes": writes}, cells

    def _answer(self, place: int, part: int, shape: tuple[int, ...]) -> None:
        """Add a part of an answer to the table, with an expression of it."""
        random, table = self._random, self._table
        steps = random.choice((0, 0, 0, 1, 2, 16))
        path = [[table.symbol(random.choice((1, 1, 2))), random.random() < 0.5] for _ in range(steps)]
        if random.random() < 0.02:
            place, part = random.choice(((place + 1, part), (place, 1), (-1, 0), (0, 1 << 40)))
        read = table.add(["read", place, part, list(shape), path], shape)
        if shape == (3, 4):
            refs = [table.add(["element", read, i], ()) for i in range(12)]
            table.add(["matrix", [4, 4], [*refs, None, None, None, table.one]], (4, 4))
        elif shape and shape != (0,):
            table.add(["element", read, 0], ())
        table.grow()

    def _question(self) -> tuple[list[Any], list[tuple[int, ...]], list[str]]:
        """Return a question, the shapes of its answer's parts, and the cells that it reads."""
        random, table = self._random, self._table
        kind = random.choice(list(QUESTIONS))
        look = random.choice((0, 0, 0, 0, 1, 2)) if random.random() < 0.98 else random.choice((3, -1, None))
        if kind in _CELL:
            of = _CELL[kind]
            name = self._name(of)
            parts: list[tuple[int, ...]] = {
                "frame": [(3, 4)],
                "factors": random.choice(([], [(3, 4)])),
                "constraint": [(), (), ()],
                "datum": random.choice(([], [()], [(2,)], [(), ()])),
            }.get(kind, [])
            return [kind, look, name], parts, [f"{of}/{name}"]
        if kind in ("fk", "between"):
            ends = [self._name("frames") for _ in range(2)]
            return [kind, look, *ends], [(3, 4)] if kind == "fk" else [], [f"frames/{end}" for end in ends]
        if kind in ("exists", "names"):
            of = random.choice(DATA_KINDS)
            return [kind, look, of, *([self._name(of)] if kind == "exists" else [])], [], []
        symbols = [table.symbol(0) for _ in range(random.choice((0, 1, 2)))]
        vector = table.add(["matrix", [len(symbols)], symbols], (len(symbols),))
        shape = random.choice(((), (), (2,)))
        about = table.ref(shape)
        if kind in ("jacobian", "facts", "partial"):
            return [kind, look, about, vector], [(*shape, len(symbols))], []
        if kind == "substitute":
            return [kind, look, about, vector, table.matrix((len(symbols),))], [shape], []
        if kind in ("unit", "quaternion"):
            size = 3 if kind == "unit" else 4
            return [kind, look, table.matrix((size,))], [(3,) if kind == "unit" else (3, 4)], []
        return [kind, look, about], [shape], []

    def _name(self, kind: str) -> str:
        known = self._names.get(kind, [])
        if known and self._random.random() < 0.9:
            return self._random.choice(known)
        return self._random.choice(("world", "f", "a", "x", *NAMES))
