"""Robots that open the fridge of the shipped kitchen: base and arm, with the handle held."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from types import MappingProxyType

import numpy as np

from kineverse.control import Controller, Goal, Hold, InverseKinematics, same_pose
from kineverse.errors import NoSolutionError
from kineverse.formats import load
from kineverse.geometry import Rule, Scene
from kineverse.model.model import Model
from kineverse.spatial import rotation_y, rpy, translation
from kineverse.state import State

from .control_workloads import ControlWorkload
from .controller_loop import ControllerLoop

OPENING = "opening"
"""Name of the workload among those of peers."""

DOOR, GRASP = "kitchen/fridge_door", "grasp"
"""Joint of the door, and the frame on its handle that a gripper holds."""

GRIPPERS: Mapping[str, str] = MappingProxyType(
    {"pr2": "pr2/r_gripper_tool_frame", "fetch": "fetch/gripper_link", "hsr": "hsr/hand_palm_link"}
)
"""Frames of grippers by robot."""

_FINGERS = {"pr2": "pr2/r_gripper*", "fetch": "fetch/*gripper*", "hsr": "hsr/hand*"}

DOOR_GAIN, OPEN = 1.0, 1.5
"""Gain of the door's opening [1/s], and the angle [rad] from which the door counts as open."""

PERIOD, STEPS = 0.02, 250
"""Control period [s], and number of steps of an opening."""

CONTACTS, MARGIN, RADIUS = 24, 0.005, 0.15
"""Number of contact slots, the distance that pairs keep and the one from which they count [m].

Within this radius there are more pairs than slots, nearly all of the time.
"""

_STARTS, _SEEDS = 64, 20


@dataclass(frozen=True, eq=False)
class Opening:
    """Robot at the closed fridge."""

    robot: str
    model: Model  # the robot in the kitchen
    tasks: tuple[Hold, Goal]  # grasp, held; and opening of the door

    def scene(self) -> Scene:
        """Return the scene, in which only the gripper may touch the door, and the kitchen does not count."""
        fingers = _FINGERS[self.robot]
        pairs = (("kitchen/*", "kitchen/*"), (fingers, "kitchen/fridge_door*"), (fingers, fingers))
        return Scene(self.model, rules=[Rule(a, b) for a, b in pairs])

    def controller(self, scene: Scene | None = None) -> Controller:
        """Return the controller, with contact slots if there is a scene."""
        return Controller(
            self.model, self.tasks, dt=PERIOD, scene=scene, contacts=CONTACTS, margin=MARGIN, radius=RADIUS
        )

    def find_start(self, controller: Controller, scene: Scene | None = None) -> State:
        """Return a state at the handle, by inverse kinematics, from which the controller opens the door."""
        solver = InverseKinematics(
            self.model, self.tasks[:1], still=[DOOR], scene=scene, margin=2 * MARGIN if scene else 0.0
        )
        for seed in range(_SEEDS):
            found = solver.solve(starts=_STARTS, seed=seed)
            if found.solved and _opens(ControllerLoop(controller, found.best)):
                return found.best
        raise NoSolutionError(f"The {self.robot} opens the fridge from none of {_SEEDS} solutions.")


def _opens(loop: ControllerLoop) -> bool:
    """Return True if the door is open at the end."""
    for _ in range(STEPS):
        loop.step()
        loop.advance()
    return loop.state[loop.controller.model.symbol(DOOR)] >= OPEN


@cache
def make_opening(robot: str) -> Opening:
    """Return the workload of a robot, one of :data:`GRIPPERS`."""
    grasp = translation(0.04, 0.0, 0.0) @ rpy(np.pi / 2, 0.0, np.pi)
    if robot == "hsr":  # its palm points along z
        grasp = translation(0.08, 0.0, 0.0) @ rpy(np.pi / 2, 0.0, np.pi) @ rotation_y(np.pi / 2)
    model = load(robot)
    with model.edit() as edit:
        edit.include("kitchen", "kitchen")
        edit.add_frame(GRASP, "kitchen/fridge_door_handle", grasp)
    grasped = same_pose(model.fk(GRASP), model.fk(GRIPPERS[robot]))
    held = Hold(grasped, name="grasp", gain=0.5 / PERIOD)  # as of the peers
    return Opening(robot, model, (held, Goal(model.symbol(DOOR), np.pi / 2, name="door", gain=DOOR_GAIN)))


def peer_workload(opening: Opening, start: State, kept: Iterable[str] | None = None) -> ControlWorkload:
    """Return the workload for peers, from a start."""
    names = None if kept is None else set(kept)
    joints = opening.model.articulations.items()
    held = [
        name
        for name, joint in joints
        if names is not None
        and joint.kind != "fixed"
        and not names.intersection(symbol.path for symbol in joint.coordinates)
    ]
    positions = {
        symbol.path: value for symbol, value in start.items() if names is None or symbol.path in names
    }
    return ControlWorkload("", lambda: opening.model, positions, tuple(held), period=PERIOD, steps=STEPS)
