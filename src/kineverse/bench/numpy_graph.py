"""A CasADi graph evaluated by numpy: each of its operations is one of numpy's, on many points at a time."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import casadi as ca
import numpy as np

from kineverse.errors import CompileError

from .agreement import Array

AT_ONCE = 1024
"""So many points that the columns of a graph stay in the cache, and numpy's overhead is small."""

OPERATIONS: Mapping[int, Callable[..., Any]] = MappingProxyType(
    {
        ca.OP_ADD: np.add,
        ca.OP_SUB: np.subtract,
        ca.OP_MUL: np.multiply,
        ca.OP_DIV: np.divide,
        ca.OP_NEG: np.negative,
        ca.OP_INV: np.reciprocal,
        ca.OP_SQ: np.square,
        ca.OP_TWICE: lambda x, out: np.multiply(x, 2.0, out=out),
        ca.OP_SQRT: np.sqrt,
        ca.OP_SIN: np.sin,
        ca.OP_COS: np.cos,
        ca.OP_ASSIGN: lambda x, out: np.copyto(out, x),
    }
)
"""What the kinematics of joints with one coordinate are made of."""


class NumpyGraph:
    """A function of CasADi's, of one vector, that numpy evaluates at many points.

    Parameters
    ----------
    function
        With scalar instructions only, as those of ``SX`` are.

    Raises
    ------
    CompileError
        If it contains operations that are not among :data:`OPERATIONS`.
    """

    def __init__(self, function: Any) -> None:
        self._columns = np.zeros((function.sz_w(), AT_ONCE))
        self._steps: list[tuple[int, Any, list[int], list[int]]] = []
        for k in range(function.n_instructions()):
            code = function.instruction_id(k)
            if code == ca.OP_CONST:
                argument = function.instruction_constant(k)
            elif code in (ca.OP_INPUT, ca.OP_OUTPUT):
                argument = None
            elif code in OPERATIONS:
                argument = OPERATIONS[code]
            else:
                raise CompileError(f"numpy is not told what CasADi's operation {code} is.")
            places = function.instruction_input(k), function.instruction_output(k)
            self._steps.append((code, argument, *places))

    def __call__(self, points: Array, outputs: Sequence[Array]) -> None:
        """Evaluate at all rows of points, shape (N, n), and write to outputs, each of N rows."""
        flat = [output.reshape(len(points), -1) for output in outputs]
        for first in range(0, len(points), AT_ONCE):
            some = slice(first, first + AT_ONCE)
            self._evaluate(points[some].T.copy(), [output[some].T for output in flat])

    def _evaluate(self, inputs: Array, outputs: Sequence[Array]) -> None:
        columns = list(self._columns[:, : inputs.shape[1]])
        for code, argument, read, written in self._steps:
            if code == ca.OP_INPUT:
                np.copyto(columns[written[0]], inputs[read[1]])
            elif code == ca.OP_OUTPUT:
                np.copyto(outputs[written[0]][written[1]], columns[read[0]])
            elif code == ca.OP_CONST:
                columns[written[0]].fill(argument)
            else:
                argument(*[columns[place] for place in read], out=columns[written[0]])
