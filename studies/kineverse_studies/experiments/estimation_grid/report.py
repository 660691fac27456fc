"""Report of the estimation grid: tables, numbers and figure."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, TypeVar

from kineverse.view.plots import Figure
from kineverse_studies.experiments.registry import Options, Progress
from kineverse_studies.experiments.report import Report, ReportTable

from .fits import (
    SAMPLES,
    SEED,
    fit_all,
    make_grid,
    make_quick_grid,
)
from .results import (
    LEAST_RIGHT,
    MOST_OVER,
    NEAR,
    TELLING,
    CellResult,
    ErrorRatios,
    GridSummary,
    rms,
    summarize_cells,
)
from .samples import LEVER, TO_AXIS, Cell

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas

FIGURE_SIZE = (13.0, 8.0)
COLORS = {"revolute": "tab:blue", "prismatic": "tab:orange"}
JOINT_NAMES = {"revolute": "hinge", "prismatic": "slider"}
TOP = 2.5
"""Largest ratio of the plots. Larger ones are drawn at the edge."""


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

Key = TypeVar("Key", bound=Hashable)
Cells = tuple[float | str, ...]


def run(progress: Progress, options: Options) -> Report:
    """Fit the grid; ``quick`` takes a few cells and fewer samples, ``count`` so many samples of each cell."""
    cells, samples = (make_quick_grid(), QUICK_SAMPLES) if options.quick else (make_grid(), SAMPLES)
    return report_grid(fit_all(cells, options.count or samples, progress, options.processes))


def report_grid(results: Sequence[CellResult]) -> Report:
    """Return the report on the results."""
    total = summarize_cells(results)
    return Report(
        name="estimation-grid",
        title=f"Hinges and sliders from noisy poses: {total.fits} fits in {total.cells} cells",
        tables=(
            _target_rows(total),
            _by_noise(results),
            _by_range(results),
            _by_count(results),
            _worst(results),
        ),
        numbers={
            "seed": SEED,
            "geometry": {"parent_to_axis": TO_AXIS, "axis_to_child": LEVER},
            "bars": {"near_deg": NEAR, "telling_deg": TELLING, "ratio": MOST_OVER, "right": LEAST_RIGHT},
            "summary": _to_json(asdict(total)),
            "cells": [_numbers(result) for result in results],
        },
        figure=Figure(lambda canvas: draw_grid(canvas, results), FIGURE_SIZE),
    )


def _target_rows(total: GridSummary) -> ReportTable:
    by_chance = total.over_by_chance
    chance = f"{by_chance:.1f} by chance"
    return ReportTable(
        "What is asked for, and what came out",
        ("", "measured", "asked for", "holds"),
        (
            *_error_rows("the Cramér-Rao bound", total.bound),
            *_error_rows("what can be attained", total.attainable),
            (
                f"cells over {MOST_OVER:g} of what can be attained",
                float(total.attainable.over),
                chance,
                _format_met(total.attainable.over <= by_chance + 3.0 * math.sqrt(by_chance)),
            ),
            ("divergences", float(total.diverged), "0", _format_met(total.diverged == 0)),
            _correct_rows("right type, the Cramér-Rao bound", total.right),
            _correct_rows("right type, what can be attained", total.right_attainable),
            (f'told rather than "cannot tell", the bound below {TELLING:g} deg', _dash(total.told), "-", "-"),
            ("told, and wrong, anywhere", float(total.told_wrong), "-", "-"),
        ),
    )


def _error_rows(what: str, ratios: ErrorRatios) -> tuple[Cells, ...]:
    """Return the rows on ratios of errors to a bound."""
    asked = f"<= {MOST_OVER:g}"
    return tuple(
        (
            f"RMS of the {part} over {what}, that below {NEAR:g} deg",
            _dash(ratio),
            asked,
            _format_met(ratio <= MOST_OVER),
        )
        for part, ratio in (("direction", ratios.direction), ("place", ratios.place))
    )


def _correct_rows(what: str, part: float) -> Cells:
    return (
        f"{what} below {TELLING:g} deg",
        _dash(part),
        f">= {LEAST_RIGHT:g}",
        _format_met(part >= LEAST_RIGHT),
    )


_HEAD = ("fits", "RMS/bound", "RMS/attainable", "place/attainable", "right", "told", "diverged")


def _by_noise(results: Sequence[CellResult]) -> ReportTable:
    return ReportTable(
        f"By noise of both poses; errors where what they are held against is below {NEAR:g} deg",
        ("joint", "noise [mm]", "noise [deg]", *_HEAD),
        tuple(
            (joint, 1e3 * position, math.degrees(orientation), *_cells(chosen))
            for (joint, position, orientation), chosen in _group_results(
                results, lambda cell: (cell.joint, cell.position, cell.orientation)
            )
        ),
    )


def _by_range(results: Sequence[CellResult]) -> ReportTable:
    groups = _group_results(results, lambda cell: (cell.joint, cell.range))
    rows = tuple(
        (joint, format_joint_range(joint, reach), *_cells(chosen)) for (joint, reach), chosen in groups
    )
    return ReportTable("By range of the motion", ("joint", "range", *_HEAD), rows)


def _by_count(results: Sequence[CellResult]) -> ReportTable:
    groups = _group_results(results, lambda cell: (cell.joint, cell.count))
    rows = tuple((joint, float(count), *_cells(chosen)) for (joint, count), chosen in groups)
    return ReportTable("By number of observations", ("joint", "N", *_HEAD), rows)


def _cells(results: Sequence[CellResult]) -> Cells:
    part = summarize_cells(results)
    numbers = (
        part.bound.direction,
        part.attainable.direction,
        part.attainable.place,
        part.right,
        part.told,
    )
    return (float(part.fits), *map(_dash, numbers), float(part.diverged))


def _worst(results: Sequence[CellResult]) -> ReportTable:
    near = sorted((r for r in results if r.attainable < NEAR), key=lambda r: -r.attained)[:WORST]
    return ReportTable(
        f"The cells farthest above what can be attained, where that is below {NEAR:g} deg",
        (
            "joint",
            "noise [mm]",
            "noise [deg]",
            "N",
            "range",
            "bound [deg]",
            "attainable",
            "RMS [deg]",
            "right",
        ),
        tuple(
            (
                r.cell.joint,
                1e3 * r.cell.position,
                math.degrees(r.cell.orientation),
                float(r.cell.count),
                format_joint_range(r.cell.joint, r.cell.range),
                r.bound,
                r.attainable,
                rms(r.degrees),
                float(r.right.mean()),
            )
            for r in near
        ),
    )


def format_joint_range(joint: str, reach: float) -> str:
    """Format the range of a joint."""
    return f"{math.degrees(reach):.0f} deg" if joint == "revolute" else f"{100 * reach:.0f} cm"


def _group_results(
    results: Iterable[CellResult], key: Callable[[Cell], Key]
) -> Iterable[tuple[Key, list[CellResult]]]:
    groups: dict[Key, list[CellResult]] = {}
    for result in results:
        groups.setdefault(key(result.cell), []).append(result)
    return groups.items()


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
        "rms_deg": _to_json(rms(result.degrees)),
        "bound_m": _to_json(rms(result.bound_metres)),
        "attainable_m": _to_json(rms(result.attainable_metres)),
        "rms_m": _to_json(rms(result.metres)),
        "above_by_chance": result.by_chance,
        "right": float(result.right.mean()),
        "told": float(result.told.mean()),
        "told_wrong": int((result.told & ~result.right).sum()),
        "taken_for": {name: result.called.count(name) for name in sorted(set(result.called))},
        "diverged": result.diverged,
    }


def _to_json(value: Any) -> Any:
    """Convert a value for JSON, with null for numbers that are not finite."""
    if isinstance(value, dict):
        return {name: _to_json(inner) for name, inner in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _dash(value: float) -> float | str:
    return value if math.isfinite(value) else "-"


def _format_met(does: bool) -> str:
    return "yes" if does else "no"
