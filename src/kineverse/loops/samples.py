"""One branch of the solutions of a loop, at many configurations."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from kineverse.errors import UnsolvedError
from kineverse.symbols import Symbol

from .continuation import follow
from .equations import Array, Equations
from .seed import FEW, Interval

_SAMPLES = {1: 65, 2: 17, 3: 9}
_SCATTERED = 400
_TRIED = 200
_MOST_CORNERED = 8
_SHOWN = 6


class Samples:
    """One branch of solutions all over the domain, which contains the limits.

    Attributes
    ----------
    inputs, solutions
        Where fits look, (N, k) and (N, n).
    tried, wanted
        Where seeds are tried out.
    winding
        How unknowns grow with whole turns, (k, n).
    condition, worst
        See :class:`Closed`; within the limits.
    """

    def __init__(
        self,
        name: str,
        equations: Equations,
        limits: Sequence[Interval],
        intervals: Sequence[Interval],
        x: Array,
        u: Array,
        angles: npt.NDArray[np.bool_],
    ) -> None:
        self.name, self.equations, self.intervals = name, equations, intervals
        self._given = u[len(intervals) :]
        self._angles = angles
        k = len(intervals)
        generator = np.random.default_rng(1)
        lower = np.array([i.lower for i in intervals])
        upper = np.array([i.upper for i in intervals])
        home = np.clip(u[:k], lower, upper)
        x = self._followed(x, u[:k], home)
        if k <= FEW:
            grid = _grid([i.samples(_SAMPLES.get(k, 1)) for i in intervals])
        else:  # a grid would have more points than anybody waits for
            parts = generator.uniform(size=(_SCATTERED, k))
            grid = np.column_stack([i.spread(p) for i, p in zip(intervals, parts.T, strict=True)])
        corners = np.vstack([_corners(limits, generator), _corners(intervals, generator)])
        tried = np.vstack([corners, generator.uniform(lower, upper, (_TRIED, k))])
        everywhere = np.vstack([home, grid, tried])
        solutions = self._everywhere(x, everywhere)
        self.inputs, self.solutions = everywhere[: len(grid) + 1], solutions[: len(grid) + 1]
        self.tried, self.wanted = everywhere[len(grid) + 1 :], solutions[len(grid) + 1 :]
        self.winding = self._winding(x, home)
        inside = np.ones(len(everywhere), dtype=bool)
        for column, limit in zip(everywhere.T, limits, strict=True):
            inside &= (column >= limit.lower) & (column <= limit.upper)
        values = np.array(
            [self._singular_values(q, s) for q, s in zip(everywhere[inside], solutions[inside], strict=True)]
        )
        ratios = values[:, -1] / np.maximum(values[:, 0], 1e-30)
        self.condition = float(ratios.min())
        self.worst = everywhere[inside][int(ratios.argmin())]

    def all_inputs(self, q: Array) -> Array:
        """Return free coordinates with the parameters behind them."""
        return np.concatenate([q, self._given])

    def turns_over(self, rows: Sequence[int]) -> bool:
        """Whether det ∂r/∂x of these rows is zero somewhere in between: it has two signs."""
        points = zip((*self.inputs, *self.tried), (*self.solutions, *self.wanted), strict=True)
        matrices = (self.equations(x, self.all_inputs(q))[1][list(rows)] for q, x in points)
        return len({float(np.linalg.slogdet(matrix)[0]) for matrix in matrices}) > 1

    def _followed(self, x: Array, start: Array, end: Array) -> Array:
        reached = follow(self.equations, x, self.all_inputs(start), self.all_inputs(end))
        if reached.part < 1.0:
            there = start + reached.part * (end - start)
            at, to = place(self.equations.inputs, there), place(self.equations.inputs, end, named=False)
            raise UnsolvedError(
                f"Loop '{self.name}' does not close on the way to {to}: it ends, or is singular, at {at}. "
                "Narrow the limits, or the loop's within={...}, so that it closes everywhere."
            )
        return reached.solution

    def _everywhere(self, x: Array, points: Array) -> Array:
        """Return the solutions at points, each followed from the nearest one that is known."""
        scale = np.array([max(i.upper - i.lower, 1e-12) for i in self.intervals])
        solutions = np.zeros((len(points), len(x)))
        solutions[0] = self._followed(x, points[0], points[0])
        left = np.arange(1, len(points))
        nearest = np.zeros(len(points), dtype=int)
        distance = np.abs((points - points[0]) / scale).max(axis=1, initial=0.0)
        while len(left):
            position = int(distance[left].argmin())
            i, left = left[position], np.delete(left, position)
            solutions[i] = self._followed(solutions[nearest[i]], points[nearest[i]], points[i])
            closer = np.abs((points - points[i]) / scale).max(axis=1, initial=0.0)
            better = closer < distance
            nearest[better], distance[better] = i, closer[better]
        return solutions

    def _winding(self, x: Array, home: Array) -> Array:
        """Return how much the unknowns grow in a whole turn of each input that goes round, per radian."""
        winding = np.zeros((len(home), len(x)))
        for k, interval in enumerate(self.intervals):
            if not interval.whole:
                continue
            end = home.copy()
            end[k] += 2 * np.pi
            grown = (self._followed(x, home, end) - x) / (2 * np.pi)
            whole = np.abs(grown - np.round(grown)) < 1e-6
            if not np.all(whole | ~self._angles):
                raise UnsolvedError(
                    f"Loop '{self.name}' is on another branch after a turn of '{self.equations.inputs[k]}': "
                    "it goes through a singular configuration. Limit that coordinate."
                )
            # A length may grow, as a nut on a screw does; what rounding leaves of 0 would be no period.
            lengths = np.where(np.abs(grown) < 1e-9, 0.0, grown)
            winding[k] = np.where(self._angles, np.round(grown), lengths)
        return winding

    def _singular_values(self, q: Array, x: Array) -> Array:
        by_x = self.equations(x, self.all_inputs(q))[1]
        return np.linalg.svd(by_x, compute_uv=False).astype(np.float64)


def place(symbols: Sequence[Symbol], values: Array, named: bool = True) -> str:
    """Return where some inputs are, the first few of them, for a message."""
    pairs = list(zip(symbols, values.tolist(), strict=False))
    shown = ", ".join(f"{s} = {v:.6g}" if named else f"{v:.6g}" for s, v in pairs[:_SHOWN])
    return shown + (", ..." if len(pairs) > _SHOWN else "")


def _corners(intervals: Sequence[Interval], generator: np.random.Generator) -> Array:
    """Return the corners of a box, or some of them if there are many."""
    ends = np.array([(i.lower, i.upper) for i in intervals]).reshape(-1, 2)
    if len(ends) <= _MOST_CORNERED:
        return _grid(list(ends))
    which = generator.integers(0, 2, (1 << _MOST_CORNERED, len(ends)))
    return np.take_along_axis(ends, which.T, axis=1).T


def _grid(axes: Sequence[Array]) -> Array:
    points = list(itertools.product(*axes))
    return np.array(points).reshape(len(points), len(axes))
