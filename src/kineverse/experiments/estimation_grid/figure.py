"""The estimation grid as a picture: errors and types against the bound."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from kineverse.experiments.estimation_grid.results import LEAST_RIGHT, MOST_OVER, NEAR, TELLING, Result

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

SIZE = (13.0, 8.0)
COLORS = {"revolute": "tab:blue", "prismatic": "tab:orange"}
NAMES = {"revolute": "hinge", "prismatic": "slider"}


def draw_grid(canvas: Canvas, results: Sequence[Result]) -> None:
    """Draw a point for each cell: errors over bounds, and how many types are right, against the bound."""
    (error, place), (ratio, right) = canvas.subplots(2, 2)
    for joint, color in COLORS.items():
        chosen = [r for r in results if r.cell.joint == joint]
        bounds = [r.bound for r in chosen]
        style = {"color": color, "s": 14, "alpha": 0.7, "label": NAMES[joint]}
        error.scatter(bounds, [_rms(r.degrees) for r in chosen], **style)
        ratio.scatter(bounds, [r.ratio for r in chosen], **style)
        right.scatter(bounds, [100.0 * float(r.right.mean()) for r in chosen], **style)
        if joint == "revolute":
            limits = [1e3 * _rms(r.bound_metres) for r in chosen]
            place.scatter(limits, [1e3 * _rms(r.metres) for r in chosen], **style)
            place.plot([min(limits), max(limits)], [min(limits), max(limits)], color="0.5", linewidth=1)
    ends = [min(r.bound for r in results), max(r.bound for r in results)]
    error.plot(ends, ends, color="0.5", linewidth=1, label="the bound")
    ratio.axhline(1.0, color="0.5", linewidth=1)
    ratio.axhline(MOST_OVER, color="tab:red", linewidth=1, linestyle="--")
    ratio.axvline(NEAR, color="tab:red", linewidth=1, linestyle="--")
    right.axhline(100.0 * LEAST_RIGHT, color="tab:red", linewidth=1, linestyle="--")
    right.axvline(TELLING, color="tab:red", linewidth=1, linestyle="--")
    for axes in (error, ratio, right):
        axes.set(xlabel="bound of the direction of the axis [deg]", xscale="log")
    error.set(title="direction of the axis", ylabel="RMS [deg]", yscale="log")
    ratio.set(title="direction of the axis over its bound", ylabel="RMS / bound", ylim=(0.0, 2.0))
    right.set(title="most probable type is right", ylabel="of the fits [%]", ylim=(-3.0, 103.0))
    place.set(
        title="place of a hinge's axis", xlabel="bound [mm]", ylabel="RMS [mm]", xscale="log", yscale="log"
    )
    error.legend()
    right.legend(loc="lower left")


def _rms(values: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> float:
    return float(np.sqrt(np.mean(values**2)))
