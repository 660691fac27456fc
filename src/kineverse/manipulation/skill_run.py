"""Run of a skill from its first look to its outcome: its object, its time, its phases, and how it ends."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

from kineverse._checks import as_tolerance, finite_number
from kineverse.control import Command
from kineverse.errors import InfeasibleError, InvalidValueError, NotFiniteError
from kineverse.model.model_view import ModelView
from kineverse.state import State
from kineverse.symbols import Symbol
from kineverse.worlds import Robot
from kineverse.worlds.furniture_overlaps import OVERLAP

from .outcome import Outcome, SkillError
from .session import Session
from .swept_volume import BlockedError, find_obstacle

_PAUSE = 0.1  # time without a step after which a reference begins at rest, however long a command acts [s]
_RAMP = 0.5  # time from rest to the usual speed [s]
_UNSEEN, _LOOK = 1.0, 2.0  # longest time without a marker before an object is done, and to look for one [s]
_SIGMAS = 2.0  # standard deviations by which an object at its target may seem to be off
CREEP = 0.25  # least share of the usual speed of a reference on a planned path
_PATIENCE = 4.0  # longest time for which a reference waits [s]


class SkillRun:
    """Run of a skill: what all skills do in the same way.

    Parameters
    ----------
    session
        The robot.
    coordinate
        Coordinate of the object; None if no model has it.
    seconds
        Largest time by the robot's clock [s].

    Attributes
    ----------
    measures
        Figures by name, which the outcome gets.
    until
        Time at which the time is up [s].

    Examples
    --------
    >>> from kineverse.manipulation import SkillRun
    >>> world = kv.worlds.KinematicWorld(kv.load("fetch"), "fetch")
    >>> session = kv.manipulation.Session(world, belief=kv.worlds.TrueBelief(world))
    >>> run = SkillRun(session, kv.position("fetch/torso_lift_joint"), seconds=5)
    >>> def lift():
    ...     while run.value < 0.05:
    ...         run.act({kv.velocity("fetch/torso_lift_joint"): 0.1})
    ...     return "the torso is up"
    >>> outcome = run.perform(lift)
    >>> outcome.done, outcome.reason
    (True, 'the torso is up')
    """

    def __init__(self, session: Session, coordinate: Symbol | None, seconds: float) -> None:
        with suppress(SkillError):  # which the skill says
            session.refresh()  # a robot's time runs on between two skills
        self.session, self.coordinate = session, coordinate
        self.model, self.robot = session.model, session.robot
        self.first, self.begin = session.steps, session.time
        self.until = self.begin + seconds
        self.measures: dict[str, Any] = {}

    overlap = OVERLAP  # depth from which on what the object meets on its way is in its way [m]

    @property
    def value(self) -> float:
        """Believed value of the object's coordinate [m], [rad]; NaN without one."""
        return math.nan if self.coordinate is None else float(self.session.state[self.coordinate])

    @property
    def left(self) -> float:
        """Time that is left [s]."""
        return self.until - self.session.time

    def check_time(self) -> None:
        """Raise SkillError if the time is up."""
        if self.left < 0.0:
            raise SkillError("time", f"The time is up in '{self.session.phase}'.")

    def check_way(self, target: float) -> None:
        """Raise BlockedError if something is in the way of the object to a value [m], [rad]."""
        session, coordinate = self.session, self.coordinate
        assert coordinate is not None
        obstacle = find_obstacle(
            self.model, coordinate, session.state, target, robot=self.robot, start=session.start,
            least=self.overlap,
        )  # fmt: skip
        if obstacle is not None:
            raise BlockedError(obstacle)

    def act(self, speeds: Mapping[Symbol, float], command: Command | None = None) -> None:
        """Command speeds for one step, those of a controller's command if given, while there is time."""
        self.check_time()
        self.session.act(speeds, command)

    def stand(self, seconds: float) -> None:
        """Stand for a time [s]."""
        end = self.session.time + seconds
        while self.session.time < end - 1e-9:
            self.session.act({})

    def perform(self, skill: Callable[[], str]) -> Outcome:
        """Run a skill, stop the robot however it ends, and return the outcome.

        The skill returns why it is done, and raises SkillError if it is not.
        """
        session = self.session
        reason, kind, session.fault = "", "", ""
        try:
            session.await_readings()
            reason = skill()
            self._look_again()
        except SkillError as failure:
            reason, kind = str(failure), failure.kind
            self.measures |= failure.measures
        except (InfeasibleError, NotFiniteError) as error:
            reason, kind = f"The controller has no command: {error}", "other"
        finally:  # also if the user interrupts it
            if session.commands:
                session.stop()
            session.phase, session.reference, session.vectors, session.contact = "", None, {}, None
        if session.fault and not kind:  # such as by the stop: it may move on
            reason, kind = f"{reason} {session.fault}".strip(), "other"
        return self.finish(reason, kind)

    def _look_again(self) -> None:
        """Wait until the object is seen at its target; raise SkillError for one that is not, or elsewhere.

        What is not seen is believed to move as it was commanded to.
        """
        session, coordinate = self.session, self.coordinate
        if coordinate is None or not self._find_unseen(coordinate):
            return
        begin = session.time
        while why := self._find_unseen(coordinate):
            if session.time - begin > _LOOK:
                raise SkillError("other", f"'{coordinate}' is believed at {self.value:.4g}, but {why}.")
            session.act({})
        off = abs(self.value - self.measures.get("target", self.value))
        if off > self.measures.get("tolerance", 0.0) + _SIGMAS * session.deviation(coordinate):
            raise SkillError(
                "other", f"'{coordinate}' was out of sight, and is seen at {self.value:.4g} now."
            )

    def _find_unseen(self, coordinate: Symbol) -> str:
        """Return why a coordinate is believed without being seen; empty if it is seen."""
        unseen = self.session.time_unseen(coordinate)
        if math.isinf(unseen):
            return "no marker of it has been seen"
        if unseen > _UNSEEN:
            return f"no marker of it has been seen for {unseen:.3g} s"
        return "its track is lost" if math.isinf(self.session.deviation(coordinate)) else ""

    def finish(self, reason: str, failure: str = "") -> Outcome:
        """Return the outcome of a run that ends here, for a reason; it is done without a kind of failure."""
        session = self.session
        measures = self.measures | ({"failure": failure} if failure else {})
        if failure and session.remarks:
            reason = " ".join([reason, *session.remarks])
        return Outcome(
            not failure, self.value, reason, session.interface.name,
            session.time - self.begin, session.steps - self.first, measures,
        )  # fmt: skip


class Pace:
    """Pace of a reference along a path, which waits for a robot that is late by a distance [m], [rad].

    It begins at rest, unless the reference does so itself (``speed=1``), and again after a pause in which the
    robot has stopped: nothing catches up. ``speed`` is the present share of the usual speed. A reference on a
    planned path creeps on (``least``), however late the robot is: what it leans against may give way.
    """

    def __init__(self, session: Session, late: float, *, speed: float = 0.0, least: float = 0.0) -> None:
        self._session, self._late, self.speed, self._least = session, late, speed, least
        self._last = self._moved = session.time

    def advance(self, distance: float) -> float:
        """Return the time by which the reference goes on after a step [s], or raise SkillError.

        The distance is that of the robot from the reference before the step [m], [rad].
        """
        session = self._session
        passed, self._last = session.time - self._last, session.time
        pause = min(session.interface.timeout, _PAUSE)
        if passed > pause:
            self.speed, self._moved, passed = 0.0, session.time, pause
        share = min(1.0, max(self._least, 1.5 - distance / self._late))
        self.speed = share * min(1.0, self.speed + passed / _RAMP)
        if share > 0.0:
            self._moved = session.time
        elif session.time - self._moved > _PATIENCE:
            raise SkillError(
                "other",
                f"The robot does not follow its path: for {_PATIENCE:g} s it has been {distance:.3g} (m or "
                f"rad) from it in '{session.phase}'.",
            )
        return self.speed * passed


_AT_LIMIT = 0.02  # distance from a limit at which an object is open or shut, in a long range [m], [rad]
_FIXED = 1e-9  # range of a coordinate up to which it counts as fixed [m], [rad]
_LEAST_TOLERANCE, _SHARE = 1e-3, 0.02  # least tolerance between limits [m], [rad], and share of the distance


def find_object_coordinate(robot: Robot, what: Symbol | str) -> Symbol:
    """Return the coordinate of an object by symbol or name."""
    if not isinstance(what, (str, Symbol)):
        raise InvalidValueError(f"what= is the coordinate of an object, by symbol or name, not {what!r:.60}.")
    coordinate = robot.model.symbol(str(what))
    if robot.moves(coordinate):
        raise InvalidValueError(f"'{coordinate}' is a coordinate of the robot; name one of an object.")
    return coordinate


def check_target(target: Any, tolerance: Any) -> tuple[float | None, float | None]:
    """Return a wanted value and its tolerance [m], [rad], None for their defaults."""
    number = None if target is None else finite_number(target)
    if target is not None and number is None:
        raise InvalidValueError(f"target= is a finite number [m], [rad], not {target!r:.60}.")
    return number, None if tolerance is None else as_tolerance(tolerance, "tolerance=")


def explain_fixed(model: ModelView, coordinate: Symbol, state: State) -> str:
    """Return why a coordinate cannot move from where it is in a state; empty if its limits let it.

    A lock is a limit of the coordinate or of its speed that depends on other coordinates, so these are named.
    """
    for symbol in (coordinate, coordinate.derivative()):
        lower, upper = (float(v) for v in model.limits(symbol, state))
        if upper - lower > _FIXED:
            continue
        limits = [c for c in model.constraints_for(symbol, exact=True).values() if c.expression == symbol]
        keys = sorted({str(s) for c in limits for s in c.symbols if s not in (symbol, coordinate)})
        at = ", ".join(f"'{key}' is {state[key]:.3g}" for key in keys if key in state)
        if at:
            return (
                f"'{coordinate}' is locked at {state[coordinate]:.3g} while {at}. "
                "'kineverse unlock' says what has to move before it."
            )
        if symbol.order:
            return f"'{coordinate}' cannot move: the limits of its speed are {lower:.3g} and {upper:.3g}."
        return f"'{coordinate}' cannot move: its lower and its upper limit are {upper:.3g}."
    return ""


def _find_range(model: ModelView, coordinate: Symbol, state: State) -> tuple[float, float]:
    """Return the limits of a coordinate in a state; where a lock holds it there, those that it can have."""
    lower, upper = model.limits(coordinate, state)
    return model.limits(coordinate) if upper - lower <= _FIXED else (lower, upper)


def choose_tolerance(
    model: ModelView, coordinate: Symbol, state: State, target: float, given: float | None = None
) -> float:
    """Return the distance from a target up to which an object is there [m], [rad].

    By default that is 2 % of the distance, between 1 and 20 mm (mrad). At a limit, where an object is open or
    shut, it is 20 mm. It is never more than a tenth of the coordinate's range.
    """
    lower, upper = _find_range(model, coordinate, state)
    if given is not None:
        tolerance = given
    elif min(abs(target - lower), abs(target - upper)) <= _FIXED:
        tolerance = _AT_LIMIT
    else:
        distance = abs(target - float(state[coordinate]))
        tolerance = min(max(_LEAST_TOLERANCE, _SHARE * distance), _AT_LIMIT)
    return min(tolerance, max(0.0, 0.1 * (upper - lower))) if math.isfinite(upper - lower) else tolerance


def choose_target(model: ModelView, coordinate: Symbol, state: State, target: float | None) -> float:
    """Return a wanted value within limits, by default the limit that is the farthest away."""
    lower, upper = _find_range(model, coordinate, state)
    here = state[coordinate]
    if target is None:
        target = upper if abs(upper - here) >= abs(lower - here) else lower
        if not math.isfinite(target):
            raise InvalidValueError(f"'{coordinate}' has no limit to move to; name a target.")
    lower, upper = model.limits(coordinate)  # a lock may be opened
    if not lower - 1e-9 <= target <= upper + 1e-9:
        raise InvalidValueError(f"'{coordinate}' moves from {lower:g} to {upper:g}, not to {target!r}.")
    return float(target)
