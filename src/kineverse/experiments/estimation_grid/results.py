"""What came out of the estimation grid, cell by cell, and whether it is as good as can be."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from kineverse.experiments.estimation_grid.samples import Cell

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

NEAR, TELLING = 10.0, 5.0
"""Where the bound is below these [deg], errors are held against it, and types have to be right."""

MOST_OVER, LEAST_RIGHT = 1.1, 0.99
"""How much errors may exceed the bound, and how many types have to be right."""

FAR_OFF = 6.0
"""An error of so many times its bound is a divergence: by chance one in some hundred millions is."""


@dataclass(frozen=True, eq=False)
class Result:
    """What became of the samples of a cell.

    Attributes
    ----------
    cell
        What they have in common.
    degrees, metres
        How far the axis found is off in direction and place, (S,); NaN where there is none, as the place of a
        slider.
    bound_degrees, bound_metres
        The bounds of these, (S,).
    spread
        The relative variance of the sum of squares of ``degrees`` by chance, if they are at the bound.
    right
        Whether the most probable family is the true one, (S,).
    told
        Whether the answer was more than "cannot tell", (S,).
    called
        The most probable family of each.
    """

    cell: Cell
    degrees: Array
    metres: Array
    bound_degrees: Array
    bound_metres: Array
    spread: float
    right: Flags
    told: Flags
    called: tuple[str, ...]

    @property
    def bound(self) -> float:
        """The bound of the root mean square of the direction's error [deg]."""
        return _rms(self.bound_degrees)

    @property
    def ratio(self) -> float:
        """Root mean square of the direction's error over its bound."""
        return _rms(self.degrees) / self.bound

    @property
    def place_ratio(self) -> float:
        """Root mean square of the place's error over its bound; NaN for sliders."""
        return _rms(self.metres) / _rms(self.bound_metres)

    @property
    def diverged(self) -> int:
        """How many have no axis, or where the bound is near, one that is far off."""
        lost = ~np.isfinite(self.degrees)
        if self.bound < NEAR:
            lost |= self.degrees > FAR_OFF * self.bound_degrees
        return int(lost.sum())

    @property
    def by_chance(self) -> float:
        """How probable it is that errors at the bound exceed it by too much, with so many samples."""
        excess = (MOST_OVER**2 - 1.0) / math.sqrt(self.spread)
        return 0.5 * math.erfc(excess / math.sqrt(2.0))


@dataclass(frozen=True)
class Summary:
    """Several cells together.

    Attributes
    ----------
    cells, fits
        How many there are.
    near
        In how many cells the bound is near.
    ratio, place_ratio
        Root mean square of errors over their bounds there, all fits together; NaN if there are none.
    worst
        The largest ratio of a cell there.
    over, over_by_chance
        How many cells there exceed the bound by too much, and how many would by chance.
    right
        How many types are right, as a part, where the bound tells; NaN if it does nowhere.
    least_right
        The same in the worst cell.
    told
        How many were told, rather than answered by "cannot tell", as a part, in the same cells.
    told_wrong
        How many of all fits were told, and wrong.
    diverged
        How many fits did.
    """

    cells: int
    fits: int
    near: int
    ratio: float
    place_ratio: float
    worst: float
    over: int
    over_by_chance: float
    right: float
    least_right: float
    told: float
    told_wrong: int
    diverged: int


def summarise(results: Sequence[Result]) -> Summary:
    """Return several cells together."""
    near = [r for r in results if r.bound < NEAR]
    telling = [r for r in results if r.bound < TELLING]
    turning = [r for r in near if r.cell.joint == "revolute"]
    return Summary(
        cells=len(results),
        fits=sum(len(r.degrees) for r in results),
        near=len(near),
        ratio=_pooled(near, lambda r: r.degrees / r.bound_degrees),
        place_ratio=_pooled(turning, lambda r: r.metres / r.bound_metres),
        worst=max((r.ratio for r in near), default=math.nan),
        over=sum(not r.ratio <= MOST_OVER for r in near),
        over_by_chance=sum(r.by_chance for r in near),
        right=_part([r.right for r in telling]),
        least_right=min((float(r.right.mean()) for r in telling), default=math.nan),
        told=_part([r.told for r in telling]),
        told_wrong=sum(int((r.told & ~r.right).sum()) for r in results),
        diverged=sum(r.diverged for r in results),
    )


def _pooled(results: Sequence[Result], relative: Callable[[Result], Array]) -> float:
    return _rms(np.concatenate([relative(r) for r in results])) if results else math.nan


def _part(flags: Sequence[Flags]) -> float:
    return float(np.concatenate(flags).mean()) if flags else math.nan


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))
