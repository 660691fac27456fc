"""Arm among static boxes: the workload of distance queries."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kineverse.geometry import Rule
from kineverse.lie import Array
from kineverse.model.body import Body, Box, Capsule, Geometry, Mesh, Pose, Shape
from kineverse.model.model import Model
from kineverse.spatial import rotation_x, rotation_y, rotation_z, translation
from kineverse.symbols import position

LINKS, RADIUS = 20, 0.1
"""Number of links of the arm, and radius of the queries [m]."""

KINDS = ("hull", "box", "capsule")
"""Shapes of the links, in cyclic order."""

LINK_LENGTH = 0.1
CAPSULE_SIZE = 0.03, 0.06
"""Radius of a capsule, and distance between the centres of its ends [m]."""

BOX_SIZE = 0.06, 0.07, 0.09
"""Edges of a link that is a box [m]."""

# Least distances of the first boxes and of others from the middles of links, so that nothing touches [m].
_CLEARANCE, _FAR = 0.12, 0.6
_BOXES_NEAR_ARM = 60
# Amplitude of each joint, in steps of about a tenth of it [rad].
_STEP_ANGLE = 0.02


@dataclass(frozen=True, eq=False)
class Clutter:
    """Arm of hulls, boxes and capsules that moves in small steps among static boxes."""

    corners: list[Array]  # corners of each link's hull, (24, 3) [m]; used by every third link
    sizes: Array  # edges of the boxes (N, 3) [m], and their poses (N, 4, 4)
    poses: Array
    angles: Array  # joint angles of the steps, (steps, 20) [rad]

    def kind(self, link: int) -> str:
        """Return the kind of shape of a link."""
        return KINDS[link % len(KINDS)]

    def axis(self, link: int) -> tuple[int, int, int]:
        """Return the axis of the joint of a link, at the end of the link before."""
        return ((0, 0, 1), (0, 1, 0))[link % 2]

    def model(self, folder: Path) -> Model:
        """Return the model of arm and boxes; hulls are written to files in a folder."""
        model = Model()
        with model.edit() as edit:
            parent = "world"
            for link in range(LINKS):
                turn = (rotation_z, rotation_y)[link % 2](position(f"joint{link:02}"))
                there = translation(0, 0, LINK_LENGTH if link else 0.0) @ turn
                edit.add_frame(f"link{link}", parent, there, _make_body(self._geometry(link, folder)))
                parent = f"link{link}"
            for k, (size, pose) in enumerate(zip(self.sizes.tolist(), self.poses, strict=True)):
                edit.add_frame(f"box{k}", "world", pose, Body(collisions=(Shape(Box(tuple(size))),)))
        return model

    def _geometry(self, link: int, folder: Path) -> Geometry:
        kind = self.kind(link)
        if kind == "box":
            return Box(BOX_SIZE)
        if kind == "capsule":
            return Capsule(*CAPSULE_SIZE)
        corners = self.corners[link]
        lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in corners.tolist()]
        lines += [f"f {k} {k + 1} {k + 2}" for k in range(1, len(corners) - 1)]
        (folder / f"link{link}.obj").write_text("\n".join(lines), encoding="utf-8")
        return Mesh(f"link{link}.obj", folder=str(folder))


RULES = (Rule("link*", "link*", why="only boxes are of interest here"),)

CENTRE = 0.0, 0.0, LINK_LENGTH / 2
"""Position of the centre of a link's shape in its frame [m]."""


def make_clutter(boxes: int = _BOXES_NEAR_ARM, steps: int = 200, seed: int = 0) -> Clutter:
    """Return an arm among boxes, the same for equal arguments.

    The first 60 boxes stand along the arm. Others stand further away, with a density independent of their
    number.
    """
    rng = np.random.default_rng(seed)
    corners = [_round_to_float32(rng.normal(size=(24, 3)) * (0.02, 0.02, 0.028)) for _ in range(LINKS)]
    home = rng.uniform(-0.35, 0.35, LINKS)
    phases = rng.uniform(0, 2 * np.pi, LINKS) + np.outer(np.arange(steps), rng.uniform(0.05, 0.15, LINKS))
    angles = home + _STEP_ANGLE * np.sin(phases)
    arm, random = _link_centres(home), np.random.default_rng(seed + 1)
    span = 1.0 + 0.2 * boxes ** (1 / 3)
    sizes, poses = np.empty((boxes, 3)), np.empty((boxes, 4, 4))
    for k in range(boxes):
        clear = _CLEARANCE if k < _BOXES_NEAR_ARM else _FAR
        while True:
            size, (yaw, roll) = (
                _round_to_float32(random.uniform(0.05, 0.2, 3)),
                random.uniform(-3, 3, 2).tolist(),
            )
            pose = (rotation_z(yaw) @ rotation_x(roll))()
            if k < _BOXES_NEAR_ARM:
                offset = random.normal(size=3)
                offset *= random.uniform(0.15, 0.28) / np.linalg.norm(offset)
                pose[:3, 3] = arm[random.integers(LINKS)] + offset
            else:
                pose[:3, 3] = arm.mean(axis=0) + random.uniform(-span, span, 3)
            if _clearance(arm, size, pose) > clear:
                break
        sizes[k], poses[k] = size, pose
    return Clutter(corners, sizes, poses, angles)


def _link_centres(angles: Array) -> Array:
    """Return the centres of the links at joint angles, (20, 3)."""
    pose, centres = np.eye(4), []
    for link, angle in enumerate(angles.tolist()):
        turn = (rotation_z, rotation_y)[link % 2](angle)
        pose = pose @ translation(0, 0, LINK_LENGTH if link else 0.0)() @ turn()
        centres.append(pose[:3] @ (*CENTRE, 1.0))
    return np.array(centres)


def _clearance(points: Array, size: Array, pose: Array) -> float:
    inside = (points - pose[:3, 3]) @ pose[:3, :3]
    return float(np.linalg.norm(np.maximum(np.abs(inside) - size / 2, 0.0), axis=1).min())


def _round_to_float32(numbers: Array) -> Array:
    """Round numbers to single precision, like MuJoCo those of meshes."""
    return numbers.astype(np.float32).astype(np.float64)


def _make_body(geometry: Geometry) -> Body:
    return Body(collisions=(Shape(geometry, Pose.from_matrix(translation(*CENTRE)())),))
