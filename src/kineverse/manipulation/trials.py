"""Trials of skills in simulated worlds: outcomes judged by the truth, and openings one after another."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from kineverse.errors import KineverseError
from kineverse.grasping import Gripper, Handle, find_handle
from kineverse.state import State
from kineverse.worlds import RunMetrics, SimulatedWorld

from .articulated_objects import ArticulatedObject
from .opening.approach_planner import Opener
from .opening.base_placement import BasePlacement
from .opening.contact_phases import PhasePlanner
from .opening.grasped_opening import open_object
from .outcome import Outcome
from .session import Belief, Session

_SHORT_WAY, _SHORT_TURN = 0.03, math.radians(6.0)
"""Distance [m] and angle [rad] by which a part may be less open than the skill believes."""


@dataclass(frozen=True, slots=True)
class JudgedOutcome(Outcome):
    """Outcome of a skill in a simulated world, whose value is the true one.

    It is done if the skill claims it, it is true, and nothing overlapped on the way.

    Attributes
    ----------
    claimed
        Whether the skill believes that it is done.
    """

    claimed: bool = False


def judge_outcome(outcome: Outcome, metrics: RunMetrics) -> JudgedOutcome:
    """Return the outcome of a skill as the metrics of its run have it.

    The object has to be where it was wanted; a part whose motion is measured, as far open as the skill says.

    Parameters
    ----------
    outcome
        What the skill believes; its measures ``target`` and ``tolerance`` say where the object was wanted.
    metrics
        Metrics of the run, with the coordinate of the object. Their measures are added, and the ``way`` and
        the ``turn`` of a part replace what the skill believes of them.
    """
    value, overlap, objections = metrics.value, metrics.overlap, list[str]()
    measures = {**metrics.measures, **outcome.measures}
    target, tolerance = measures.get("target", math.nan), measures.get("tolerance", math.nan)
    if abs(value - target) > tolerance:
        objections.append(f"The world says {value:.4g}, not {target:.4g} ± {tolerance:.2g}.")
    if not math.isnan(metrics.way):
        way, turn = measures.get("way", 0.0), measures.get("turn", 0.0)
        measures |= {"way": metrics.way, "turn": metrics.turn}
        if metrics.way < way - _SHORT_WAY or metrics.turn < turn - _SHORT_TURN:
            opened = f"{100 * metrics.way:.0f} cm and {math.degrees(metrics.turn):.0f}°"
            objections.append(f"The world says that it is open by {opened}.")
    if math.isnan(value - target - tolerance) and math.isnan(metrics.way):
        objections.append("No truth was measured: metrics need the coordinate of the object, or its part.")
    if not metrics.is_complete:
        objections.append("The run was not measured: give its metrics to the session, as on_step=.")
    if not outcome:
        objections = []  # the skill has said why
    if overlap is not None:
        objections.append(str(overlap))
    done, reason = outcome.done and not objections, outcome.reason
    if objections:
        reason = " ".join([f"{reason.removesuffix('.')}.", *objections])
    if outcome and not done:
        measures["failure"] = "other" if overlap is None else "collision"
    return JudgedOutcome(
        done, outcome.value if math.isnan(value) else value, reason, outcome.world, outcome.seconds,
        outcome.steps, measures, outcome.done,
    )  # fmt: skip


def stand_at_handle(
    session: Session,
    world: SimulatedWorld,
    handle: Handle,
    target: float,
    *,
    gripper: Gripper | None = None,
    placements: int = 600,
    seed: int = 0,
) -> bool:
    """Put a base on wheels that does not drive by itself to where the hand takes a handle first.

    It is put there by a reset of the world. Others stay where they are: they drive in the skill.

    Parameters
    ----------
    session
        The robot in the world.
    world
        The world, whose state is read.
    handle
        Handle of the object.
    target
        Wanted value of the object's coordinate [m], [rad].
    gripper
        The likeliest one by default.
    placements, seed
        As for :func:`.open_object`.

    Returns
    -------
    bool
        Whether the world was reset.
    """
    state = world.state
    opener = Opener.of(session.robot, gripper or session.robot.gripper(), state)
    search, approaches = opener.search, opener.approaches
    if not approaches.explain_standing(state):
        return False

    def place(placement: BasePlacement) -> State:
        base = zip(placement.coordinates, placement.approach.tolist(), strict=True)
        return state.updated({s: v for s, v in base if s in search.standing})

    phase = PhasePlanner(session.model, session.robot, handle).find_next(state, target)
    found = search.find(
        state,
        opener.grasps(handle, state, seed),
        phase.way if phase.handle is handle else target,
        accept=lambda placement: bool(approaches.plan_to(place(placement), placement, seed)),
        samples=placements,
        seed=seed,
    )
    if found:
        world.reset(place(found))
        session.refresh()
    return bool(found)


@dataclass(frozen=True, slots=True)
class OpenCloseReport:
    """Result of opening and closing an object, true if both were done.

    Attributes
    ----------
    opened, closed
        Outcomes; None for what was not begun.
    steps
        CPU times of the control steps [s].
    """

    object: ArticulatedObject
    opened: JudgedOutcome | None
    closed: JudgedOutcome | None
    steps: tuple[float, ...]

    def __bool__(self) -> bool:
        return bool(self.opened) and bool(self.closed)

    @property
    def outcomes(self) -> tuple[JudgedOutcome, ...]:
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
        return self._find_largest("grasp_error")

    @property
    def estimate_error(self) -> float:
        """Largest difference of the believed to the true coordinate [m], [rad]; NaN without a step."""
        return self._find_largest("estimate_largest")

    @property
    def reason(self) -> str:
        """Reason why it was not done; empty if it was."""
        return "" if self else (self.outcomes[-1].reason if self.outcomes else "It was not begun.")

    def _find_largest(self, name: str) -> float:
        result = [float(one.measures.get(name, math.nan)) for one in self.outcomes]
        return max((value for value in result if not math.isnan(value)), default=math.nan)


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
        Source of the state; by default as for :class:`.Session`.
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
        world: SimulatedWorld,
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
        self._world, self._start, self._on_step = world, start, on_step
        self._gripper = self.session.robot.gripper(hand)
        self._seconds, self._seed = seconds, seed
        self._metrics: RunMetrics | None = None
        self._failed = False

    def open_and_close(self, one: ArticulatedObject) -> OpenCloseReport:
        """Open an object and close it, and report it."""
        self.current = one
        if self._failed:
            self._world.reset(self._start)
            if self.session.broken:  # a simulation that was not to be trusted begins anew
                self.session = Session(self._world, belief=self.session.belief, on_step=self._look)
            self.session.refresh()
        session = self.session
        counted = {name: len(times) for name, times in session.cpu.items()}
        self.opening = True
        opened, closed = self._move(one, one.opened), None
        if opened:
            self.opening = False
            closed = self._move(one, one.shut)
        times = [time for name, times in session.cpu.items() for time in times[counted.get(name, 0) :]]
        self._failed = not (opened and closed)
        return OpenCloseReport(one, opened, closed, tuple(times))

    def _move(self, one: ArticulatedObject, target: float) -> JudgedOutcome:
        """Return the outcome of an opening; an error of the library is one that is not done."""
        session, world, gripper, metrics = self.session, self._world, self._gripper, None
        begin, first = session.time, session.steps
        try:
            handle = find_handle(world.model, one.coordinate)
            if stand_at_handle(session, world, handle, target, gripper=gripper, seed=self._seed):
                begin = session.time
            metrics = self._metrics = RunMetrics(
                world, one.coordinate, gripper=gripper, handle=handle.frame, start=self._start
            )
            outcome = open_object(
                session, one.coordinate, target=target, hand=gripper, handle=handle,
                seconds=self._seconds, seed=self._seed,
            )  # fmt: skip
        except KineverseError as error:
            reason = f"{type(error).__name__}: {error}"
            outcome = Outcome(
                False, float(session.state[one.coordinate]), reason, world.name,
                session.time - begin, session.steps - first, {"failure": "other"},
            )  # fmt: skip
        finally:
            self._metrics = None
        return judge_outcome(outcome, metrics or RunMetrics(world, one.coordinate))

    def _look(self, session: Session) -> None:
        if self._metrics is not None:
            self._metrics(session)
        if self._on_step is not None:
            self._on_step(session)
