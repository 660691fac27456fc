"""Documents by grammar: a table of nodes of every type, and operations that refer to it."""

from __future__ import annotations

import json
import math
from random import Random
from typing import Any

from fuzz import programs
from fuzz.values import NAMES, words
from kineverse.formats.document.node_types import BINARY, UNARY
from kineverse.model.traces.trace_queries import QUERY_KINDS as QUESTIONS

from .traces import Tracer

KINDS = ("frames", "bodies", "articulations", "constraints", "rates", "data")
VOCABULARY = (
    *KINDS,
    *UNARY,
    *BINARY,
    *QUESTIONS,
    *words(
        """
    kineverse constant symbol elementary element matrix augment less not and or select extremum norm
    piecewise carried composed dependent implicit read rotation translation below min max dof parameter
    contact location format version nodes
    operations tag kind reads writes existence value listing parent factors visuals collisions inertia
    expression float trace questions frozen parameters a b world frames/f
    """
    ),
)
_TYPES = words(
    """
    constant symbol unary binary binary element matrix augment less not joined select extremum norm
    piecewise carried composed dependent implicit motion
    """
)
_PATHS = ("a", "b", "c/d")
_SHAPES = ((), (2,), (3,), (4, 4), (0,), (1, 0), (2, 1, 2))
_IDENTITY = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0]


def generate(random: Random) -> bytes:
    """Return a document with mostly valid nodes and references."""
    if random.random() < 0.15:
        return programs.document(random)
    table = Table(random)
    for _ in range(random.choice((3, 10, 30))):
        table.grow()
    operations = [{**one, "nodes": table.nodes} for one in _Writer(table, random).operations()]
    text = json.dumps({"format": "kineverse", "version": 2, "operations": operations})
    if random.random() < 0.02:
        text = text.replace(
            '"version": 2', '"version": ' + random.choice(("0", "1", "3", "2.0", '"2"', "1e99", "null"))
        )
    return text.encode()


class Table:
    """Table of nodes with their shapes."""

    def __init__(self, random: Random) -> None:
        self.random = random
        self.nodes: list[Any] = []
        self.shapes: list[tuple[int, ...]] = []
        self.symbols: list[tuple[int, str, int]] = []
        self.carried: list[int] = []
        for path in (*_PATHS, "u"):
            for order in (0, 1, 2):
                self.symbols.append((self.add(["symbol", path, order, "dof"], ()), path, order))
        for value in (0, 1, -1, 0.5):
            self.add(["constant", value], ())
        self.one = len(self.nodes) - 3

    def add(self, node: list[Any], shape: tuple[int, ...]) -> int:
        """Append a node and return its index."""
        self.nodes.append(node)
        self.shapes.append(shape)
        return len(self.nodes) - 1

    def hide(self, first: int) -> None:
        """Exclude the nodes from an index on from further choices."""
        self.shapes[first:] = [(-1,)] * (len(self.shapes) - first)
        self.symbols = [found for found in self.symbols if found[0] < first]
        self.carried = [place for place in self.carried if place < first]

    def ref(self, shape: tuple[int, ...] | None = ()) -> Any:
        """Return the index of a node of a shape, rarely a wrong one."""
        if self.random.random() < 0.004:
            return self.random.choice(
                (-1, len(self.nodes), len(self.nodes) + 5, 1 << 70, None, "0", 0.0, True, [0])
            )
        fitting = [i for i, s in enumerate(self.shapes) if (s != (-1,) if shape is None else s == shape)]
        if not fitting:
            return self.matrix(shape or ())
        return self.random.choice(fitting[-12:] if self.random.random() < 0.7 else fitting)

    def matrix(self, shape: tuple[int, ...]) -> int:
        """Append an array and return its index."""
        count = math.prod(shape)
        refs = [self.ref() if self.random.random() < 0.6 else None for _ in range(count)]
        return self.add(["matrix", list(shape), refs], shape)

    def symbol(self, order: int | None = None, path: str | None = None) -> int:
        """Return the index of a symbol, of an order and a path if they are given."""
        places = [s for s, p, o in self.symbols if order in (None, o) and path in (None, p)]
        return self.random.choice(places)

    def grow(self) -> None:
        """Add a node of any type."""
        random = self.random
        shape = random.choice(_SHAPES)
        kind = random.choice(_TYPES)
        if kind == "constant":
            number: Any = random.gauss(0, 1)
            if random.random() < 0.3:
                number = random.choice((1e308, -0.0, 5e-324, "inf", "-inf", 1 << 60, 0.1 + 0.2))
            if random.random() < 0.02:
                number = random.choice(("nan", 10**20, None, "1"))
            self.add(["constant", number], ())
        elif kind == "symbol":
            path = random.choice(NAMES if random.random() < 0.1 else _PATHS)
            role = random.choice(("dof", "parameter", "contact", "location"))
            if random.random() < 0.02:
                role = "king"
            order = 0 if role == "parameter" else random.choice((0, 0, 1, 2, 5, 999))
            node = ["parameter", path, 0.5] if role == "parameter" else ["symbol", path, order, role]
            self.add(node, ())
        elif kind == "unary":
            self.add(["elementary", random.choice(list(UNARY)), [self.ref()]], ())
        elif kind == "binary":
            self.add(["elementary", random.choice(list(BINARY)), [self.ref(), self.ref()]], ())
        elif kind == "element":
            array = self.matrix(random.choice(((2,), (4, 4), (2, 1, 2))))
            self.add(["element", array, random.randrange(math.prod(self.shapes[array]))], ())
        elif kind == "matrix":
            self.matrix(shape)
        elif kind in ("augment", "less", "not", "joined", "select", "extremum", "norm", "piecewise"):
            getattr(self, f"_{kind}")(shape)
        else:
            getattr(self, f"_{kind}")()

    def _motion(self) -> None:
        axis = self.random.choice(([1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0, 0, 1], [0.6, 0.0, 0.8], [1, 1, 0]))
        self.add([self.random.choice(("rotation", "translation")), axis, self.ref()], (4, 4))

    def _augment(self, shape: tuple[int, ...]) -> None:
        keys = sorted({self.symbol(1) for _ in range(self.random.choice((0, 1, 2)))})
        pairs = [[key, self.ref(shape)] for key in keys]
        replace, heuristic = (self.random.random() < 0.5 for _ in range(2))
        self.add(["augment", self.ref(shape), replace, heuristic, pairs], shape)

    def _less(self, shape: tuple[int, ...]) -> None:
        contrast = self.random.choice(
            (1e10, 1, 1e-300, 1e308) if self.random.random() < 0.97 else (0, -1, "inf")
        )
        self.add(["less", self.ref(shape), self.ref(shape), contrast], shape)

    def _not(self, shape: tuple[int, ...]) -> None:
        self.add(["not", self.ref(shape)], shape)

    def _joined(self, shape: tuple[int, ...]) -> None:
        refs = [self.ref(shape) for _ in range(self.random.choice((0, *[1, 2, 5] * 10)))]
        self.add([self.random.choice(("and", "or")), refs], shape)

    def _select(self, shape: tuple[int, ...]) -> None:
        self.add(["select", *(self.ref(shape) for _ in range(3))], shape)

    def _extremum(self, shape: tuple[int, ...]) -> None:
        refs = [self.ref(shape) for _ in range(self.random.choice((1, *[2] * 15, *[3] * 15)))]
        self.add(["extremum", self.random.choice(("min", "max")), refs], shape)

    def _norm(self, shape: tuple[int, ...]) -> None:
        self.add(["norm", self.matrix(self.random.choice((*[(3,)] * 20, *[(1,)] * 10, (0,), (2, 2))))], ())

    def _piecewise(self, shape: tuple[int, ...]) -> None:
        random = self.random
        knots: list[Any] = random.choice(([0, 1, 2], [0, 1e-320, 1], [-1e308, 0, 1e308], [0, 1]))
        degree, periodic = random.choice((1, 2, 4, 6)), random.random() < 0.5
        count = len(knots) - 1 if periodic else len(knots) + 1
        pieces = [[random.gauss(0, 1) for _ in range(degree)] for _ in range(count)]
        if random.random() < 0.05:
            knots = random.choice(([2, 1, 0], [0], ["-inf", 0, "inf"]))
        if random.random() < 0.05:
            pieces[0] = pieces[0][1:]
        self.add(["piecewise", self.ref(shape), periodic, knots, pieces], shape)

    def rows(self) -> list[Any]:
        """Return a rate table."""
        keys = sorted({self.symbol(0, self.random.choice(_PATHS)) for _ in range(2)})
        return [[key, self.row()] for key in keys]

    def row(self) -> list[Any]:
        """Return speeds with their entries."""
        # Rows of coordinates that have rows themselves mostly go round.
        paths = ("u",) if self.random.random() < 0.9 else _PATHS
        speeds = {self.symbol(1, self.random.choice(paths)) for _ in range(self.random.choice((0, 1, 2)))}
        return [[speed, self.ref()] for speed in sorted(speeds)]

    def _carried(self) -> None:
        rows = self.rows()
        self.carried.append(self.add(["carried", self.random.choice(rows)[0], rows], ()))

    def _composed(self) -> None:
        if not self.carried:
            self._carried()
        of = self.random.choice(self.carried) if self.random.random() < 0.98 else self.ref()
        keys = {self.symbol() for _ in range(self.random.choice((0, 1, 2)))}
        place = self.add(["composed", of, [[key, self.ref()] for key in sorted(keys)]], ())
        self.carried.append(place)

    def _dependent(self) -> None:
        self.add(["dependent", self.ref(), self.symbol(0)], ())

    def _implicit(self) -> None:
        random = self.random
        unknown, given = random.sample([place for place, _, order in self.symbols if order == 0], 2)
        residual = self.ref()
        if random.random() < 0.7:
            residual = self.add(["elementary", "sub", [unknown, given]], ())
        column, seed = self.add(["matrix", [1], [residual]], (1,)), self.add(["matrix", [1], [given]], (1,))
        steps = random.choice((0, 1, 5, 100))
        function = ["implicit", "i", [unknown], [given], column, [0], seed, steps, [self.ref()], []]
        place = self.add(function, (1,))
        self.add(["element", place, 0], ())


class _Writer:
    """Writer of operations over a table."""

    def __init__(self, table: Table, random: Random) -> None:
        self.table, self.random = table, random
        self.frames = ["world"]
        self.names: dict[str, list[str]] = {"frames": self.frames}
        self.tracer = Tracer(table, random, self.names)

    def operations(self) -> list[Any]:
        """Return some operations."""
        return [self._operation(i) for i in range(self.random.choice((0, 1, 2, 4)))]

    def _operation(self, i: int) -> dict[str, Any]:
        random = self.random
        writes = self._writes([random.choice(KINDS) for _ in range(random.choice((1, 1, 2, 3)))])
        paths = [f"{random.choice(KINDS)}/{random.choice((*self.frames, 'a', 'g'))}" for _ in range(2)]
        reads = random.choice(({}, {}, {"value": paths}, {"existence": paths, "listing": ["data"]}))
        tag = f"t{i}" if random.random() < 0.97 else random.choice(("t0", "", *NAMES))
        given = {"tag": tag, "kind": "K", "reads": reads, "writes": writes}
        if random.random() < 0.3:
            given["parameters"] = {"name": self._parameter(0), "frame": self._parameter(0)}
        if i and random.random() < 0.7:
            given["trace"], cells = self.tracer.trace(lambda: self._writes(list(writes)))
            given["reads"] = {"value": sorted(set(cells))}
        elif random.random() < 0.05:
            given["frozen"] = "it is"
        for kind, found in writes.items():
            self.names.setdefault(kind, []).extend(found)
        return given

    def _writes(self, kinds: list[str]) -> dict[str, Any]:
        writes: dict[str, Any] = {}
        for kind in kinds:
            name, value = getattr(self, f"_{kind}")()
            writes.setdefault(kind, {})[name] = value
        return writes

    def _parameter(self, depth: int) -> Any:
        random = self.random

        def inner() -> Any:
            return self._parameter(depth + 1)

        tag = random.choice(("pose", "mapping", "record", "written", "unwritten", "list", "datum"))
        if depth > 3 or tag == "datum":
            return self._data()[1]
        if tag == "pose":
            return {"pose": random.choice((_IDENTITY, _IDENTITY, [0] * 12, [1e101] * 12))}
        if tag == "mapping":
            return {"mapping": [[inner(), inner()] for _ in range(random.choice((0, 1, 2)))]}
        if tag == "record":
            return {"record": ["R", {"a": inner(), "b": inner()}]}
        if tag == "list":
            return [inner(), inner()]
        path = f"{random.choice(KINDS)}/{random.choice((*self.frames, 'a', 'x'))}"
        return {tag: path if tag == "written" else "T"}

    def _frames(self) -> tuple[str, Any]:
        random = self.random
        factors: list[Any] = []
        for _ in range(random.choice((0, 1, 2))):
            if random.random() < 0.5:
                factors.append(
                    random.choice(([_IDENTITY], [[random.gauss(0, 1) for _ in range(12)]], [[0] * 12], [0]))
                )
            else:
                factors.append(self.table.ref((4, 4)))
        name = random.choice(("f", "g", "h", *NAMES) if random.random() < 0.1 else ("f", "g", "h"))
        value = {"parent": random.choice((*self.frames, "world")), "factors": factors}
        self.frames.append(name)
        return name, value

    def _bodies(self) -> tuple[str, Any]:
        random = self.random
        form = random.choice((
            {"kind": "box", "size": [1, 2, 3]}, {},
            {"kind": "sphere", "radius": random.choice((1, -1, "inf", 1e308))},
            {"kind": "mesh", "uri": random.choice(NAMES), "scale": [1, 1, 1]},
        ))  # fmt: skip
        shape = {"geometry": form, "origin": [_IDENTITY], "color": [0, 1, 0, 1]}
        return random.choice(self.frames), {"visuals": [shape], "collisions": []}

    def _articulations(self) -> tuple[str, Any]:
        random, table = self.random, self.table
        count = random.choice((0, 1, 2))
        return random.choice(("a", "b", "j")), {
            "kind": "revolute",
            "parent": random.choice(self.frames),
            "child": random.choice(self.frames),
            "coordinates": [table.symbol(0) for _ in range(count)],
            "home": [random.choice((0, 1, 1e308, "inf")) for _ in range(count)],
            "speeds": [table.symbol(1) for _ in range(count)],
            "dynamics": [
                ["effort", random.choice((1, None, "x", {"float": "inf"}, {"expression": table.ref(None)}))]
            ],
        }

    def _constraints(self) -> tuple[str, Any]:
        return self.random.choice(("c", "d", "a/position")), [self.table.ref() for _ in range(3)]

    def _rates(self) -> tuple[str, Any]:
        table, random = self.table, self.random
        known = [found for found in table.symbols if not found[2] or random.random() < 0.02]
        place, path, order = random.choice(known)
        text = path + {0: "", 1: ":velocity", 2: ":acceleration"}[order]
        return text, [place, table.row() if random.random() < 0.6 else table.ref()]

    def _data(self) -> tuple[str, Any]:
        deep: Any = 1
        for _ in range(self.random.choice((0, 1, 3, 300))):
            deep = [deep]
        return self.random.choice(("x", "y/z")), self.random.choice(
            (1, "a", None, deep, {"expression": self.table.ref(None)})
        )
