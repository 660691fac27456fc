"""A model that stands somewhere in the scene, in its own colours or in those of what is only believed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import groupby

import numpy as np

from kineverse.model.model_view import ModelView
from kineverse.view.drawables import Drawable, Rgba, collect_drawables
from kineverse.view.poses import FramePoses
from kineverse.view.triangle_mesh import Floats, concatenate_meshes

PAPER, INK = (0.88, 0.93, 0.98), (0.38, 0.50, 0.64)
"""The colours of what is believed and does not move: those of white and black things."""

DOUBTS = ((0.22, 0.50, 0.88), (0.98, 0.80, 0.30), (0.94, 0.36, 0.10))
"""The colours of what is believed to be somewhere: within little, within more, within much."""

LITTLE, MUCH = 0.08, 0.8
"""The doubts of the first and the last of these [m]."""

SHADES = 12
"""How many colours there are between them."""


class Figure:
    """The bodies of a model, placed in the scene.

    Parameters
    ----------
    name
        Tells its parts from those of other figures.
    model
        What is shown.
    place
        Where its world is in the scene, 4×4.
    paint
        What becomes of the colours of bodies; they stay if None.

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
        """Return what a frame of the model is called in the scene."""
        return f"{self._name}|{frame}"

    def poses(self, values: Mapping[str, float]) -> dict[str, Floats]:
        """Return where the frames that have bodies are in the scene, by key."""
        names = map(self.key, self._poses.names)
        return dict(zip(names, self._place @ self._poses.at(values), strict=True))


def on_paper(color: Rgba) -> Rgba:
    """Return the colour of something as it is drawn where it is only believed."""
    red, green, blue, alpha = color
    return _between(INK, PAPER, 0.3 * red + 0.59 * green + 0.11 * blue, alpha)


def doubtful(doubt: float) -> Rgba:
    """Return the colour of a part that may be anywhere on a way of a length [m]."""
    share = np.log(max(doubt, LITTLE) / LITTLE) / np.log(MUCH / LITTLE)
    # In steps, so that a page need not be told of every change.
    share = 2.0 * round(min(float(share), 1.0) * SHADES) / SHADES
    low, high = DOUBTS[:2] if share < 1.0 else DOUBTS[1:]
    return _between(low, high, share % 1.0 if share < 2.0 else 1.0, 1.0)


def shaded(color: Rgba, own: Rgba) -> Rgba:
    """Return a colour as dark as a part's own one has it: what is inside of a drawer stays dark."""
    light = 0.45 + 0.55 * (0.3 * own[0] + 0.59 * own[1] + 0.11 * own[2])
    return color[0] * light, color[1] * light, color[2] * light, own[3]


def _between(dark: tuple[float, ...], light: tuple[float, ...], share: float, alpha: float) -> Rgba:
    red, green, blue = (d + share * (v - d) for d, v in zip(dark, light, strict=True))
    return red, green, blue, alpha
