"""Model of a hand alone, which is placed freely among bodies that stand still."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from kineverse import lie
from kineverse.geometry import Scene
from kineverse.lie import Array
from kineverse.model.body import Body, Pose
from kineverse.model.frame import WORLD
from kineverse.model.model import Model
from kineverse.model.model_view import ModelView
from kineverse.spatial import rpy, translation
from kineverse.symbols import Symbol, position

_PLACE = tuple(position(f"free_hand/{name}") for name in ("x", "y", "z", "roll", "pitch", "yaw"))


class HandModel:
    """Bodies of a hand with their own coordinates, below a frame with six more.

    Parameters
    ----------
    model
        Model of the robot.
    hand
        Frame that is placed.
    frames
        Frames of the bodies, which move with respect to the hand by the joints alone.
    joints
        Free coordinates of the fingers.
    obstacles
        Poses (4, 4) [m] and bodies of what stands still, by name.

    Attributes
    ----------
    scene
        Collision scene of the bodies and obstacles.
    bodies
        The frames that have shapes.
    """

    def __init__(
        self,
        model: ModelView,
        hand: str,
        frames: Iterable[str],
        joints: Iterable[Symbol],
        obstacles: Mapping[str, tuple[Array, Body]] | None = None,
    ) -> None:
        self.joints = tuple(joints)
        self.bodies = tuple(f for f in frames if f in model.bodies and has_shapes(model.bodies[f]))
        alone = Model()
        with alone.edit() as edit:
            place = [translation(*_PLACE[:3]), rpy(*_PLACE[3:])]
            edit.add_frame(hand, WORLD, place, model.bodies.get(hand))
            for frame in self.bodies:
                if frame != hand:
                    edit.add_frame(frame, hand, model.fk(frame, hand), model.bodies[frame])
            for name, (pose, body) in (obstacles or {}).items():
                edit.add_frame(name, WORLD, Pose.from_matrix(lie.orthonormalize(pose)), body)
        self.model = alone
        self.scene = Scene(alone)
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
        self.scene.update(dict(zip(self.coordinates, self.row(values, pose).tolist(), strict=True)))

    def box_corners(self, frames: Iterable[str]) -> Array:
        """Return the corners (n, 3) of the boxes around the shapes of placed bodies, in the world [m]."""
        wanted, found = set(frames), []
        for item in self.scene.collision_world.objects:
            if item.body in wanted:
                solid = item.make_solid()
                corners = solid.centre + _SIGNS * solid.half
                pose = self.scene.pose(item.body) @ item.shape.origin.matrix
                found.append(corners @ pose[:3, :3].T + pose[:3, 3])
        return np.concatenate(found)


_SIGNS = np.array(np.meshgrid([-1.0, 1.0], [-1.0, 1.0], [-1.0, 1.0])).reshape(3, -1).T


def has_shapes(body: Body) -> bool:
    """Return True if a body has collision shapes, or visual shapes in their place."""
    return bool(body.collisions or body.visuals)
