"""Drawing of a run: the belief as a ghost beside the truth, and vectors of the controller as arrows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from kineverse.lie import rotation_angle
from kineverse.model.frame import WORLD
from kineverse.model.model_view import ModelView
from kineverse.state import StateLike
from kineverse.view.drawables import Drawable, Rgba, collect_drawables
from kineverse.view.motion_drawables import TRACE
from kineverse.view.poses import FramePoses, complete, keep_known
from kineverse.view.proximity import build_arrow
from kineverse.view.sphere_drawables import build_spheres
from kineverse.view.triangle_mesh import Floats
from kineverse.worlds import Contact

GHOST: Rgba = (0.16, 0.47, 0.86, 0.35)
"""Colour of the belief."""

ARROWS: tuple[Rgba, ...] = (
    (0.86, 0.16, 0.16, 1.0),
    (0.13, 0.55, 0.20, 1.0),
    (0.16, 0.33, 0.88, 1.0),
    (0.80, 0.45, 0.05, 1.0),
    (0.55, 0.20, 0.70, 1.0),
    (0.05, 0.55, 0.60, 1.0),
)
"""Colours of arrows, in the order in which their names come."""

ARROW_SCALE, LONGEST_ARROW = 0.25, 0.6
"""Length of the arrow of a vector of 1, and the largest length of an arrow [m]."""

WAY_RADIUS = 0.008
"""Half of the width of the way of a hand [m]."""

_APART, _TURNED = 3e-3, 5e-3
"""Least difference of a belief that is shown [m], [rad]; below, the ghost would flicker on the body."""

_MOST_CONTACTS = 4

Vectors = Mapping[str, tuple[npt.ArrayLike, npt.ArrayLike]]
"""Vectors by name, each with its origin in the world (3,) [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class RunMoment:
    """Things to draw of a run at one time."""

    ghosts: Mapping[str, Floats]  # (4, 4)
    arrows: Mapping[str, Floats]  # ends (2, 3) of arrows in the world [m], by name
    lines: Sequence[str] = ()  # lines of text
    way: Floats | None = None  # points (k, 3) of the way ahead of the hand [m]; None without a way
    wanted: Floats | None = None  # pose (4, 4) at which the hand is wanted now [m]


class RunDrawing:
    """Drawing of runs of a model."""

    def __init__(self, model: ModelView) -> None:
        self._model = model
        self.parts = [part for part in collect_drawables(model) if model.fk(part.frame).symbols]
        self._kinematics = FramePoses(model, dict.fromkeys(part.frame for part in self.parts))
        self._colors: dict[str, Rgba] = {}

    def values(self, state: StateLike) -> dict[str, float]:
        """Return the values of all symbols of the model by name; what a state has beyond is left out."""
        named = {str(symbol): float(value) for symbol, value in state.items()}
        return complete(self._model, keep_known(self._model, named))

    def find_ghosts(
        self, truth: StateLike, belief: StateLike, poses: Mapping[str, Floats] | None = None
    ) -> dict[str, Floats]:
        """Return the believed world poses (4, 4) of those bodies that are elsewhere in truth, by frame."""
        values = self.values(truth)
        named = {str(symbol): float(value) for symbol, value in belief.items()}
        true_poses = self._kinematics.evaluate(values)
        believed = self._kinematics.evaluate(values | keep_known(self._model, named))
        for frame, pose in (poses or {}).items():
            if frame in self._kinematics.names:
                believed[self._kinematics.index(frame)] = pose
        apart = np.linalg.norm(believed[:, :3, 3] - true_poses[:, :3, 3], axis=1)
        turned = rotation_angle(np.swapaxes(true_poses[:, :3, :3], 1, 2) @ believed[:, :3, :3])
        different = np.isfinite(believed).all(axis=(1, 2)) & ((apart > _APART) | (turned > _TURNED))
        return {self._kinematics.names[k]: believed[k] for k in np.flatnonzero(different).tolist()}

    def color(self, name: str) -> Rgba:
        """Return the colour of the arrow of a vector."""
        return self._colors.setdefault(name, ARROWS[len(self._colors) % len(ARROWS)])

    def draw_ghosts(self, moment: RunMoment) -> list[Drawable]:
        """Return the bodies where they are believed, as parts in the world."""
        return [
            replace(
                part,
                frame=WORLD,
                surface=replace(part.surface.transform(moment.ghosts[part.frame]), colors=None),
                color=GHOST,
            )
            for part in self.parts
            if part.frame in moment.ghosts
        ]

    def draw_arrows(self, moment: RunMoment) -> list[Drawable]:
        """Return the arrows and the way of the hand, as parts in the world."""
        drawn = [
            Drawable(WORLD, piece, self.color(name), "visual")
            for name, ends in moment.arrows.items()
            for piece in build_arrow(ends, float(np.linalg.norm(ends[1] - ends[0])))
        ]
        if moment.way is not None:
            surface = build_spheres(moment.way, np.full(len(moment.way), WAY_RADIUS))
            drawn.append(Drawable(WORLD, surface, TRACE, "visual"))
        return drawn


def find_arrows(vectors: Vectors) -> dict[str, Floats]:
    """Return the ends (2, 3) of the arrows of vectors, by name [m]; vectors of length 0 have none."""
    found = {}
    for name, (origin, vector) in vectors.items():
        start, along = np.asarray(origin, dtype=float), np.asarray(vector, dtype=float)
        length = float(np.linalg.norm(along))
        if 0.0 < length < np.inf:
            found[name] = np.array([start, start + min(ARROW_SCALE * length, LONGEST_ARROW) / length * along])
    return found


def format_contact_lines(contacts: Sequence[Contact]) -> list[str]:
    """Return a line for each contact, of many the first ones."""
    lines = []
    for contact in contacts[:_MOST_CONTACTS]:
        force = "" if np.isnan(contact.force) else f", {contact.force:.1f} N"
        lines.append(f"contact: {contact.a} and {contact.b}{force}")
    more = len(contacts) - _MOST_CONTACTS
    return [*lines, f"and {more} more contacts"] if more > 0 else lines
