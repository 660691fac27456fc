"""Pairs within a distance of a robot and a room: MuJoCo, Bullet."""

from __future__ import annotations

from typing import Any

import numpy as np

from kineverse.geometry import Scene
from kineverse.geometry.shapes import Solid
from kineverse.lie import Array
from kineverse.model.body import Box, Capsule, Cylinder, Ellipsoid, Sphere
from kineverse.view.poses import to_wxyz
from kineverse_studies.bench.geometry import RADIUS

from .bullet import create_static_bodies, xyzw_quaternions
from .clutter_search import UNIT_BOX_CORNERS, MujocoSearch, PairDistances, format_mjcf_numbers, make_mjcf


class RobotSurroundings:
    """Collision objects of a scene, divided into those of a robot and the static ones of a room."""

    def __init__(self, scene: Scene, values: Array, robot: str) -> None:
        self._scene, self._world = scene, scene.collision_world
        scene.update(values)
        self._world.prepare()
        self.names = [piece.body for piece in self._world.objects]
        self.robot = [k for k, name in enumerate(self.names) if name.startswith(robot)]
        self.others = [k for k, name in enumerate(self.names) if not name.startswith(robot)]

    def update(self, values: Array) -> Array:
        """Move the robot, and return the poses of its objects, (N, 3, 4)."""
        self._scene.update(values)
        return self.poses(self.robot)

    def poses(self, objects: list[int]) -> Array:
        """Return the poses of objects, (N, 3, 4)."""
        return self._world.table.poses[objects]

    def solid(self, index: int) -> Solid:
        return self._world.solid(index)


class MujocoRobotSearch(MujocoSearch):
    """Search with MuJoCo, each object of the robot a free body; see :class:`.MujocoSearch`."""

    def __init__(self, room: RobotSurroundings) -> None:
        self._room = room
        assets, world = [], []
        for k, pose in zip(room.others, room.poses(room.others), strict=True):
            asset, geom = _mjcf_geom(k, room.solid(k))
            assets.append(asset)
            at = f'pos="{format_mjcf_numbers(pose[:, 3])}" xyaxes="{format_mjcf_numbers(pose[:, :2].T)}"'
            world.append(f'<geom {geom} {at} contype="0" conaffinity="1"/>')
        for k in room.robot:
            asset, geom = _mjcf_geom(k, room.solid(k))
            assets.append(asset)
            inertia = '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
            mask = f'margin="{RADIUS}" contype="1" conaffinity="0"'
            world.append(f"<body><freejoint/>{inertia}<geom {geom} {mask}/></body>")
        self._start(make_mjcf(assets, world))
        self.names = [room.names[int(name)] for name in self.names]

    def update(self, angles: Array) -> None:
        """Set the state of the robot."""
        poses = self._room.update(angles)
        self.data.qpos.reshape(-1, 7)[:] = np.hstack([poses[:, :, 3], to_wxyz(poses)])
        self._mujoco.mj_kinematics(self.model, self.data)


def _mjcf_geom(number: int, solid: Solid) -> tuple[str, str]:
    """Return the asset and the geom attributes of an object in MJCF."""
    shape, name = solid.surface, f'name="{number}"'
    if isinstance(shape, Sphere):
        return "", f'{name} type="sphere" size="{shape.radius!r}"'
    if isinstance(shape, Ellipsoid):
        return "", f'{name} type="ellipsoid" size="{format_mjcf_numbers(shape.radii)}"'
    if isinstance(shape, Capsule | Cylinder):
        kind = type(shape).__name__.lower()
        return "", f'{name} type="{kind}" size="{shape.radius!r} {shape.length / 2!r}"'
    vertices = format_mjcf_numbers(_solid_corners(solid))
    asset = f'<mesh {name} vertex="{vertices}" inertia="shell" maxhullvert="-1"/>'
    return asset, f'{name} type="mesh" mesh="{number}"'


def _solid_corners(solid: Solid) -> Array:
    """Return the corners of a box or hull, (N, 3)."""
    if isinstance(solid.surface, Box):
        return UNIT_BOX_CORNERS * solid.surface.size
    assert solid.core is not None
    return np.unique(solid.core.corners.T, axis=0)


class BulletRobotSearch:
    """Search with Bullet's getClosestPoints of each object of the robot and bodies of the others."""

    def __init__(self, room: RobotSurroundings) -> None:
        import pybullet

        self._bullet: Any = pybullet
        self._room = room
        self._client = client = pybullet.connect(pybullet.DIRECT)
        shapes = [self._shape(room.solid(k)) for k in room.others]
        self._bodies = create_static_bodies(pybullet, shapes, room.poses(room.others), client)
        self._robot = {
            pybullet.createMultiBody(1.0, self._shape(room.solid(k)), physicsClientId=client): k
            for k in room.robot
        }
        self.results: list[tuple[int, int, Any]] = []

    def update(self, angles: Array) -> None:
        """Set the state of the robot."""
        poses, place = self._room.update(angles), self._bullet.resetBasePositionAndOrientation
        for body, at, turn in zip(self._robot, poses[:, :, 3].tolist(), xyzw_quaternions(poses), strict=True):
            place(body, at, turn, physicsClientId=self._client)

    def query(self) -> object:
        """Search for pairs within the radius."""
        closest_points, client = self._bullet.getClosestPoints, self._client
        self.results = [
            (index, first, closest_points(body, other, RADIUS, physicsClientId=client))
            for body, index in self._robot.items()
            for other, first in self._bodies.items()
        ]
        return self.results

    def distances(self) -> PairDistances:
        """Return the pairs of the last search, with distances [m]."""
        names, others = self._room.names, self._room.others
        for index, first, contacts in self.results:
            for contact in contacts:
                yield names[index], names[others[first + contact[4]]], contact[8]

    def _shape(self, solid: Solid) -> int:
        bullet, shape = self._bullet, solid.surface
        sizes: dict[str, Any]
        if isinstance(shape, Box):
            kind, sizes = bullet.GEOM_BOX, {"halfExtents": [edge / 2 for edge in shape.size]}
        elif isinstance(shape, Sphere):
            kind, sizes = bullet.GEOM_SPHERE, {"radius": shape.radius}
        elif isinstance(shape, Capsule | Cylinder):
            kind = bullet.GEOM_CAPSULE if isinstance(shape, Capsule) else bullet.GEOM_CYLINDER
            sizes = {"radius": shape.radius, "height": shape.length}
        else:
            kind, sizes = bullet.GEOM_MESH, {"vertices": _solid_corners(solid).tolist()}
        return int(bullet.createCollisionShape(kind, physicsClientId=self._client, **sizes))

    def __del__(self) -> None:
        self._bullet.disconnect(self._client)
