"""Grasped opening: a hand takes a handle, moves the object to a value of its coordinate, and lets go."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from kineverse.control import Controller, Goal, Hold, Target, same_pose
from kineverse.control.tasks import Task
from kineverse.errors import InfeasibleError, InvalidValueError, KineverseError, NotFiniteError
from kineverse.geometry import Rule, Scene
from kineverse.grasping import Grasp, Gripper, Handle, find_gripper, find_handle, sample_grasps
from kineverse.lie import Array, inverse
from kineverse.model.model_view import ModelView
from kineverse.planning import Planner, TrajectoryFollower
from kineverse.state import State
from kineverse.symbols import Symbol
from kineverse.worlds import Judge

from .outcome import Outcome
from .placement import BasePlacement, PlacementSearch
from .session import Session

_GRASPS = 128
_CLOSING, _MOST_CLOSING = 1.5, 4.0
"""Time in which fingers open or close fully, and the largest one [s]."""
_LINE_SPEED = 0.1
"""Speed of the hand on the straight way to the handle and from it [m/s]."""
_SETTLED, _MOST_SETTLING = 5e-4, 150
"""Error of the hand's pose at the end of a straight way [m], [rad], and the most steps until it is met."""
_PLANNING = 2.0
"""Largest time to plan the way to the handle [s]."""
_SPEED = 0.3
"""Speed of an object along its planned way [m/s], [rad/s]."""
_FOLLOWING, _POSTURE = 5.0, 0.5
"""Gain of the goals along the way [1/s], and the weight of the arm beside the object."""
_LATE = 0.1
"""Distance from the way at which the reference begins to wait [m], [rad]."""
_MARGIN = 0.002
"""Least distance of bodies while the object moves [m]; placements keep more."""
_BESIDE = 0.008
"""Difference of the gap of closed fingers to the thickness of the bar that says that it is not there [m]."""
_SLIPPED = 0.02
"""Distance of the hand from its grasp from which on the handle has slipped [m]."""
_STALLED, _PATIENCE = 1e-3, 4.0
"""Least progress of the object [m], [rad] in a time [s]."""
_SHARES = (1.0, 0.75, 0.5, 0.3)
"""Shares of the rest of a motion that are tried with one grasp."""
_MOST_GRASPS = 4
_LARGEST = ("limit_violation", "penetration", "grasp_error", "grasp_rotation", "jitter", "reversals")
_SUMS = ("contact_losses", "distance", "hand_distance")
"""Measures of the parts of a run: the largest, or the sum."""


class SkillError(KineverseError):
    """End of a skill that is not done.

    Attributes
    ----------
    kind
        ``"collision"``, ``"reach"``, ``"time"`` or ``"other"``.
    """

    def __init__(self, kind: str, reason: str) -> None:
        super().__init__(reason)
        self.kind = kind


def open_object(
    session: Session,
    what: Symbol | str,
    *,
    target: float | None = None,
    hand: str | None = None,
    handle: str | None = None,
    seconds: float = 60.0,
    tolerance: float = 0.02,
    placements: int = 1000,
    seed: int = 0,
) -> Outcome:
    """Move an object to a value of its coordinate by its handle.

    A base, a grasp and a way of the arm are found, see :class:`.PlacementSearch`. The robot goes to the
    handle on a planned path, closes its fingers, moves the object, lets go and retracts. Where one grasp does
    not lead to the target, the object is released on the way and grasped anew. A base that rolls on wheels is
    put to its place by a reset of the world; its drive there is not part of the skill.

    Parameters
    ----------
    session
        Robot in a world.
    what
        The coordinate of the object, as symbol or name.
    target
        Wanted value [m], [rad]; by default the limit that is the farthest from the present value.
    hand, handle
        Frames of the hand and of the handle, found by default.
    seconds
        Largest time in the world [s].
    tolerance
        Largest distance from the target [m], [rad].
    placements
        Largest number of sampled bases for one grasp.
    seed
        Seed of all searches.

    Returns
    -------
    Outcome
        With ``measures``: those of :class:`.Judge`, ``placements``, ``grasps`` (number of grasps), and
        ``failure``: ``"collision"``, ``"reach"``, ``"time"`` or ``"other"`` if it was not done.

    Raises
    ------
    UnknownNameError, InvalidValueError
        Without a gripper or a handle, for a coordinate of the robot, or a target out of limits.
    """
    world, model = session.world, session.world.model
    coordinate = model.symbol(what) if isinstance(what, str) else what
    if coordinate.path.startswith(f"{world.robot}/"):
        raise InvalidValueError(f"'{coordinate}' is a coordinate of the robot; name one of an object.")
    goal = _choose_target(model, coordinate, session.state, target)
    found = find_handle(model, coordinate, handle)
    opener = _find_opener(model, find_gripper(model, world.robot, hand), session.state)
    run = _Run(session, opener, found, goal, seconds, tolerance, placements, seed)
    reason, kind = "", ""
    try:
        run.perform()
    except SkillError as failure:
        reason, kind = str(failure), failure.kind
    except (InfeasibleError, NotFiniteError) as error:
        reason, kind = f"The controller has no command: {error}", "other"
    session.stop()
    value = float(world.state[coordinate])
    done = not reason and abs(value - goal) <= tolerance
    if not reason:
        reason = (
            f"'{coordinate}' is at {value:.3f}, as wanted."
            if done
            else (f"'{coordinate}' ended at {value:.3f}, not at {goal:.3f}.")
        )
    measures: dict[str, Any] = {**run.measures, "placements": run.placements, "grasps": run.grasps}
    if not done:
        measures["failure"] = kind or "other"
    return Outcome(
        done, value, reason, world.name, world.time - run.begin, session.steps - run.first, measures
    )


class _Opener:
    """Everything that openings of one model have in common: placements and the planner of ways."""

    def __init__(self, model: ModelView, gripper: Gripper, state: State) -> None:
        self.model, self.gripper, self.version = model, gripper, model.version
        self.search = PlacementSearch(model, gripper, state)
        self._planner: Planner | None = None
        self._grasps: dict[tuple[str, Symbol, int], tuple[Grasp, ...]] = {}

    @property
    def planner(self) -> Planner:
        """Planner of the robot's ways with the hand empty."""
        if self._planner is None:
            self._planner = Planner(self.model, self.search.moving, rules=self.search.scene.rules)
        return self._planner

    def grasps(self, handle: Handle, seed: int) -> tuple[Grasp, ...]:
        """Return the grasps of a handle."""
        key = handle.frame, handle.coordinate, seed
        if key not in self._grasps:
            self._grasps[key] = sample_grasps(self.model, self.gripper, handle, _GRASPS, seed)
        return self._grasps[key]


_OPENERS: WeakKeyDictionary[ModelView, dict[str, _Opener]] = WeakKeyDictionary()


def _find_opener(model: ModelView, gripper: Gripper, state: State) -> _Opener:
    kept = _OPENERS.setdefault(model, {})
    found = kept.get(gripper.hand)
    if found is None or found.version != model.version:
        found = kept[gripper.hand] = _Opener(model, gripper, state)
    return found


def _choose_target(model: ModelView, coordinate: Symbol, state: State, target: float | None) -> float:
    lower, upper = (float(v) for v in model.limits(coordinate, state))
    here = state[coordinate]
    if target is None:
        target = upper if abs(upper - here) >= abs(lower - here) else lower
        if not math.isfinite(target):
            raise InvalidValueError(f"'{coordinate}' has no limit to move to; name a target.")
    if not lower - 1e-9 <= target <= upper + 1e-9:
        raise InvalidValueError(f"'{coordinate}' moves from {lower:g} to {upper:g}, not to {target!r}.")
    return float(target)


class _Run:
    """One opening: its phases, and what was measured on the way."""

    def __init__(
        self,
        session: Session,
        opener: _Opener,
        handle: Handle,
        target: float,
        seconds: float,
        tolerance: float,
        placements: int,
        seed: int,
    ) -> None:
        self.session, self.opener, self.handle = session, opener, handle
        self.target, self.tolerance = target, tolerance
        self.samples, self.seed = placements, seed
        self.model = opener.model
        self.gripper = opener.gripper
        self.first, self.begin = session.steps, session.world.time
        self.seconds = seconds
        self.placements = self.grasps = 0
        self._earlier: list[Mapping[str, Any]] = []
        self.judge = Judge(self.model, session.world.robot, self.gripper, handle=handle.frame)
        self.judge.update(session.world.state)
        self._hand, self._bar = self.model.fk(self.gripper.hand), self.model.fk(handle.frame)

    @property
    def measures(self) -> dict[str, Any]:
        """Measures of the judge, also of those parts that ended with a reset of the world."""
        found = [*self._earlier, self.judge.measures]
        last = dict(found[-1])
        for name in _LARGEST:
            last[name] = max((m[name] for m in found if not math.isnan(m[name])), default=math.nan)
        for name in _SUMS:
            last[name] = sum(m[name] for m in found)
        return last

    def _judge_afresh(self) -> None:
        self._earlier.append(self.judge.measures)
        self.judge.reset()
        self.judge.update(self.session.world.state)

    def perform(self) -> None:
        """Move the object to the target with one grasp after the other, or raise SkillError."""
        coordinate = self.handle.coordinate
        self._check_start()
        for _ in range(_MOST_GRASPS):
            if abs(self.session.state[coordinate] - self.target) <= self.tolerance / 2:
                return
            placement = self._place()
            assert placement.grasp is not None
            self.grasps += 1
            self._approach(placement)
            if self._close(placement.grasp):
                self._move(placement)
            self._release(placement.grasp)
        if abs(self.session.state[coordinate] - self.target) > self.tolerance:
            raise SkillError("reach", f"After {self.grasps} grasps '{coordinate}' is not at the target.")

    def _check_start(self) -> None:
        """Raise SkillError if the robot touches something before anything is done."""
        search = self.opener.search
        if search.standing:
            return  # the base is put elsewhere
        search.scene.update(self.session.state)
        touching = search.scene.watch(search.own, search.others, 0.0)()
        if len(touching):
            pair = touching[0]
            raise SkillError("collision", f"The robot begins in contact: '{pair.a}' at '{pair.b}'.")

    # -- phases --------------------------------------------------------------------------------------------

    def _place(self) -> BasePlacement:
        """Return a placement that leads as far as possible."""
        session, here = self.session, self.session.state[self.handle.coordinate]
        session.phase = "place"
        grasps = self.opener.grasps(self.handle, self.seed)
        why = ""
        with session.timed("place"):
            for share in _SHARES:
                until = here + share * (self.target - here)
                found = self.opener.search.find(
                    session.state, grasps, until, samples=self.samples, seed=self.seed + self.grasps
                )
                self.placements += found.samples
                if found:
                    return found
                why = why or found.why
        contacts = any(" at " in reason for reason in found.reasons)
        raise SkillError("collision" if contacts else "reach", why)

    def _approach(self, placement: BasePlacement) -> None:
        """Bring the hand to the pose before the handle, on a planned path, and then straight to it."""
        session, search = self.session, self.opener.search
        session.phase = "approach"
        opened = self.gripper.opened
        wanted = dict(zip(placement.coordinates, placement.approach.tolist(), strict=True))
        if search.standing:
            stands = {s: wanted[s] for s in search.standing}
            gone = session.world.time - self.begin
            session.restart(session.world.state.updated(stands))
            self.begin = -gone
            self._judge_afresh()
        self._move_fingers(opened)
        planner = self.opener.planner
        with session.timed("plan"):
            planner.place(session.state)
            start = session.state.vector(planner.symbols)
            end = np.array([wanted[s] for s in planner.symbols])
            path = planner.plan(start, end, seconds=_PLANNING, seed=self.seed)
            if not path.found:
                raise SkillError("collision", f"There is no way to the handle: {path.why}")
            trajectory = path.trajectory()
        follower = TrajectoryFollower(trajectory)
        controller = self._controller(follower.tasks, posture=0.0)
        begin = session.world.time
        while session.world.time - begin < trajectory.duration + 0.2:
            self._check_time()
            with session.timed("approach"):
                follower.set(controller, session.world.time - begin)
                command = controller.step(session.state)
            self._act(command.speeds)
        assert placement.grasp is not None
        self._turns = self._count_turns(placement.line[0])
        rows = placement.line[:, : len(search.moving)] + self._turns
        self._follow_line(placement.grasp.approach, placement.grasp.pose, rows)

    def _follow_line(self, start: Array, end: Array, rows: Array | None = None) -> None:
        """Move the hand straight from a pose relative to the handle to another one, near to arms (L, n)."""
        session = self.session
        wanted = Target("hand/pose", end)
        posture, goals = (None, []) if rows is None else self._posture(rows[0])
        error = same_pose(self._bar @ wanted.expression, self._hand)
        controller = self._controller([Goal(error, gain=0.5 / session.dt, name="hand"), *goals])
        length = float(np.linalg.norm(end[:3, 3] - start[:3, 3]))
        steps = max(2, math.ceil(length / (_LINE_SPEED * session.dt)))
        for k in range(1, steps + _MOST_SETTLING):
            self._check_time()
            pose = end.copy()
            share = min(1.0, k / steps)
            pose[:3, 3] = start[:3, 3] + share * (end[:3, 3] - start[:3, 3])
            with session.timed("line"):
                controller.set(wanted, pose)
                if posture is not None and rows is not None:
                    controller.set(posture, _row_at(rows, share))
                command = controller.step(session.state)
            if k > steps and command.residuals["hand"] < _SETTLED:
                break
            self._act(command.speeds)

    def _count_turns(self, row: Array) -> Array:
        """Return the whole turns (n,) [rad] by which joints without limits are away from a configuration."""
        moving, planner = self.opener.search.moving, self.opener.planner
        turning = np.array([planner.space.turning[planner.symbols.index(s)] for s in moving])
        away = self.session.state.vector(moving) - row[: len(moving)]
        return np.where(turning, 2 * math.pi * np.round(away / (2 * math.pi)), 0.0)

    def _posture(self, row: Array) -> tuple[Target, list[Goal]]:
        """Return a target for the arm (n,), and the goals that keep the arm near to it."""
        posture = Target("arm/posture", row)
        goals = [
            Goal(s, posture.expression[k], gain=_FOLLOWING, weight=_POSTURE, name=f"posture {s}")
            for k, s in enumerate(self.opener.search.moving)
        ]
        return posture, goals

    def _close(self, grasp: Grasp) -> bool:
        """Close the fingers until they stand still, and return True if they stand around the bar."""
        self.session.phase = "close"
        self._move_fingers(self.gripper.closed)
        state, gripper = self.session.state, self.gripper
        narrow = gripper.values_at(max(0.25 * grasp.thickness, grasp.thickness - _BESIDE))
        wide = gripper.values_at(grasp.thickness + _BESIDE)
        return all(
            min(narrow[s], wide[s]) - 1e-4 <= state[s] <= max(narrow[s], wide[s]) + 1e-4
            for s in gripper.joints
        )

    def _move(self, placement: BasePlacement) -> None:
        """Move the held object along the planned way."""
        session, coordinate, grasp = self.session, self.handle.coordinate, placement.grasp
        assert grasp is not None
        session.phase = "move"
        state = session.state
        held = inverse(self._bar(state)) @ self._hand(state)
        hold = Hold(same_pose(self._bar @ held, self._hand), name="grasp")
        target = float(placement.values[-1])
        moving = self.opener.search.moving
        rows = placement.way[:, : len(moving)] + self._turns
        values = placement.values
        posture, goals = self._posture(rows[0])
        wanted = Target("opening/object", np.array([values[0]]))
        tasks: list[Task] = [hold, Goal(coordinate, wanted.expression[0], gain=_FOLLOWING, name="object")]
        tasks += goals
        rules = [Rule(b, self.handle.frame, False, "grasped") for b in self.gripper.bodies]
        scene = Scene(self.model, rules=[*self.opener.search.scene.rules, *rules])
        controller = self._controller(tasks, scene=scene, margin=_MARGIN)
        share, ends = 0.0, abs(target - values[0])
        best, since = 0.0, session.world.time
        while abs(session.state[coordinate] - target) > self.tolerance / 4:
            self._check_time()
            with session.timed("open"):
                reference = _row_at(rows, share)
                value = values[0] + share * (target - values[0])
                controller.set(posture, reference)
                controller.set(wanted, np.array([value]))
                command = controller.step(session.state)
                # The reference waits for the slowest joint.
                late = max(
                    float(np.abs(reference - session.state.vector(moving)).max(initial=0.0)),
                    abs(value - session.state[coordinate]),
                )
                share += _SPEED * session.dt / ends * min(1.0, max(0.0, 1.5 - late / _LATE))
                share = min(1.0, share)
            self._act(command.speeds)
            if command.residuals["grasp"] > _SLIPPED:
                raise SkillError("other", "The handle slipped out of the hand.")
            done = abs(session.state[coordinate] - values[0])
            if done > best + _STALLED:
                best, since = done, session.world.time
            elif session.world.time - since > _PATIENCE:
                stops = ", ".join(command.active[:3]) or "nothing that the controller knows; it may be locked"
                raise SkillError(
                    "collision" if "contact" in stops else "other",
                    f"'{coordinate}' does not move on from {session.state[coordinate]:.3f}. "
                    f"In the way: {stops}.",
                )

    def _release(self, grasp: Grasp) -> None:
        """Open the fingers, and take the hand away."""
        self.session.phase = "release"
        state = self.session.state
        self._move_fingers(self.gripper.opened)
        pose = inverse(self._bar(state)) @ self._hand(state)
        away = pose.copy()
        away[:3, 3] += grasp.approach[:3, 3] - grasp.pose[:3, 3]
        self.session.phase = "retract"
        self._follow_line(pose, away)

    # -- commands ------------------------------------------------------------------------------------------

    def _controller(self, tasks: Iterable[Task], **options: Any) -> Controller:
        """Return a controller of the robot's coordinates, and of the object's if tasks are about it."""
        tasks = list(tasks)
        still: list[Symbol | str] = [*self.opener.search.standing, *self.gripper.joints]
        if not any(isinstance(task, Hold) for task in tasks):
            still.append(self.handle.coordinate)
        with self.session.timed("plan"):
            controller = Controller(self.model, tasks, dt=self.session.dt, still=still, **options)
            controller.wait()
        return controller

    def _move_fingers(self, values: Mapping[Symbol, float]) -> None:
        """Move the fingers to values, or until they stand still."""
        session, gripper = self.session, self.gripper
        begin, idle = session.world.time, 0
        while session.world.time - begin < _MOST_CLOSING:
            state = session.state
            speeds = {}
            for s in gripper.joints:
                most = abs(gripper.closed[s] - gripper.opened[s]) / _CLOSING
                lower, upper = self.model.limits(s.derivative())
                wanted = (values[s] - state[s]) / session.dt
                speeds[s.derivative()] = float(np.clip(wanted, max(-most, lower), min(most, upper)))
            if max((abs(values[s] - state[s]) for s in gripper.joints), default=0.0) < 1e-5:
                break
            self._act(speeds)
            moved = max(abs(session.state[s] - state[s]) for s in gripper.joints)
            asked = max(abs(v) for v in speeds.values()) * session.dt
            idle = idle + 1 if moved < 0.1 * asked else 0
            if idle >= 10:
                break

    def _act(self, speeds: Mapping[Symbol, float]) -> None:
        session = self.session
        session.act(speeds)
        self.judge.update(session.world.state, session.commands, held=session.world.held)

    def _check_time(self) -> None:
        if self.session.world.time - self.begin > self.seconds:
            raise SkillError("time", f"The time of {self.seconds:g} s is up in '{self.session.phase}'.")


def _row_at(rows: Array, share: float) -> Array:
    """Return the configuration (n,) at a share of the way along some (K, n)."""
    place = share * (len(rows) - 1)
    return np.array([np.interp(place, range(len(rows)), column) for column in rows.T])
