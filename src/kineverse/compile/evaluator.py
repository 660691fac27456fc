"""Evaluators: a compiled function bound to memory of one's own, for loops that count nanoseconds."""

from __future__ import annotations

from abc import ABCMeta
from collections.abc import Callable
from typing import Any

import numpy as np

from .binding import Array, Run, Shape
from .program import Vector


class Evaluator(metaclass=ABCMeta):
    """A function with a place for its input and for its outputs, for one thread.

    Fill :attr:`input`, call, read :attr:`outputs`. Every call rewrites the arrays in :attr:`outputs` in
    place: copy what has to outlive the next one. Made by :meth:`CompiledFunction.bind`; it becomes faster by
    itself when the function's C is ready.

    Attributes
    ----------
    input
        The vector that is evaluated at, shape (n,); zeros at first.
    outputs
        The arrays that calls write to, one per output.
    """

    __slots__ = ("__weakref__", "_convert", "_kept", "_run", "_view", "input", "outputs")

    input: Vector
    outputs: tuple[Array, ...]

    def __init__(self, shapes: tuple[Shape, ...], size: int, convert: Callable[[Any], Vector]) -> None:
        put = super().__setattr__
        put("input", np.zeros(size))
        put("outputs", tuple(np.zeros(shape) for shape in shapes))
        put("_view", self.input.data)
        put("_convert", convert)
        put("_kept", [])

    def __call__(self, x: Any = None, /) -> None:
        """Evaluate, and rewrite :attr:`outputs`.

        Parameters
        ----------
        x
            The input; what :attr:`input` holds if None. It is copied there.

        Raises
        ------
        ShapeError
            If ``x`` is no vector of n numbers.
        """
        if x is not None:
            try:
                self._view[:] = x if type(x) is np.ndarray else self._convert(x)  # type: ignore[call-overload]
            except (ValueError, TypeError):
                self.input[:] = self._convert(x)
        self._run()

    def _evaluate_by(self, run: Run, keep: object) -> None:
        """Evaluate by something else from the next call on, in the same memory.

        Parameters
        ----------
        run
            What reads :attr:`input` and writes :attr:`outputs`.
        keep
            What has to live as long as ``run`` may be called.
        """
        # A call may be running in another thread: what it uses must stay.
        self._kept.append(keep)
        object.__setattr__(self, "_run", run)

    _kept: list[object]
    _run: Run
    _view: memoryview
    _convert: Callable[[Any], Vector]

    def __setattr__(self, name: str, value: object) -> None:
        raise AttributeError(
            f"Evaluators write in place; for the input, say evaluator.input[:] = x (not {name} = ...)."
        )

    def __repr__(self) -> str:
        outputs = ", ".join(str(o.shape) for o in self.outputs[:6]) + (
            ", ..." if len(self.outputs) > 6 else ""
        )
        return f"Evaluator({self.input.size} inputs -> {outputs})"
