"""Bodies of a model at a pose in the scene, in their own colours or in those of an estimate."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import groupby

import numpy as np

from kineverse.model.model_view import ModelView
from kineverse.view.drawables import Drawable, Rgba, collect_drawables
from kineverse.view.poses import FramePoses
from kineverse.view.rendering.triangle_mesh import Floats, concatenate_meshes

LIGHT_TONE, DARK_TONE = (0.88, 0.93, 0.98), (0.38, 0.50, 0.64)
"""The colours of white and black parts of an estimate that do not move."""

UNCERTAINTY_COLORS = ((0.22, 0.50, 0.88), (0.98, 0.80, 0.30), (0.94, 0.36, 0.10))
"""The colours of moving parts of an estimate, by increasing uncertainty."""

LEAST_LENGTH, LARGEST_LENGTH = 0.08, 0.8
"""The uncertainties of the first and the last of these colours [m]."""

COLOR_STEPS = 12
"""Number of colours between them."""


class PlacedModel:
    """Bodies of a model, placed in the scene.

    Parameters
    ----------
    name
        Prefix of its frames in the scene.
    model
        The model.
    place
        The pose of its world in the scene, 4×4.
    paint
        Function that replaces the colours of bodies; None keeps them.

    Attributes
    ----------
    parts
        Its shapes, one for each frame and colour; their frames are keys of :meth:`poses`.
    """

    def __init__(
        self,
        name: str,
        model: ModelView,
        place: Floats | None = None,
        paint: Callable[[Rgba], Rgba] | None = None,
    ) -> None:
        self.model = model
        self._name, self._place = name, np.eye(4) if place is None else place
        shown = sorted(collect_drawables(model), key=lambda part: (part.frame, part.color))
        self.parts: list[Drawable] = []
        for (frame, color), same in groupby(shown, key=lambda part: (part.frame, part.color)):
            surface = concatenate_meshes([part.surface for part in same])
            self.parts.append(Drawable(self.key(frame), surface, paint(color) if paint else color, "visual"))
        self._poses = FramePoses(model, sorted({part.frame for part in shown}))

    def key(self, frame: str) -> str:
        """Return the name of a frame of the model in the scene."""
        return f"{self._name}|{frame}"

    def poses(self, values: Mapping[str, float]) -> dict[str, Floats]:
        """Return the poses in the scene of the frames that have bodies, by key."""
        names = map(self.key, self._poses.names)
        return dict(zip(names, self._place @ self._poses.evaluate(values), strict=True))


def estimate_color(color: Rgba) -> Rgba:
    """Return the colour of a body in the estimated kitchen."""
    red, green, blue, alpha = color
    return _between(DARK_TONE, LIGHT_TONE, 0.3 * red + 0.59 * green + 0.11 * blue, alpha)


def uncertainty_color(length: float) -> Rgba:
    """Return the colour of a part whose position is uncertain along a path of a length [m]."""
    share = np.log(max(length, LEAST_LENGTH) / LEAST_LENGTH) / np.log(LARGEST_LENGTH / LEAST_LENGTH)
    # In steps, so that small changes are not sent to the page.
    share = 2.0 * round(min(float(share), 1.0) * COLOR_STEPS) / COLOR_STEPS
    low, high = UNCERTAINTY_COLORS[:2] if share < 1.0 else UNCERTAINTY_COLORS[1:]
    return _between(low, high, share % 1.0 if share < 2.0 else 1.0, 1.0)


def shade(color: Rgba, own: Rgba) -> Rgba:
    """Return a colour at the brightness of a part's own colour: the inside of a drawer stays dark."""
    light = 0.45 + 0.55 * (0.3 * own[0] + 0.59 * own[1] + 0.11 * own[2])
    return color[0] * light, color[1] * light, color[2] * light, own[3]


def _between(dark: tuple[float, ...], light: tuple[float, ...], share: float, alpha: float) -> Rgba:
    red, green, blue = (d + share * (v - d) for d, v in zip(dark, light, strict=True))
    return red, green, blue, alpha
