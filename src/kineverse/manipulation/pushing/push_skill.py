"""Pushing skill: a robot pushes an articulated object to a value of its coordinate."""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import partial

import numpy as np

from kineverse._checks import as_positive
from kineverse.control import Goal
from kineverse.manipulation.articulated_objects import find_shut_value
from kineverse.manipulation.outcome import Outcome, SkillError
from kineverse.manipulation.session import Session
from kineverse.manipulation.skill_run import (
    CREEP,
    Pace,
    SkillRun,
    check_target,
    choose_tolerance,
    explain_fixed,
    find_object_coordinate,
)
from kineverse.manipulation.swept_volume import BlockedError
from kineverse.planning import Path, Planner
from kineverse.state import State
from kineverse.symbols import Symbol

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
    planner = Planner(model, free, rules=pushing.scene.rules)
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
_FOLLOWING, _LATE = 5.0, 0.1
"""Gain on a path to a contact point [1/s], and distance from it at which it begins to wait [m], [rad]."""
_SETTLING = 0.2  # time at the end of such a path [s]
_SIGMAS = 2.0  # standard deviations by which an object that was at its target may seem to be off afterwards


def push(
    session: Session,
    what: Symbol | str,
    *,
    target: float | None = None,
    bodies: str | Iterable[str] | None = None,
    seconds: float = 30.0,
    tolerance: float | None = None,
    plan: bool = True,
    retreat: bool = False,
    returns: bool = False,
    pushing: Pushing | None = None,
) -> Outcome:
    """Push an articulated object to a value of its coordinate.

    The robot first looks until it knows the coordinate. The controller finds contact points and changes them
    where it is blocked. After some of them a path is planned to another one. What the robot believes with a
    deviation is felt for. What its limits hold is not pushed, nor is anything with something in its way, see
    :func:`.find_obstacle`.

    Parameters
    ----------
    session
        The robot.
    what
        The coordinate of the object, as symbol or name.
    target
        Wanted value [m], [rad]; by default the limit nearest to the default value, where furniture is shut.
    bodies
        Bodies of the robot that may touch the object, names or patterns; by default those of its gripper.
    seconds
        Largest time by the robot's clock [s].
    tolerance
        Largest distance from the target [m], [rad]; by default 2 % of the distance, and 20 mm at a limit, see
        :func:`.choose_tolerance`.
    plan
        Whether approaches are planned where the path of the controller is blocked.
    retreat
        Whether the pusher is taken away from the object at the end.
    returns
        Whether the object may move back when the pusher is taken away, as a button on a spring does.
    pushing
        A controller that was built before, in place of ``target`` and ``bodies``.

    Returns
    -------
    Outcome
        With ``measures``: ``losses``, ``blocked``, ``contacts``, ``jammed``, ``planned``, ``target``,
        ``tolerance``, and ``failure``: ``"collision"``, ``"time"`` or ``"other"``, if it was not done;
        ``free``, the value up to which the path is free, if something is in the way.

    Raises
    ------
    UnknownNameError, InvalidValueError
        For a coordinate of the robot, and as :class:`.Pushing`.

    Examples
    --------
    >>> scene = kv.load("shelf_door")
    >>> robot = kv.manipulation.place_robot(scene, "hsr", at=(-1.0, -0.2, 0.0))
    >>> world = kv.worlds.KinematicWorld(scene, robot.name)
    >>> world.reset(robot.start_state(scene) | {"shelf_door/door": 0.4})
    >>> session = kv.manipulation.Session(world, belief=kv.worlds.TrueBelief(world))
    >>> outcome = kv.manipulation.push(session, "shelf_door/door", target=0.3, seconds=30)
    >>> outcome.done, round(world.state["shelf_door/door"], 2)
    (True, 0.3)
    """
    coordinate, seconds = find_object_coordinate(session.robot, what), as_positive(seconds, "seconds=")
    wanted, tolerance = check_target(target, tolerance)
    if pushing is not None:
        wanted = pushing.target
    elif wanted is None:
        wanted = find_shut_value(session.model, coordinate)
    run = PushRun(session, coordinate, seconds, wanted, plan)
    return run.perform(partial(run.push, bodies, pushing, tolerance, retreat, returns))


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


class PushRun(SkillRun):
    """Run of a push."""

    coordinate: Symbol

    def __init__(
        self, session: Session, coordinate: Symbol, seconds: float, target: float, plan: bool
    ) -> None:
        super().__init__(session, coordinate, seconds)
        self._target, self._plan = target, plan
        self._tolerance, self._approaches = 0.0, 0
        self._pushing: Pushing

    def push(
        self,
        bodies: str | Iterable[str] | None,
        pushing: Pushing | None,
        tolerance: float | None,
        retreat: bool,
        returns: bool,
    ) -> str:
        """Push until the object is at its target, and return why it is, or raise SkillError."""
        session, model, coordinate, target = self.session, self.model, self.coordinate, self._target
        self._look()
        self._tolerance = tolerance = choose_tolerance(model, coordinate, session.state, target, tolerance)
        self.measures |= {"target": target, "tolerance": tolerance}
        if pushing is None:
            if abs(self.value - target) <= tolerance / 2:
                return f"'{coordinate}' is there from the start"
            if why := explain_fixed(model, coordinate, session.state):
                raise SkillError("other", why)
            self.check_way(target)
            with session.search(f"points of '{coordinate}' at which it can be pushed"):
                own = self.robot.gripper().bodies if bodies is None else bodies
                pushing = Pushing(
                    model, self.robot, coordinate, own, session.state, target=target, dt=session.dt
                )
        elif (obstacle := pushing.find_obstacle(session.state)) is not None:
            raise BlockedError(obstacle)
        pushing.reset()
        self._pushing = pushing
        try:
            failure = self._push_on()
            value = self.value
            if retreat:
                self._retreat()
        finally:
            self.measures |= {
                "losses": pushing.losses,
                "blocked": pushing.choice.blocked,
                "contacts": pushing.choice.contacts,
                "jammed": pushing.choice.jammed,
                "planned": self._approaches,
            }
        value = value if returns else self.value
        rest = abs(value - target)
        allowed = 0.0 if failure is not None else _SIGMAS * session.deviation(coordinate)
        if rest < tolerance + allowed:
            return f"'{coordinate}' is at {value:.3g}"
        raise failure or SkillError(
            "other", f"'{coordinate}' was at its target, {target:.3g}, and then went on to {value:.3g}."
        )

    def _look(self) -> None:
        """Stand until the coordinate is known, or raise SkillError if it is not seen."""
        session, coordinate = self.session, self.coordinate
        while (deviation := session.deviation(coordinate)) > _UNKNOWN:
            if session.time - self.begin > _LOOK:
                raise SkillError(
                    "other",
                    f"'{coordinate}' is not known: its deviation is {deviation:.2g} after {_LOOK:g} s. No "
                    "camera sees a marker that it moves, or its track is lost.",
                )
            session.phase = "look"
            self.act({})

    def _push_on(self) -> SkillError | None:
        """Push until the object is at its target, and return what prevented it; None if nothing did."""
        session, pushing = self.session, self._pushing
        if contact := pushing.first_contact(session.state):
            return SkillError("collision", f"The push begins with a {contact}.")
        blocked, end = 0, _End(pushing, self._tolerance)
        while not end.reached(session.state):
            if self.left < 0.0:
                where = "touching" if pushing.touching else "on the way to a contact"
                return SkillError("time", f"Out of time at {self.value:.3g}, {where}.")
            if pushing.choice.is_jammed:
                return SkillError(
                    "collision",
                    f"The object does not move: pushed at {pushing.choice.jammed} points, it stays at "
                    f"{self.value:.3g}. It may be locked, jammed or blocked.",
                )
            if pushing.choice.blocked - blocked >= _MOST_BLOCKED and self._plan:
                blocked = pushing.choice.blocked
                if problem := self._approach():
                    return SkillError("collision", problem)
            if end.near:
                session.act({})  # an object that has run on by itself is not followed
            else:
                self._step("push")
        return None

    def _step(self, phase: str) -> None:
        """Act by the controller's command for one step, also for a retreat when the time is up."""
        session, pushing = self.session, self._pushing
        session.phase = phase
        with session.timed("push"):
            state = session.state
            deviation = pushing.find_deviation(state, session.belief.deviation)
            command = pushing.step(state, session.observation if deviation else None, deviation)
        session.contact, session.vectors = pushing.contact, pushing.vectors
        session.act(command.speeds, command)
        session.vectors = {}

    def _approach(self) -> str:
        """Plan a path to another contact point and follow it; return what prevents it."""
        session, pushing = self.session, self._pushing
        if self._approaches >= _MOST_APPROACHES:
            tried = pushing.choice.contacts
            return f"No contact point was reached, of {tried} and {self._approaches} plans."
        self._approaches += 1
        self._retreat()  # a path that begins with a contact cannot be planned
        self.act({})
        with session.search("a path to another point of the object"):
            path, point = plan_push_approach(pushing, session.state)
        if not path.found:
            return f"Blocked, and no path leads to a contact point. {path.why}"
        self._follow(path)
        pushing.choose(session.state, point)
        return ""

    def _follow(self, path: Path) -> None:
        """Follow a path, which waits where the robot is late."""
        session, trajectory = self.session, path.trajectory()
        session.phase, symbols = "approach", trajectory.symbols
        time, pace = 0.0, Pace(session, _LATE, speed=1.0, least=CREEP)
        while time < trajectory.duration + _SETTLING:
            now = trajectory.positions_at(time)
            later, away = (
                trajectory.positions_at(time + pace.speed * session.dt),
                now - session.state.vector(symbols),
            )
            rates = (later - now) / session.dt + _FOLLOWING * away
            self.act({s.derivative(): v for s, v in zip(symbols, rates.tolist(), strict=True)})
            time += pace.advance(float(np.abs(away).max()))

    def _retreat(self) -> None:
        self._pushing.retreating = True
        for _ in range(_RETREAT_STEPS):
            self._step("retreat")
            if math.isinf(self._pushing.gap):
                break
        self._pushing.retreating = False
