"""Run of a skill from its first look to its outcome: its object, its time, its phases, and how it ends."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

from kineverse.control import Command
from kineverse.errors import InfeasibleError, NotFiniteError
from kineverse.symbols import Symbol

from .outcome import Outcome, SkillError
from .session import Session

_RAMP = 0.5  # time from rest to the usual speed [s]
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
    """

    def __init__(self, session: Session, coordinate: Symbol | None, seconds: float) -> None:
        with suppress(SkillError):  # which the skill says
            session.refresh()  # a robot's time runs on between two skills
        self.session, self.coordinate = session, coordinate
        self.model, self.robot = session.model, session.robot
        self.first, self.begin = session.steps, session.time
        self.until = self.begin + seconds
        self.measures: dict[str, Any] = {}

    @property
    def value(self) -> float:
        """Believed value of the object's coordinate [m], [rad]; NaN without one."""
        return float("nan") if self.coordinate is None else float(self.session.state[self.coordinate])

    @property
    def left(self) -> float:
        """Time that is left [s]."""
        return self.until - self.session.time

    def check_time(self) -> None:
        """Raise SkillError if the time is up."""
        if self.left < 0.0:
            raise SkillError("time", f"The time is up in '{self.session.phase}'.")

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
        reason, kind = "", ""
        try:
            session.await_readings()
            reason = skill()
        except SkillError as failure:
            reason, kind = str(failure), failure.kind
            self.measures |= failure.measures
        except (InfeasibleError, NotFiniteError) as error:
            reason, kind = f"The controller has no command: {error}", "other"
        finally:  # also if the user interrupts it
            if session.commands:
                session.stop()
            session.phase, session.reference, session.vectors, session.contact = "", None, {}, None
        return self.finish(reason, kind)

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
    robot has stopped: nothing catches up. ``speed`` is the present share of the usual speed.
    """

    def __init__(self, session: Session, late: float, *, speed: float = 0.0) -> None:
        self._session, self._late, self.speed = session, late, speed
        self._last = self._moved = session.time

    def advance(self, distance: float) -> float:
        """Return the time by which the reference goes on after a step [s], or raise SkillError.

        The distance is that of the robot from the reference before the step [m], [rad].
        """
        session = self._session
        passed, self._last = session.time - self._last, session.time
        if passed > session.interface.timeout:
            self.speed, self._moved, passed = 0.0, session.time, session.dt
        share = min(1.0, max(0.0, 1.5 - distance / self._late))
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
