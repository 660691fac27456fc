"""Opening and closing of articulated objects, one after another, by one robot in one world."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from kineverse.errors import KineverseError
from kineverse.state import State
from kineverse.worlds import World

from .articulated_objects import ArticulatedObject
from .belief import Belief
from .opening.grasped_opening import open_object
from .outcome import Outcome
from .session import Session

_PLANS = ("plan", "place")  # computations that are no control steps


@dataclass(frozen=True, slots=True)
class OpenCloseReport:
    """Result of opening and closing an object, true if both were done.

    Attributes
    ----------
    opened, closed
        Outcomes; None for what was not begun.
    estimate_error
        Largest difference of the believed to the true coordinate meanwhile [m], [rad].
    steps
        CPU times of the control steps [s].
    """

    object: ArticulatedObject
    opened: Outcome | None
    closed: Outcome | None
    estimate_error: float
    steps: tuple[float, ...]

    def __bool__(self) -> bool:
        return bool(self.opened) and bool(self.closed)

    @property
    def outcomes(self) -> tuple[Outcome, ...]:
        """Outcomes of what was begun."""
        return tuple(one for one in (self.opened, self.closed) if one is not None)

    @property
    def pushed(self) -> bool:
        """True if it was pushed, because no grasp led on."""
        return any(one.measures.get("pushed", False) for one in self.outcomes)

    @property
    def seconds(self) -> float:
        """Time in the world [s]."""
        return sum(one.seconds for one in self.outcomes)

    @property
    def grasp_error(self) -> float:
        """Largest motion of the held object in the hand [m]; NaN if nothing was held."""
        result = [float(one.measures.get("grasp_error", math.nan)) for one in self.outcomes]
        return max((error for error in result if not math.isnan(error)), default=math.nan)

    @property
    def reason(self) -> str:
        """Reason why it was not done; empty if it was."""
        return "" if self else (self.outcomes[-1].reason if self.outcomes else "It was not begun.")


class OpenCloseRunner:
    """Robot that opens and closes objects, one after another.

    After an object that was not done, the world is reset, so that the next one begins as the first did.

    Parameters
    ----------
    world
        World with the robot, which is reset to the start.
    start
        State at the beginning and after resets.
    belief
        Source of the state; the truth by default.
    on_step
        Is called with the session after each step.
    hand
        Frame of the hand; the likeliest gripper by default.
    seconds
        Largest time of one skill in the world [s].
    seed
        Seed of all searches.

    Attributes
    ----------
    session
        The robot in the world.
    current
        Object that is handled; None before the first.
    opening
        True while it is opened, False while it is closed.
    """

    def __init__(
        self,
        world: World,
        start: State,
        *,
        belief: Belief | None = None,
        on_step: Callable[[Session], object] | None = None,
        hand: str | None = None,
        seconds: float = 60.0,
        seed: int = 0,
    ) -> None:
        world.reset(start)
        self.session = Session(world, belief=belief, on_step=self._look)
        self.current: ArticulatedObject | None = None
        self.opening = True
        self._start, self._on_step = start, on_step
        self._options: dict[str, Any] = {"hand": hand, "seconds": seconds, "seed": seed}
        self._error, self._failed = 0.0, False

    def open_and_close(self, one: ArticulatedObject) -> OpenCloseReport:
        """Open an object and close it, and report it."""
        session, self.current, self.opening, self._error = self.session, one, True, 0.0
        if self._failed:
            session.restart(self._start)
        counted = {name: len(times) for name, times in session.cpu.items()}
        opened = self._act(lambda: self._move(one, one.opened))
        closed = None
        if opened:
            self.opening = False
            closed = self._act(lambda: self._move(one, one.shut))
        times = [
            time
            for name, times in session.cpu.items()
            if not name.startswith(_PLANS)
            for time in times[counted.get(name, 0) :]
        ]
        self._failed = not (opened and closed)
        return OpenCloseReport(one, opened, closed, self._error, tuple(times))

    def _move(self, one: ArticulatedObject, target: float) -> Outcome:
        return open_object(self.session, one.coordinate, target=target, **self._options)

    def _act(self, skill: Callable[[], Outcome]) -> Outcome:
        """Return the outcome of a skill; an error of the library is one that is not done."""
        session, one = self.session, self.current
        assert one is not None
        begin, first = session.world.time, session.steps
        try:
            return skill()
        except KineverseError as error:
            world, reason = session.world, f"{type(error).__name__}: {error}"
            value, seconds = float(world.state[one.coordinate]), world.time - begin
            steps, measures = session.steps - first, {"failure": "other"}
            return Outcome(False, value, reason, world.name, seconds, steps, measures)
        finally:
            session.phase, session.reference, session.vectors = "", None, {}

    def _look(self, session: Session) -> None:
        if self.current is not None:
            coordinate = self.current.coordinate
            difference = session.state[coordinate] - session.world.state[coordinate]
            self._error = max(self._error, abs(float(difference)))
        if self._on_step is not None:
            self._on_step(session)
