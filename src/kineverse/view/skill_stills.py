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

from .drawables import Drawable, collect_drawables
from .pictures import draw_picture, join_pictures, write_png
from .poses import FramePoses
from .rendering.auto_camera import choose_camera_for_parts
from .rendering.triangle_mesh import Floats
from .run_overlay import RunDrawing, RunMoment

SIZE = (400, 300)  # size of a still [pixels]
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
        camera = choose_camera_for_parts(items, places[:2], weights, SIZE[0] / SIZE[1])
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
