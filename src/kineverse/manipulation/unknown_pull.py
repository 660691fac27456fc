"""Pulling of a held part: straight while nobody knows how it moves, then along the joint that was learned."""

from __future__ import annotations

import math

import numpy as np

from kineverse.control import Controller, Goal, Hold, Target, same_pose
from kineverse.control.command import Command
from kineverse.errors import InvalidValueError
from kineverse.estimation import Fit
from kineverse.geometry import Rule, Scene
from kineverse.lie import Array, inverse
from kineverse.model.model import Model
from kineverse.state import State
from kineverse.symbols import Symbol

from .hand_motion import HandMotion
from .part_looks import PartBelief
from .unknown_part import JointProjection, write_joint

PULL_SPEED = 0.05
"""Speed of the straight pull [m/s]."""
_HAND_SPEED, _TURN_SPEED = 0.1, 0.3
"""Largest speeds of the handle along a learned joint [m/s], [rad/s]."""
_GAIN = 5.0
"""Rate at which errors of the hand's place on the part decay [1/s]."""
_RAMP = 0.5
"""Time in which the pull begins [s]."""
_MARGIN = 0.002
"""Least distance of bodies while the part moves [m]."""


class StraightPull:
    """Pull along the outward normal of a handle, while the hand follows the part as it is seen.

    The hand holds its place on the part, shifted ahead by speed / gain along the normal. So a part that does
    not follow stops the hand after a centimetre, and the hand yields to any other motion of the part.

    Parameters
    ----------
    motion
        Motions of the hand.
    belief
        Belief about the part.
    bar_T_hand
        Place (4, 4) of the hand on the handle.
    """

    def __init__(self, motion: HandMotion, belief: PartBelief, bar_T_hand: Array) -> None:
        self.motion, self.bar_T_hand = motion, bar_T_hand
        model, unknown = motion.model, belief.unknown
        hand, bar = model.fk(motion.gripper.hand), model.fk(motion.handle.frame)
        self._place = Target("pull/place", bar_T_hand)
        hold = Hold(same_pose(bar @ self._place.expression, hand), gain=_GAIN, name="grasp")
        still = [*motion.search.standing, *motion.gripper.joints, unknown.handle.coordinate]
        self._controller = _make_controller(motion, model, [hold], [*still, *unknown.floating])
        self._begin = motion.session.world.time

    def step(self) -> Command:
        """Return the command of a step."""
        session = self.motion.session
        share = min(1.0, (session.world.time - self._begin) / _RAMP)
        place = self.bar_T_hand.copy()
        place[:3, 3] += share * PULL_SPEED / _GAIN * self.motion.handle.pose[:3, 0]
        self._controller.set(self._place, place)
        return self._controller.step(session.state)


class LearnedPull:
    """Motion of the hand with a part along its joint in a model.

    Parameters
    ----------
    motion
        Motions of the hand.
    belief
        Belief about the part.
    model
        Model with a joint of the part; another one than that of the motions.
    bar_T_hand
        Place (4, 4) of the hand on the handle.
    parent
        Frame of the model in which the joint alone moves the part.
    opened, direction
        Wanted distance from the first pose of the part [m], [rad], and the sign of the motion.
    first
        First pose (4, 4) of the part relative to what it moves in.

    Attributes
    ----------
    coordinate
        Coordinate of the joint.
    value
        Its present value [m], [rad].
    """

    def __init__(
        self,
        motion: HandMotion,
        belief: PartBelief,
        model: Model,
        bar_T_hand: Array,
        first: Array,
        opened: float,
    ) -> None:
        self.motion, self.belief, self.model = motion, belief, model
        unknown = belief.unknown
        parent = belief.beside or "world"
        self._projection = JointProjection(model, unknown.frame, parent)
        self.coordinate = self._projection.coordinate
        start = self._projection.project(first, 0.0)
        self.value = self._projection.project(belief.relative_pose, start)
        self.direction = math.copysign(1.0, self.value - start)
        self.start, self.end = start, start + self.direction * opened
        hand, bar = model.fk(motion.gripper.hand), model.fk(motion.handle.frame)
        hold = Hold(same_pose(bar @ bar_T_hand, hand), gain=_GAIN, name="grasp")
        lever = self._lever(first)
        speed = min(_TURN_SPEED if lever < 0.999 or lever > 1.001 else _HAND_SPEED, _HAND_SPEED / lever)
        goal = Goal(self.coordinate, self.end, speed=speed, name="object")
        still: list[Symbol] = [*motion.search.standing, *motion.gripper.joints]
        self._controller = _make_controller(motion, model, [hold, goal], still)

    def _lever(self, first: Array) -> float:
        """Return the way of the handle by the coordinate [m/rad], or 1 of a drawer."""
        bar = self.model.fk(self.motion.handle.frame, self.belief.beside or "world")
        a, b = (bar({self.coordinate: v})[:3, 3] for v in (self.value, self.value + 1e-3))
        return max(float(np.linalg.norm(b - a)) / 1e-3, 1e-2)

    @property
    def progress(self) -> float:
        """Distance from the first value [m], [rad]."""
        return self.direction * (self.value - self.start)

    def update(self) -> None:
        """Project the believed pose of the part onto the joint."""
        self.value = self._projection.project(self.belief.relative_pose, self.value)
        self.belief.extra = {self.coordinate: self.value}

    def step(self) -> Command:
        """Return the command of a step."""
        self.update()
        state = self.motion.session.state | State({self.coordinate: self.value})
        return self._controller.step(state)


def learn_model(model: Model, belief: PartBelief, fit: Fit) -> Model:
    """Return a copy of a model with a joint that was learned, in which the furniture stands where it is seen."""
    copy = model.copy()
    place_beside(copy, belief)
    write_joint(copy, belief.unknown.frame, fit, belief.beside or "world")
    return copy


def place_beside(model: Model, belief: PartBelief) -> None:
    """Put the furniture that carries the part where it is seen.

    Raises
    ------
    InvalidValueError
        If joints move it, so that there is no frame to put elsewhere.
    """
    if belief.beside is None:
        return
    if model.fk(belief.beside).symbols:
        raise InvalidValueError(
            f"'{belief.beside}' is moved by joints itself; name a frame that stands still as beside=."
        )
    top = belief.beside
    while model.frames[top].parent != "world":
        top = model.frames[top].parent
    pose = belief.reference_pose @ inverse(model.fk(belief.beside)({})) @ model.fk(top)({})
    with model.edit() as edit:
        edit.attach(top, "world", pose, f"seen {top}")


def _make_controller(motion: HandMotion, model: Model, tasks: list[Hold | Goal], still: list[Symbol]) -> Controller:
    """Return a controller with rows for near bodies, in which the hand may touch the handle."""
    rules = [Rule(b, motion.handle.frame, False, "grasped") for b in motion.gripper.bodies]
    with motion.session.timed("plan"):
        scene = Scene(model, rules=[*motion.search.scene.rules, *rules])
        return Controller(model, tasks, dt=motion.session.dt, still=still, scene=scene, margin=_MARGIN)
