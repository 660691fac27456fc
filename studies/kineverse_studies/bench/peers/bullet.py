"""Pairs within a distance in Bullet: an arm among boxes, and a robot in a room."""

from __future__ import annotations

import itertools
from typing import Any

from kineverse.geometry.shapes import Solid
from kineverse.lie import Array, to_quaternion
from kineverse.model.body import Box, Capsule, Cylinder, Sphere
from kineverse_studies.bench import geometry

_LINKS_PER_BODY = 100  # number of boxes in one body, as Bullet limits the number of links


class BulletSearch:
    def __init__(self, clutter: geometry.Clutter) -> None:
        import pybullet

        self._bullet: Any = pybullet
        self._client = pybullet.connect(pybullet.DIRECT)
        shapes = [_create_link_shape(pybullet, clutter, link, self._client) for link in range(geometry.LINKS)]
        links = [[0.0, 0.0, geometry.LINK_LENGTH if link else 0.0] for link in range(geometry.LINKS)]
        axes = [list(clutter.axis(link)) for link in range(geometry.LINKS)]
        self._arm = _create_body(pybullet, shapes, links, None, axes, self._client)
        boxes = [
            pybullet.createCollisionShape(
                pybullet.GEOM_BOX, halfExtents=(size / 2).tolist(), physicsClientId=self._client
            )
            for size in clutter.sizes
        ]
        self._bodies = _create_static_bodies(pybullet, boxes, clutter.poses, self._client)
        self._joints = list(range(geometry.LINKS))
        self.results: list[Any] = []

    def update(self, angles: Array) -> None:
        rows = angles[:, None].tolist()
        self._bullet.resetJointStatesMultiDof(
            self._arm, self._joints, targetValues=rows, physicsClientId=self._client
        )

    def query(self) -> object:
        closest_points, arm, client = self._bullet.getClosestPoints, self._arm, self._client
        self.results = [
            closest_points(arm, body, geometry.RADIUS, physicsClientId=client) for body in self._bodies
        ]
        return self.results

    def distances(self) -> geometry.PairDistances:
        for contact in itertools.chain(*self.results):
            yield f"link{contact[3]}", f"box{self._bodies[contact[2]] + contact[4]}", contact[8]

    def __del__(self) -> None:
        self._bullet.disconnect(self._client)


def _create_static_bodies(pybullet: Any, shapes: list[int], poses: Array, client: int) -> dict[int, int]:
    """Create static bodies of shapes at poses, (N, 3, 4) or larger, each shape a link."""
    bodies = {}
    for first in range(0, len(shapes), _LINKS_PER_BODY):
        some = slice(first, first + _LINKS_PER_BODY)
        positions, turns = poses[some, :3, 3].tolist(), _xyzw_quaternions(poses[some])
        bodies[_create_body(pybullet, shapes[some], positions, turns, None, client)] = first
    return bodies


def _create_link_shape(pybullet: Any, clutter: geometry.Clutter, link: int, client: int) -> int:
    kind = clutter.kind(link)
    at = {"collisionFramePosition": list(geometry.CENTRE), "physicsClientId": client}
    if kind == "box":
        half = [edge / 2 for edge in geometry.BOX_SIZE]
        return int(pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=half, **at))
    if kind == "capsule":
        radius, length = geometry.CAPSULE_SIZE
        return int(pybullet.createCollisionShape(pybullet.GEOM_CAPSULE, radius=radius, height=length, **at))
    return int(
        pybullet.createCollisionShape(pybullet.GEOM_MESH, vertices=clutter.corners[link].tolist(), **at)
    )


def _create_body(
    pybullet: Any,
    shapes: list[int],
    positions: list[list[float]],
    quaternions: list[list[float]] | None,
    axes: list[list[int]] | None,
    client: int,
) -> int:
    count, nothing, upright = len(shapes), [0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]
    fixed, turning = pybullet.JOINT_FIXED, pybullet.JOINT_REVOLUTE
    return int(
        pybullet.createMultiBody(
            baseMass=0,
            linkMasses=[0.0 if axes is None else 1.0] * count,
            linkCollisionShapeIndices=shapes,
            linkVisualShapeIndices=[-1] * count,
            linkPositions=positions,
            linkOrientations=quaternions or [upright] * count,
            linkInertialFramePositions=[nothing] * count,
            linkInertialFrameOrientations=[upright] * count,
            linkParentIndices=[0] * count if axes is None else list(range(count)),
            linkJointTypes=[fixed if axes is None else turning] * count,
            linkJointAxis=axes or [[0, 0, 1]] * count,
            physicsClientId=client,
        )
    )


def _xyzw_quaternions(poses: Array) -> list[list[float]]:
    """Return (x, y, z, w) of (N, 3, 4) or larger poses."""
    quaternions: list[list[float]] = to_quaternion(poses[:, :3, :3]).tolist()
    return quaternions


class BulletRobotSearch:
    def __init__(self, room: geometry.RobotSurroundings) -> None:
        import pybullet

        self._bullet: Any = pybullet
        self._room = room
        self._client = client = pybullet.connect(pybullet.DIRECT)
        shapes = [self._shape(room.solid(k)) for k in room.others]
        self._bodies = _create_static_bodies(pybullet, shapes, room.poses(room.others), client)
        self._robot = {
            pybullet.createMultiBody(1.0, self._shape(room.solid(k)), physicsClientId=client): k
            for k in room.robot
        }
        self.results: list[tuple[int, int, Any]] = []

    def update(self, angles: Array) -> None:
        poses, place = self._room.update(angles), self._bullet.resetBasePositionAndOrientation
        for body, at, turn in zip(
            self._robot, poses[:, :, 3].tolist(), _xyzw_quaternions(poses), strict=True
        ):
            place(body, at, turn, physicsClientId=self._client)

    def query(self) -> object:
        closest_points, client = self._bullet.getClosestPoints, self._client
        self.results = [
            (index, first, closest_points(body, other, geometry.RADIUS, physicsClientId=client))
            for body, index in self._robot.items()
            for other, first in self._bodies.items()
        ]
        return self.results

    def distances(self) -> geometry.PairDistances:
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
            kind, sizes = bullet.GEOM_MESH, {"vertices": geometry.solid_corners(solid).tolist()}
        return int(bullet.createCollisionShape(kind, physicsClientId=self._client, **sizes))

    def __del__(self) -> None:
        self._bullet.disconnect(self._client)
