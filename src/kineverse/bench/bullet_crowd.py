"""Bullet's way to find what is near an arm among boxes."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from typing import Any

import numpy as np

from .agreement import Array
from .crowd import BOX, CAPSULE, CENTRE, LINK_LENGTH, LINKS, RADIUS, Crowd
from .crowd_peers import Found

_LINKS = 100
"""How many boxes are in one body: those of Bullet have a bounded number of links."""


class Bullet:
    """Bullet: getClosestPoints of the arm and of one body that has all boxes as links."""

    def __init__(self, crowd: Crowd) -> None:
        import pybullet

        self._bullet: Any = pybullet
        self._client = pybullet.connect(pybullet.DIRECT)
        shapes = [_link(pybullet, crowd, link, self._client) for link in range(LINKS)]
        links = [[0.0, 0.0, LINK_LENGTH if link else 0.0] for link in range(LINKS)]
        self._arm = _body(pybullet, shapes, links, None, crowd, range(LINKS), self._client)
        boxes = [
            pybullet.createCollisionShape(
                pybullet.GEOM_BOX, halfExtents=(size / 2).tolist(), physicsClientId=self._client
            )
            for size in crowd.sizes
        ]
        self._bodies = {}
        for first in range(0, len(boxes), _LINKS):
            some = slice(first, first + _LINKS)
            body = _body(
                pybullet,
                boxes[some],
                crowd.poses[some, :3, 3].tolist(),
                _quaternions(crowd.poses[some]),
                crowd,
                None,
                self._client,
            )
            self._bodies[body] = first
        self._joints = list(range(LINKS))
        self.found: list[Any] = []

    def put(self, angles: Array) -> None:
        """Move what moves."""
        rows = angles[:, None].tolist()
        self._bullet.resetJointStatesMultiDof(
            self._arm, self._joints, targetValues=rows, physicsClientId=self._client
        )

    def find(self) -> object:
        """Find what is near."""
        ask, arm, client = self._bullet.getClosestPoints, self._arm, self._client
        self.found = [ask(arm, body, RADIUS, physicsClientId=client) for body in self._bodies]
        return self.found

    def distances(self) -> Found:
        """Return what was found."""
        for contact in itertools.chain(*self.found):
            yield f"link{contact[3]}", f"box{self._bodies[contact[2]] + contact[4]}", contact[8]

    def __del__(self) -> None:
        self._bullet.disconnect(self._client)


def _link(pybullet: Any, crowd: Crowd, link: int, client: int) -> int:
    kind = crowd.kind(link)
    at = {"collisionFramePosition": list(CENTRE), "physicsClientId": client}
    if kind == "box":
        half = [edge / 2 for edge in BOX]
        return int(pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=half, **at))
    if kind == "capsule":
        radius, length = CAPSULE
        return int(pybullet.createCollisionShape(pybullet.GEOM_CAPSULE, radius=radius, height=length, **at))
    return int(pybullet.createCollisionShape(pybullet.GEOM_MESH, vertices=crowd.corners[link].tolist(), **at))


def _body(
    pybullet: Any,
    shapes: list[int],
    positions: list[list[float]],
    quaternions: list[list[float]] | None,
    crowd: Crowd,
    joints: Iterable[int] | None,
    client: int,
) -> int:
    count, nothing, upright = len(shapes), [0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]
    fixed, turning = pybullet.JOINT_FIXED, pybullet.JOINT_REVOLUTE
    return int(
        pybullet.createMultiBody(
            baseMass=0,
            linkMasses=[0.0 if joints is None else 1.0] * count,
            linkCollisionShapeIndices=shapes,
            linkVisualShapeIndices=[-1] * count,
            linkPositions=positions,
            linkOrientations=quaternions or [upright] * count,
            linkInertialFramePositions=[nothing] * count,
            linkInertialFrameOrientations=[upright] * count,
            linkParentIndices=[0] * count if joints is None else list(range(count)),
            linkJointTypes=[fixed if joints is None else turning] * count,
            linkJointAxis=[[0, 0, 1]] * count if joints is None else [list(crowd.axis(k)) for k in joints],
            physicsClientId=client,
        )
    )


def _quaternions(poses: Array) -> list[list[float]]:
    """Return (x, y, z, w) of (N, 4, 4) poses."""
    import mujoco

    found = []
    for pose in poses:
        w_first = np.empty(4)
        mujoco.mju_mat2Quat(w_first, pose[:3, :3].ravel())
        found.append([*w_first[1:].tolist(), float(w_first[0])])
    return found
