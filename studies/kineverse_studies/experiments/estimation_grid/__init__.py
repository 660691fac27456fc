"""``estimation-grid``: identified hinges and sliders over noise, number and range of observations.

Each fit is compared with the Cramér-Rao bound of its own sample, see :mod:`.cramer_rao`, and the most
probable family with the true one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from kineverse.errors import KineverseError
from kineverse.estimation import identify, pose_covariance
from kineverse.estimation.identification.result import Fit
from kineverse.lie import Array
from kineverse.view.plots import Figure
from kineverse_studies.experiments.execution import run_jobs
from kineverse_studies.experiments.registry import Options, Progress
from kineverse_studies.experiments.report import Cell as TableCell
from kineverse_studies.experiments.report import Report, ReportTable, format_yes, make_table

from .cramer_rao import (
    LEVER,
    TO_AXIS,
    Bound,
    Cell,
    Joint,
    JointSamples,
    compute_attainable_bound,
    compute_bound,
    draw_samples,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas

Flags = npt.NDArray[np.bool_]
NEAR, TELLING = 10.0, 5.0
"""Bounds [deg] below which errors are compared with the bound, and below which families must be correct."""
MOST_OVER, LEAST_RIGHT = 1.1, 0.99  # largest ratio of errors to a bound, and least share of right families
FAR_OFF = 6.0
"""Ratio of an error to the attainable bound that counts as divergence. The chance is one in a million."""


@dataclass(frozen=True, eq=False)
class CellResult:
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
    near: int  # number of these cells
    direction: float  # root mean square ratios of direction and position over all fits; NaN without cells
    place: float
    worst: float  # largest ratio of the direction in a cell
    over: int  # number of cells above the target ratio


@dataclass(frozen=True)
class GridSummary:
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


SEED = 2011
SAMPLES = 50
POSITIONS = (0.001, 0.03, 0.1)
ORIENTATIONS = tuple(math.radians(degrees) for degrees in (1.0, 3.0, 10.0))
COUNTS = (5, 10, 20, 40, 80, 160, 320)
RANGES: dict[Joint, tuple[float, ...]] = {
    "prismatic": (0.05, 0.2, 0.4),
    "revolute": tuple(math.radians(degrees) for degrees in (15.0, 45.0, 90.0)),
}


def make_grid() -> list[Cell]:
    return [
        Cell(joint, position, orientation, count, reach)
        for joint, ranges in RANGES.items()
        for position, orientation, count, reach in product(POSITIONS, ORIENTATIONS, COUNTS, ranges)
    ]


def make_quick_grid() -> list[Cell]:
    return [
        Cell(joint, position, orientation, count, reach)
        for joint, ranges in RANGES.items()
        for position, orientation in zip(POSITIONS, ORIENTATIONS, strict=True)
        for count, reach in product((10, 40), ranges[1:])
    ]


def fit_all(
    cells: Sequence[Cell], samples: int, progress: Progress, options: Options | None = None
) -> list[CellResult]:
    # Long cells first, so that all processes end at about the same time.
    order = sorted(range(len(cells)), key=lambda k: -cells[k].count)
    jobs = [(cells[k], samples) for k in order]
    found = run_jobs(_fit_one, jobs, progress, "estimation-grid", "cell", options)
    return [result for _, result in sorted(zip(order, found, strict=True), key=lambda pair: pair[0])]


def _fit_one(job: tuple[Cell, int]) -> list[CellResult]:
    return [fit_cell(*job)]


def fit_cell(cell: Cell, count: int) -> CellResult:
    samples = draw_samples(cell, count, np.random.default_rng(_seed(cell)))
    limit, reach = compute_bound(samples), compute_attainable_bound(samples)
    fits = [_fit(samples, k) for k in range(count)]
    return CellResult(
        cell=cell,
        degrees=np.array([_degrees(fit, samples.axis[k]) for k, (fit, _, _) in enumerate(fits)]),
        metres=np.array([_metres(fit, samples, k) for k, (fit, _, _) in enumerate(fits)]),
        bound_degrees=limit.degrees,
        bound_metres=limit.metres,
        attainable_degrees=reach.degrees,
        attainable_metres=reach.metres,
        spread=_spread(reach),
        right=np.array([called == cell.joint for _, called, _ in fits]),
        told=np.array([told for _, _, told in fits]),
        called=tuple(called for _, called, _ in fits),
    )


def _fit(samples: JointSamples, k: int) -> tuple[Fit | None, str, bool]:
    """Return the fit of the true family or None, the most probable family, and True if it is unambiguous."""
    cell = samples.cell
    covariance = pose_covariance(cell.position, cell.orientation)
    try:
        found = identify(
            samples.seen_parents[k],
            samples.seen_children[k],
            parent_covariance=covariance,
            child_covariance=covariance,
        )
        return found[cell.joint], found.best.family, not found.is_ambiguous
    except KineverseError as error:
        return None, f"refused: {error}", False


def _degrees(fit: Fit | None, axis: Array) -> float:
    """Return the angle between the true and the estimated axis [deg], regardless of sign."""
    if fit is None:
        return math.nan
    found = np.asarray(fit.parameters["axis"])
    return math.degrees(math.atan2(float(np.linalg.norm(np.cross(axis, found))), abs(float(axis @ found))))


def _metres(fit: Fit | None, samples: JointSamples, k: int) -> float:
    """Return the distance of the estimated axis from the true one, in the plane across it at mid-path [m]."""
    if fit is None or samples.cell.joint == "prismatic":
        return math.nan
    axis, point = samples.axis[k], samples.point[k]
    found, through = np.asarray(fit.parameters["axis"]), np.asarray(fit.parameters["point"])
    slope = float(axis @ found)
    if abs(slope) < 1e-9:
        return math.inf
    crossing = through + (float(axis @ (point - through)) / slope) * found
    return float(np.linalg.norm(crossing - point))


def _spread(limit: Bound) -> float:
    squares = np.trace(limit.direction @ limit.direction, axis1=1, axis2=2).sum()
    return float(2.0 * squares / np.trace(limit.direction, axis1=1, axis2=2).sum() ** 2)


def _seed(cell: Cell) -> list[int]:
    micro = (round(1e6 * value) for value in (cell.position, cell.orientation, cell.range))
    return [SEED, cell.joint == "revolute", cell.count, *micro]


FIGURE_SIZE = (13.0, 8.0)
COLORS = {"revolute": "tab:blue", "prismatic": "tab:orange"}
JOINT_NAMES = {"revolute": "hinge", "prismatic": "slider"}
TOP = 2.5  # largest ratio of the plots. Larger ones are drawn at the edge


def draw_grid(canvas: Canvas, results: Sequence[CellResult]) -> None:
    """Draw a point for each cell: ratios to both bounds, and the share of right families."""
    (bound, attained), (place, right) = canvas.subplots(2, 2)
    _plot_ratios(bound, results, [r.bound for r in results], [r.ratio for r in results])
    bound.set(title="direction, over the Cramér-Rao bound", xlabel="the bound [deg]")
    _plot_ratios(attained, results, [r.attainable for r in results], [r.attained for r in results])
    attained.set(title="direction, over what can be attained", xlabel="what can be attained [deg]")
    turning = [r for r in results if r.cell.joint == "revolute"]
    reach = [rms(r.attainable_metres) for r in turning]
    over = [rms(r.metres) / best for r, best in zip(turning, reach, strict=True)]
    _plot_ratios(place, turning, [r.attainable for r in turning], over)
    place.set(title="place of a hinge's axis, over what can be attained", xlabel="attainable direction [deg]")
    _scatter(right, results, [r.bound for r in results], [100.0 * float(r.right.mean()) for r in results])
    _plot_targets(right, TELLING, 100.0 * LEAST_RIGHT)
    right.set(title="the most probable type is right", ylabel="of the fits [%]", ylim=(-3.0, 103.0))
    right.set(xlabel="the Cramér-Rao bound of the direction [deg]", xscale="log")
    right.legend(loc="lower left")


def _plot_ratios(
    axes: Axes, results: Sequence[CellResult], across: Sequence[float], ratios: Sequence[float]
) -> None:
    _scatter(axes, results, across, [min(ratio, TOP) for ratio in ratios])
    axes.axhline(1.0, color="0.5", linewidth=1.0)
    _plot_targets(axes, NEAR, MOST_OVER)
    axes.set(ylabel="RMS / bound", ylim=(0.0, 1.02 * TOP), xscale="log")


def _plot_targets(axes: Axes, across: float, up: float) -> None:
    axes.axhline(up, color="tab:red", linewidth=1.0, linestyle="--")
    axes.axvline(across, color="tab:red", linewidth=1.0, linestyle="--")


def _scatter(axes: Axes, results: Sequence[CellResult], across: Sequence[float], up: Sequence[float]) -> None:
    for joint, color in COLORS.items():
        chosen = [k for k, r in enumerate(results) if r.cell.joint == joint]
        if chosen:
            xs, ys = [across[k] for k in chosen], [up[k] for k in chosen]
            axes.scatter(xs, ys, s=14.0, alpha=0.7, color=color, label=JOINT_NAMES[joint])


OPTIONS = ("quick", "count", "processes")
QUICK_SAMPLES = 10
WORST = 10


def run(progress: Progress, options: Options) -> Report:
    """Fit the grid; ``quick`` takes a few cells and fewer samples, ``count`` so many samples of each cell."""
    cells, samples = (make_quick_grid(), QUICK_SAMPLES) if options.quick else (make_grid(), SAMPLES)
    return report_grid(fit_all(cells, options.count or samples, progress, options))


def report_grid(results: Sequence[CellResult]) -> Report:
    total = summarize_cells(results)
    near = sorted((r for r in results if r.attainable < NEAR), key=lambda r: -r.attained)[:WORST]
    return Report(
        name="estimation-grid",
        title=f"Hinges and sliders from noisy poses: {total.fits} fits in {total.cells} cells",
        tables=(
            _target_table(total),
            _grouped_table(
                f"By noise of both poses; errors where what they are held against is below {NEAR:g} deg",
                results,
                {
                    "joint": lambda cell: cell.joint,
                    "noise [mm]": lambda cell: 1e3 * cell.position,
                    "noise [deg]": lambda cell: math.degrees(cell.orientation),
                },
            ),
            _grouped_table(
                "By range of the motion",
                results,
                {"joint": lambda cell: cell.joint, "range": format_joint_range},
            ),
            _grouped_table(
                "By number of observations",
                results,
                {"joint": lambda cell: cell.joint, "N": lambda cell: float(cell.count)},
            ),
            make_table(
                f"The cells farthest above what can be attained, where that is below {NEAR:g} deg",
                near,
                {
                    "joint": lambda r: r.cell.joint,
                    "noise [mm]": lambda r: 1e3 * r.cell.position,
                    "noise [deg]": lambda r: math.degrees(r.cell.orientation),
                    "N": lambda r: float(r.cell.count),
                    "range": lambda r: format_joint_range(r.cell),
                    "bound [deg]": lambda r: r.bound,
                    "attainable": lambda r: r.attainable,
                    "RMS [deg]": lambda r: rms(r.degrees),
                    "right": lambda r: float(r.right.mean()),
                },
            ),
        ),
        numbers={
            "seed": SEED,
            "geometry": {"parent_to_axis": TO_AXIS, "axis_to_child": LEVER},
            "bars": {"near_deg": NEAR, "telling_deg": TELLING, "ratio": MOST_OVER, "right": LEAST_RIGHT},
            "summary": total,
            "cells": [_numbers(result) for result in results],
        },
        figure=Figure(lambda canvas: draw_grid(canvas, results), FIGURE_SIZE),
    )


def _target_table(total: GridSummary) -> ReportTable:
    rows: list[tuple[TableCell, ...]] = []
    held = {"the Cramér-Rao bound": total.bound, "what can be attained": total.attainable}
    for what, ratios in held.items():
        for part, ratio in (("direction", ratios.direction), ("place", ratios.place)):
            name = f"RMS of the {part} over {what}, that below {NEAR:g} deg"
            rows.append((name, _dash(ratio), f"<= {MOST_OVER:g}", format_yes(ratio <= MOST_OVER)))
    chance, over = total.over_by_chance, total.attainable.over
    few = f"{chance:.1f} by chance", format_yes(over <= chance + 3.0 * math.sqrt(chance))
    rows.append((f"cells over {MOST_OVER:g} of what can be attained", float(over), *few))
    rows.append(("divergences", float(total.diverged), "0", format_yes(total.diverged == 0)))
    for what, share in zip(held, (total.right, total.right_attainable), strict=True):
        name = f"right type, {what} below {TELLING:g} deg"
        rows.append((name, _dash(share), f">= {LEAST_RIGHT:g}", format_yes(share >= LEAST_RIGHT)))
    name = f'told rather than "cannot tell", the bound below {TELLING:g} deg'
    rows.append((name, _dash(total.told), "-", "-"))
    rows.append(("told, and wrong, anywhere", float(total.told_wrong), "-", "-"))
    head = ("", "measured", "asked for", "holds")
    return ReportTable("What is asked for, and what came out", head, tuple(rows))


def _grouped_table(
    title: str, results: Sequence[CellResult], by: Mapping[str, Callable[[Cell], TableCell]]
) -> ReportTable:
    groups: dict[tuple[TableCell, ...], list[CellResult]] = {}
    for result in results:
        groups.setdefault(tuple(of(result.cell) for of in by.values()), []).append(result)
    columns: dict[str, Callable[[GridSummary], TableCell]] = {
        "fits": lambda part: float(part.fits),
        "RMS/bound": lambda part: _dash(part.bound.direction),
        "RMS/attainable": lambda part: _dash(part.attainable.direction),
        "place/attainable": lambda part: _dash(part.attainable.place),
        "right": lambda part: _dash(part.right),
        "told": lambda part: _dash(part.told),
        "diverged": lambda part: float(part.diverged),
    }
    summaries = make_table(title, map(summarize_cells, groups.values()), columns)
    rows = tuple((*key, *row) for key, row in zip(groups, summaries.rows, strict=True))
    return ReportTable(title, (*by, *summaries.head), rows)


def format_joint_range(cell: Cell) -> str:
    return f"{math.degrees(cell.range):.0f} deg" if cell.joint == "revolute" else f"{100 * cell.range:.0f} cm"


def _numbers(result: CellResult) -> dict[str, Any]:
    cell = result.cell
    return {
        "joint": cell.joint,
        "position_noise": cell.position,
        "orientation_noise_deg": math.degrees(cell.orientation),
        "count": cell.count,
        "range": cell.range,
        "samples": len(result.degrees),
        "bound_deg": result.bound,
        "attainable_deg": result.attainable,
        "rms_deg": rms(result.degrees),
        "bound_m": rms(result.bound_metres),
        "attainable_m": rms(result.attainable_metres),
        "rms_m": rms(result.metres),
        "above_by_chance": result.by_chance,
        "right": result.right.mean(),
        "told": result.told.mean(),
        "told_wrong": (result.told & ~result.right).sum(),
        "taken_for": {name: result.called.count(name) for name in sorted(set(result.called))},
        "diverged": result.diverged,
    }


def _dash(value: float) -> TableCell:
    return value if math.isfinite(value) else "-"
