"""Pushing skill: a robot pushes an articulated object to a value of its coordinate."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from kineverse.control import Goal
from kineverse.errors import KineverseError
from kineverse.geometry import Rule, Scene
from kineverse.geometry.objects import Exclusion
from kineverse.grasping import find_gripper
from kineverse.manipulation.articulated_objects import find_shut_value
from kineverse.manipulation.outcome import Outcome, SkillError
from kineverse.manipulation.session import Session
from kineverse.manipulation.skill_arguments import (
    check_positive,
    check_target,
    choose_tolerance,
    explain_fixed,
    find_object_coordinate,
)
from kineverse.manipulation.swept_volume import find_obstacle
from kineverse.planning import Path, Planner
from kineverse.state import State
from kineverse.symbols import Symbol
from kineverse.worlds import Judge

from .guarded_contact import STILL
from .push_controller import Pushing

_STANDOFF = 0.03
_TILT = math.radians(60.0)  # largest angle between the pusher's axis and the direction of the push
_CONFIGURATIONS = 48


def plan_push_approach(
    pushing: Pushing, state: State, *, points: int = 4, seconds: float = 0.5, seed: int = 0
) -> tuple[Path, int]:
    """Return a path of the robot to a contact point, and the index of the point.

    Coordinates that rates drive, such as those of a base on rolling wheels, stand still. If no path is found,
    the returned one says why.
    """
    model, tool = pushing.model, pushing.tool
    moving = [s.position for s in pushing.speeds if s.position != pushing.coordinate]
    free = [s for s in moving if s in model.degrees_of_freedom and s not in model.rates]
    planner = Planner(model, free, rules=pushing.scene.rules, leave_out=pushing.leave_out)
    planner.place(state)
    tip, axis = tool.locate_tip(model), tool.point_axis(model)
    at = pushing.surface.at(state)
    path: Path | None = None
    chosen, goal = -1, None
    for chosen in pushing.rank(state)[:points]:
        point, normal = at.points[chosen], at.normals[chosen]
        goal = Goal(tip, point + _STANDOFF * normal, name="tip")
        result = planner.solutions(goal, _CONFIGURATIONS, seconds=seconds, seed=seed)
        if not len(result):
            continue
        states = [state.updated(dict(zip(planner.symbols, q, strict=True))) for q in result.tolist()]
        facing = np.array([-normal @ axis(at_goal) for at_goal in states])
        good = result[facing > math.cos(_TILT)]
        here = state.vector(planner.symbols)
        ends = [planner.space.nearest_turn(q, here) for q in (good if len(good) else result)]
        path = planner.plan(None, ends, seconds=seconds, seed=seed)
        if path.found:
            break
    if path is None:
        path = planner.plan(None, [goal] if goal else [], seconds=seconds, seed=seed)  # says why
    return path, chosen


_SETTLED, _SETTLED_ESTIMATE = 5, 25
"""Number of steps for which the value, or its estimate, is within half of the tolerance when a push ends."""
_PATIENCE = 25  # further steps within the tolerance without progress that end a push
_PROGRESS = 5e-4
_AVERAGED = 0.1  # weight of the latest estimate in the mean that counts at the end
_PRESSED = 5  # number of steps for which an object within the tolerance gives way no more when a push ends
_MOST_BLOCKED = 3  # number of contact points given up before an approach is planned
_MOST_APPROACHES = 2
_UNKNOWN, _LOOK = 0.05, 2.0  # deviation of an unknown coordinate [m], [rad], and time to look for it [s]
_RETREAT_STEPS = 100


def push(
    session: Session,
    what: Symbol | str,
    *,
    target: float | None = None,
    bodies: str | Iterable[str] | None = None,
    object_frames: str | Iterable[str] | None = None,
    seconds: float = 30.0,
    tolerance: float | None = None,
    fixed: Iterable[Symbol | str] = (),
    rules: Iterable[Rule] = (),
    leave_out: Iterable[Exclusion] = (),
    logic: str | None = "and",
    plan: bool = True,
    retreat: bool = False,
    pushing: Pushing | None = None,
    judge: Judge | None = None,
    on_step: Callable[[Pushing], object] | None = None,
) -> Outcome:
    """Push an articulated object to a value of its coordinate.

    The controller finds contact points and changes them where it is blocked. After some of them a path is
    planned to another one. Where the session's belief is an estimate, the robot first looks until it knows
    the coordinate, and then feels for the object. What its limits hold is not pushed, nor is anything with
    something in its way, see :func:`.find_obstacle`. The result is judged by the world's truth.

    Parameters
    ----------
    session
        Robot in a world.
    what
        The coordinate of the object, as symbol or name.
    target
        Wanted value [m], [rad]; by default the limit nearest to the default value, where furniture is shut.
    bodies
        Bodies of the robot that may touch the object, names or patterns; by default those of its gripper.
    object_frames
        Bodies of the object that may be pushed, names or patterns; by default all that the coordinate moves.
    seconds
        Largest time in the world [s].
    tolerance
        Largest distance from the target [m], [rad]; by default 2 % of the distance, and 20 mm at a limit, see
        :func:`.choose_tolerance`.
    fixed, rules, leave_out, logic
        As for :class:`.Pushing`.
    plan
        Whether approaches are planned where the path of the controller is blocked.
    retreat
        Whether the pusher is taken away from the object at the end.
    pushing
        A controller that was built before, for the same arguments.
    judge
        Judge that measures all steps; by default one of this push alone. It may have begun before.
    on_step
        Is called with the controller after each step, for drawings and recordings of its ``view``.

    Returns
    -------
    Outcome
        With ``measures``: those of :class:`.Judge`, ``losses``, ``blocked``, ``contacts``, ``jammed``,
        ``planned``, ``tolerance``, ``peak_force`` [N] in a world with forces, and ``failure``:
        ``"collision"``, ``"time"`` or ``"other"``, if it was not done; ``free``, the value up to which the
        path is free, if something is in the way.

    Raises
    ------
    UnknownNameError, InvalidValueError
        For a coordinate of the robot, and as :class:`.Pushing`.
    """
    model, world = session.world.model, session.world
    coordinate = find_object_coordinate(world, what)
    seconds, target = check_positive("seconds", seconds), check_target(target)
    if pushing is not None:
        target = pushing.target
    elif target is None:
        target = find_shut_value(model, coordinate)
    tolerance = choose_tolerance(model, coordinate, session.state, target, tolerance)
    first, begin = session.steps, world.time

    def skip(done: bool, reason: str, failure: str = "other", **measures: Any) -> Outcome:
        measures |= {} if done else {"failure": failure}
        steps, passed = session.steps - first, world.time - begin
        return Outcome(done, world.state[coordinate], reason, world.name, passed, steps, measures)

    while session.deviation(coordinate) > _UNKNOWN:
        if world.time - begin > _LOOK:
            reason = (
                f"'{coordinate}' is not known: its deviation is {session.deviation(coordinate):.2g} after "
                f"{_LOOK:g} s. No camera sees a marker that it moves, or its track is lost."
            )
            return skip(False, reason)
        session.phase = "look"
        session.stop()
    if pushing is None:
        if abs(session.state[coordinate] - target) <= tolerance / 2:
            done = abs(world.state[coordinate] - target) <= tolerance
            return skip(done, f"'{coordinate}' is there from the start")
        if why := explain_fixed(model, coordinate, session.state):
            return skip(False, why)
        own = tuple(rules), tuple(leave_out)
        obstacle = find_obstacle(
            model, coordinate, session.state, target,
            robot=world.robot, rules=own[0], leave_out=own[1], start=session.start,
        )  # fmt: skip
        if obstacle is not None:
            return skip(False, str(obstacle), **obstacle.measures)
        if bodies is None:
            bodies = find_gripper(model, world.robot).bodies
        pushing = Pushing(
            model,
            coordinate,
            bodies,
            session.state,
            target=target,
            robot=world.robot,
            object_frames=object_frames,
            dt=session.dt,
            fixed=fixed,
            rules=own[0],
            leave_out=own[1],
            logic=logic,
        )
    elif (obstacle := pushing.find_obstacle(session.state)) is not None:
        return skip(False, str(obstacle), **obstacle.measures)
    pushing.reset()
    session.peak_force = math.nan
    measured = judge is None
    if judge is None:
        scene = Scene(model, rules=pushing.rules, leave_out=pushing.leave_out)
        judge = Judge(model, world.robot, coordinate=coordinate, start=session.start, scene=scene)
        judge.update(world.state)
    judge.allow(pushing.object_bodies, pushing.pusher)
    run = _Run(session, pushing, judge, seconds, tolerance, plan, on_step)
    try:
        failure = run.push()
        if retreat:
            run.retreat()
    except SkillError as error:
        failure = error
    except KineverseError as error:
        failure = SkillError("other", f"{type(error).__name__}: {error}")
    run.act({})
    value, overlap = world.state[coordinate], judge.overlap
    there = abs(value - target) < tolerance and not session.untrusted
    done = there and overlap is None
    measures = {**(judge.measures if measured else {}), **run.measures(), "tolerance": tolerance}
    if not done:
        measures["failure"] = "collision" if there else failure.kind
    reason = f"'{coordinate}' is at {value:.3g}" if there else str(failure)
    if overlap is not None:
        reason = f"{reason.removesuffix('.')}. {overlap}"
    return Outcome(done, value, reason, world.name, run.time, run.steps, measures, done or run.claimed)


class _End:
    """End of a push: the estimate is at the target for some steps, or the object gives way no more there."""

    def __init__(self, pushing: Pushing, tolerance: float) -> None:
        self._pushing, self._tolerance = pushing, tolerance
        self._mean: float | None = None
        self._least = math.inf
        self._settled = self._within = self._pressed = 0

    @property
    def near(self) -> bool:
        """True if the object seems to be at its target, and is not pushed."""
        return self._settled > 0 and not self._pushing.touching

    def reached(self, state: State) -> bool:
        pushing, press = self._pushing, self._pushing.press
        rest = state[pushing.coordinate] - pushing.target
        if press.deviation > 0.0:
            # Noise passes by the target now and then, and its mean over a while does not.
            rest = rest if self._mean is None else self._mean + _AVERAGED * (rest - self._mean)
            self._mean = rest
        rest = abs(rest)
        goes_on = rest < self._least - _PROGRESS
        self._within = self._within + 1 if rest < self._tolerance and not goes_on else 0
        self._least = rest if goes_on or rest >= self._tolerance else self._least
        self._settled = self._settled + 1 if rest < self._tolerance / 2 else 0
        still = pushing.touching and press.touched and press.speed < STILL
        self._pressed = self._pressed + 1 if still and rest < self._tolerance else 0
        long = _SETTLED_ESTIMATE if press.deviation > 0.0 else _SETTLED
        return self._settled >= long or self._within >= long + _PATIENCE or self._pressed >= _PRESSED


class _Run:
    """Steps of one push."""

    def __init__(
        self,
        session: Session,
        pushing: Pushing,
        judge: Judge,
        seconds: float,
        tolerance: float,
        plan: bool,
        on_step: Callable[[Pushing], object] | None,
    ) -> None:
        self._session, self._pushing, self._judge, self._on_step = session, pushing, judge, on_step
        self.claimed = False
        self._seconds, self._tolerance, self._plan = seconds, tolerance, plan
        self._first, self._begin = session.steps, session.world.time
        self._approaches = 0

    @property
    def steps(self) -> int:
        return self._session.steps - self._first

    @property
    def time(self) -> float:
        return self._session.world.time - self._begin

    def push(self) -> SkillError:
        """Push until the object is at its target, and return what prevented it if it is not there."""
        session, pushing = self._session, self._pushing
        contact = pushing.first_contact(session.state)
        if contact:
            return SkillError("collision", f"The push begins with a {contact}.")
        blocked = 0
        end = _End(pushing, self._tolerance)
        while self.time < self._seconds:
            if end.reached(session.state):
                self.claimed = True
                return SkillError("other", "The estimate is at the target, and the world is not.")
            if pushing.choice.is_jammed:
                force = session.peak_force
                strength = "" if math.isnan(force) else f" with up to {force:.0f} N"
                return SkillError(
                    "collision",
                    f"The object does not move: pushed at {pushing.choice.jammed} points{strength}, it stays "
                    f"at {session.state[pushing.coordinate]:.3g}. It may be locked, jammed or blocked.",
                )
            if pushing.choice.blocked - blocked >= _MOST_BLOCKED and self._plan:
                blocked = pushing.choice.blocked
                problem = self._approach()
                if problem:
                    return SkillError("collision", problem)
            if end.near:
                self.act({})  # an object that has run on by itself is not followed
                continue
            self._step("push")
        where = "touching" if pushing.touching else "on the way to a contact"
        return SkillError("time", f"Out of time at {session.state[pushing.coordinate]:.3g}, {where}.")

    def _step(self, phase: str) -> None:
        session, pushing = self._session, self._pushing
        session.phase = phase
        with session.timed("push"):
            state, observation, deviation = session.state, session.observation, 0.0
            if observation is not None:
                deviation = pushing.find_deviation(state, session.belief.deviation)
            command = pushing.step(state, observation if deviation else None, deviation)
        session.vectors = {} if pushing.view is None else pushing.view.vectors
        self.act(command.speeds)
        session.vectors = {}
        if self._on_step is not None:
            self._on_step(pushing)

    def act(self, speeds: Mapping[Symbol, float]) -> None:
        """Command speeds for one step, and judge it; none stop the robot, also where the world fails."""
        session, before = self._session, self._session.world.time
        if speeds:
            session.act(speeds)
        else:
            session.stop()
        if session.world.time > before:
            self._judge.update(session.world.state, session.commands, pushing=self._pushing.touching)

    def _approach(self) -> str:
        """Plan a path to another contact point and follow it; return what prevents it."""
        if self._approaches >= _MOST_APPROACHES:
            tried = self._pushing.choice.contacts
            return f"No contact point was reached, of {tried} and {self._approaches} plans."
        self._approaches += 1
        session, pushing = self._session, self._pushing
        self.retreat()  # a path that begins with a contact cannot be planned
        self.act({})
        path, point = plan_push_approach(pushing, session.state)
        if not path.found:
            return f"Blocked, and no path leads to a contact point. {path.why}"
        self._follow(path)
        pushing.controller.reset()
        pushing.choose(session.state, point)
        return ""

    def _follow(self, path: Path) -> None:
        session, trajectory = self._session, path.trajectory()
        session.phase = "approach"
        dt = session.dt
        times = np.arange(dt, trajectory.duration + dt, dt).clip(max=trajectory.duration)
        for wanted in trajectory.positions_at(times):
            here = session.state.vector(trajectory.symbols)
            rates = (wanted - here) * (1 / dt)
            self.act({s.derivative(): float(v) for s, v in zip(trajectory.symbols, rates, strict=True)})

    def retreat(self) -> None:
        self._pushing.retreating = True
        for _ in range(_RETREAT_STEPS):
            self._step("retreat")
            view = self._pushing.view
            if view is not None and math.isinf(view.distance):
                break
        self._pushing.retreating = False

    def measures(self) -> dict[str, Any]:
        pushing, force = self._pushing, self._session.peak_force
        return {
            **({} if math.isnan(force) else {"peak_force": force}),
            "losses": pushing.losses,
            "blocked": pushing.choice.blocked,
            "contacts": pushing.choice.contacts,
            "jammed": pushing.choice.jammed,
            "planned": self._approaches,
        }
