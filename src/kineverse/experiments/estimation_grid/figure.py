"""The estimation grid as a picture: errors and types against what can be known."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from kineverse.experiments.estimation_grid.results import (
    LEAST_RIGHT,
    MOST_OVER,
    NEAR,
    TELLING,
    Result,
    rms,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas

SIZE = (13.0, 8.0)
COLORS = {"revolute": "tab:blue", "prismatic": "tab:orange"}
NAMES = {"revolute": "hinge", "prismatic": "slider"}
TOP = 2.5
"""Larger ratios are drawn at the edge."""


def draw_grid(canvas: Canvas, results: Sequence[Result]) -> None:
    """Draw a point for each cell: errors over both bounds, and how many types are right."""
    (bound, attained), (place, right) = canvas.subplots(2, 2)
    _ratios(bound, results, [r.bound for r in results], [r.ratio for r in results])
    bound.set(title="direction, over the Cramér-Rao bound", xlabel="the bound [deg]")
    _ratios(attained, results, [r.attainable for r in results], [r.attained for r in results])
    attained.set(title="direction, over what can be attained", xlabel="what can be attained [deg]")
    turning = [r for r in results if r.cell.joint == "revolute"]
    reach = [rms(r.attainable_metres) for r in turning]
    over = [rms(r.metres) / best for r, best in zip(turning, reach, strict=True)]
    _ratios(place, turning, [r.attainable for r in turning], over)
    place.set(title="place of a hinge's axis, over what can be attained", xlabel="attainable direction [deg]")
    _scatter(right, results, [r.bound for r in results], [100.0 * float(r.right.mean()) for r in results])
    _bars(right, TELLING, 100.0 * LEAST_RIGHT)
    right.set(title="the most probable type is right", ylabel="of the fits [%]", ylim=(-3.0, 103.0))
    right.set(xlabel="the Cramér-Rao bound of the direction [deg]", xscale="log")
    right.legend(loc="lower left")


def _ratios(axes: Axes, results: Sequence[Result], across: Sequence[float], ratios: Sequence[float]) -> None:
    _scatter(axes, results, across, [min(ratio, TOP) for ratio in ratios])
    axes.axhline(1.0, color="0.5", linewidth=1.0)
    _bars(axes, NEAR, MOST_OVER)
    axes.set(ylabel="RMS / bound", ylim=(0.0, 1.02 * TOP), xscale="log")


def _bars(axes: Axes, across: float, up: float) -> None:
    axes.axhline(up, color="tab:red", linewidth=1.0, linestyle="--")
    axes.axvline(across, color="tab:red", linewidth=1.0, linestyle="--")


def _scatter(axes: Axes, results: Sequence[Result], across: Sequence[float], up: Sequence[float]) -> None:
    for joint, color in COLORS.items():
        chosen = [k for k, r in enumerate(results) if r.cell.joint == joint]
        if chosen:
            xs, ys = [across[k] for k in chosen], [up[k] for k in chosen]
            axes.scatter(xs, ys, s=14.0, alpha=0.7, color=color, label=NAMES[joint])
