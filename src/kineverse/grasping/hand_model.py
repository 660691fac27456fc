"""Model of a hand alone, which is placed freely among bodies that stand still."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from kineverse import lie
from kineverse.errors import FormatError, InvalidValueError, summarize_error
from kineverse.geometry import Scene
from kineverse.geometry.objects import collision_shapes
from kineverse.geometry.shapes import solid_from_geometry
from kineverse.lie import Array
from kineverse.model.body import Body, Pose
from kineverse.model.frame import WORLD
from kineverse.model.model import Model
from kineverse.model.model_view import ModelView
from kineverse.spatial import rpy, translation
from kineverse.symbols import Symbol, position

_PLACE = tuple(position(f"free_hand/{name}") for name in ("x", "y", "z", "roll", "pitch", "yaw"))


class HandModel:
    """Bodies of a hand with their own coordinates, below a frame with six more."""

    def __init__(
        self,
        model: ModelView,
        hand: str,
        bodies: Mapping[str, Body],
        joints: Iterable[Symbol],
        obstacles: Mapping[str, tuple[Array, Body]] | None = None,
        decomposed: Iterable[str] = (),
    ) -> None:
        self.bodies = tuple(bodies)
        alone = Model()
        with alone.edit() as edit:
            place = [translation(*_PLACE[:3]), rpy(*_PLACE[3:])]
            edit.add_frame(hand, WORLD, place, bodies.get(hand))
            for frame, body in bodies.items():
                if frame != hand:
                    edit.add_frame(frame, hand, model.fk(frame, hand), body)
            for name, (pose, body) in (obstacles or {}).items():
                edit.add_frame(name, WORLD, Pose.from_matrix(lie.orthonormalize(pose)), body)
        self.joints = tuple(s for s in joints if s in alone.symbols)
        self.model = alone
        defaults = model.default_state()
        self._held = {s: defaults[s] for s in alone.symbols if s not in self.coordinates}
        self.scene = Scene(alone, decomposed=decomposed)
        self.place({})

    @property
    def coordinates(self) -> tuple[Symbol, ...]:
        """The place of the hand as x, y, z [m], roll, pitch, yaw [rad], and then the joints."""
        return (*_PLACE, *self.joints)

    def row(self, values: Mapping[Symbol, float], pose: Array | None = None) -> Array:
        """Return the values of :attr:`coordinates` (n,) for values of the joints and a pose (4, 4) [m]."""
        place = np.zeros(6) if pose is None else np.append(pose[:3, 3], lie.to_rpy(pose[:3, :3]))
        return np.append(place, [values.get(s, 0.0) for s in self.joints])

    def place(self, values: Mapping[Symbol, float], pose: Array | None = None) -> None:
        """Place the scene at values of the joints, with the hand at a pose (4, 4) [m]."""
        moved = dict(zip(self.coordinates, self.row(values, pose).tolist(), strict=True))
        self.scene.update({**self._held, **moved})

    def box_corners(self, frames: Iterable[str]) -> Array:
        """Return the corners (n, 3) of the boxes around the shapes of placed bodies, in the world [m]."""
        return find_box_corners(self.scene, frames)


def find_box_corners(scene: Scene, frames: Iterable[str]) -> Array:
    """Return the corners (n, 3) of the boxes around the shapes of bodies in a scene, in the world [m]."""
    wanted, result = set(frames), []
    for item in scene.collision_world.objects:
        if item.body in wanted:
            solid = item.make_solid()
            pose = scene.pose(item.body) @ item.shape.origin.matrix
            result.append((solid.centre + _SIGNS * solid.half) @ pose[:3, :3].T + pose[:3, 3])
    return np.concatenate(result)


_SIGNS = np.array(np.meshgrid([-1.0, 1.0], [-1.0, 1.0], [-1.0, 1.0])).reshape(3, -1).T


def bodies_with_shapes(model: ModelView, frames: Iterable[str]) -> dict[str, Body]:
    """Return the bodies of some frames that have collision shapes, or visual shapes in their place."""
    return {f: model.bodies[f] for f in frames if f in model.bodies and collision_shapes(model.bodies[f])}


def usable_bodies(bodies: Mapping[str, Body]) -> tuple[dict[str, Body], list[str]]:
    """Return bodies without the shapes that cannot be read, and what is wrong with these."""
    usable, problems = {}, []
    for name, body in bodies.items():
        kept = []
        for shape in collision_shapes(body):
            try:
                solid_from_geometry(shape.geometry)
                kept.append(shape)
            except (FormatError, InvalidValueError, OSError) as error:
                problems.append(f"{name}: {summarize_error(error, advice=False)}")
        if kept:
            usable[name] = Body(collisions=tuple(kept))
    return usable, problems
