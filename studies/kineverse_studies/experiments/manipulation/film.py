"""Pictures of trials: films of a robot at an object, and vectors of a push."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from kineverse.lie import Array
from kineverse.model.frame import WORLD
from kineverse.model.model import Model
from kineverse.view.drawables import Drawable, Rgba, build_spheres, collect_drawables
from kineverse.view.pictures import picture
from kineverse.view.plots import Figure
from kineverse.view.poses import FramePoses, complete
from kineverse.view.proximity import build_arrow
from kineverse.view.rendering.camera import Camera, fit_camera
from kineverse.view.rendering.rasterizer import Projection, TriangleSoup, rasterize

from .trials import Moment

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

_DIRECTIONS, _ELEVATIONS = 16, (0.3, 0.55)
_TRIAL_HEIGHT = 60
_NEAREST = 0.035  # distance within which a push has nearest points [m]


@dataclass(frozen=True, eq=False)
class FilmRow:
    title: str
    load: Callable[[], Model]  # function that returns the model; it is called when the row is drawn
    states: Sequence[Mapping[str, float]]  # values by name, one mapping for each picture
    labels: Sequence[str]  # texts of the pictures
    shown: tuple[str, ...]  # beginnings of the names of the bodies that have to be seen


def make_film(rows: Sequence[FilmRow], size: tuple[int, int] = (420, 420)) -> Figure:
    count = max(len(row.states) for row in rows)
    scale = 3.0 / size[0]

    def draw(canvas: Canvas) -> None:
        panels = canvas.subplots(len(rows), count, squeeze=False)
        models = [row.load() for row in rows]
        views = [RowView.of(m, row.states, row.shown) for m, row in zip(models, rows, strict=True)]
        cameras = choose_cameras(views, size[0] / size[1])
        for row, model, camera, axes in zip(rows, models, cameras, panels, strict=True):
            for panel in axes:
                panel.set_axis_off()
            for panel, values, label in zip(axes, row.states, row.labels, strict=False):
                panel.imshow(picture(model, values, size, camera))
                panel.set_title(label, fontsize="small")
            axes[0].text(
                -0.04, 0.5, row.title, rotation=90, va="center", ha="right", transform=axes[0].transAxes
            )

    return Figure(draw, (count * size[0] * scale + 0.3, len(rows) * (size[1] * scale + 0.25)))


def make_row(
    title: str,
    load: Callable[[], Model],
    film: Sequence[Moment],
    count: int,
    label: str,
    shown: tuple[str, ...],
) -> FilmRow:
    numbers = np.linspace(0, len(film) - 1, count).round().astype(int).tolist() if film else []
    chosen = [film[k] for k in numbers]
    return FilmRow(title, load, [m.values for m in chosen], [label.format(m) for m in chosen], shown)


@dataclass(frozen=True, eq=False)
class RowView:
    scenes: Sequence[TriangleSoup]  # all bodies at some times
    wanted: npt.NDArray[np.bool_]  # which parts have to be seen (N,)
    points: Array  # points that have to be in view (M, 3) [m]

    @staticmethod
    def of(model: Model, states: Sequence[Mapping[str, float]], shown: Sequence[str]) -> RowView:
        """Return the view of the bodies whose names begin with some texts, at some states."""
        items = collect_drawables(model)
        wanted = np.array([part.frame.startswith(tuple(shown)) for part in items])
        at = (states[0], states[len(states) // 2], states[-1])
        scenes = [_place(model, items, values) for values in at]
        points = np.concatenate([s.corners[wanted[s.source]].reshape(-1, 3) for s in scenes])
        return RowView(scenes, wanted, points)

    def camera(self, direction: tuple[float, float], aspect: float) -> Camera:
        elevation, azimuth = direction
        return fit_camera(self.points, azimuth, elevation, aspect, margin=0.04)

    def score(self, camera: Camera, aspect: float) -> float:
        """Return how much a camera sees of what is wanted."""
        projection = Projection.from_camera(camera, round(aspect * _TRIAL_HEIGHT), _TRIAL_HEIGHT)
        score = 0.0
        for scene in self.scenes:
            seen, _ = rasterize(projection, scene.corners.astype(np.float32), scene.closed)
            area = np.bincount(scene.source[seen[seen >= 0]], minlength=len(self.wanted))
            # The logarithm weighs many visible parts above one large panel.
            score += float(np.log1p(area[self.wanted]).sum())
        return score


def choose_cameras(views: Sequence[RowView], aspect: float) -> list[Camera]:
    azimuths = (2 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS).tolist()
    best = max(
        product(_ELEVATIONS, azimuths),
        key=lambda direction: sum(v.score(v.camera(direction, aspect), aspect) for v in views),
    )
    return [view.camera(best, aspect) for view in views]


def _place(model: Model, items: Sequence[Drawable], values: Mapping[str, float]) -> TriangleSoup:
    poses = FramePoses(model)
    at = dict(zip(poses.names, poses.evaluate(complete(model, values)), strict=True))
    return TriangleSoup.from_drawables(items, {**at, WORLD: np.eye(4)})


VECTORS: Mapping[str, tuple[str, Rgba]] = {
    "n": ("n, contact normal", (0.10, 0.25, 0.90, 1.0)),
    "push": ("−∇p, direction of the push", (0.95, 0.75, 0.05, 1.0)),
    "neutral": ("−∇p × n, neutral tangent", (0.10, 0.60, 0.20, 1.0)),
    "tangent": ("v, active tangent", (0.50, 0.05, 0.10, 1.0)),
}
"""Labels and colours of the vectors of a push, as in the papers."""
_POINT: Rgba = (0.93, 0.10, 0.12, 1.0)


def make_push_picture(
    panels: Sequence[tuple[str, Callable[[], Model], Moment]], size: tuple[int, int] = (760, 620)
) -> Figure:
    """Return the figure of the points and vectors of pushes, a panel for each title, model and moment."""

    def draw(canvas: Canvas) -> None:
        from matplotlib.lines import Line2D

        for axes, (title, load, moment) in zip(
            canvas.subplots(1, len(panels), squeeze=False)[0], panels, strict=True
        ):
            model = load()
            parts, ends = draw_vectors(moment.vectors)
            camera = _find_close_camera(model, moment, ends, parts, size[0] / size[1])
            axes.imshow(picture(model, moment.values, size, camera, over=parts))
            axes.set_title(title)
            axes.set_axis_off()
        handles = [Line2D([], [], color=color, linewidth=3, label=label) for label, color in VECTORS.values()]
        handles.insert(
            0, Line2D([], [], color=_POINT, marker="o", linestyle="", label="p on the object, r on the robot")
        )
        canvas.legend(
            handles=handles, loc="outside lower center", ncols=min(3, 1 + len(panels)), frameon=False
        )

    return Figure(draw, (6.0 * len(panels), 6.0 * size[1] / size[0] + 1.2))


def find_telling_moment(film: Sequence[Moment]) -> tuple[float, Moment | None]:
    """Return the length of the longest active tangent at nearest points, and its moment; None without any."""
    # Farther away there are no nearest points, but the tip and the contact point that was chosen.
    near = [m for m in film if "tangent" in m.vectors and _length(m.vectors["r - p"]) < _NEAREST]
    best = max(near, key=lambda m: _length(m.vectors["tangent"]), default=None)
    return (0.0 if best is None else _length(best.vectors["tangent"])), best


def draw_vectors(
    vectors: Mapping[str, tuple[Array, Array]], length: float = 0.16
) -> tuple[list[Drawable], Array]:
    """Return a push's points and vectors as parts, and their ends (N, 3); vectors have one length [m]."""
    p, apart = (np.asarray(v, dtype=float) for v in vectors["r - p"])
    arrows = {name: np.asarray(vector, dtype=float) for name, (_, vector) in vectors.items()}
    arrows["neutral"] = np.cross(arrows["push"], arrows["n"])
    parts = [
        Drawable(WORLD, build_spheres(np.array([p, p + apart]), np.full(2, 0.07 * length)), _POINT, "visual")
    ]
    points = [p, p + apart]
    for name, (_, color) in VECTORS.items():
        size = float(np.linalg.norm(arrows[name]))
        if size < 1e-3:
            continue
        ends = np.array([p, p + length / size * arrows[name]])
        points.append(ends[1])
        parts += [Drawable(WORLD, piece, color, "visual") for piece in build_arrow(ends, length)]
    return parts, np.array(points)


def _length(vector: tuple[Array, Array]) -> float:
    return float(np.linalg.norm(vector[1]))


def _find_close_camera(
    model: Model, moment: Moment, points: Array, parts: Sequence[Drawable], aspect: float
) -> Camera:
    items = [*collect_drawables(model), *parts]
    wanted = np.arange(len(items)) >= len(items) - len(parts)
    middle = points.mean(axis=0)
    around = middle + 1.6 * (points - middle)
    return choose_cameras([RowView([_place(model, items, moment.values)], wanted, around)], aspect)[0]
