"""Results of the estimation grid, their comparison with the bounds, and the targets."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from kineverse.lie import Array
from kineverse_studies.experiments.estimation_grid.samples import Cell

Flags = npt.NDArray[np.bool_]

NEAR, TELLING = 10.0, 5.0
"""Bounds [deg] below which errors are compared with the bound, and below which families must be correct."""

MOST_OVER, LEAST_RIGHT = 1.1, 0.99
"""Largest ratio of errors to a bound, and least share of right families."""

FAR_OFF = 6.0
"""Ratio of an error to the attainable bound that counts as divergence. The chance is one in a million."""


@dataclass(frozen=True, eq=False)
class CellResult:
    """Results of the samples of a cell."""

    cell: Cell
    degrees: Array
    metres: Array
    bound_degrees: Array  # their Cramér-Rao bounds, (S,), see :func:`.cramer_rao.compute_bound`
    bound_metres: Array
    # their attainable bounds, (S,), see :func:`.cramer_rao.compute_attainable_bound`
    attainable_degrees: Array
    attainable_metres: Array
    spread: float  # relative variance of the sum of squares of ``degrees`` at the attainable bound
    right: Flags  # mask of the samples in which the most probable family is the true one, (S,)
    told: Flags  # mask of the samples with an unambiguous result, (S,)
    called: tuple[str, ...]  # most probable family of each sample

    @property
    def bound(self) -> float:
        """Cramér-Rao bound of the root mean square direction error [deg]."""
        return rms(self.bound_degrees)

    @property
    def attainable(self) -> float:
        """Attainable bound of the root mean square direction error [deg]."""
        return rms(self.attainable_degrees)

    @property
    def ratio(self) -> float:
        """Ratio of the root mean square direction error to its Cramér-Rao bound."""
        return rms(self.degrees) / self.bound

    @property
    def attained(self) -> float:
        """Ratio of the root mean square direction error to its attainable bound."""
        return rms(self.degrees) / self.attainable

    @property
    def diverged(self) -> int:
        """Number of samples without an axis, or with a divergent one where the bound is small."""
        lost = ~np.isfinite(self.degrees)
        if self.attainable < NEAR:
            lost |= self.degrees > FAR_OFF * self.attainable_degrees
        return int(lost.sum())

    @property
    def by_chance(self) -> float:
        """Probability that errors at the attainable bound exceed the target ratio by chance."""
        excess = (MOST_OVER**2 - 1.0) / math.sqrt(self.spread)
        return 0.5 * math.erfc(excess / math.sqrt(2.0))


@dataclass(frozen=True)
class ErrorRatios:
    """Ratios of errors to a bound, in the cells with a small bound."""

    near: int  # number of these cells
    direction: float  # root mean square ratios of direction and position over all fits; NaN without cells
    place: float
    worst: float  # largest ratio of the direction in a cell
    over: int  # number of cells above the target ratio


@dataclass(frozen=True)
class GridSummary:
    """Summary of several cells."""

    cells: int  # numbers of cells and fits
    fits: int
    bound: ErrorRatios  # ratios of errors to the Cramér-Rao bound and to the attainable bound
    attainable: ErrorRatios
    over_by_chance: float  # expected number of cells above the target ratio at the attainable bound
    right: float  # share of right families in cells with a small Cramér-Rao bound; NaN without such cells
    right_attainable: float  # the same for cells with a small attainable bound
    told: float  # share of unambiguous results in the cells of ``right``
    told_wrong: int  # number of fits with an unambiguous and wrong family
    diverged: int  # number of divergent fits


def summarize_cells(results: Sequence[CellResult]) -> GridSummary:
    """Summarise several cells."""
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
    """Return the root mean square."""
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
