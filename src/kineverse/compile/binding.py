"""CasADi functions bound to memory, and calls of them that share nothing.

A plain call of a CasADi function takes some 17 µs whatever it computes; one that is bound to its arguments
and results takes a tenth of one. But it has one place for its results and no lock, so a function that may be
called from anywhere keeps a pool of bindings, takes one out for each call and hands out copies.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from operator import call
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from .program import CasadiFunction, Check, Vector

Array: TypeAlias = npt.NDArray[np.float64]
Run: TypeAlias = Callable[[], object]
Call: TypeAlias = Callable[[Any], Any]
Shape: TypeAlias = tuple[int, ...]


def bind(
    function: CasadiFunction, vector: Vector, outputs: Sequence[Array], check: Check | None
) -> tuple[Run, object]:
    """Bind a function of one vector to arrays.

    Parameters
    ----------
    function
        CasADi's function.
    vector
        Where it reads; contiguous.
    outputs
        Where it writes, an array per output; contiguous.
    check
        What is done with vector and outputs after each evaluation; None for nothing.

    Returns
    -------
    tuple
        What evaluates, and an object that must be kept for as long as that may be called.
    """
    buffer, run = function.buffer()
    buffer.set_arg(0, vector.data)
    for i, output in enumerate(outputs):
        buffer.set_res(i, output.reshape(-1).data)
    if check is None:
        return run, buffer

    def run_checked() -> None:
        run()
        check(vector, outputs)

    return run_checked, buffer


def pooled(
    function: CasadiFunction,
    size: int,
    shapes: Sequence[Shape],
    single: bool,
    convert: Call,
    check: Check | None,
) -> Call:
    """Return a call that gives fresh arrays and can be used by any number of threads.

    Parameters
    ----------
    function
        CasADi's function of one vector.
    size
        The length of the vector.
    shapes
        The shape of each output.
    single
        Whether the one array is returned, rather than a tuple of them.
    convert
        Turns what is not a vector of doubles into one, or raises.
    check
        As for :func:`bind`.
    """
    # Appending to and popping from a list are atomic.
    pool: list[tuple[memoryview, Run, Any, object]] = []
    take, give_back = pool.pop, pool.append
    pair = len(shapes) == 2

    def new() -> tuple[memoryview, Run, Any, object]:
        vector = np.zeros(size)
        outputs = tuple(np.zeros(shape) for shape in shapes)
        run, keep = bind(function, vector, outputs, check)
        return vector.data, run, tuple(output.copy for output in outputs), keep

    def evaluate(x: Any) -> Any:
        try:
            binding = take()
        except IndexError:
            binding = new()
        vector, run, copies, _ = binding
        try:
            # This assignment refuses everything but doubles of the right number; it would not see a mask.
            vector[:] = x if type(x) is np.ndarray else convert(x)  # type: ignore[assignment]
        except (ValueError, TypeError):
            vector[:] = convert(x)
        run()
        if pair:
            # The usual case; going through a list of copies would take a quarter of the whole call.
            first, second = copies
            results = first(), second()
        elif single:
            results = copies[0]()
        else:
            results = tuple(map(call, copies))
        give_back(binding)
        return results

    return evaluate
