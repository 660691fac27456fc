"""Stills of skills in one picture: a row for each object, with its state before, open and after."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from kineverse.model.frame_dependence import moved_frames
from kineverse.state import State
from kineverse.symbols import Symbol
from kineverse.worlds import Robot
from kineverse.worlds.robot_interface import SkillStep

from .auto_camera import TRIAL_HEIGHT, find_extreme_points
from .camera import Camera, fit_camera
from .drawables import Drawable, collect_drawables
from .pictures import draw_picture, join_pictures, write_png
from .poses import FramePoses
from .rasterizer import Projection, TriangleSoup, rasterize
from .run_overlay import RunDrawing, RunMoment
from .triangle_mesh import Floats

SIZE = (400, 300)  # size of a still [pixels]
_AZIMUTHS, _ELEVATION = 8, 0.45
_FIELD_OF_VIEW = 0.6
_MOVED, _ROBOT = 2.0, 1.0  # weights of the object and of the robot in the choice of a camera


class _Still(NamedTuple):
    shown: State
    belief: State | None
    way: Floats | None


class HasState(Protocol):
    """Source of the true state, such as a simulated world."""

    @property
    def state(self) -> State:
        """True values of all coordinates."""


class SkillStills:
    """Stills of a robot that opens and closes objects.

    They show the true state of a simulated world, with the belief as a ghost; without a world, the belief. A
    thread draws them while the robot goes on with the next object; its errors are raised by :meth:`draw`.
    """

    def __init__(self, robot: Robot, world: HasState | None = None) -> None:
        self._robot, self._model, self._world = robot, robot.model, world
        self._drawing = RunDrawing(robot.model)
        self._rows: list[Future[list[npt.NDArray[np.uint8]]]] = []
        self._drawer = ThreadPoolExecutor(1, "kineverse-stills")
        self._grasped: list[_Still] = []
        self._last: _Still | None = None

    def __bool__(self) -> bool:
        return bool(self._rows)

    def watch(self, step: SkillStep, opening: bool) -> None:
        """Keep a step of the present row: the first and last of a held handle that opens, and the last."""
        shown = step.state if self._world is None else self._world.state
        reference = getattr(step, "reference", None)
        way = None if reference is None else reference.ahead
        self._last = _Still(shown, None if step.state is shown else step.state, way)
        if opening and step.phase == "move":
            self._grasped = [*self._grasped[:1], self._last]

    def end_row(self, coordinate: Symbol) -> None:
        """End the row of an object."""
        if self._last is not None:
            last = self._last
            stills = [*self._grasped, last]
            row = [*stills, *[last] * (3 - len(stills))]
            self._rows.append(self._drawer.submit(self._draw_row, coordinate, row))
        self._grasped, self._last = [], None

    def draw(self) -> npt.NDArray[np.uint8]:
        """Return the picture as (height, width, 3) bytes."""
        return join_pictures([row.result() for row in self._rows])

    def save(self, path: str | Path) -> None:
        """Write the picture to a PNG file."""
        write_png(path, self.draw())

    def _draw_row(self, coordinate: Symbol, row: list[_Still]) -> list[npt.NDArray[np.uint8]]:
        items, poses = collect_drawables(self._model), FramePoses(self._model)
        places = [
            dict(zip(poses.names, poses.evaluate(self._drawing.values(still.shown)), strict=True))
            for still in row
        ]
        moved = {*moved_frames(self._model, [coordinate])[coordinate]}
        weights = np.array([self._weigh(part, moved) for part in items])
        camera = _choose_camera(items, places, weights)
        images = []
        for still, place in zip(row, places, strict=True):
            ghosts = {} if still.belief is None else self._drawing.find_ghosts(still.shown, still.belief)
            moment = RunMoment(ghosts, {}, way=still.way)
            parts = [*items, *self._drawing.draw_ghosts(moment)]
            images.append(draw_picture(parts, place, SIZE, camera, self._drawing.draw_arrows(moment)))
        return images

    def _weigh(self, part: Drawable, moved: set[str]) -> float:
        if part.frame in moved:
            return _MOVED
        return _ROBOT if self._robot.owns(part.frame) else 0.0


def _choose_camera(
    items: list[Drawable], places: list[dict[str, Floats]], weights: npt.NDArray[np.float64]
) -> Camera:
    """Return the camera that shows most of the parts with weights in the first two states."""
    scenes = [TriangleSoup.from_drawables(items, place) for place in places[:2]]
    corners = [scene.corners.astype(np.float32) for scene in scenes]
    points = np.concatenate([scene.corners[weights[scene.source] > 0.0].reshape(-1, 3) for scene in scenes])
    extreme, aspect = find_extreme_points(points), SIZE[0] / SIZE[1]
    best, chosen = -1.0, None
    for azimuth in np.linspace(0.0, 2 * np.pi, _AZIMUTHS, endpoint=False).tolist():
        camera = fit_camera(extreme, azimuth, _ELEVATION, aspect, _FIELD_OF_VIEW)
        projection = Projection.from_camera(camera, int(TRIAL_HEIGHT * aspect), TRIAL_HEIGHT)
        score = 0.0
        for scene, triangles in zip(scenes, corners, strict=True):
            seen, _ = rasterize(projection, triangles, scene.closed)
            area = np.bincount(scene.source[seen[seen >= 0]], minlength=len(weights))
            score += float(weights @ np.log1p(area))
        if score > best:
            best, chosen = score, camera
    assert chosen is not None
    return chosen
