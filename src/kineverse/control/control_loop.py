"""A loop around a controller: fixed rate, stale states, errors, and a stop within acceleration limits."""

from __future__ import annotations

import contextlib
import logging
import math
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from kineverse.errors import InvalidValueError, KineverseError, NotFiniteError, UnknownNameError, suggest
from kineverse.state import State
from kineverse.symbols import Symbol

if TYPE_CHECKING:
    from .controller import Controller

Speeds = dict[Symbol, float]
DEFAULT_ACCELERATION = 2.0  # acceleration [m/s^2], [rad/s^2] by which speeds go to zero where none is given

_ROUNDING = 1e-9
logger = logging.getLogger(__name__)


class DurationSummary(NamedTuple):
    """Mean, 99th percentile (of the last 10 000) and maximum of durations [s]; zeros if there are none."""

    mean: float
    p99: float
    worst: float


@dataclass(frozen=True, slots=True)
class LoopReport:
    """Outcome of a control loop."""

    cycles: int  # commands that the sink got
    missed_deadlines: int  # periods that ended without a command
    worst_lateness: float  # longest time from a deadline to the end of its cycle [s]; 0 if none was missed
    stale_cycles: int  # cycles without a state, or with one that was too old
    errors: int  # cycles in which the controller raised an error, or a speed was not finite
    last_error: KineverseError | None
    step_times: DurationSummary  # of the controller, by the clock of the loop
    interrupted: bool  # whether a KeyboardInterrupt ended the loop


def run_control_loop(
    controller: Controller,
    *,
    rate: float,
    source: Callable[[], State | None],
    sink: Callable[[Speeds], object],
    stale: float = 0.1,
    acceleration: float | Mapping[Symbol | str, float] = DEFAULT_ACCELERATION,
    duration: float | None = None,
    until: Callable[[State], bool] | None = None,
    on_error: Callable[[KineverseError], object] | None = None,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], object] = time.sleep,
) -> LoopReport:
    """Run a controller at a fixed rate until a time, a condition or a KeyboardInterrupt.

    Cycle k begins at ``start + k/rate``, so delays do not add up; its deadline is the beginning of the next
    one. After a cycle that is late by whole periods, these are left out and count as missed. The sink gets
    one command per cycle: that of the controller if the state is fresh, else speeds that go to zero within
    ``acceleration``. So they do on errors of the controller (which goes on with the next state), and at the
    end, which is a command of zeros. The controller goes on from the speeds that were commanded last.

    An exception of ``source``, ``until`` or ``on_error``, or one of the controller that is none of this
    package, ends the loop: it is raised once the speeds are zero. One of the sink is raised at once, after
    an attempt to command zeros; so is a second KeyboardInterrupt.
    """
    for name, value in (("rate", rate), ("stale", stale), ("duration", duration)):
        if value is not None and not (isinstance(value, int | float) and 0 < value < math.inf):
            raise InvalidValueError(f"{name}= is a positive number, not {value!r}.")
    reductions = {s: a / rate for s, a in _accelerations(controller.speeds, acceleration).items()}
    loop = _Loop(controller, source, until, on_error, clock, stale, reductions, DEFAULT_ACCELERATION / rate)
    start, period, cycle = clock(), 1.0 / rate, 0
    end = None if duration is None else start + duration
    missed, worst, interrupted = 0, 0.0, False
    while True:
        try:
            wait = start + cycle * period - clock()
            if wait > 0.0:
                sleep(wait)
            if end is not None and start + cycle * period >= end:
                loop.stopping = True
            speeds = loop.next_speeds()
            sink(dict(speeds))
            loop.last = speeds
            loop.cycles += 1
            late = clock() - start - (cycle + 1) * period
            if late > _ROUNDING:
                missed, worst = missed + 1 + int(late / period), max(worst, late)
                cycle += int(late / period)
            cycle += 1
            if loop.stopping and not any(speeds.values()):
                break
        except KeyboardInterrupt:
            if interrupted:
                sink(loop.zeros())
                raise
            loop.stopping = interrupted = True
        except BaseException:
            with contextlib.suppress(Exception):
                sink(loop.zeros())
            raise
    if loop.fatal is not None:
        raise loop.fatal
    problems = loop.stale_cycles, loop.errors, loop.last_error
    return LoopReport(loop.cycles, missed, worst, *problems, loop.step_times(), interrupted)


class _Loop:
    def __init__(
        self,
        controller: Controller,
        source: Callable[[], State | None],
        until: Callable[[State], bool] | None,
        on_error: Callable[[KineverseError], object] | None,
        clock: Callable[[], float],
        stale: float,
        reductions: Mapping[Symbol, float],
        other: float,
    ) -> None:
        self._controller, self._source, self._until, self._on_error = controller, source, until, on_error
        self._clock, self._stale, self._reductions, self._other = clock, stale, reductions, other
        self._state: State | None = None
        self._stamp = -math.inf
        self._follows = False
        """Whether the last command was that of the controller."""
        self._durations: deque[float] = deque(maxlen=10_000)
        self._total, self._worst, self._steps = 0.0, 0.0, 0
        self.last: Speeds = dict.fromkeys(controller.speeds, 0.0)
        self.cycles = self.stale_cycles = self.errors = 0
        self.last_error: KineverseError | None = None
        self.fatal: Exception | None = None
        self.stopping = False

    def next_speeds(self) -> Speeds:
        """Return the speeds of this cycle, those of the controller or slower ones than the last."""
        speeds = None
        if not self.stopping:
            try:
                speeds = self._controlled()
            except Exception as error:  # whatever it is, the robot stops first
                self.fatal, self.stopping = error, True
        self._follows = speeds is not None
        return self._slower() if speeds is None else speeds

    def zeros(self) -> Speeds:
        return dict.fromkeys(self.last, 0.0)

    def step_times(self) -> DurationSummary:
        if not self._steps:
            return DurationSummary(0.0, 0.0, 0.0)
        p99 = float(np.percentile(self._durations, 99))
        return DurationSummary(self._total / self._steps, p99, self._worst)

    def _controlled(self) -> Speeds | None:
        """Return the controller's speeds; None without a fresh state, after an error, or at the end."""
        state = self._fresh_state()
        if state is None:
            self.stale_cycles += 1
            return None
        if self._until is not None and self._until(state):
            self.stopping = True
            return None
        try:
            return self._step(state)
        except KineverseError as error:
            self.errors += 1
            if self.last_error is None or str(self.last_error) != str(error):
                logger.warning("The controller fails, so the speeds go to zero: %s", error)
            self.last_error = error
            if self._on_error is not None:
                self._on_error(error)
            return None

    def _fresh_state(self) -> State | None:
        new = self._source()
        now = self._clock()
        if new is not None:
            self._state, self._stamp = new, now if new.stamp is None else new.stamp
        return self._state if abs(now - self._stamp) <= self._stale else None

    def _step(self, state: State) -> Speeds:
        if not self._follows:
            self._controller.reset(self.last)
        begin = self._clock()
        try:
            speeds = {s: float(v) for s, v in self._controller.step(state).speeds.items()}
        finally:
            taken = self._clock() - begin
            self._durations.append(taken)
            self._total, self._worst = self._total + taken, max(self._worst, taken)
            self._steps += 1
        wrong = [str(s) for s, v in speeds.items() if not math.isfinite(v)]
        if wrong:
            raise NotFiniteError(f"The controller's command is not finite for {', '.join(wrong)}.", wrong)
        return speeds

    def _slower(self) -> Speeds:
        steps = {s: min(abs(v), self._reductions.get(s, self._other)) for s, v in self.last.items()}
        return {s: v - math.copysign(steps[s], v) for s, v in self.last.items()}


def _accelerations(
    speeds: Sequence[Symbol], acceleration: float | Mapping[Symbol | str, float]
) -> dict[Symbol, float]:
    if not isinstance(acceleration, Mapping):
        acceleration = dict.fromkeys(speeds, acceleration)
    known = {str(name): s for s in speeds for name in (s, s.position)}
    result = dict.fromkeys(speeds, DEFAULT_ACCELERATION)
    for key, value in acceleration.items():
        if str(key) not in known:
            known_speeds = suggest(str(key), known, "speed")
            raise UnknownNameError(f"The controller commands no speed of '{key}'. {known_speeds}")
        if not (isinstance(value, int | float) and 0 < value < math.inf):
            raise InvalidValueError(f"The acceleration of '{key}' is a positive number, not {value!r}.")
        result[known[str(key)]] = float(value)
    return result
