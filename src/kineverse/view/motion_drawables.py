"""Drawable motions: the way of a frame, and translucent bodies at several states."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from kineverse.model.model_view import ModelView
from kineverse.state import State
from kineverse.view.drawables import Drawable, Rgba, collect_drawables
from kineverse.view.poses import FramePoses, complete
from kineverse.view.sphere_drawables import build_spheres

TRACE: Rgba = (0.93, 0.42, 0.13, 1.0)
"""Colour of the way of a frame."""

_RADIUS, _OPACITY = 0.006, 0.3
_WORLD = "world"


def draw_frame_path(model: ModelView, frame: str, states: Iterable[State]) -> Drawable:
    """Return the origins of a frame at some states as small spheres."""
    poses = FramePoses(model, [frame])
    origins = np.array([poses.evaluate(complete(model, state))[0, :3, 3] for state in states])
    surface = build_spheres(origins, np.full(len(origins), _RADIUS))
    return Drawable(_WORLD, surface, TRACE, "visual")


def draw_ghosts(model: ModelView, bodies: Sequence[str], states: Iterable[State]) -> list[Drawable]:
    """Return translucent visual shapes of some bodies at some states."""
    parts = [part for part in collect_drawables(model) if part.frame in bodies]
    poses = FramePoses(model, bodies)
    found = []
    for state in states:
        world_T = dict(zip(bodies, poses.evaluate(complete(model, state)), strict=True))
        for part in parts:
            surface = replace(part.surface.transform(world_T[part.frame]), colors=None)
            found.append(replace(part, frame=_WORLD, surface=surface, color=(*part.color[:3], _OPACITY)))
    return found
