"""Forward kinematics of a USD stage: the tree of its joints, from what OpenUSD's parser reads.

OpenUSD places joints and has no kinematics of its own. So this is ours on its parser, which proves less than
an engine does: that joints, frames, axes and units are written as the schema says, not that a simulator moves
so.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from kineverse._checks import finite_number
from kineverse.errors import FormatError, InvalidValueError, UnknownNameError, suggest
from kineverse.formats.description import DisjointSets, Matrix
from kineverse.formats.engines import PoseEngine
from kineverse.formats.xml_reader import quote
from kineverse.lie import (
    inverse,
    log_so3,
    quaternion,
    rotation_angle,
    rotation_x,
    rotation_y,
    rotation_z,
    to_quaternion,
    transform,
    translation,
)
from kineverse.model.body import Pose
from kineverse.model.registry import FrameDeviation

from .pxr_api import ROTATIONS, TRANSLATIONS, open_stage, pxr
from .scene import BALL, IN_WORLD, UsdBody, UsdJoint, UsdScene, read_scene

_TURNS = (rotation_x, rotation_y, rotation_z)
_FREE = ("x", "y", "z", "qx", "qy", "qz", "qw")


def stage_poses(
    path: str | os.PathLike[str],
    coordinates: Mapping[str, float],
    roots: Mapping[str, Matrix] | None = None,
) -> dict[str, Matrix]:
    """Compute the poses of all bodies and named frames of a USD file in the world, by their names.

    Parameters
    ----------
    path
        File of USD.
    coordinates
        Position of each joint by its name [rad], [m]; of a ball ``name/qx`` … ``name/qw``. Joints without
        one are at 0, those that mimic follow. Joints that close a loop, or move a kinematic body, are passed
        over.
    roots
        Poses (4, 4) in the world of bodies that no joint carries, by name; by default those on the stage, or
        those of the coordinates of their free motion where the stage names it.

    Raises
    ------
    FormatError
        If the file cannot be read, or its joints are no tree.
    UnknownNameError
        If there is no such coordinate or body.
    ShapeError, InvalidValueError
        If a position is not a finite number, or a pose not a rigid transform.

    Examples
    --------
    >>> result = kv.load("shelf_door").save("shelf.usda")
    >>> poses = kv.formats.usd.stage_poses("shelf.usda", {"shelf_door/door": 0.5})
    >>> poses["shelf_door/door"][:3, 0].round(3)
    array([-0.878, -0.479,  0.   ])
    """
    file = Path(path)
    tree = StagePoses(read_scene(open_stage(file), file.name))
    for name, value in coordinates.items():
        if not isinstance(name, str) or name not in tree.coordinates:
            raise UnknownNameError(
                f"No joint of {file.name} has the coordinate {name!r}. {suggest(str(name), tree.coordinates)}"
            )
        if finite_number(value) is None:
            raise InvalidValueError(f"The position of '{name}' is a finite number, not {value!r:.60}.")
    return tree.at(coordinates, {name: Pose.from_matrix(pose).matrix for name, pose in (roots or {}).items()})


class StagePoses:
    """Tree of the joints of a scene, and the poses that it gives to bodies and frames."""

    def __init__(self, scene: UsdScene) -> None:
        self._scene = scene
        self._order = tuple(_tree(scene))
        self.still = {path for path, body in scene.bodies.items() if body.is_kinematic}
        for _, near, far in self._order:
            if near in self.still:
                self.still.add(far)
        free = [f"{body.free}/{c}" for body in scene.bodies.values() if body.free for c in _FREE]
        self.coordinates = (
            *(name for joint, *_ in self._order for one in joint.freedoms for name in one.coordinates),
            *free,
        )

    def at(
        self, coordinates: Mapping[str, float], roots: Mapping[str, Matrix] | None = None
    ) -> dict[str, Matrix]:
        """Return the poses in the world, by name; see :func:`stage_poses`. Other coordinates are ignored."""
        scene, given = self._scene, dict(roots or {})
        poses: dict[str, Matrix] = {IN_WORLD: np.eye(4)}
        carried = {child for _, _, child in self._order}
        for path, body in scene.bodies.items():
            if path not in carried:
                placed = given.pop(body.name, None)
                poses[path] = _free_pose(body, coordinates) if placed is None else placed
        if given:
            names = [body.name for path, body in scene.bodies.items() if path not in carried]
            name = next(iter(given))
            raise UnknownNameError(f"No free body of the stage is {name!r}. {suggest(name, names)}")
        by_path = {joint.path: joint for joint in scene.joints}
        for joint, parent, child in self._order:
            motion = joint.pose0 @ _motion(joint, coordinates, by_path) @ inverse(joint.pose1)
            poses[child] = poses[parent] @ (motion if parent == joint.body0 else inverse(motion))
        result: dict[str, Matrix] = {body.name: poses[path] for path, body in scene.bodies.items()}
        result |= {frame.name: poses[frame.body] @ frame.pose for frame in scene.frames}
        return result

    def closures(self) -> dict[str, FrameDeviation]:
        """Return the gap of each joint that closes a loop, where the bodies are on the stage."""
        world = {IN_WORLD: np.eye(4)} | {path: body.pose for path, body in self._scene.bodies.items()}
        found: dict[str, FrameDeviation] = {}
        for joint in self._scene.joints:
            if joint.is_excluded and all(one.kind == BALL for one in joint.freedoms):
                near, far = world[joint.body0] @ joint.pose0, world[joint.body1] @ joint.pose1
                turn = inverse(near)[:3, :3] @ far[:3, :3]
                angle = 0.0 if joint.freedoms else float(rotation_angle(turn))
                found[joint.name] = FrameDeviation(float(np.linalg.norm(near[:3, 3] - far[:3, 3])), angle)
        return found


class UsdEngine(PoseEngine):
    """USD in OpenUSD, whose parser places bodies and joints; the forward kinematics are ours.

    Kinematic bodies, which no joint moves, and what they carry have no poses here.
    """

    name, package, distribution = "usd-core", "pxr", "usd-core"
    equal = 1e-6  # joints are in single precision

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        scene = read_scene(open_stage(path), path.name)
        self._tree = StagePoses(scene)
        still = self._tree.still
        self.frames = [body.name for place, body in scene.bodies.items() if place not in still]
        self.frames += [frame.name for frame in scene.frames if frame.body not in still]
        self.skipped = {body.name for place, body in scene.bodies.items() if place in still}
        self.skipped |= {frame.name for frame in scene.frames if frame.body in still}
        self.remarks = ["usd-core reads the file, and has no kinematics: these are of Kineverse"]
        self.remarks += [
            f"no joint of the file moves '{scene.bodies[place].name}': it is not compared" for place in still
        ]

    @classmethod
    def require(cls) -> Any:
        """Import OpenUSD and the schemas of Newton; raise if one is missing."""
        return pxr()

    def poses(self, values: Mapping[str, float]) -> Matrix:
        """Return the poses of all bodies and frames."""
        placed = self._tree.at(values)
        return np.array([placed[name] for name in self.frames]).reshape(-1, 4, 4)

    def closures(self) -> Mapping[str, FrameDeviation]:
        """Return the gap of each joint that closes a loop, where the bodies are on the stage."""
        return self._tree.closures()


_SAME_PLACE = 1e-3  # largest residual [m], [rad] of a joint whose bodies are where it can hold them


def positions_on_stage(scene: UsdScene) -> dict[str, float]:
    """Return the positions of all coordinates where the bodies are on the stage, by their names.

    A joint whose bodies are elsewhere than it can hold them has none.
    """
    found: dict[str, float] = {}
    world = {IN_WORLD: np.eye(4)} | {path: body.pose for path, body in scene.bodies.items()}
    for joint in scene.joints:
        near, far = world[joint.body0] @ joint.pose0, world[joint.body1] @ joint.pose1
        motion = inverse(near) @ far
        values: dict[str, float] = {}
        turn = log_so3(motion[:3, :3])
        for freedom in joint.freedoms:
            if freedom.kind == BALL:
                values |= zip(freedom.coordinates, to_quaternion(motion[:3, :3]).tolist(), strict=True)
            elif freedom.kind in TRANSLATIONS:
                values[freedom.name] = float(motion[TRANSLATIONS.index(freedom.kind), 3])
            else:
                angle = float(turn[ROTATIONS.index(freedom.kind)])
                turns = (angle, angle + math.tau, angle - math.tau)  # the one within limits
                inside = (x for x in turns if freedom.lower - _SAME_PLACE <= x <= freedom.upper + _SAME_PLACE)
                values[freedom.name] = next(inside, angle)
        alone = replace(joint, mimic=None)
        if np.abs(_motion(alone, values, {}) - motion).max() < _SAME_PLACE:
            found |= values
    return found


def _tree(scene: UsdScene) -> Iterator[tuple[UsdJoint, str, str]]:
    """Yield the joints from the world and the free bodies outwards, each with the near and the far body."""
    connected = DisjointSets()
    at: dict[str, list[UsdJoint]] = {}
    children: set[str] = set()
    still = [IN_WORLD, *(path for path, body in scene.bodies.items() if body.is_kinematic)]
    free = [path for path, body in scene.bodies.items() if body.free]
    for path in (*still, *free):
        connected.union("world", path or "world")
    # Those that are excluded from the articulation close loops, unless nothing else carries a body.
    for joint in sorted(scene.joints, key=lambda joint: joint.is_excluded):
        if joint.body0 in still and joint.body1 in still:
            continue
        if not connected.union(joint.body0 or "world", joint.body1 or "world"):
            if joint.is_excluded:
                continue
            raise FormatError(
                f"{joint.path} closes a loop. Exclude it from the articulation (excludeFromArticulation)."
            )
        at.setdefault(joint.body0, []).append(joint)
        at.setdefault(joint.body1, []).append(joint)
        children.add(joint.body1)
    visited: set[str] = set()
    # First those that nothing carries; where all have parents, at the first of the bodies.
    for start in (*still, *free, *(path for path in scene.bodies if path not in children), *scene.bodies):
        stack = [] if start in visited else [start]
        visited.add(start)
        while stack:
            near = stack.pop()
            for joint in at.get(near, ()):
                far = joint.body1 if joint.body0 == near else joint.body0
                if far not in visited:
                    visited.add(far)
                    stack.append(far)
                    yield joint, near, far


def _free_pose(body: UsdBody, values: Mapping[str, float]) -> Matrix:
    """Return the pose of a body that nothing carries: that on the stage, moved from home."""
    names = [f"{body.free}/{c}" for c in _FREE]
    if not body.free or not body.home or not any(name in values for name in names):
        return body.pose
    there = [float(values.get(name, x)) for name, x in zip(names, body.home, strict=True)]
    moves = [transform(quaternion(np.array(v[3:])), np.array(v[:3])) for v in (list(body.home), there)]
    result: Matrix = body.pose @ inverse(moves[0]) @ moves[1]
    return result


def _motion(joint: UsdJoint, values: Mapping[str, float], by_path: Mapping[str, UsdJoint]) -> Matrix:
    """Return the motion of a joint: slides first, then the turn."""
    offset, turn = np.zeros(3), np.eye(3)
    for freedom in joint.freedoms:
        if freedom.kind == BALL:
            names = zip(freedom.coordinates, (0.0, 0.0, 0.0, 1.0), strict=True)
            turn = quaternion(np.array([float(values.get(name, rest)) for name, rest in names]))
            continue
        amount = _position(joint, freedom.name, values, by_path)
        if freedom.kind in TRANSLATIONS:
            offset = offset + amount * np.eye(3)[TRANSLATIONS.index(freedom.kind)]
        else:
            turn = _TURNS[ROTATIONS.index(freedom.kind)](np.array(amount))
    result: Matrix = translation(offset) @ transform(turn, np.zeros(3))
    return result


def _position(
    joint: UsdJoint, name: str, values: Mapping[str, float], by_path: Mapping[str, UsdJoint]
) -> float:
    factor, offset, followers = 1.0, 0.0, [joint.path]
    while joint.mimic is not None:
        factor, offset = factor * joint.mimic.multiplier, offset + factor * joint.mimic.offset
        joint = by_path[joint.mimic.leader]
        if joint.path in followers:
            raise FormatError(f"{quote(joint.path)} follows itself.")
        followers.append(joint.path)
        name = joint.freedoms[0].name
    return factor * float(values.get(name, 0.0)) + offset
