"""Pulling policy for a part with an unknown joint: straight at first, then along the joint that is learned.

A handle that slips is grasped again. A part that does not follow is pulled to the sides, too.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from kineverse.control import Command, Controller, Goal, Hold, Target, same_pose
from kineverse.estimation import Fit
from kineverse.geometry import Scene
from kineverse.grasping import Grasp
from kineverse.lie import Array, adjoint, exp_se3, inverse
from kineverse.manipulation.opening.arm_paths import row_at
from kineverse.manipulation.opening.hand_motion import PULLED_OUT, HandMotion
from kineverse.manipulation.outcome import SkillError
from kineverse.manipulation.skill_run import SkillRun
from kineverse.manipulation.swept_volume import BlockedError, find_obstacle
from kineverse.model.model import Model
from kineverse.model.model_view import ModelView
from kineverse.state import State
from kineverse.symbols import Symbol

from .joint_learning import JointLearning
from .part_belief import PartBelief, measure_way
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
_MARGIN = 0.002  # least distance of bodies while the part moves [m]


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
        hand, bar = model.fk(motion.gripper.hand), model.fk(motion.handle.frame)
        self._place = Target("pull/place", bar_T_hand)
        hold = Hold(same_pose(bar @ self._place.expression, hand), gain=_GAIN, name="grasp")
        still = [*motion.search.standing, *motion.gripper.joints, unknown.handle.coordinate]
        self._controller = _make_controller(motion, model, [hold], [*still, *unknown.floating])
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
        still: list[Symbol] = [*motion.search.standing, *motion.gripper.joints]
        self._posture, self._speeds, goals = motion.posture()
        self._controller = _make_controller(motion, model, [hold, goal, *goals], still)
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


def _make_controller(
    motion: HandMotion, model: ModelView, tasks: list[Hold | Goal], still: list[Symbol]
) -> Controller:
    """Return a controller with rows for near bodies, in which the hand may touch the handle."""
    with motion.session.search():
        scene = Scene(model, rules=motion.holding_rules)
        return Controller(model, tasks, dt=motion.session.dt, fixed=still, scene=scene, margin=_MARGIN)


LEAST_OPENING = 0.08, math.radians(10.0)  # from which a part at its own stop is open [m], [rad]
LOOKING, _HELD_LOOKING = 0.6, 1.0  # times of looks at a part that stands, and with the hand closed [s]
_MOST_GRASPS = 3
_DIRECTIONS = (
    (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, -1.0),
)  # fmt: skip
"""Directions in which a part is pulled one after the other until it follows, in the axes of its handle: along
its outward normal, to both sides across the bar, and to both ends along it."""
_REFIT = 0.5  # time between two controllers for a learned joint [s]
_FOLLOWS, _STALLED, _PATIENCE = 0.01, 0.004, 1.5
"""Motion of a part that follows the hand, and its least progress [m] in a time [s]."""
_LED = 0.06  # distance of the handle before which the hand does not rely on a joint that was learned [m]
_ENDING = 0.5  # time without progress where the arm is expected to end [s]
_AHEAD, _AHEAD_STEPS = 0.03, 4  # distance that an arm must be able to go on [m], and number of poses


class ArmEndError(SkillError):
    """End of the arm's reach, or an obstacle, before the part is open."""


class PartPulling:
    """Pulling of a part until it is open."""

    def __init__(
        self,
        run: SkillRun,
        belief: PartBelief,
        learning: JointLearning,
        model: Model,
        wanted: tuple[float, float],
    ) -> None:
        self.run, self.session, self.belief = run, run.session, belief
        self.learning, self.model = learning, model
        self.wanted, self.part = wanted, belief.unknown.frame
        self.point, self.frame_T_handle = belief.unknown.point, belief.unknown.frame_T_handle
        self.start: Array | None = None  # pose (4, 4) of the part when it was grasped first
        self.begin = run.session.time
        self._measures: dict[str, Any] = {"grasps": 0}
        self._reached = self.begin
        self._direction, *self._others = _DIRECTIONS
        self.motion: HandMotion

    @property
    def measures(self) -> dict[str, Any]:
        """Number of grasps, time since the first one, and that until the part moved no further [s]."""
        return {**self._measures, "pull_seconds": self.session.time - self.begin}

    def perform(self, motion: HandMotion, grasp: Grasp) -> str:
        """Pull until the part is open or at its own stop, and return how far that is.

        A handle that slips is grasped again.
        """
        self.motion = motion
        distance = self.opening[0] if self.learning.poses else -math.inf
        for _ in range(_MOST_GRASPS):
            self._measures["grasps"] += 1
            barrier = ""
            if not self.motion.close(grasp):
                why = "The fingers closed next to the handle."
            else:
                if not self.learning.poses:
                    self.begin = self.session.time
                why, barrier = self._pull_once()
            if not why:
                return self._describe_opening("is open")
            self._let_go()
            last, distance = distance, self.opening[0]
            if barrier and distance >= _FOLLOWS:
                kind = ArmEndError if self.learning.learned is not None else SkillError
                raise kind(barrier, f"{self._describe_opening('was pulled')} {why}")
            if distance - last < _FOLLOWS:
                break
            self._measures["opened_seconds"] = self._reached - self.begin
            pose = inverse(self.belief.pose @ self.frame_T_handle) @ self.belief.hand_pose
            self.motion.follow_line(pose, grasp.pose)
        opened, _ = self.opening
        if opened < _FOLLOWS:
            raise SkillError(
                "other",
                f"'{self.part}' does not follow the hand, pulled outwards, to both sides, and to both ends "
                f"of its handle: it moved by {1e3 * opened:.0f} mm. {why} It may be fixed, locked, or need "
                "more force than the grip holds.",
            )
        words = f"{self._describe_opening('goes no further')} {why}"
        if opened >= LEAST_OPENING[0] or self.opening[1] >= LEAST_OPENING[1]:
            self._measures["opened_seconds"] = self._reached - self.begin
            return f"{words} The arm could go on, so this is its stop."
        raise SkillError("other", words)

    def _let_go(self) -> None:
        self.session.phase = "let go"
        self.belief.release()
        self.motion.move_fingers(self.motion.gripper.opened)
        self.run.stand(LOOKING)

    def _pull_once(self) -> tuple[str, str]:
        """Pull until the part is open.

        Return why it is not, empty if it is, and the kind of failure if the part could go on.
        """
        session, belief, motion, learning = self.session, self.belief, self.motion, self.learning
        session.phase = "pull"
        belief.hold()
        self.run.stand(_HELD_LOOKING)
        part_T_hand = inverse(belief.pose) @ belief.hand_pose
        bar_T_hand = inverse(self.frame_T_handle) @ part_T_hand
        if self.start is None or not learning.poses:
            self.start = belief.relative_pose
        belief.begin_motion()
        pull: StraightPull | LearnedPull = StraightPull(motion, belief, bar_T_hand, self._direction)
        fitted, known = -math.inf, learning.learned is not None
        best, idle = self.opening[0], 0.0  # time without progress, but for that in which the robot waits [s]
        while True:
            for look in belief.looks:
                learning.add(*look)
            belief.looks.clear()
            distance, turn = self.opening
            now = self.session.time
            with session.timed("learn"):
                if learning.update(distance, turn, now - self.begin):
                    known = True
                if known and now - fitted >= _REFIT and distance >= _LED and learning.learned is not None:
                    fit, fitted = learning.learned.fit, now
                    pull = LearnedPull(
                        motion, belief, learn_model(self.model, belief, fit), bar_T_hand, self.start,
                        self.wanted[fit.motion.kinds[0]],
                    )  # fmt: skip
                elif learning.likely is not None and isinstance(pull, StraightPull):
                    pull.likely = JointPath.of_fit(learning.likely, self.start)
            if isinstance(pull, LearnedPull) and pull.obstacle is not None and pull.is_blocked:
                self._let_go()
                raise BlockedError(pull.obstacle)
            with session.timed("open"):
                command = pull.step(distance)
            self.run.act(command.speeds, command)
            distance, turn = self.opening
            if self._is_open(distance, turn):
                self._measures["opened_seconds"] = now - self.begin
                return "", ""
            if belief.slip(part_T_hand, self.point) > PULLED_OUT:
                session.stop()
                ends = isinstance(pull, LearnedPull) and not self._can_go_on(pull, part_T_hand)
                why = "The handle slipped in the hand"
                return (f"{why} where the arm ends.", "reach") if ends else (f"{why}.", "")
            idle += session.dt
            if distance > best + _STALLED:
                best, idle = distance, 0.0
                self._reached = now
            elif idle > (_ENDING if isinstance(pull, LearnedPull) and pull.ends else _PATIENCE):
                if isinstance(pull, StraightPull) and distance < _FOLLOWS and self._others:
                    # It may slide to a side.
                    self._direction, idle = self._others.pop(0), 0.0
                    pull = StraightPull(motion, belief, bar_T_hand, self._direction)
                    continue
                return self._explain_stall(pull, command, part_T_hand)

    def _explain_stall(
        self, pull: StraightPull | LearnedPull, command: Command, part_T_hand: Array
    ) -> tuple[str, str]:
        """Return what is in the way, and its kind if that is not the part itself."""
        words = f"In the way: {', '.join(command.active[:3]) or 'nothing that the controller knows'}."
        if any(name.startswith("contact of") for name in command.active[:3]):
            return words, "collision"
        limits = [c for name, c in self.model.constraints.items() if name in command.active and not c.order]
        limited = any(map(self.run.robot.moves, [s for c in limits for s in c.expression.symbols]))
        if limited or (isinstance(pull, LearnedPull) and not self._can_go_on(pull, part_T_hand)):
            return f"The arm ends there. {words}", "reach"
        return words, ""

    def _can_go_on(self, pull: LearnedPull, part_T_hand: Array) -> bool:
        """Return whether the arm reaches the next poses of the handle along a learned joint."""
        path, search, state = pull.path, self.motion.search, self.session.state
        step = path.direction * _AHEAD / point_speed(path.twist(), self.point) / _AHEAD_STEPS
        values = path.value + step * np.arange(_AHEAD_STEPS + 1)
        hands = [self.belief.reference_pose @ path.pose(v) @ part_T_hand for v in values.tolist()]
        arm, base = state.vector(search.moving)[None], state.vector(search.standing)[None]
        _, reached = search.paths.follow(arm, base, np.array(hands)[None])
        return int(reached[0]) == len(hands)

    @property
    def opening(self) -> tuple[float, float]:
        """Believed distance of the handle [m] and angle of the part [rad] since the first grasp."""
        if self.start is None:
            return 0.0, 0.0
        return measure_way(self.start, self.belief.relative_pose, self.point)

    def _is_open(self, distance: float, turn: float) -> bool:
        learned = self.learning.learned
        if learned is not None and learned.fit.motion.kinds[0]:
            return turn >= self.wanted[1]
        return distance >= self.wanted[0] or turn >= self.wanted[1]

    def _describe_opening(self, verb: str) -> str:
        distance, turn = self.opening
        return f"'{self.part}' {verb}, by {100 * distance:.0f} cm and {math.degrees(turn):.0f}°."
