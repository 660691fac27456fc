"""Objects of the opening experiment: a folding cupboard door, a hinged door and a drawer, each on its own."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from kineverse.control import Hold, InverseKinematics, same_pose
from kineverse.errors import NoSolutionError
from kineverse.expressions.expression import Expression
from kineverse.geometry import Rule, Scene
from kineverse.manipulation.robot_sources import RobotSource
from kineverse.model.frame import WORLD
from kineverse.model.model import Model
from kineverse.spatial import rotation_z, rpy, translation
from kineverse.state import State
from kineverse.symbols import Symbol

PLACE = translation(1.0, 0.0, 0.7) @ rotation_z(0.57)
"""Pose of the object in the world; its front looks at the robot, along its -x."""
OBJECT, GRASP = "object", "grasp"

_STARTS, _SEEDS = 32, 8
_MARGIN = 0.005
_AREA = {"x": (-0.4, 0.5), "y": (-0.8, 0.4), "angle": (-0.8, 0.8)}


@dataclass(frozen=True)
class GraspedObject:
    """Object that is opened by its handle."""

    name: str
    source: str
    coordinate: str  # coordinate that is opened, without the prefix
    handle: str  # frame of the handle, without the prefix
    grasp: Expression  # pose handle_T_hand: x of the hand points out of it, its fingers close along y


_BAR_GRASP = translation(0.04, 0.0, 0.0) @ rpy(math.pi / 2, 0.0, math.pi)
# x of the folding door's handle points inward, and its plate is across z.
_PLATE_GRASP = translation(-0.04, 0.0, 0.0) @ rpy(math.pi / 2, 0.0, 0.0)

OBJECTS: Mapping[str, GraspedObject] = MappingProxyType(
    {
        one.name: one
        for one in (
            GraspedObject("folding door", "articulations/folding_door", "door", "door/handle", _PLATE_GRASP),
            GraspedObject("hinged door", "shelf_door", "door", "door_handle", _BAR_GRASP),
            GraspedObject("drawer", "shelf_drawers", "upper_drawer", "upper_drawer_handle", _BAR_GRASP),
        )
    }
)
"""Objects by name."""


@dataclass(frozen=True, eq=False)
class OpeningSetup:
    """Robot before an object."""

    robot: RobotSource
    thing: GraspedObject  # the robot, and the object
    model: Model
    what: Symbol  # coordinate of the object
    hand: Expression
    grasp: Expression

    @property
    def upper(self) -> float:
        """Largest value of the coordinate."""
        return float(self.model.limits(self.what)[1])

    def scene(self) -> Scene:
        """Return the collision scene, in which the gripper may touch the object."""
        gripper = self.robot.gripper(self.model)
        rules = [Rule(body, f"{OBJECT}/*") for body in gripper.bodies]
        return Scene(self.model, rules=[*rules, Rule(f"{OBJECT}/*", f"{OBJECT}/*")])

    def find_start(self, seed: int = 0) -> State:
        """Return a state with the hand at the grasp, the object shut and without contacts.

        Inverse kinematics begins at the robot's start for the seed 0, else at random positions nearby.
        """
        held = Hold(same_pose(self.grasp, self.hand), name="grasp")
        gripper = self.robot.gripper(self.model)
        scene = self.scene()
        opened = {str(s): value for s, value in gripper.opened.items()}
        values = self.robot.start_state(self.model).updated(opened)
        if seed:
            values = values.updated(self._draw_configuration(np.random.default_rng(seed)))
        solver = InverseKinematics(self.model, [held], still=[self.what], scene=scene, margin=_MARGIN)
        for more in range(_SEEDS):
            found = solver.solve(values, starts=_STARTS, seed=_SEEDS * seed + more)
            if found.solved:
                return found.best
        raise NoSolutionError(
            f"{self.robot.name} has no configuration at the handle of the {self.thing.name}."
        )

    def _draw_configuration(self, rng: np.random.Generator) -> dict[str, float]:
        """Return random positions of the arm within its limits, and of the base in front of the object."""
        base = {f"{self.robot.prefix}/base/{key}": area for key, area in _AREA.items()}
        drawn = {}
        for symbol in self.hand.symbols:
            name = str(symbol)
            lower, upper = base.get(name, self.model.limits(symbol))
            drawn[name] = float(rng.uniform(max(lower, -math.pi), min(upper, math.pi)))
        return drawn


def make_opening_setup(robot: RobotSource, thing: GraspedObject) -> OpeningSetup:
    """Return a robot before an object."""
    model = robot.load()
    with model.edit() as edit:
        edit.include(thing.source, OBJECT)
        roots = [
            f for f, placed in model.frames.items() if f.startswith(f"{OBJECT}/") and placed.parent == WORLD
        ]
        for root in roots:
            edit.attach(root, WORLD, PLACE)
        edit.add_frame(GRASP, f"{OBJECT}/{thing.handle}", thing.grasp)
    gripper = robot.gripper(model)
    what = model.symbol(f"{OBJECT}/{thing.coordinate}")
    hand = model.fk(gripper.hand) @ gripper.grasp_pose
    return OpeningSetup(robot, thing, model, what, hand, model.fk(GRASP))
