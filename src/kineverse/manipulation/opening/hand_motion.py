"""Motions of a hand to a handle, with the held object, and away from it, step by step."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Hashable, Iterable, Mapping
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from kineverse.compilation import compile
from kineverse.control import Controller, Goal, Hold, Target, same_pose
from kineverse.control.tasks import Task
from kineverse.geometry import Rule, Scene
from kineverse.grasping import Grasp, Handle
from kineverse.grasping.grasp_sampling import RETREAT
from kineverse.lie import Array, inverse
from kineverse.manipulation.outcome import SkillError
from kineverse.manipulation.session import HandReference
from kineverse.manipulation.skill_run import CREEP, Pace, SkillRun
from kineverse.model.model_view import ModelView
from kineverse.planning import Trajectory, TrajectoryFollower
from kineverse.state import State
from kineverse.symbols import Symbol

from .approach_planner import Approach, Opener
from .arm_paths import draw_retreats, find_least_time, row_at
from .base_placement import BasePlacement

_CLOSING, _MOST_CLOSING = 1.5, 4.0  # time in which fingers open or close fully, and the largest one [s]
_IDLE = 10  # number of steps in which fingers that stand still have not moved
_LINE_SPEED = 0.1  # speed of the hand on the straight path to the handle and from it [m/s]
_SETTLED, _MOST_SETTLING = 5e-4, 3.0
"""Error of the hand's pose at the end of a straight path [m], [rad], and the longest time until it is met
[s]."""
_LATE, _LINE_LATE = 0.1, 0.02
"""Distances from a reference at which that stands still [m], [rad]: of an arm and a held object, and of a
hand beside a handle, which must not cut corners."""
_RESTING_AT_END = 0.2  # time for which a reference stands at the end of a trajectory [s]
_AT_HANDLE = 0.02  # distance of a hand that may hold a handle, less than after any retreat [m]
_REFERENCES = 24  # number of poses that pages show of a path
_KNOWN, _MOST_LOOKING, _UNKNOWN = 1.5e-3, 1.0, 0.02
"""Deviation of a handle's position that is small [m], longest time to look until it is [s], and the deviation
from which on nothing is done [m]."""
_SIGMAS = 2.0  # standard deviations of the believed handle by which the hand may be off instead
FOLLOWING = 5.0
"""Gain of all goals and holds [1/s]. A larger one follows the noise of estimates, and the delay of servos
adds to it."""
_POSTURE = 0.5  # weight of the arm relative to the object
_ARRIVED = 0.05  # distance from the end of a path up to which the retreat there is meant [m], [rad]
_BESIDE = 0.008  # difference of the gap to the thickness of the bar if it is not between the fingers [m]
_KEPT = 8  # number of controllers that are kept
_MARGIN = 0.002  # least distance of bodies while the object moves [m]; placements keep more

Targets = TypeVar("Targets")


class HandMotion:
    """Motions of the hand of a robot at a handle, and the path to it that was planned last.

    ``carriers`` are coordinates that move the handle, besides its own.
    """

    def __init__(
        self,
        run: SkillRun,
        opener: Opener,
        handle: Handle,
        seed: int = 0,
        carriers: tuple[Symbol, ...] = (),
    ) -> None:
        self.run, self.session, self.handle, self.seed = run, run.session, handle, seed
        self.planned = Approach()
        self.gripper, self.search, self.approaches = opener.gripper, opener.search, opener.approaches
        self.controllers, self.model = opener.controllers, opener.search.model
        self.turns: Array = np.zeros(len(self.search.moving))
        self.hand, self.bar = self.model.fk(self.gripper.hand), self.model.fk(handle.frame)
        self._carriers = *carriers, handle.coordinate
        self._slopes = self.bar[:3, 3].partial(self._carriers)
        limits = {s: self.model.limits(s) for s in (*self.search.moving, *self._carriers)}
        self._limits = {s: (float(a), float(b)) for s, (a, b) in limits.items()}
        self.fingers: dict[Symbol, float] = {}  # where they stood around the bar

    @property
    def deviation(self) -> float:
        """Standard deviation of the position of the handle [m]; 0 if it is known exactly."""
        session = self.session
        deviations = np.array([session.deviation(s) for s in self._carriers])
        if not deviations.any():
            return 0.0
        slopes = self._slopes(session.state).reshape(3, -1)
        moving = (slopes != 0.0) & (deviations > 0.0)
        return float(np.linalg.norm(np.multiply(slopes, deviations, out=np.zeros_like(slopes), where=moving)))

    def look(self) -> None:
        """Stand until the handle is known well, or raise SkillError if it is not seen."""
        session = self.session
        session.phase = "look"
        begin = session.time
        while self.deviation > _KNOWN and session.time - begin < _MOST_LOOKING:
            session.act({})
        if (deviation := self.deviation) > _UNKNOWN:
            coordinate = self.handle.coordinate
            raise SkillError(
                "other",
                f"'{coordinate}' is not seen: believed at {session.state[coordinate]:.3f}, with a standard "
                f"deviation of {session.deviation(coordinate):.2g}, or {deviation:.2g} m at the handle.",
            )

    @property
    def state(self) -> State:
        """The believed state within the limits of positions.

        A joint that rests at its limit is read to be a little beyond, and a controller would lead it back
        before anything else.
        """
        state = self.session.state
        inside = {s: min(max(state[s], a), b) for s, (a, b) in self._limits.items()}
        moved = {s: v for s, v in inside.items() if v != state[s]}
        return state.updated(moved) if moved else state

    def plan(self, placement: BasePlacement) -> bool:
        """Plan the path to a placement, and return whether there is one."""
        self.planned = self.approaches.plan_to(self.session.state, placement, self.seed)
        return bool(self.planned)

    def explain(self, result: BasePlacement) -> SkillError:
        """Return why no placement was found."""
        if standing := self.approaches.explain_standing(self.session.state):
            return SkillError("reach", f"{result.why} {standing}")
        why = f" There is no path to the handle: {self.planned.why}" if self.planned.why else ""
        return SkillError(result.failure, f"{result.why}{why}")

    def drive(self) -> bool:
        """Drive a base on wheels as planned, with a compact arm where needed; return False if it stays."""
        drive, places = self.approaches.drive, self.planned.places
        if places is None:
            return False
        assert drive is not None
        self.session.phase = "drive"
        if self.planned.tuck is not None:
            self.follow(self.planned.tuck)
        self.session.reference = None
        drive.follow(self.run, places)
        return True

    def follow_planned(self) -> None:
        """Follow the planned path, from where the base has driven to."""
        self.session.phase = "approach"
        assert self.planned.trajectory is not None
        self.follow(self.planned.trajectory)

    def approach(self, placement: BasePlacement) -> None:
        """Bring the hand along the planned path before the handle, and then straight to the grasp."""
        assert placement.grasp is not None
        self.follow_planned()
        self.move_fingers(self.gripper.opened)
        self.count_turns(placement.line[0])
        # A hand that takes a path back comes from where it left, and not on the line of the grasp.
        start = self._place_hand(placement, placement.line[0], 0)
        self.follow_line(start, placement.grasp.pose, self.rows(placement.line))

    def _place_hand(self, placement: BasePlacement, row: Array, index: int) -> Array:
        """Return the pose bar_T_hand at a configuration (n,) of a placement and a place on its way."""
        wanted = dict(zip(placement.coordinates, row.tolist(), strict=True))
        state = self.session.state.updated({**wanted, **placement.way.at(index)})
        pose: Array = inverse(self.bar(state)) @ self.hand(state)
        return pose

    def follow(self, trajectory: Trajectory) -> None:
        """Follow a trajectory, whose time waits where the robot is late."""
        session = self.session

        def make() -> tuple[Controller, TrajectoryFollower]:
            result = TrajectoryFollower(trajectory)
            return self.controller(result.tasks, posture=0.0), result

        controller, follower = self.find_controller(("follow", trajectory.symbols), make)
        follower.trajectory = trajectory
        time, pace = 0.0, Pace(session, _LATE, speed=1.0, least=CREEP)
        times = np.linspace(0.0, trajectory.duration, _REFERENCES)
        self.refer([self.hand(session.state.updated(trajectory.at(t))) for t in times.tolist()])
        while time < trajectory.duration + _RESTING_AT_END:
            self.refer_to(time / max(trajectory.duration, session.dt))
            with session.timed("approach"):
                follower.set(controller, time, pace=pace.speed)
                command = controller.step(self.state)
            away = session.state.vector(trajectory.symbols) - trajectory.positions_at(time)
            self.run.act(command.speeds, command)
            time += pace.advance(float(np.abs(away).max(initial=0.0)))
        session.reference = None

    def follow_line(self, start: Array, end: Array, rows: Array | None = None) -> None:
        """Move the hand straight from a pose relative to the handle to another one, near to arms (L, n)."""
        session = self.session

        def make() -> tuple[Controller, tuple[Target, Target, Target | None, Target | None]]:
            # The initial values are of no run: a controller with others would be compiled for these alone.
            wanted, rate = Target("hand/pose", np.eye(4)), Target("hand/rate", np.zeros(6))
            posture, follow, goals = (None, None, []) if rows is None else self.posture()
            error = same_pose(wanted.expression, self.hand)
            goal = Goal(error, gain=FOLLOWING, rate=rate.expression, name="hand")
            return self.controller([goal, *goals]), (wanted, rate, posture, follow)

        bar = compile(self.bar, tier="interpreter")  # some hundred calls
        controller, (wanted, rate, posture, follow) = self.find_controller(("line", rows is None), make)
        displacement = end[:3, 3] - start[:3, 3]
        seconds = max(float(np.linalg.norm(displacement)) / _LINE_SPEED, 2.0 * session.dt)
        if rows is not None:
            seconds = max(seconds, find_least_time(rows, self.search.samples.speeds))
        speed = np.concatenate([end[:3, :3].T @ displacement / seconds, np.zeros(3)])
        time, pace = 0.0, Pace(session, _LINE_LATE, speed=1.0, least=CREEP)
        uncertain = [session.deviation(x) for x in (self.bar @ end)[:3, 3]]
        settled = max(_SETTLED, _SIGMAS * float(np.linalg.norm(uncertain)))
        self.refer(self.bar(session.state) @ np.array([start, end]))
        while time < seconds + _MOST_SETTLING:
            pose = end.copy()
            share, later = (min(1.0, (time + k * session.dt) / seconds) for k in (1, 2))
            self.refer_to(share)
            pose[:3, 3] = start[:3, 3] + share * (end[:3, 3] - start[:3, 3])
            with session.timed("line"):
                state = self.state
                controller.set(wanted, bar(state.vector(bar.inputs)) @ pose)
                controller.set(rate, (pace.speed if share < 1.0 else 0.0) * speed)
                if posture is not None and follow is not None and rows is not None:
                    # A base that lags would lead the arm along a path that was not checked.
                    row, next_row = row_at(rows, share), row_at(rows, later)
                    controller.set(posture, row)
                    controller.set(follow, pace.speed * (next_row - row) / session.dt)
                command = controller.step(state)
            error = command.residuals["hand"]
            if share == 1.0 and error < settled:
                break
            self.run.act(command.speeds, command)
            time += pace.advance(error if share < 1.0 else 0.0)
        session.reference = None

    def count_turns(self, row: Array) -> None:
        """Find the whole turns by which joints without limits are away from a configuration (n,)."""
        moving, planner = self.search.moving, self.approaches.planner
        turning = np.array([planner.space.turning[planner.symbols.index(s)] for s in moving])
        away = self.session.state.vector(moving) - row[: len(moving)]
        self.turns = np.where(turning, 2 * math.pi * np.round(away / (2 * math.pi)), 0.0)

    def posture(self) -> tuple[Target, Target, list[Goal]]:
        """Return targets for the arm (n,) and its speeds, and the goals that keep the arm near to them."""
        posture = Target("arm/posture", np.zeros(len(self.search.moving)))
        speeds = Target("arm/speeds", np.zeros(len(self.search.moving)))
        goals = [
            Goal(
                s,
                posture.expression[k],
                gain=FOLLOWING,
                weight=_POSTURE,
                rate=speeds.expression[k],
                name=f"posture {s}",
            )
            for k, s in enumerate(self.search.moving)
        ]
        return posture, speeds, goals

    def close(self, grasp: Grasp) -> bool:
        """Close the fingers until they stand still, and return True if they stand around the bar."""
        self.session.phase = "close"
        self.move_fingers(self.gripper.closed)
        self._await_observation()
        state, gripper = self.session.state, self.gripper
        self.fingers = {s: state[s] for s in gripper.joints}
        narrow = gripper.values_at(max(0.25 * grasp.thickness, grasp.thickness - _BESIDE))
        wide = gripper.values_at(grasp.thickness + _BESIDE)
        return all(
            min(narrow[s], wide[s]) - 1e-4 <= state[s] <= max(narrow[s], wide[s]) + 1e-4
            for s in gripper.joints
        )

    def release(self, placement: BasePlacement) -> None:
        """Open the fingers, and take the hand away."""
        self.session.phase = "release"
        grasp = placement.grasp
        assert grasp is not None
        self.move_fingers(self.gripper.opened)
        state = self.session.state  # a spring may have moved the object
        world_T_bar, world_T_hand = self.bar(state), self.hand(state)
        pose = inverse(world_T_bar) @ world_T_hand
        self.session.phase = "retract"
        if max(abs(state[s] - v) for s, v in placement.way.at(-1).items()) > _ARRIVED:
            # The retreat of the placement was checked for an object that has arrived.
            self._back_off(grasp)
            return
        gone = self._place_hand(placement, placement.retreat[-1], -1)
        away = pose.copy()
        away[:3, 3] += gone[:3, 3] - grasp.pose[:3, 3]
        self.follow_line(pose, away, self.rows(placement.retreat))

    def let_go(self, grasp: Grasp | None = None) -> None:
        """Open the fingers, and take the hand straight away from the handle."""
        self.session.phase = "release"
        self.move_fingers(self.gripper.opened)
        self.session.phase = "retract"
        self._back_off(grasp)

    def _back_off(self, grasp: Grasp | None) -> None:
        """Take the hand straight away from the handle, as far as it touches nothing."""
        world_T_bar, world_T_hand = self.bar(self.session.state), self.hand(self.session.state)
        end, arms = find_retreat(self, grasp, world_T_bar, world_T_hand)
        bar_T_world = inverse(world_T_bar)
        self.follow_line(bar_T_world @ world_T_hand, bar_T_world @ end, arms)

    @property
    def is_at_handle(self) -> bool:
        """Hand at the handle: True if it may hold it, as after a skill that was broken off."""
        search = self.search
        search.scene.update(self.session.state)
        return len(search.scene.watch(self.gripper.bodies, [self.handle.frame], _AT_HANDLE)()) > 0

    def rows(self, configurations: Array) -> Array:
        """Return the arms (K, n) of configurations of a placement, with the present turns."""
        return configurations[:, : len(self.search.moving)] + self.turns

    def controller(self, tasks: Iterable[Task], **options: Any) -> Controller:
        """Return a controller of the robot's coordinates."""
        still: list[Symbol | str] = [*self.search.standing, *self.gripper.joints]
        still += [s for s in self.model.degrees_of_freedom if not self.search.robot.moves(s)]
        with self.session.search():  # which lasts less in the interpreter than a compiler would take
            return Controller(self.model, tasks, dt=self.session.dt, fixed=still, **options)

    def holding_controller(
        self, model: ModelView, tasks: Iterable[Task], still: Iterable[Symbol] = ()
    ) -> Controller:
        """Return a controller of a hand that holds the handle, with rows for all other near bodies."""
        held = (Rule(b, self.handle.frame, False, "grasped") for b in self.gripper.bodies)
        fixed = [*self.search.standing, *self.gripper.joints, *still]
        with self.session.search():
            scene = Scene(model, rules=(*self.search.scene.rules, *held))
            return Controller(model, tasks, dt=self.session.dt, fixed=fixed, scene=scene, margin=_MARGIN)

    def find_controller(
        self, key: Hashable, make: Callable[[], tuple[Controller, Targets]]
    ) -> tuple[Controller, Targets]:
        """Return a controller at rest and the targets of its tasks, those of an earlier motion if any."""
        key = key, self.session.dt
        result = self.controllers.pop(key) if key in self.controllers else make()
        self.controllers[key] = result  # the last one is the one used last
        if len(self.controllers) > _KEPT:
            del self.controllers[next(iter(self.controllers))]
        result[0].reset()
        return result

    def move_fingers(self, values: Mapping[Symbol, float]) -> None:
        """Move the fingers to values, or until they stand still."""
        session, gripper = self.session, self.gripper
        begin, session.reference = session.time, None
        steps: deque[tuple[State, float]] = deque(maxlen=_IDLE)
        while session.time - begin < _MOST_CLOSING:
            state = session.state
            noise = max((session.deviation(s) for s in gripper.joints), default=0.0)
            speeds = {}
            for s in gripper.joints:
                most = abs(gripper.closed[s] - gripper.opened[s]) / _CLOSING
                lower, upper = self.model.limits(s.derivative())
                wanted = (values[s] - state[s]) / session.dt
                speeds[s.derivative()] = float(np.clip(wanted, max(-most, lower), min(most, upper)))
            if max((abs(values[s] - state[s]) for s in gripper.joints), default=0.0) < max(1e-5, noise):
                break
            session.act(speeds)  # also when the time is up: a hand that opens lets go
            # Single steps are within the noise of encoders.
            steps.append((state, max(abs(v) for v in speeds.values()) * session.dt))
            moved = max(abs(session.state[s] - steps[0][0][s]) for s in gripper.joints)
            asked = sum(one for _, one in steps)
            if len(steps) == _IDLE and moved < 0.1 * asked + 2.0 * noise:
                break

    def _await_observation(self) -> None:
        """Stand until readings of the present arrive; predicted fingers close through what they hold."""
        session = self.session
        begin = session.time
        while session.observation.stamp < begin - 1e-9:
            if session.time - begin > _MOST_LOOKING:
                raise SkillError("other", f"The sensors have been silent for {_MOST_LOOKING:g} s.")
            session.act({})

    def refer(self, poses: npt.ArrayLike) -> None:
        """State the world poses (K, 4, 4) of the hand along the path that begins."""
        self.session.reference = HandReference(np.asarray(poses, dtype=float))

    def refer_to(self, share: float) -> None:
        """State the share of the path that was passed, in [0, 1]."""
        if self.session.reference is not None:
            self.session.reference.share = share


SLIPPED, PULLED_OUT = 0.008, 0.012
"""Distances from its place in the hand from which on a handle has slipped [m]: of a modelled object, and of a
part whose joint is unknown."""
_SLIP_SIGMAS = 4.0  # standard deviations of the estimate that are added
_EMPTY = 0.002  # motion of closed fingers from which on nothing is between them any more [m]


class SlipError(SkillError):
    """Loss of a held handle."""


class SlipDetector:
    """Watch over a bar in closed fingers, compared with its place in the hand at the start."""

    def __init__(self, motion: HandMotion) -> None:
        self._motion, session, bar, hand = motion, motion.session, motion.bar, motion.hand
        self.bar_T_hand = inverse(bar(session.state)) @ hand(session.state)
        self._middle = motion.gripper.grasp_pose[:, 3]
        error = ((bar @ self.bar_T_hand - hand) @ self._middle)[:3]
        self._limit = SLIPPED + _SLIP_SIGMAS * float(np.linalg.norm([session.deviation(x) for x in error]))
        self._poses = compile([bar, hand], tier="interpreter")  # a call a step

    def check(self) -> None:
        """Raise SlipError if the bar is too far from its place, or if the fingers have closed further."""
        state, coordinate = self._motion.session.state, self._motion.handle.coordinate
        world_T_bar, world_T_hand = self._poses(state.vector(self._poses.inputs))
        moved = (world_T_bar @ self.bar_T_hand - world_T_hand) @ self._middle
        distance, empty = float(np.linalg.norm(moved[:3])), self._are_fingers_empty()
        if empty or distance > self._limit:
            how = "It is out of the hand." if empty else f"It moved {1e3 * distance:.0f} mm in the hand."
            where = f"{state[coordinate]:.3f} of '{coordinate}'"
            raise SlipError("other", f"The handle slipped at {where}. {how}")

    def _are_fingers_empty(self) -> bool:
        gripper, session = self._motion.gripper, self._motion.session
        state, closed = session.state, 0.0
        for s, held in self._motion.fingers.items():
            range_ = gripper.closed[s] - gripper.opened[s]
            noise = math.copysign(4.0 * session.deviation(s), range_)
            further = (state[s] - held - noise) / range_ if range_ else 0.0
            closed = max(closed, gripper.width * further)
        return closed > _EMPTY


_SPEED = 0.3  # speed of an object on its path [m/s], [rad/s]
_STALLED, _PATIENCE, _RESTING = 1e-3, 4.0, 0.5  # least progress [m], [rad] in a time [s], and at the end
_LOCKED, _STANDING = 1.5, 1e-3
"""Time [s] after which an object that has not moved yet is not waited for, if the controller plans no speed
beyond some [m/s], [rad/s] for it either: its own constraints hold it."""
_LEAN, _MOST_LEAN = 3.0, 0.2
"""Rate at which the goal of a key that stays behind goes on [1/s], and how far it goes [m], [rad]: a spring
holds it back by as much as servos give way."""
_GIVING = 0.5  # share of the distance of joints from their path that counts while a spring is held
_AT_CORNER = 0.03  # distance from a corner of a way at which that counts as passed [m], [rad]
_STEPS_AT_TARGET = 10  # number of steps for which an estimate is at the target when a motion ends


def move_held(motion: HandMotion, placement: BasePlacement, tolerance: float, near: float) -> None:
    """Move a held object along the path of a placement, near to its end, or to rest within a tolerance."""
    bar, hand = motion.bar, motion.hand
    session, way, grasp = motion.session, placement.way, placement.grasp
    assert grasp is not None
    coordinates, coordinate, target = way.coordinates, way.coordinates[-1], way.target
    session.phase = "move"
    slip = SlipDetector(motion)
    held = slip.bar_T_hand
    moving = motion.search.moving
    rows = motion.rows(placement.path)

    def make() -> tuple[Controller, tuple[Target, Target, Target, Target]]:
        # The initial values are of no run: a controller with others would be compiled for these alone.
        grasped, wanted = (
            Target("grasp/pose", np.eye(4)),
            Target("opening/object", np.zeros(len(coordinates))),
        )
        posture, arm_speeds, goals = motion.posture()
        hold = Hold(same_pose(bar @ grasped.expression, hand), gain=FOLLOWING, name="grasp")
        moved = [
            Goal(s, wanted.expression[k], gain=FOLLOWING, name="object" if s == coordinate else f"object {s}")
            for k, s in enumerate(coordinates)
        ]
        result = motion.holding_controller(motion.model, [hold, *moved, *goals])
        return result, (grasped, wanted, posture, arm_speeds)

    key = "held", motion.handle.frame, coordinates
    controller, (grasped, wanted, posture, arm_speeds) = motion.find_controller(key, make)
    share, pace = 0.0, Pace(session, _LATE)
    length = float(np.abs(np.diff(way.values, axis=0)).max(axis=1).sum())
    best, since = 0.0, session.time
    last = len(way) - 1
    corners = deque(k / last for k in way.corners)
    ends, lean = way.values[-1], np.zeros(len(coordinates))
    controller.set(grasped, held)
    controller.set(arm_speeds, np.zeros(len(moving)))  # the path waits for the arm
    motion.refer([bar(session.state.updated(way.at(k))) @ held for k in range(len(way))])
    within, enough = 0, _STEPS_AT_TARGET if session.deviation(coordinate) else 1
    while True:
        rest = abs(session.state[coordinate] - target)
        there = rest <= near and (share == 1.0 or len(coordinates) == 1)
        within = within + 1 if there else 0
        if within >= enough:
            return
        with session.timed("open"):
            state = motion.state
            reference = row_at(rows, share)
            place = row_at(way.values, share)
            controller.set(posture, reference)
            controller.set(wanted, place + lean)
            command = controller.step(state)
            # The reference waits for the slowest joint.
            arm, here = state.vector(moving), state.vector(coordinates)
            off = np.abs(place - here)
            late = max(float(np.abs(reference - arm).max(initial=0.0)), float(off.max()))
            if share * last < way.last_run:
                # What a spring has taken back is not waited for where it is let back anyway.
                ahead = slice(int(share * last), round((corners[0] if corners else 1.0) * last) + 1)
                joints = _GIVING * np.abs(rows[ahead] - arm).max(axis=1, initial=0.0)
                late = min(
                    late, float(np.maximum(joints, np.abs(way.values[ahead] - here).max(axis=1)).min())
                )
            lean = np.clip(lean + _LEAN * session.dt * (place - here), -_MOST_LEAN, _MOST_LEAN)
            lean[place == ends] = lean[-1] = 0.0
        motion.refer_to(share)
        motion.run.act(command.speeds, command)
        passed = share * length
        share = min(corners[0] if corners else 1.0, share + pace.advance(late) * _SPEED / length)
        slip.check()
        done = passed - float(np.abs(place - session.state.vector(coordinates)).max())
        if done > best + _STALLED:
            best, since = done, session.time
        resting = session.time - since
        if corners and share == corners[0] and (off.max() < _AT_CORNER or resting > _RESTING):
            corners.popleft()
            pace = Pace(session, _LATE)
        if share == 1.0 and rest < 0.75 * tolerance and resting > _RESTING:
            return
        planned = max(abs(float(command.speeds.get(s.derivative(), np.inf))) for s in coordinates)
        held_fast = best == 0.0 and share < 1.0 and planned < _STANDING
        if resting > (_LOCKED if held_fast else _PATIENCE):
            stops = ", ".join(command.active[:3]) or "nothing that the controller knows; it may be locked"
            stuck = coordinates[int(np.argmax(off))]
            raise SkillError(
                "collision" if "contact" in stops else "other",
                f"'{stuck}' does not move on from {session.state[stuck]:.3f}. In the way: {stops}.",
            )


_STEPS = 12  # number of arms along a retreat


def find_retreat(
    motion: HandMotion, grasp: Grasp | None, world_T_handle: Array, world_T_hand: Array
) -> tuple[Array, Array | None]:
    """Return the straight path from a handle that touches nothing, or goes the farthest before it does.

    That is the last pose world_T_hand (4, 4), and the configurations (L, n) of the arm on the way; None if it
    does not reach the end. The path is the reversed approach of the grasp, or deviates from it along the bar.
    The approach of a grasp that nobody knows is taken to be straight ahead of the hand.
    """
    search, state = motion.search, motion.state
    if grasp is None:
        ahead = world_T_hand[:3, :3] @ motion.gripper.grasp_pose[:3, 0]
        out = -RETREAT * world_T_handle[:3, :3].T @ ahead
    else:
        out = grasp.approach[:3, 3] - grasp.pose[:3, 3]
    lines = draw_retreats(out, motion.handle.pose[:3, 2], world_T_handle, world_T_hand, _STEPS)
    arm, base = state.vector(search.moving), state.vector(search.standing)
    count, ends = len(lines), lines[:, -1]
    paths, reached = search.paths.follow(np.tile(arm, (count, 1)), np.tile(base, (count, 1)), lines)
    best: tuple[Array, Array | None] = (ends[0], None)
    farthest = 0
    for end, path, number in zip(ends, paths, reached.tolist(), strict=True):
        if number < 2:
            continue
        rows = path[:number]
        hit = search.contacts.first(state, search.moving, rows, motion.handle.frame, opened=False)
        free = number if hit is None else hit
        if free > farthest:
            best, farthest = (end, path if number == _STEPS else None), free
    return best
