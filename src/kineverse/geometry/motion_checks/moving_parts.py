"""Moving parts of a model: their shapes, axes and ranges, for the checks of single coordinates."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from kineverse.errors import FormatError, InvalidValueError, NoSolutionError
from kineverse.formats.partnet.description import NORMALIZED
from kineverse.geometry.exclusions import find_unusable_shapes
from kineverse.geometry.mesh_files import Floats
from kineverse.geometry.objects import collision_shapes
from kineverse.geometry.scene import Scene
from kineverse.model.model_view import ModelView
from kineverse.state import State
from kineverse.symbols import Symbol

from .part_shape import PartShape, shape_points
from .rigid_groups import SAME_AXIS, Axis, RigidGroup, RigidGroups

STATES = 25  # states in which a coordinate is looked at: steps of 4° for a door, of 2 cm for a drawer

LARGEST_ANGLE, LARGEST_TRAVEL = 720.0, 2e4
"""Limits beyond which numbers stand for no limit: two turns in degrees, a house in millimetres [rad], [m]."""

ROBOT_CHAIN = 3
"""Least number of moving parts in a row that are links of a robot; furniture has a door and its handle.

Robots have empty links, and shapes that stand for half of a link, so less is certain about them.
"""


class MovingParts:
    """Rigid groups of a model with their shapes, and its scene."""

    def __init__(self, model: ModelView) -> None:
        self.model = model
        self.groups = RigidGroups(model)
        self.default = model.default_state()
        self.unusable = find_unusable_shapes(model)
        self.scene = Scene(model, leave_out=self.unusable)
        self.scene.update(self.default)
        self.solid_bodies = frozenset(self.scene.bodies)  # those that have usable shapes
        self.is_normalized = any(
            (name == NORMALIZED or name.endswith(f"/{NORMALIZED}")) and bool(value)
            for name, value in model.data.items()
        )
        self._shapes: dict[int, PartShape] = {}
        self._bodies: dict[str, PartShape] = {}

    @cached_property
    def surfaces(self) -> Scene:
        """Scene of the triangles of all meshes, as they are drawn; they are read when they are asked for."""
        return Scene(self.model, leave_out=self.unusable, triangles=["*"])

    def body_shape(self, name: str) -> PartShape:
        """Return the shape of a body in its frame: what collides."""
        if name not in self._bodies:
            excluded = {number for body, number in self.unusable if body == name}
            shapes = collision_shapes(self.model.bodies[name])
            self._bodies[name] = PartShape(shape_points(s for k, s in enumerate(shapes) if k not in excluded))
        return self._bodies[name]

    def whole_shape(self, name: str) -> PartShape | None:
        """Return what collides and what is drawn of a body, in its frame; None if a file of it is missing."""
        body = self.model.bodies[name]
        try:
            return PartShape(shape_points((*body.collisions, *body.visuals)))
        except (FormatError, InvalidValueError, OSError):
            return None

    def solids(self, group: RigidGroup) -> list[str]:
        """Return the bodies of a group that have usable shapes."""
        return [body for body in group.bodies if body in self.solid_bodies]

    def shape(self, group: RigidGroup) -> PartShape:
        """Return the shape of a group in the world at the default state."""
        if group.number not in self._shapes:
            self._shapes[group.number] = self.shape_of(self.solids(group))
        return self._shapes[group.number]

    def shape_of(self, bodies: Sequence[str]) -> PartShape:
        """Return the shape of some bodies in the world at the default state."""
        placed = [self.body_shape(body).moved(self.default_pose(body)).points for body in bodies]
        return PartShape(np.concatenate([np.zeros((0, 3)), *placed]))

    def default_pose(self, body: str) -> Floats:
        """Return the pose of a body with shapes in the world at the default state, (4, 4)."""
        if body not in self._default_poses:
            self.scene.update(self.default)
            self._default_poses |= {name: self.scene.pose(name) for name in self.scene.bodies}
        return self._default_poses[body]

    @cached_property
    def _default_poses(self) -> dict[str, Floats]:
        return {}

    def group_pose(self, group: RigidGroup) -> Floats:
        """Return the pose of a group in the world at the default state, (4, 4)."""
        pose: Floats = np.eye(4)
        while group.carrier >= 0:
            pose = self.groups.pose(group, self.default) @ pose
            group = self.groups[group.carrier]
        return pose

    def has_missing_shapes(self, bodies: Sequence[str]) -> bool:
        """Return True if any shape of some bodies cannot be used."""
        return not {body for body, _ in self.unusable}.isdisjoint(bodies)

    @cached_property
    def _depths(self) -> list[int]:
        """Number of moving parts on the way from the world to each group; a locked joint moves nothing."""
        depths = [0]
        for group in list(self.groups)[1:]:
            limits = [self.model.limits(coordinate) for coordinate in group.coordinates]
            depths.append(depths[group.carrier] + any(lower != upper for lower, upper in limits))
        return depths

    def is_robot_link(self, group: RigidGroup) -> bool:
        """Return True if a group is in a chain of moving parts as long as those of robots."""
        return max(self._depths[part.number] for part in self.groups.subtree(group)) >= ROBOT_CHAIN

    def others(self, group: RigidGroup) -> list[str]:
        """Return the bodies with usable shapes that a group does not carry."""
        carried = {body for part in self.groups.subtree(group) for body in part.bodies}
        return [body for body in self.scene.bodies if body not in carried]


@dataclass(frozen=True)
class MovingPart:
    """Rigid group as one coordinate moves it in its carrier."""

    parts: MovingParts
    group: RigidGroup
    coordinate: Symbol

    @property
    def bodies(self) -> tuple[str, ...]:
        """Bodies of the part, at least its frame."""
        return self.group.bodies or (self.group.frame,)

    @property
    def carrier(self) -> RigidGroup:
        """The group in which it moves."""
        return self.parts.groups[self.group.carrier]

    @cached_property
    def solids(self) -> list[str]:
        """Bodies of the part with usable shapes."""
        return self.parts.solids(self.group)

    @property
    def shape(self) -> PartShape:
        """Shape of the part in the world at the default state."""
        return self.parts.shape(self.group)

    @property
    def size(self) -> float:
        """Largest edge of the box around the part [m]."""
        return self.shape.size

    @cached_property
    def is_robot_link(self) -> bool:
        """True for a link of a robot."""
        return self.parts.is_robot_link(self.group)

    @cached_property
    def limits(self) -> tuple[float, float]:
        """Limits of the coordinate, ±inf for none and for numbers that stand for none [rad], [m]."""
        lower, upper = self.parts.model.limits(self.coordinate)
        most = (LARGEST_ANGLE if self.turns else LARGEST_TRAVEL) / (self.axis.rate if self.axis else 1.0)
        return lower if lower >= -most else -math.inf, upper if upper <= most else math.inf

    @property
    def home(self) -> float:
        """Value of the coordinate at the default state."""
        return float(self.parts.default[self.coordinate])

    @cached_property
    def axis(self) -> Axis | None:
        """Axis in the frame of the carrier, at the default state or at a limit; None if it moves at none."""
        values = filter(math.isfinite, (self.home, *self.parts.model.limits(self.coordinate)))
        return next(filter(None, map(self._axis_at, values)), None)

    @cached_property
    def fixed_axis(self) -> Axis | None:
        """The axis in the world at the default state if it is the same over the whole range, else None."""
        lower, upper = self.range
        first = self.axis
        if first is None:
            return None
        for value in (lower + (upper - lower) * share for share in (0.25, 0.5, 0.75)):
            other = self._axis_at(value)
            if other is None or bool(first.turn) != bool(other.turn):
                return None
            offset = np.cross(first.direction, other.point - first.point) if first.turn else np.zeros(3)
            tilt = np.linalg.norm(np.cross(first.direction, other.direction))
            if tilt > SAME_AXIS or np.linalg.norm(offset) > SAME_AXIS * max(self.size, 1e-3):
                return None
        pose = self.parts.group_pose(self.carrier)
        direction, point = pose[:3, :3] @ first.direction, pose[:3, :3] @ first.point + pose[:3, 3]
        return Axis(direction, point, first.turn, first.shift)

    def _axis_at(self, value: float) -> Axis | None:
        try:
            state = self.parts.default.updated({self.coordinate: value})
            return self.parts.groups.axis(self.group, self.coordinate, state)
        except NoSolutionError:  # a loop that does not close there
            return None

    @property
    def turns(self) -> bool:
        """True if the coordinate turns the part."""
        return self.axis is not None and self.axis.turn > 0.0

    @cached_property
    def range(self) -> tuple[float, float]:
        """Range in which the part is looked at [rad], [m].

        Without a limit on a side, the part turns by half a turn, or moves by its size.
        """
        lower, upper = self.limits
        reach = (math.pi if self.turns else max(self.size, 1e-3)) / (self.axis.rate if self.axis else 1.0)
        lower = lower if math.isfinite(lower) else min(self.home, upper) - reach
        upper = upper if math.isfinite(upper) else max(self.home, lower) + reach
        return lower, upper

    def is_unlimited(self, state: State) -> bool:
        """Return True if no limit is on the side of a state."""
        return math.isinf(self.limits[state[self.coordinate] > self.home])

    def states(self, mirrored: bool = False) -> list[State]:
        """Return states over the range, or over its mirror image about the default."""
        ends = self.range
        if mirrored:
            ends = 2 * self.home - ends[1], 2 * self.home - ends[0]
        return [self.parts.default.updated({self.coordinate: v}) for v in np.linspace(*ends, STATES).tolist()]


def has_shapes(model: ModelView, bodies: Sequence[str]) -> bool:
    """Return True if any of some bodies has a shape, whether its file is there or not."""
    return any(body in model.bodies and collision_shapes(model.bodies[body]) for body in bodies)
