"""A picture of the scene that lives, without a browser."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from kineverse.model.frame import WORLD
from kineverse.view.camera import Camera
from kineverse.view.pictures import draw_picture, write_png

from .scene import CAMERA, Scenery, marks_of
from .simulation import Life

SIZE = (1200, 600)
"""Width and height [pixels]."""


def picture(life: Life, size: tuple[int, int] = SIZE, camera: Camera = CAMERA) -> npt.NDArray[np.uint8]:
    """Return a picture of a life at this moment as (height, width, 3) bytes."""
    scenery = Scenery(life)
    return draw_picture(
        scenery.parts(), {WORLD: np.eye(4), **scenery.poses()}, size, camera, marks_of(scenery)
    )


def save(path: str | Path, life: Life) -> None:
    """Write :func:`picture` to a PNG file."""
    write_png(path, picture(life))
