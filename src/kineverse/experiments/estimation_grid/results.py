"""Results of the estimation grid by cell, and their comparison with the attainable bound."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from kineverse.experiments.estimation_grid.samples import Cell
from kineverse.lie import Array

Flags = npt.NDArray[np.bool_]

NEAR, TELLING = 10.0, 5.0
"""Bounds [deg] below which errors are compared with the bound, and types have to be right."""

MOST_OVER, LEAST_RIGHT = 1.1, 0.99
"""Allowed ratio of errors to the bound, and required part of correct types."""

FAR_OFF = 6.0
"""An error of so many times what can be attained is a divergence: by chance, hardly one in a million is."""


@dataclass(frozen=True, eq=False)
class CellResult:
    """Outcome of the samples of a cell.

    Attributes
    ----------
    cell
        What they have in common.
    degrees, metres
        How far the axis found is off in direction and place, (S,); NaN where there is none, as the place of a
        slider.
    bound_degrees, bound_metres
        The Cramér-Rao bounds of these, (S,), see :func:`.cramer_rao.compute_bound`.
    attainable_degrees, attainable_metres
        What can be attained at best, (S,), see :func:`.cramer_rao.compute_attainable_bound`.
    spread
        The relative variance of the sum of squares of ``degrees`` by chance, at what can be attained.
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
    attainable_degrees: Array
    attainable_metres: Array
    spread: float
    right: Flags
    told: Flags
    called: tuple[str, ...]

    @property
    def bound(self) -> float:
        """The Cramér-Rao bound of the root mean square of the direction's error [deg]."""
        return rms(self.bound_degrees)

    @property
    def attainable(self) -> float:
        """Attainable bound of the error [deg]."""
        return rms(self.attainable_degrees)

    @property
    def ratio(self) -> float:
        """Root mean square of the direction's error over its Cramér-Rao bound."""
        return rms(self.degrees) / self.bound

    @property
    def attained(self) -> float:
        """Root mean square of the direction's error over what can be attained."""
        return rms(self.degrees) / self.attainable

    @property
    def diverged(self) -> int:
        """Number of samples without an axis, or with one that is far off where it can be known."""
        lost = ~np.isfinite(self.degrees)
        if self.attainable < NEAR:
            lost |= self.degrees > FAR_OFF * self.attainable_degrees
        return int(lost.sum())

    @property
    def by_chance(self) -> float:
        """Probability that attainable errors exceed the bound by too much by chance."""
        excess = (MOST_OVER**2 - 1.0) / math.sqrt(self.spread)
        return 0.5 * math.erfc(excess / math.sqrt(2.0))


@dataclass(frozen=True)
class ErrorRatios:
    """Errors over a bound, in the cells where that is near.

    Attributes
    ----------
    near
        How many cells these are.
    direction, place
        Root mean squares over the bounds, all fits together; NaN if there are none.
    worst
        The largest ratio of the direction in a cell.
    over
        In how many cells that is more than it may be.
    """

    near: int
    direction: float
    place: float
    worst: float
    over: int


@dataclass(frozen=True)
class GridSummary:
    """Several cells together.

    Attributes
    ----------
    cells, fits
        How many there are.
    bound, attainable
        Errors over the Cramér-Rao bound, and over what can be attained.
    over_by_chance
        In how many cells errors would be too much above what can be attained by chance.
    right
        How many types are right, as a part, where the Cramér-Rao bound tells; NaN if it does nowhere.
    right_attainable
        The same where what can be attained tells.
    told
        How many were told, rather than answered by "cannot tell", as a part, in the cells of ``right``.
    told_wrong
        How many of all fits were told, and wrong.
    diverged
        How many fits did.
    """

    cells: int
    fits: int
    bound: ErrorRatios
    attainable: ErrorRatios
    over_by_chance: float
    right: float
    right_attainable: float
    told: float
    told_wrong: int
    diverged: int


def summarize_cells(results: Sequence[CellResult]) -> GridSummary:
    """Return several cells together."""
    telling = [r for r in results if r.bound < TELLING]
    return GridSummary(
        cells=len(results),
        fits=sum(len(r.degrees) for r in results),
        bound=_ratios([(r, r.bound_degrees, r.bound_metres) for r in results]),
        attainable=_ratios([(r, r.attainable_degrees, r.attainable_metres) for r in results]),
        over_by_chance=sum(r.by_chance for r in results if r.attainable < NEAR),
        right=_fraction([r.right for r in telling]),
        right_attainable=_fraction([r.right for r in results if r.attainable < TELLING]),
        told=_fraction([r.told for r in telling]),
        told_wrong=sum(int((r.told & ~r.right).sum()) for r in results),
        diverged=sum(r.diverged for r in results),
    )


def rms(values: Array) -> float:
    """Return a root mean square."""
    return float(np.sqrt(np.mean(values**2)))


def _ratios(results: Sequence[tuple[CellResult, Array, Array]]) -> ErrorRatios:
    near = [entry for entry in results if rms(entry[1]) < NEAR]
    cells = [rms(result.degrees) / rms(degrees) for result, degrees, _ in near]
    directions = [result.degrees / degrees for result, degrees, _ in near]
    places = [result.metres / metres for result, _, metres in near if result.cell.joint == "revolute"]
    return ErrorRatios(
        near=len(near),
        direction=rms(np.concatenate(directions)) if directions else math.nan,
        place=rms(np.concatenate(places)) if places else math.nan,
        worst=max(cells, default=math.nan),
        over=sum(not ratio <= MOST_OVER for ratio in cells),
    )


def _fraction(flags: Sequence[Flags]) -> float:
    return float(np.concatenate(flags).mean()) if flags else math.nan
