"""Pictures by matplotlib, and plots of identified joints: observations, fitted motion and uncertainty.

Two views without perspective, in the parent's units: across the axis and along it. Drawn with matplotlib, on
canvases and axes that the caller makes.
"""

from __future__ import annotations

import importlib
import io
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from kineverse._extras import install_command
from kineverse.errors import FormatError, MissingDependencyError
from kineverse.formats.files import replace_file
from kineverse.lie import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas

    from kineverse.estimation.identification.result import Fit

SIZE = (13.0, 5.2)  # size of the picture of one joint [inch]

SEEN, MODEL, AXIS = "0.35", "tab:blue", "tab:red"
AXIAL_FAMILIES = ("revolute", "screw", "cylindrical")  # families whose axis has a position
SIGMAS = 2.0  # half width of drawn uncertainties, in standard deviations


@dataclass(frozen=True)
class Figure:
    """Picture that is drawn on demand."""

    draw: Callable[[Canvas], None]  # function that draws on an empty matplotlib figure
    size: tuple[float, float]  # width and height [inch]

    def save(self, path: str | Path) -> None:
        """Write the picture to a file, in the format of its suffix."""
        # Not with pyplot, which would search for a display and keep a reference to the figure.
        try:
            figure = importlib.import_module("matplotlib.figure")
        except ImportError:
            raise MissingDependencyError(f"Figures need matplotlib: {install_command('figures')}") from None
        canvas = figure.Figure(figsize=self.size, layout="constrained")
        self.draw(canvas)
        content = io.BytesIO()
        try:
            canvas.savefig(content, format=Path(path).suffix.removeprefix(".") or "png", dpi=150)
        except ValueError as error:
            raise FormatError(f"The figure cannot be written to '{path}': {error}") from None
        replace_file(Path(path), content.getvalue())


@dataclass(frozen=True, eq=False)
class FitProjection:
    """Fit in a picture's axes: u to the right, v upwards, w towards the viewer; w is the joint's axis."""

    fit: Fit
    origin: Array  # origin in the parent, (3,), and u, v, w as columns, (3, 3)
    axes: Array
    observed: Array  # (N, 3), (M, 3)
    fitted: Array
    path: Array

    @staticmethod
    def from_fit(fit: Fit, relative: Array) -> FitProjection:
        """Project a fit and its observations: poses (N, 4, 4) or positions (N, 3) of the child."""
        observed = relative[:, :3, 3] if relative.ndim == 3 else relative
        fitted = fit.motion.linearise(fit.joint_values).pose[:, :3, 3]
        path = fitted
        if fit.joint_values.shape[1] == 1:
            low, high = fit.range[0]
            path = fit.motion.linearise(np.linspace(low, high, 200)[:, None]).pose[:, :3, 3]
        origin, axes = _frame(fit, fitted)
        projected = ((points - origin) @ axes for points in (observed, fitted, path))
        return FitProjection(fit, origin, axes, *projected)

    @property
    def has_axis(self) -> bool:
        """True if the joint has an axis of rotation."""
        return self.fit.family in AXIAL_FAMILIES

    def axis_covariances(self, heights: Array) -> Array:
        """Return the (M, 2, 2) covariances of the axis in u and v, at heights above the origin."""
        frame = self.fit.frame
        heights = heights + (self.origin - frame[:3, 3]) @ frame[:3, 2]
        into = (self.axes.T @ frame[:3, :3])[:2, :2]
        return into @ axis_covariances(self.fit, heights) @ into.T


def axis_covariances(fit: Fit, heights: Array) -> Array:
    """Return the (M, 2, 2) covariances of the position of an axis at heights above its point [m].

    They are those of the crossing with planes across the axis, in the first two columns of ``fit.frame``. The
    axis of a prismatic joint has no position; its direction is taken to vary about its point.
    """
    names = [*(("point.x", "point.y") if fit.family in AXIAL_FAMILIES else ()), "axis.x", "axis.y"]
    index = [fit.coordinates.index(name) for name in names]
    by_names = np.zeros((len(heights), 2, 4))
    by_names[:, 0, 0] = by_names[:, 1, 1] = 1.0
    # A rotation about y moves points above the origin along x, one about x moves them against y.
    by_names[:, 0, 3], by_names[:, 1, 2] = heights, -heights
    by_names = by_names[:, :, -len(index) :]
    covariances: Array = by_names @ fit.covariance[np.ix_(index, index)] @ np.swapaxes(by_names, 1, 2)
    return covariances


def draw_fit(canvas: Canvas, fit: Fit, relative: Array, title: str) -> None:
    """Draw observations and a fit: along the axis, from its side, and over the observations."""
    projection = FitProjection.from_fit(fit, relative)
    parts = canvas.subplot_mosaic(
        [["along", "side", "values"], ["along", "side", "left"]], width_ratios=[3, 3, 2]
    )
    draw_axial_view(parts["along"], projection)
    draw_side_view(parts["side"], projection)
    for part, points in _list_parts(projection):
        x, y = points[list(fit.outliers)].T
        parts[part].scatter(x, y, s=60, facecolors="none", edgecolors=AXIS, zorder=4)
    draw_joint_values(parts["values"], fit)
    draw_residuals(parts["left"], fit)
    canvas.suptitle(title)


def draw_axial_view(axes: Axes, projection: FitProjection) -> None:
    """Draw observed positions along the axis, with the axis and the uncertainty of its position."""
    if projection.fit.family == "prismatic":
        off = 1e3 * (projection.observed - projection.fitted)[:, :2]
        _scatter(axes, off)
        axes.plot(0.0, 0.0, "+", color=AXIS, markersize=12, zorder=3)
        axes.set(title="along the axis: off the fitted line", xlabel="[mm]", ylabel="[mm]", aspect="equal")
        return
    _points(axes, projection, 0, 1)
    if projection.has_axis:
        ring = np.linspace(0.0, 2.0 * np.pi, 90)
        root = np.linalg.cholesky(projection.axis_covariances(np.zeros(1))[0] + 1e-18 * np.eye(2))
        axes.fill(*(SIGMAS * root @ np.array([np.cos(ring), np.sin(ring)])), color=AXIS, alpha=0.25)
        axes.plot(0.0, 0.0, "+", color=AXIS, markersize=12, label=f"axis, ±{SIGMAS:g} σ", zorder=3)
    title = "along the axis" if projection.has_axis else "across"
    axes.set(title=title, xlabel="[m]", ylabel="[m]", aspect="equal")
    axes.legend(loc="best", fontsize="small")


def draw_side_view(axes: Axes, projection: FitProjection) -> None:
    """Draw observed positions from the side, with the axis and the uncertainty of its direction."""
    if projection.fit.family == "prismatic":
        points = projection.observed[:, [2, 0]]
        _scatter(axes, points)
        axes.plot(projection.path[:, 2], projection.path[:, 0], color=MODEL, label="fitted")
        axes.set(title="from the side", xlabel="along the axis [m]", ylabel="across [m]")
        axes.set_aspect("equal", adjustable="datalim")
        axes.legend(loc="best", fontsize="small")
        return
    _points(axes, projection, 0, 2)
    if projection.has_axis:
        along, across = projection.observed[:, 2], projection.observed[:, :2]
        reach = max(0.1, float(np.ptp(along)), float(np.abs(across).max()) / 2.0)
        heights = np.linspace(-reach, reach, 60)
        spread = SIGMAS * np.sqrt(projection.axis_covariances(heights)[:, 0, 0])
        axes.fill_betweenx(heights, -spread, spread, color=AXIS, alpha=0.25, linewidth=0)
        axes.plot(np.zeros(2), [-reach, reach], color=AXIS, linestyle="-.", linewidth=1)
    axes.set(
        title="from the side", xlabel="[m]", ylabel="along the axis [m]" if projection.has_axis else "[m]"
    )
    axes.set_aspect("equal", adjustable="datalim")


def draw_joint_values(axes: Axes, fit: Fit) -> None:
    """Draw joint values over the inliers, with their standard deviations."""
    number = fit.inliers
    # A custom family does not declare which of its joint values are angles.
    freedom = getattr(fit.motion, "parametrisation", None)
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
    """Draw the residuals of the inliers, and a line for each outlier."""
    number = fit.inliers
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


def _list_parts(projection: FitProjection) -> list[tuple[str, Array]]:
    """Return the positions of the observations in both views, (N, 2) each."""
    if projection.fit.family == "prismatic":
        return [
            ("along", 1e3 * (projection.observed - projection.fitted)[:, :2]),
            ("side", projection.observed[:, [2, 0]]),
        ]
    return [("along", projection.observed[:, [0, 1]]), ("side", projection.observed[:, [0, 2]])]


def _points(axes: Axes, projection: FitProjection, right: int, up: int) -> None:
    _scatter(axes, projection.observed[:, [right, up]])
    if projection.fit.joint_values.shape[1] == 1:
        axes.plot(projection.path[:, right], projection.path[:, up], color=MODEL, label="fitted", zorder=1)
    else:
        fitted = projection.fitted
        axes.scatter(fitted[:, right], fitted[:, up], s=8, marker="x", color=MODEL, label="fitted")


def _scatter(axes: Axes, points: Array) -> None:
    order, label = np.arange(len(points)), "seen, first to last"
    axes.scatter(points[:, 0], points[:, 1], s=8, c=order, cmap="viridis", label=label, zorder=2)


def _frame(fit: Fit, fitted: Array) -> tuple[Array, Array]:
    """Return origin and axes of a picture."""
    middle = fitted.mean(axis=0)
    if fit.family not in (*AXIAL_FAMILIES, "prismatic"):
        return middle, _directions(fitted - middle)
    axis = fit.frame[:3, 2]
    origin = fit.frame[:3, 3] if fit.family in AXIAL_FAMILIES else middle
    # At the height of the child's path, so that axis and path are near to each other.
    origin = origin + ((middle - origin) @ axis) * axis
    aside = middle - origin
    if fit.family == "prismatic" or np.linalg.norm(aside) < 1e-9:
        aside = fit.frame[:3, 0]
    aside = aside / np.linalg.norm(aside)
    return origin, np.column_stack([aside, np.cross(axis, aside), axis])


def _directions(offsets: Array) -> Array:
    """Return the principal directions of points, the widest first, as columns of a rotation."""
    _, _, rows = np.linalg.svd(offsets, full_matrices=True)
    axes: Array = rows.T.copy()
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    return axes
