"""Expressions as one function of a vector of numbers, without any name from outside.

The symbols are replaced by elements of one neutral vector first. So the same mechanism under other names is
the same program, with the same compiled library, and no name of a document can reach generated code.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
import numpy.typing as npt

from kineverse.errors import CompileError
from kineverse.expressions import Expression, layout
from kineverse.expressions.implicit import explain, implicit_nodes
from kineverse.symbols import Symbol

CasadiFunction: TypeAlias = Any
Vector: TypeAlias = npt.NDArray[np.float64]
Check: TypeAlias = Callable[[Vector, Vector | Sequence[Vector]], None]

NAME = "kineverse_function"

# Of two zeros CasADi's interpreter returns the first, the C library the second.
_PRELUDE = """
#include <math.h>
#define CASADI_SYMBOL_EXPORT __attribute__((visibility("default")))
static inline double first_smaller(double x, double y) { return x <= y || y != y ? x : y; }
static inline double first_larger(double x, double y) { return x >= y || y != y ? x : y; }
#define fmin(x, y) first_smaller(x, y)
#define fmax(x, y) first_larger(x, y)
"""


class Program:
    """What is computed: n numbers in, and one column of numbers, in C order, per output.

    Parameters
    ----------
    outputs
        The expressions.
    inputs
        All symbols that occur in them, and maybe others, in the order of the input vector.
    """

    def __init__(self, outputs: Sequence[Expression], inputs: Sequence[Symbol]) -> None:
        self.size = len(inputs)
        self.sizes = tuple(e.size for e in outputs)
        self._vector = ca.SX.sym("x", self.size)
        columns = [ca.densify(layout.column(e.casadi, e.shape)) for e in outputs]
        symbols = ca.vertcat(*(s.casadi for s in inputs)) if inputs else ca.SX(0, 1)
        self._columns = ca.substitute(columns, [symbols], [self._vector])
        self._function: CasadiFunction = None
        # Common parts are not shared yet: for a library that exists already, that would be time lost.
        graph = ca.Function(NAME, [self._vector], self._columns)
        self.instructions: int = graph.n_instructions()
        # Closed loops, which have no solution everywhere.
        self.implicit = implicit_nodes(outputs)
        self._symbols = tuple(inputs)
        text = f"{_PRELUDE} {ca.CasadiMeta.version()} {graph.serialize()}"
        self.digest = hashlib.sha256(text.encode())

    def key(self, *details: str) -> str:
        """Return the digest of this program and of how it is compiled, the same in every process.

        Parameters
        ----------
        details
            All that the library depends on beside the program.
        """
        digest = self.digest.copy()
        digest.update(repr(details).encode())
        return digest.hexdigest()[:40]

    def check(self, vector: Vector, results: Vector | Sequence[Vector]) -> None:
        """Raise an error if results are NaN because an implicit function has no solution.

        Parameters
        ----------
        vector
            What was evaluated at, shape (n,).
        results
            What came out: arrays of any shape, or a single one.

        Raises
        ------
        UnsolvedError
            Naming the function, and where it was asked for.
        """
        arrays = (results,) if isinstance(results, np.ndarray) else results
        if any(np.isnan(array).any() for array in arrays):
            error = explain(self.implicit, self._symbols, vector)
            if error is not None:
                raise error

    @property
    def checked(self) -> Check | None:
        """:meth:`check` if there is anything to check."""
        return self.check if self.implicit else None

    @property
    def function(self) -> CasadiFunction:
        """CasADi's function of one input vector, common parts shared."""
        if self._function is None:
            shared = ca.vertsplit(ca.cse(ca.vertcat(*self._columns)), _offsets(self.sizes))
            self._function = ca.Function(NAME, [self._vector], [ca.densify(c) for c in shared])
        return self._function

    def source(self) -> str:
        """Return the C source of the function, as CasADi generates it, comments removed.

        Raises
        ------
        CompileError
            If an operation has no definition in C.
        """
        generator = ca.CodeGenerator("kineverse.c")
        generator.add(self.function)
        # Comments hold the names of functions that are called inside, such as those of loops.
        code = re.sub(r"/\*.*?\*/", "", generator.dump(), flags=re.DOTALL)
        if re.search(r"\berfinv\(", code):
            raise CompileError("CasADi has no C for the inverse error function.")
        return _PRELUDE + code


def _offsets(sizes: Sequence[int]) -> list[int]:
    offsets = [0]
    for size in sizes:
        offsets.append(offsets[-1] + size)
    return offsets
