"""Rigid groups of a model: frames that never move in each other, and the coordinates between groups."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from kineverse.compilation.function import compile as compile_expressions
from kineverse.geometry.mesh_files import Floats
from kineverse.lie import inverse, log_so3, unit_vector
from kineverse.model.body import is_empty_body
from kineverse.model.frame import WORLD
from kineverse.model.frame_dependence import moving_symbols
from kineverse.model.model_view import ModelView
from kineverse.state import State
from kineverse.symbols import Symbol

STEP = 1e-4
"""Step of a coordinate over which a motion is differenced [rad], [m].

The error of the axis is about the step times the change of the axis, and rounding over the step, 1e-12.
"""

STILL = 1e-6
"""Turn or shift by a unit of the coordinate that counts as none [rad], [m].

A spindle shifts its nut by 1e-4 m/rad. Loops are closed to 1e-11, which STEP makes 1e-7.
"""

SAME_AXIS = 1e-3  # tilt, and offset over the size of the part, of two axes that count as one


@dataclass(frozen=True)
class RigidGroup:
    """Frames that move as one, the first of them in the carrier."""

    number: int
    frame: str  # the frame that moves in its parent; that of the group at rest is the world
    parent: str  # its parent, a frame of the carrier
    carrier: int  # number of the group that carries it; -1 for the group at rest
    coordinates: tuple[Symbol, ...]  # those that move it in its carrier
    bodies: tuple[str, ...]  # frames of it with shapes or inertia
    joint: str  # name of the articulation whose child it is; that of the frame without one
    is_child: bool  # True for the child of an articulation, False for another frame that it writes


@dataclass(frozen=True)
class Axis:
    """Velocity of points p by a coordinate: turn · direction × (p - point) + shift · direction."""

    direction: Floats  # (3,) unit vector; of a motion without a turn, that of the shift
    point: Floats  # (3,) a point of the axis [m]
    turn: float  # by a unit of the coordinate [rad]
    shift: float  # along the direction by a unit of the coordinate [m]

    @property
    def rate(self) -> float:
        """Turn by a unit of the coordinate [rad]; of a motion without one, shift [m]."""
        return self.turn or self.shift


class RigidGroups(Sequence[RigidGroup]):
    """All rigid groups of a model, carriers first; number 0 is the group at rest."""

    def __init__(self, model: ModelView) -> None:
        self.model = model
        coordinates = model.degrees_of_freedom
        moves = moving_symbols(model, coordinates)
        joints = {record.child: name for name, record in model.articulations.items()}
        frames = dict(model.frames)
        number = {WORLD: 0}
        members: list[list[str]] = [[WORLD]]
        heads: list[tuple[str, str, int, tuple[Symbol, ...]]] = [(WORLD, "", -1, ())]
        for name in frames:
            above = []
            while name not in number:
                above.append(name)
                name = frames[name].parent
            for frame in reversed(above):
                parent = frames[frame].parent
                if frame in moves:
                    number[frame] = len(heads)
                    heads.append((frame, parent, number[parent], moves[frame]))
                    members.append([])
                else:
                    number[frame] = number[parent]
                members[number[frame]].append(frame)
        self.number = number  # of the group of each frame
        bodies = {name for name, body in model.bodies.items() if not is_empty_body(body)}
        self._groups = [
            RigidGroup(
                number=k,
                frame=frame,
                parent=parent,
                carrier=carrier,
                coordinates=by,
                bodies=tuple(f for f in members[k] if f in bodies),
                joint=joints.get(frame, frame),
                is_child=frame in joints,
            )
            for k, (frame, parent, carrier, by) in enumerate(heads)
        ]
        poses = [model.fk(group.frame, self._groups[group.carrier].frame) for group in self._groups[1:]]
        self._poses: Any = compile_expressions(poses, tier="interpreter") if poses else None

    def __len__(self) -> int:
        return len(self._groups)

    def __getitem__(self, index: int) -> RigidGroup:  # type: ignore[override]
        return self._groups[index]

    def moved_by(self, coordinate: Symbol) -> Iterator[RigidGroup]:
        """Yield the groups that a coordinate moves in their carriers."""
        return (group for group in self._groups if coordinate in group.coordinates)

    def subtree(self, group: RigidGroup) -> Iterator[RigidGroup]:
        """Yield a group and all that it carries."""
        inside = {group.number}
        for other in self._groups[group.number :]:
            if other.number in inside or other.carrier in inside:
                inside.add(other.number)
                yield other

    def coordinates_between(self, one: RigidGroup, other: RigidGroup) -> set[Symbol]:
        """Return the coordinates that move two groups in each other."""
        ways: list[dict[int, RigidGroup]] = []
        for group in (one, other):
            way: dict[int, RigidGroup] = {}
            while group.carrier >= 0:
                way[group.number] = group
                group = self._groups[group.carrier]
            ways.append(way)
        return {s for k in ways[0].keys() ^ ways[1].keys() for s in (ways[0] | ways[1])[k].coordinates}

    def axis(self, group: RigidGroup, coordinate: Symbol, state: State) -> Axis | None:
        """Return the axis of a group's motion in its carrier at a state; None if it does not move there."""
        value = state[coordinate]
        before, after = (
            self._poses(state.updated({coordinate: value + step}))[group.number - 1] for step in (-STEP, STEP)
        )
        motion = after @ inverse(before)
        turn = log_so3(motion[:3, :3]) / (2 * STEP)
        # The velocity of the point at the middle of the step, which differences give to second order.
        middle = (before[:3, 3] + after[:3, 3]) / 2
        velocity = (after[:3, 3] - before[:3, 3]) / (2 * STEP)
        speed = float(np.linalg.norm(turn))
        if speed < STILL:
            length = float(np.linalg.norm(velocity))
            if length < STILL:
                return None
            return Axis(velocity / length, middle, 0.0, length)
        direction = unit_vector(turn)
        return Axis(
            direction, middle + np.cross(turn, velocity) / speed**2, speed, float(direction @ velocity)
        )

    def pose(self, group: RigidGroup, state: State) -> Floats:
        """Return the pose of a group in its carrier at a state, (4, 4) [m]."""
        pose: Floats = self._poses(state)[group.number - 1]
        return pose
