"""Line of sight from a camera to bodies, by rays to points of their shapes."""

from __future__ import annotations

from collections.abc import Collection, Iterable

import numpy as np

from kineverse.compile import compile as compile_expressions
from kineverse.geometry import Scene
from kineverse.geometry.collision_world import CollisionWorld
from kineverse.geometry.support import support
from kineverse.lie import Array
from kineverse.model.frame_dependence import FrameDependence
from kineverse.model.model_view import ModelView
from kineverse.state import State

_INSET = 0.9
"""Points lie at this fraction of the way from the middle of a shape to its corners."""

_MOST_SHAPES = 8
"""Largest number of shapes of a body whose points are tried."""


class LineOfSight:
    """Line of sight from a camera to bodies.

    A body is visible if a ray from the camera reaches a point of it and hits no other body before. The
    points are the middle and eight inner corners of each of its shapes. Bodies that never move relative to
    the camera hide nothing, nor do those of the robot that contain the camera at the default state: it is
    built into them. A camera inside of anything else sees nothing.
    """

    def __init__(self, model: ModelView, camera: str, own: Collection[str], bodies: Iterable[str]) -> None:
        motion = FrameDependence(model, model.degrees_of_freedom)
        known = Scene(model).bodies
        hidden = [name for name in known if not motion.moves_between(name, camera)]
        self._scene = _start(model, hidden)
        eye = compile_expressions(model.fk(camera))(model.default_state())[:3, 3]
        while (hit := self._scene.ray(eye, (1.0, 0.0, 0.0))) and hit.distance == 0.0 and hit.body in own:
            hidden.append(hit.body)
            self._scene = _start(model, hidden)
        world, shown = self._scene.collision_world, set(self._scene.bodies)
        self._points = {name: _inner_points(world, name) for name in bodies if name in shown}

    def update(self, state: State) -> None:
        """Compute the poses of all bodies at a state."""
        self._scene.update(state)

    def sees(self, body: str, eye: Array) -> bool:
        """Return whether a body is visible from a point (3,) in the world [m]."""
        if body not in self._points:
            return True
        world_T_body = self._scene.pose(body)
        for point in self._points[body] @ world_T_body[:3, :3].T + world_T_body[:3, 3]:
            way = point - eye
            distance = float(np.linalg.norm(way))
            if distance == 0.0:
                return True
            hit = self._scene.ray(eye, way, distance)
            if hit is None or hit.body == body:
                return True
        return False


def _start(model: ModelView, hidden: Iterable[str]) -> Scene:
    """Return a scene at the default state without some bodies."""
    scene = Scene(model, leave_out=hidden)
    scene.update(model.default_state())
    scene.collision_world.prepare()
    return scene


def _inner_points(world: CollisionWorld, body: str) -> Array:
    """Return points (n, 3) inside of the shapes of a body, in its frame [m]."""
    found: list[Array] = []
    for k in world.members[world.body_index(body)][:_MOST_SHAPES]:
        origin, solid = world.objects[k].shape.origin.matrix, world.solid(k)
        rotation, middle = origin[:3, :3], origin[:3, 3]
        if solid.core is None:
            found.append(middle)
            continue
        corners = np.array(
            [support((solid, rotation, middle), rotation @ corner / np.sqrt(3.0)) for corner in _CORNERS]
        )
        middle = corners.mean(axis=0)
        found += [middle, *(middle + _INSET * (corners - middle))]
    return np.array(found)


_CORNERS = np.array([(x, y, z) for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
