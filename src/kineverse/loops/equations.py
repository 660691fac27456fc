"""The equations of a loop, as functions of numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from kineverse.compile import compile  # noqa: A004
from kineverse.errors import UnsolvedError
from kineverse.expressions.expression import Expression
from kineverse.symbols import Symbol

Array: TypeAlias = npt.NDArray[np.float64]

CLOSED = 1e-11
"""What is left of the residual where a loop counts as closed while it is analysed [m] or [rad]."""

_NEWTON = 30
_SINGULAR = 1e-9


MOST_EFFORT = 150_000.0
"""How much is spent on closing one loop: some ten seconds. Loops of usual size take a fifth of it."""


@dataclass
class Effort:
    """How much may still be spent on analysing a loop, the same in every process and on every machine.

    Attributes
    ----------
    name
        Of the loop.
    left
        What is left; an evaluation of a few equations is 1.

    Raises
    ------
    UnsolvedError
        When nothing is left.
    """

    name: str
    left: float = MOST_EFFORT

    def spend(self, amount: float) -> None:
        """Take something from what is left."""
        self.left -= amount
        if self.left < 0:
            raise UnsolvedError(
                f"Loop '{self.name}' is too much work: its branch is not known after {MOST_EFFORT:.0f} "
                "evaluations. Narrow the limits, or close it in parts."
            )


class Equations:
    """A residual r(x, u) with its derivatives, at numbers.

    Parameters
    ----------
    residual
        Of shape (m,).
    unknowns, inputs
        The symbols x, shape (n,), and u, shape (k,).
    effort
        What may be spent on evaluations.
    """

    def __init__(
        self, residual: Expression, unknowns: Sequence[Symbol], inputs: Sequence[Symbol], effort: Effort
    ) -> None:
        self.unknowns, self.inputs = tuple(unknowns), tuple(inputs)
        self._effort, self._size = effort, 1 + residual.size * len(self.unknowns) / 100
        by_all = residual.partial([*unknowns, *inputs])
        function = compile([residual, by_all], [*unknowns, *inputs], tier="interpreter")
        self._evaluate = function.bind()

    def __call__(self, x: Array, u: Array) -> tuple[Array, Array, Array]:
        """Return r, ∂r/∂x and ∂r/∂u; r is infinite where they are not defined."""
        self._effort.spend(self._size)
        n = len(self.unknowns)
        self._evaluate.input[:n] = x
        self._evaluate.input[n:] = u
        try:
            self._evaluate()
        except UnsolvedError:
            # A loop that this one is built on does not close there.
            m, n_all = self._evaluate.outputs[1].shape
            return np.full(m, np.inf), np.zeros((m, n)), np.zeros((m, n_all - n))
        residual, derivative = self._evaluate.outputs
        return residual.copy(), derivative[:, :n].copy(), derivative[:, n:].copy()

    def gap(self, x: Array, u: Array) -> float:
        """Return the length of the residual."""
        return float(np.linalg.norm(self(x, u)[0]))

    def close(self, x: Array, u: Array, steps: int = _NEWTON) -> tuple[Array, float]:
        """Return a solution near x, and what is left of the residual there.

        Newton's method where it leads downhill, and shorter, more careful steps where it does not
        (Levenberg, Marquardt); so it ends in the place where the loop comes closest to closing.
        """
        damping = 0.0
        residual, by_x, _ = self(x, u)
        gap = float(np.linalg.norm(residual))
        for _ in range(steps):
            if gap < 1e-15 or gap == np.inf:
                break
            matrix = by_x.T @ by_x
            scale = max(float(np.trace(matrix)) / len(x), 1e-30)
            if damping == 0.0:
                step = -np.linalg.lstsq(by_x, residual, rcond=_SINGULAR)[0]
            else:
                step = -np.linalg.solve(matrix + damping * scale * np.eye(len(x)), by_x.T @ residual)
            tried = x + step
            after, derivative, _ = self(tried, u)
            left = float(np.linalg.norm(after))
            if left < gap:
                x, residual, by_x, gap = tried, after, derivative, left
                damping = damping / 10 if damping > 1e-6 else 0.0
            elif gap < CLOSED:
                break
            else:
                damping = max(10 * damping, 1e-4)
                if damping > 1e8:
                    break
        return x, gap


def periodic(equations: Equations, x: Array, u: Array) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
    """Return which unknowns and which inputs are angles: a whole turn changes nothing."""
    at = equations(x, u)[0]

    def same(dx: Array, du: Array) -> bool:
        return bool(np.allclose(equations(x + dx, u + du)[0], at, rtol=0, atol=1e-9))

    turn = 2 * np.pi
    no_x, no_u = np.zeros(len(x)), np.zeros(len(u))
    unknowns = [same(turn * e, no_u) for e in np.eye(len(x))]
    inputs = [same(no_x, turn * e) for e in np.eye(len(u))]
    return np.array(unknowns, dtype=bool), np.array(inputs, dtype=bool)
