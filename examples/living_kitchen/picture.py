"""Picture of the simulation without a browser."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from kineverse.model.frame import WORLD
from kineverse.view.pictures import draw_picture, write_png
from kineverse.view.rendering.camera import Camera

from .scene import CAMERA, SceneDrawables, create_marks
from .simulation import Simulation

SIZE = (1200, 600)
"""Width and height [pixels]."""


def picture(
    simulation: Simulation, size: tuple[int, int] = SIZE, camera: Camera = CAMERA
) -> npt.NDArray[np.uint8]:
    """Return a picture of the present state of a simulation as (height, width, 3) bytes."""
    drawables = SceneDrawables(simulation)
    return draw_picture(
        drawables.parts(), {WORLD: np.eye(4), **drawables.poses()}, size, camera, create_marks(drawables)
    )


def save(path: str | Path, simulation: Simulation) -> None:
    """Write :func:`picture` to a PNG file."""
    write_png(path, picture(simulation))
