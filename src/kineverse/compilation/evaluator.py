"""CasADi functions bound to memory: evaluators for one thread and pools for many.

A plain call of a CasADi function takes some 17 µs, whatever it computes; a call that is bound to arrays of
arguments and results takes 0.1 µs. A binding has one set of result arrays and no lock. So a function for many
threads has a pool of bindings, uses one of them for each call and returns copies.
"""

from __future__ import annotations

from abc import ABCMeta
from collections.abc import Callable, Sequence
from operator import call
from typing import Any, TypeAlias

import numpy as np

from kineverse.expressions.layout import ArrayShape
from kineverse.lie import Array

from .program import CasadiFunction, Check

BoundCall: TypeAlias = Callable[[], object]
VectorCall: TypeAlias = Callable[[Any], Any]


def bind(
    function: CasadiFunction, vector: Array, outputs: Sequence[Array], check: Check | None
) -> tuple[BoundCall, object]:
    """Bind a function of one vector to arrays."""
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


def make_pooled_call(
    function: CasadiFunction,
    size: int,
    shapes: Sequence[ArrayShape],
    single: bool,
    convert: VectorCall,
    check: Check | None,
) -> VectorCall:
    """Return a call that returns new arrays and can be used by any number of threads."""
    # Appending to and popping from a list are atomic.
    pool: list[tuple[memoryview, BoundCall, Any, object]] = []
    take, give_back = pool.pop, pool.append
    pair = len(shapes) == 2

    def new() -> tuple[memoryview, BoundCall, Any, object]:
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
            # This assignment refuses everything but n doubles; it ignores masks, hence the type check.
            vector[:] = x if type(x) is np.ndarray else convert(x)  # type: ignore[assignment]
        except (ValueError, TypeError):
            vector[:] = convert(x)
        run()
        if pair:
            # The usual case; a loop over copies would take a quarter of the whole call.
            first, second = copies
            results = first(), second()
        elif single:
            results = copies[0]()
        else:
            results = tuple(map(call, copies))
        give_back(binding)
        return results

    return evaluate


class Evaluator(metaclass=ABCMeta):
    """A function bound to arrays for its input and outputs, for one thread.

    Fill :attr:`input`, call, read :attr:`outputs`. Every call rewrites the arrays in :attr:`outputs` in
    place; copy those that have to outlive the next call. Made by :meth:`.CompiledFunction.bind`. It switches
    to C when the function's C is ready.

    Attributes
    ----------
    input
        The input vector, shape (n,); zeros at first.
    outputs
        The arrays of results, one per output.

    Examples
    --------
    >>> f = kv.compile(kv.load("pr2").fk("pr2/l_gripper_tool_frame"))
    >>> evaluate = f.bind()
    >>> evaluate.input[:] = 0.1  # in the order of f.names
    >>> evaluate()
    >>> evaluate.outputs[0][:3, 3].round(3)
    array([0.994, 0.488, 0.734])
    """

    __slots__ = ("__weakref__", "_convert", "_references", "_run", "_view", "input", "outputs")

    input: Array
    outputs: tuple[Array, ...]

    def __init__(self, shapes: tuple[ArrayShape, ...], size: int, convert: Callable[[Any], Array]) -> None:
        assign = super().__setattr__
        assign("input", np.zeros(size))
        assign("outputs", tuple(np.zeros(shape) for shape in shapes))
        assign("_view", self.input.data)
        assign("_convert", convert)
        assign("_references", [])

    def __call__(self, x: Any = None, /) -> None:
        """Evaluate, and rewrite :attr:`outputs`.

        Parameters
        ----------
        x
            The input, which is copied to :attr:`input`; the present content of :attr:`input` if None.
        """
        if x is not None:
            try:
                self._view[:] = x if type(x) is np.ndarray else self._convert(x)  # type: ignore[call-overload]
            except (ValueError, TypeError):
                self.input[:] = self._convert(x)
        self._run()

    def _evaluate_by(self, run: BoundCall, keep: object) -> None:
        """Replace the function from the next call on, with the same arrays."""
        # A call may be running in another thread, so the previous object must stay alive.
        self._references.append(keep)
        object.__setattr__(self, "_run", run)

    _references: list[object]
    _run: BoundCall
    _view: memoryview
    _convert: Callable[[Any], Array]

    def __setattr__(self, name: str, value: object) -> None:
        raise AttributeError(
            f"Evaluators write in place; for the input, say evaluator.input[:] = x (not {name} = ...)."
        )

    def __repr__(self) -> str:
        outputs = ", ".join(str(o.shape) for o in self.outputs[:6]) + (
            ", ..." if len(self.outputs) > 6 else ""
        )
        return f"Evaluator({self.input.size} inputs -> {outputs})"
