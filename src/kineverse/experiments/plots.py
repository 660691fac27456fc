"""Plots of identified joints: observations, fitted motion and uncertainty.

Two views without perspective, in the parent's units: across the axis and along it. Drawn with matplotlib, on
canvases and axes that the caller makes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from kineverse.lie import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas

    from kineverse.estimation.identification.result import Fit


SIZE = (13.0, 5.2)
"""Of a picture of one joint [inch]."""

SEEN, MODEL, AXIS = "0.35", "tab:blue", "tab:red"
TURNING = ("revolute", "screw", "cylindrical")
SIGMAS = 2.0
"""How many standard deviations are drawn."""


@dataclass(frozen=True, eq=False)
class FitProjection:
    """A fit in the axes of a picture: u to the right, v upwards, w towards the viewer; w is the joint's axis.

    Attributes
    ----------
    fit
        What is drawn.
    origin, axes
        The origin in the parent, (3,), and u, v, w as columns, (3, 3).
    seen, fitted, way
        Positions of the child in these axes: as seen and as fitted (N, 3), and evenly along the joint (M, 3).
    """

    fit: Fit
    origin: Array
    axes: Array
    seen: Array
    fitted: Array
    way: Array

    @staticmethod
    def at(fit: Fit, relative: Array) -> FitProjection:
        """Return a fit with the poses (N, 4, 4) or positions (N, 3) of the child that it was made of."""
        seen = relative[:, :3, 3] if relative.ndim == 3 else relative
        fitted = fit.motion.at(fit.joint_values).pose[:, :3, 3]
        way = fitted
        if fit.joint_values.shape[1] == 1:
            low, high = fit.range[0]
            way = fit.motion.at(np.linspace(low, high, 200)[:, None]).pose[:, :3, 3]
        origin, axes = _frame(fit, fitted)
        return FitProjection(fit, origin, axes, *((points - origin) @ axes for points in (seen, fitted, way)))

    @property
    def turns(self) -> bool:
        """Whether there is an axis to turn about."""
        return self.fit.family in TURNING

    def shifts(self, heights: Array) -> Array:
        """Return covariances of the place of the axis at heights above the origin, in u and v: (M, 2, 2)."""
        fit = self.fit
        heights = heights + (self.origin - fit.frame[:3, 3]) @ fit.frame[:3, 2]
        names = ("point.x", "point.y", "axis.x", "axis.y")
        if not all(name in fit.coordinates for name in names):
            return np.zeros((len(heights), 2, 2))
        chosen = [fit.coordinates.index(name) for name in names]
        # A turn about y moves what is above the point along x, one about x against y.
        by_chosen = np.zeros((len(heights), 2, 4))
        by_chosen[:, 0, 0] = by_chosen[:, 1, 1] = 1.0
        by_chosen[:, 0, 3], by_chosen[:, 1, 2] = heights, -heights
        into = (self.axes.T @ fit.frame[:3, :3])[:2, :2] @ by_chosen
        return into @ fit.covariance[np.ix_(chosen, chosen)] @ np.swapaxes(into, 1, 2)


def draw_fit(canvas: Canvas, fit: Fit, relative: Array, title: str) -> None:
    """Draw what was seen and a fit: along the axis, from its side, and over the observations.

    Parameters
    ----------
    canvas
        An empty figure.
    fit
        Of :func:`kineverse.estimation.identify`.
    relative
        What it was made of: poses (N, 4, 4) or positions (N, 3) of the child in the parent [m].
    title
        Above the picture. What is outlying is ringed.
    """
    looked = FitProjection.at(fit, relative)
    parts = canvas.subplot_mosaic(
        [["along", "side", "values"], ["along", "side", "left"]], width_ratios=[3, 3, 2]
    )
    draw_axial_view(parts["along"], looked)
    draw_side_view(parts["side"], looked)
    for part, points in _list_parts(looked):
        _circle_outliers(parts[part], points[list(fit.outliers)])
    draw_joint_values(parts["values"], fit)
    draw_residuals(parts["left"], fit)
    canvas.suptitle(title)


def draw_axial_view(axes: Axes, looked: FitProjection) -> None:
    """Draw positions as seen along the axis, with the place of the axis and how sure that is."""
    if looked.fit.family == "prismatic":
        off = 1e3 * (looked.seen - looked.fitted)[:, :2]
        _scatter(axes, off, "seen, first to last")
        axes.plot(0.0, 0.0, "+", color=AXIS, markersize=12, zorder=3)
        axes.set(title="along the axis: off the fitted line", xlabel="[mm]", ylabel="[mm]", aspect="equal")
        return
    _points(axes, looked, 0, 1)
    if looked.turns:
        ring = np.linspace(0.0, 2.0 * np.pi, 90)
        root = np.linalg.cholesky(looked.shifts(np.zeros(1))[0] + 1e-18 * np.eye(2))
        axes.fill(*(SIGMAS * root @ np.array([np.cos(ring), np.sin(ring)])), color=AXIS, alpha=0.25)
        axes.plot(0.0, 0.0, "+", color=AXIS, markersize=12, label=f"axis, ±{SIGMAS:g} σ", zorder=3)
    axes.set(title="along the axis" if looked.turns else "across", xlabel="[m]", ylabel="[m]", aspect="equal")
    axes.legend(loc="best", fontsize="small")


def draw_side_view(axes: Axes, looked: FitProjection) -> None:
    """Draw positions as seen from the side, with the axis and how sure its direction is."""
    if looked.fit.family == "prismatic":
        points = looked.seen[:, [2, 0]]
        _scatter(axes, points, "seen, first to last")
        axes.plot(looked.way[:, 2], looked.way[:, 0], color=MODEL, label="fitted")
        axes.set(title="from the side", xlabel="along the axis [m]", ylabel="across [m]")
        axes.set_aspect("equal", adjustable="datalim")
        axes.legend(loc="best", fontsize="small")
        return
    _points(axes, looked, 0, 2)
    if looked.turns:
        reach = max(0.1, float(np.ptp(looked.seen[:, 2])), float(np.abs(looked.seen[:, :2]).max()) / 2.0)
        heights = np.linspace(-reach, reach, 60)
        spread = SIGMAS * np.sqrt(looked.shifts(heights)[:, 0, 0])
        axes.fill_betweenx(heights, -spread, spread, color=AXIS, alpha=0.25, linewidth=0)
        axes.plot(np.zeros(2), [-reach, reach], color=AXIS, linestyle="-.", linewidth=1)
    axes.set(title="from the side", xlabel="[m]", ylabel="along the axis [m]" if looked.turns else "[m]")
    axes.set_aspect("equal", adjustable="datalim")


def draw_joint_values(axes: Axes, fit: Fit) -> None:
    """Draw joint values over the observations that are right, with their standard deviations."""
    number = fit.right
    # A family of one's own does not say which of its joint values are angles.
    freedom = getattr(fit.motion, "freedom", None)
    turning = [j >= 3 for j in freedom.joints] if freedom else [False] * fit.joint_values.shape[1]
    units = {"[deg]" if turns else "[m]" for turns in turning} if freedom else {"its own units"}
    for k, turns in enumerate(turning):
        scale = np.degrees(1.0) if turns else 1.0
        value, spread = scale * fit.joint_values[number, k], scale * SIGMAS * fit.deviations[number, k]
        axes.fill_between(number, value - spread, value + spread, alpha=0.25, linewidth=0)
        axes.plot(number, value, ".-", markersize=3, linewidth=0.8)
    axes.set(title=f"joint values, ±{SIGMAS:g} σ", ylabel=", ".join(sorted(units)))
    axes.tick_params(labelbottom=False)


def draw_residuals(axes: Axes, fit: Fit) -> None:
    """Draw what the fit leaves of each observation, and a line for those that do not fit."""
    number = fit.right
    residuals = fit.residuals[number]
    for outlier in fit.outliers:
        axes.axvline(outlier, color=AXIS, linewidth=0.8, linestyle=":")
    axes.plot(number, 1e3 * np.linalg.norm(residuals[:, :3], axis=1), color=MODEL, linewidth=0.8)
    axes.set(xlabel="observation", title="left over")
    axes.set_ylabel("position [mm]", color=MODEL)
    axes.set_ylim(bottom=0.0)
    if fit.residuals.shape[1] > 3:
        other = axes.twinx()
        angles = np.degrees(np.linalg.norm(residuals[:, 3:], axis=1))
        other.plot(number, angles, color="tab:orange", linewidth=0.8)
        other.set_ylabel("orientation [deg]", color="tab:orange")
        other.set_ylim(bottom=0.0)


def _list_parts(looked: FitProjection) -> list[tuple[str, Array]]:
    """Return where observations are in both views, (N, 2) each."""
    if looked.fit.family == "prismatic":
        return [("along", 1e3 * (looked.seen - looked.fitted)[:, :2]), ("side", looked.seen[:, [2, 0]])]
    return [("along", looked.seen[:, [0, 1]]), ("side", looked.seen[:, [0, 2]])]


def _circle_outliers(axes: Axes, points: Array) -> None:
    """Mark what does not fit."""
    axes.scatter(points[:, 0], points[:, 1], s=60, facecolors="none", edgecolors=AXIS, zorder=4)


def _points(axes: Axes, looked: FitProjection, right: int, up: int) -> None:
    seen = looked.seen[:, [right, up]]
    _scatter(axes, seen, "seen, first to last")
    if looked.fit.joint_values.shape[1] == 1:
        axes.plot(looked.way[:, right], looked.way[:, up], color=MODEL, label="fitted", zorder=1)
    else:
        axes.scatter(
            looked.fitted[:, right], looked.fitted[:, up], s=8, marker="x", color=MODEL, label="fitted"
        )


def _scatter(axes: Axes, points: Array, label: str) -> None:
    axes.scatter(
        points[:, 0], points[:, 1], s=8, c=np.arange(len(points)), cmap="viridis", label=label, zorder=2
    )


def _frame(fit: Fit, fitted: Array) -> tuple[Array, Array]:
    """Return origin and axes of a picture."""
    middle = fitted.mean(axis=0)
    if fit.family not in (*TURNING, "prismatic"):
        return middle, _directions(fitted - middle)
    axis = fit.frame[:3, 2]
    origin = fit.frame[:3, 3] if fit.family in TURNING else middle
    # At the height of the child's way, so that what is drawn is near to each other.
    origin = origin + ((middle - origin) @ axis) * axis
    aside = middle - origin
    if fit.family == "prismatic" or np.linalg.norm(aside) < 1e-9:
        aside = fit.frame[:3, 0]
    aside = aside / np.linalg.norm(aside)
    return origin, np.column_stack([aside, np.cross(axis, aside), axis])


def _directions(offsets: Array) -> Array:
    """Return the directions in which points spread, the widest first, as columns of a rotation."""
    _, _, rows = np.linalg.svd(offsets, full_matrices=True)
    axes: Array = rows.T.copy()
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    return axes
