"""Figures of matplotlib as pixels."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

DENSITY = 100  # [pixels per inch]


def draw_figure(draw: Callable[[Figure], None], size: tuple[int, int]) -> np.ndarray:
    """Return what a function draws on an empty figure, (height, width, 3) bytes."""
    figure = Figure((size[0] / DENSITY, size[1] / DENSITY), dpi=DENSITY, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    draw(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
