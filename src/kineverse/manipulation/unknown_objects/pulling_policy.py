"""Pulls of a part with an unknown joint: straight at first, then along the joint that is learned."""

from __future__ import annotations

import math

import numpy as np

from kineverse.control import Command, Goal, Hold, Target, same_pose
from kineverse.estimation import Fit
from kineverse.lie import Array, adjoint, exp_se3, inverse
from kineverse.manipulation.opening.arm_paths import row_at
from kineverse.manipulation.opening.hand_motion import HandMotion
from kineverse.manipulation.swept_volume import find_obstacle
from kineverse.model.model import Model
from kineverse.state import State

from .part_belief import PartBelief
from .unmodelled_joint import JointPath, place_frame, write_joint

_FIRST_SPEED, PULL_SPEED, _SPEED_UP = 0.02, 0.05, 0.04  # at first, and after a distance [m/s], [m]
PATH_SPEED = 0.1  # speed of the handle along a learned joint [m/s]
_BEYOND = 1.2  # place of the goal by the wanted opening: before a goal the motion slows down
_GAIN = 5.0  # rate at which errors of the hand's place on the part decay [1/s]
_STRAIGHT = 0.035  # distance after which the likeliest joint counts as much as the first direction [m]
_RAMP = 0.5  # time in which the pull begins [s]
_STEP = 0.03  # distance of the handle between two arms that are found for a learned joint [m]
_QUICK = 0.5  # speed from which on joints take their whole part [m/s], [rad/s]
_UNSURE = 0.01  # depth of obstacles along a learned joint, which is off by millimetres [m]


class StraightPull:
    """Pull straight at a handle, while the hand follows the part as it is seen.

    The hand holds its place on the part, shifted ahead by speed / gain along the direction. So a part that
    does not follow stops the hand after 4 mm, and the hand yields to any other motion of the part. The pull
    begins slowly, as nothing is known of the direction.
    """

    def __init__(
        self,
        motion: HandMotion,
        belief: PartBelief,
        bar_T_hand: Array,
        direction: tuple[float, float, float] = (1.0, 0.0, 0.0),
    ) -> None:
        self.motion, self.belief, self.bar_T_hand = motion, belief, bar_T_hand
        self._direction = motion.handle.pose[:3, :3] @ np.array(direction)
        model, unknown = motion.model, belief.unknown
        self._part_T_bar = np.asarray(model.fk(motion.handle.frame, unknown.frame)({}))
        self._place = Target("pull/place", bar_T_hand)
        hold = Hold(same_pose(motion.bar @ self._place.expression, motion.hand), gain=_GAIN, name="grasp")
        still = unknown.handle.coordinate, *unknown.floating
        self._controller = motion.holding_controller(model, [hold], still)
        self._time = 0.0  # of the pull, without the time in which the robot waits [s]
        self._point = motion.handle.pose[:3, 3]
        self.likely: JointPath | None = None

    def step(self, distance: float) -> Command:
        """Return the command of a step, after a distance of the handle [m]."""
        session = self.motion.session
        share = min(1.0, self._time / _RAMP)
        self._time += session.dt
        speed = _FIRST_SPEED + min(1.0, distance / _SPEED_UP) * (PULL_SPEED - _FIRST_SPEED)
        lead = share * speed / _GAIN
        twist = np.concatenate([self._direction, np.zeros(3)])
        if self.likely is not None:
            self.likely.project(self.belief.relative_pose)
            weight = distance**2 / (distance**2 + _STRAIGHT**2)
            led = adjoint(inverse(self._part_T_bar)) @ self.likely.twist()
            twist = (1.0 - weight) * twist + weight * led / point_speed(led, self._point)
        self._controller.set(self._place, exp_se3(lead * twist) @ self.bar_T_hand)
        return self._controller.step(session.state)


class LearnedPull:
    """Motion of the hand with a part along its joint in a model."""

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
        path, self.coordinate = JointPath.of_model(model, unknown.frame, belief.beside, first)
        path.project(belief.relative_pose)
        belief.path = self.path = path
        end = path.start + path.direction * _BEYOND * opened
        state = motion.session.state | State({self.coordinate: path.value})
        self.obstacle = find_obstacle(
            model, self.coordinate, state, path.start + path.direction * opened,
            robot=motion.search.robot, least=_UNSURE,
        )  # fmt: skip
        hand, bar = model.fk(motion.gripper.hand), model.fk(motion.handle.frame)
        hold = Hold(same_pose(bar @ bar_T_hand, hand), gain=_GAIN, name="grasp")
        twist = adjoint(inverse(model.fk(motion.handle.frame, unknown.frame)({}))) @ path.twist()
        speed = PATH_SPEED / point_speed(twist, motion.handle.pose[:3, 3])
        goal = Goal(self.coordinate, end, speed=speed, name="object")
        self._posture, self._speeds, goals = motion.posture()
        self._controller = motion.holding_controller(model, [hold, goal, *goals])
        self._lead = path.direction * speed / _GAIN
        self._find_arms(path.start + path.direction * opened, unknown.frame_T_handle @ bar_T_hand)

    def _find_arms(self, end: float, part_T_hand: Array) -> None:
        """Find arms along the path to a value, as far as there are any.

        Without them the arm drifts to its limits and slows down.
        """
        search, state = self.motion.search, self.motion.session.state
        count = max(2, math.ceil(abs(end - self.path.value) / (abs(self._lead) * _GAIN / PATH_SPEED) / _STEP))
        self._values = np.linspace(self.path.value, end, count)
        hands = [self.belief.reference_pose @ self.path.pose(v) @ part_T_hand for v in self._values.tolist()]
        arm, base = state.vector(search.moving), state.vector(search.standing)
        # Slow joints, such as a torso's, would hold up the motion.
        search.paths.ease = search.samples.eases[0] * np.minimum(1.0, search.samples.speeds / _QUICK)
        paths, reached = search.paths.follow(arm[None], base[None], np.array(hands)[None])
        self._arms = paths[0, : reached[0]] if reached[0] else arm[None]
        self._controller.set(self._speeds, np.zeros(len(arm)))

    @property
    def is_blocked(self) -> bool:
        """Obstacle reached: True if the part is where an obstacle ends its motion."""
        value = self.path.value
        return self.obstacle is not None and self.path.direction * (value - self.obstacle.free) >= 0.0

    @property
    def ends(self) -> bool:
        """End of the arm before the part is open: True if it is expected."""
        return len(self._arms) < len(self._values)

    def step(self, distance: float) -> Command:
        """Return the command of a step, after a distance of the handle [m]."""
        ahead = (self.path.value + self._lead - self._values[0]) / (self._values[-1] - self._values[0])
        share = ahead * (len(self._values) - 1) / max(1, len(self._arms) - 1)
        self._controller.set(self._posture, row_at(self._arms, min(max(share, 0.0), 1.0)))
        return self._controller.step(self.motion.session.state | State({self.coordinate: self.path.value}))


def point_speed(twist: Array, point: Array) -> float:
    """Return the speed of a point (3,) [m] of a body with a twist (6,), both in axes of the body."""
    return float(np.linalg.norm(twist[:3] + np.cross(twist[3:], point)))


def learn_model(model: Model, belief: PartBelief, fit: Fit) -> Model:
    """Return a copy of a model with a learned joint, in which the furniture stands where it is seen."""
    copy = model.copy()
    place_frame(copy, belief.beside, belief.reference_pose)
    write_joint(copy, belief.unknown.frame, fit, belief.beside)
    return copy
