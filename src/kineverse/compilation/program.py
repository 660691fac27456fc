"""Expressions as one function of a vector of numbers, independent of names.

Symbols are replaced by elements of one vector. So equal mechanisms with different names are the same program,
with the same compiled library, and no name from a document occurs in generated code.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, TypeAlias

import casadi as ca
import numpy as np

from kineverse.errors import CompileError
from kineverse.expressions import Expression, layout
from kineverse.expressions.implicit import explain_no_solution, implicit_nodes
from kineverse.lie import Array
from kineverse.symbols import Symbol

from .c_source import Scalar

CasadiFunction: TypeAlias = Any
Check: TypeAlias = Callable[[Array, Array | Sequence[Array]], None]

FUNCTION_NAME = "kineverse_function"

# Of two zeros CasADi's interpreter returns the first, the C library the second.
_PRELUDE = """
#include <math.h>
#define CASADI_SYMBOL_EXPORT __attribute__((visibility("default")))
#define UNUSED __attribute__((unused))
static inline UNUSED double first_smaller(double x, double y) { return x <= y || y != y ? x : y; }
static inline UNUSED double first_larger(double x, double y) { return x >= y || y != y ? x : y; }
#define fmin(x, y) first_smaller(x, y)
#define fmax(x, y) first_larger(x, y)
"""

SINGLE_KIND = "single 3"  # raise the number when other source is generated from the same program

# From so many constants on, an output is initialised from a table: compile time grows with statements.
_TABLE = 64


class Program:
    """A function of a vector, with one column of numbers, in C order, per output."""

    def __init__(self, outputs: Sequence[Expression], inputs: Sequence[Symbol]) -> None:
        self.size = len(inputs)
        self.sizes = tuple(e.size for e in outputs)
        self._vector = ca.SX.sym("x", self.size)
        columns = [ca.densify(layout.column(e.casadi, e.shape)) for e in outputs]
        symbols = ca.vertcat(*(s.casadi for s in inputs)) if inputs else ca.SX(0, 1)
        self._columns = ca.substitute(columns, [symbols], [self._vector])
        self._function: CasadiFunction = None
        # Common parts are shared later, since that takes time and an existing library does not need it.
        self.instructions: int = self._graph().n_instructions()
        # Closed loops, which may have no solution.
        self.implicit = implicit_nodes(outputs)
        self._symbols = tuple(inputs) if self.implicit else ()  # for errors about them

    @cached_property
    def _digest(self) -> hashlib._Hash:
        text = f"{_PRELUDE} {ca.CasadiMeta.version()} {self._graph().serialize()}"
        return hashlib.sha256(text.encode())

    def key(self, *details: str) -> str:
        """Return the digest of this program and of its compilation, the same in every process."""
        digest = self._digest.copy()
        digest.update(repr(details).encode())
        return digest.hexdigest()[:40]

    def check(self, vector: Array, results: Array | Sequence[Array]) -> None:
        """Raise an error if results are NaN because an implicit function has no solution."""
        arrays = (results,) if isinstance(results, np.ndarray) else results
        if any(np.isnan(array).any() for array in arrays):
            error = explain_no_solution(self.implicit, self._symbols, vector)
            if error is not None:
                raise error

    @property
    def checked(self) -> Check | None:
        """:meth:`check` if there is anything to check."""
        return self.check if self.implicit else None

    @property
    def operations(self) -> frozenset[int]:
        """CasADi's codes of the operations of the program."""
        graph = self._graph()
        return frozenset(graph.instruction_id(k) for k in range(graph.n_instructions()))

    @property
    def function(self) -> CasadiFunction:
        """CasADi's function of one input vector, common parts shared."""
        if self._function is None:
            self._function = ca.Function(FUNCTION_NAME, [self._vector], self._shared())
        return self._function

    def _graph(self) -> CasadiFunction:
        """Return CasADi's function with common parts as they are."""
        return ca.Function(FUNCTION_NAME, [self._vector], self._columns)

    def _shared(self) -> list[ca.SX]:
        """Return the columns with common parts shared."""
        shared = ca.vertsplit(ca.cse(ca.vertcat(*self._columns)), _offsets(self.sizes))
        return [ca.densify(c) for c in shared]

    def source(self) -> str:
        """Return the C source of the function, as CasADi generates it, but for inputs and outputs.

        All inputs and outputs have to be given when it is called: CasADi asks for each number whether it is,
        and hundreds of such branches keep a compiler busy for minutes. Constants of which there are many are
        copied from a table.
        """
        columns: list[Any] = []
        tables: dict[int, dict[int, float]] = {}
        for k, column in enumerate(self._shared()):
            elements: list[Any] = column.elements()
            table = {n: float(e) for n, e in enumerate(elements) if e.is_constant()}
            if len(table) >= _TABLE:
                tables[k] = table
                elements = [0.0 if n in table else e for n, e in enumerate(elements)]
            columns.append(ca.densify(ca.vertcat(*elements)) if elements else column)
        generator = ca.CodeGenerator("kineverse.c")
        generator.add(ca.Function(FUNCTION_NAME, [self._vector], columns))
        # Comments contain the names of inner functions, such as those of loops.
        code = re.sub(r"/\*.*?\*/", "", generator.dump(), flags=re.DOTALL)
        if re.search(r"\berfinv\(", code):
            raise CompileError("CasADi has no C for the inverse error function.")
        main = _MAIN.search(code)
        if main is None:
            raise CompileError("CasADi generates other C than before: its function was not found.")
        return (
            _PRELUDE + code[: main.start()] + _remove_branches(main, self.sizes, tables) + code[main.end() :]
        )


# The function itself; inner functions come after it, and are called for part of their results.
_MAIN = re.compile(
    r"(static int casadi_f0\(.*?\) \{\n(?:  casadi_(?:real|int)[^=;]*;\n)*)(.*?\n\}\n)", re.DOTALL
)
_INPUT = re.compile(r"arg\[0\]\? arg\[0\]\[(\d+)\] : 0")
_OUTPUT = re.compile(r"  if \(res\[(\d+)\]!=0\) res\[\d+\]\[(\d+)\]=(\w+);\n")


def _remove_branches(main: re.Match[str], sizes: Sequence[int], tables: dict[int, dict[int, float]]) -> str:
    """Return a C function without a branch for each number, and with constants from tables."""
    declared, body = main.groups()

    def written(output: re.Match[str]) -> str:
        k, place, value = int(output[1]), int(output[2]), output[3]
        return "" if place in tables.get(k, ()) else f"  res[{k}][{place}]={value};\n"

    body = _OUTPUT.sub(written, _INPUT.sub(r"arg[0][\1]", body))
    if body.count("res[") != sum(sizes) - sum(map(len, tables.values())):
        raise CompileError("CasADi generates other C than before: its results were not found.")
    data, copies = "", ""
    for k, table in tables.items():
        numbers = ", ".join(c_literal(table.get(place, 0.0)) for place in range(sizes[k]))
        data += f"static const casadi_real constants{k}[] = {{{numbers}}};\n"
        copies += f"  __builtin_memcpy(res[{k}], constants{k}, sizeof constants{k});\n"
    return data + declared + copies + body


def c_literal(x: float, scalar: Scalar = "double") -> str:
    """Return a number as a C literal: exactly, or rounded to float."""
    if scalar == "float":
        with np.errstate(over="ignore"):
            x = float(np.float32(x))
    if x != x:
        return "NAN"
    if x in (float("inf"), float("-inf")):
        return "INFINITY" if x > 0 else "-INFINITY"
    return x.hex() + ("f" if scalar == "float" else "")


def _offsets(sizes: Sequence[int]) -> list[int]:
    offsets = [0]
    for size in sizes:
        offsets.append(offsets[-1] + size)
    return offsets
