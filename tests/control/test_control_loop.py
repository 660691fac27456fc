"""The control loop with fake time: its schedule, stale states, errors and ends."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from control_models import planar_arm

import kineverse as kv
from kineverse.control.control_loop import DEFAULT_ACCELERATION, LoopReport, run_control_loop
from kineverse.errors import InfeasibleError, InvalidValueError, NotFiniteError, UnknownNameError

A, B = kv.velocity("arm"), kv.velocity("base")
POSITION = kv.position("arm")
RATE = 100.0


@dataclass
class FakeCommand:
    speeds: Mapping[kv.Symbol, float]


class World:
    """A clock that stands still unless something waits, and everything that a loop is connected to.

    ``faults`` maps from the number of a step to what happens in it.
    """

    speeds = (A, B)

    def __init__(self, speeds: tuple[float, float] = (0.5, -1.0), start: float = 1000.0) -> None:
        self.now, self.wanted = start, speeds
        self.start = start
        self.commands: list[dict[kv.Symbol, float]] = []
        self.times: list[float] = []
        self.resets: list[dict[kv.Symbol, float]] = []
        self.steps = 0
        self.faults: dict[int, Callable[[], Any]] = {}
        self.silent: Callable[[float], bool] = lambda t: False
        self.delay: Callable[[int], float] = lambda k: 0.001
        self.stamped = True

    def clock(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        assert seconds > 0
        self.now += seconds + 2e-5  # as operating systems do, never too early

    def source(self) -> kv.State | None:
        if self.silent(self.now - self.start):
            return None
        return kv.State({POSITION: 0.0}, stamp=self.now if self.stamped else None)

    def sink(self, speeds: dict[kv.Symbol, float]) -> None:
        assert all(math.isfinite(v) for v in speeds.values())
        self.commands.append(speeds)
        self.times.append(self.now - self.start)

    def step(self, state: kv.State) -> FakeCommand:
        step = self.steps
        self.steps += 1
        self.now += self.delay(step)
        if step in self.faults:
            return FakeCommand(self.faults[step]())
        return FakeCommand(dict(zip(self.speeds, self.wanted, strict=True)))

    def reset(self, speeds: Mapping[kv.Symbol, float]) -> None:
        self.resets.append(dict(speeds))

    def run(self, **options: Any) -> LoopReport:
        options = {"rate": RATE, "source": self.source, "sink": self.sink, "duration": 1.0, **options}
        return run_control_loop(self, clock=self.clock, sleep=self.sleep, **options)

    def of(self, speed: kv.Symbol) -> Any:
        return np.array([command[speed] for command in self.commands])


def fail(error: BaseException) -> Callable[[], Any]:
    def raise_it() -> Any:
        raise error

    return raise_it


def assert_smooth(world: World, accelerations: tuple[float, float] = (DEFAULT_ACCELERATION,) * 2) -> None:
    """Each command is that of the controller, or closer to zero than the one before, within accelerations."""
    for speed, wanted, acceleration in zip(world.speeds, world.wanted, accelerations, strict=True):
        values = world.of(speed)
        for before, after in itertools.pairwise(values):
            if after != wanted:
                assert 0 <= after * math.copysign(1.0, before) <= abs(before)
                assert abs(after - before) <= acceleration / RATE + 1e-12


def test_the_schedule_does_not_drift() -> None:
    """Neither by the time of steps nor by late wake-ups."""
    world = World()
    world.delay = lambda k: 0.001 + 0.007 * ((k * 7919) % 13) / 13
    report = world.run(duration=50.0)
    begins = np.array(world.times[:5000]) - [world.delay(k) for k in range(5000)]
    assert abs(begins - np.arange(5000) / RATE).max() < 1e-4
    assert (report.missed_deadlines, report.worst_lateness) == (0, 0.0)
    assert report.cycles == len(world.commands)


def test_missed_deadlines_are_counted_and_left_out() -> None:
    """A step of 35 ms at 100 Hz misses the deadlines at 10, 20 and 30 ms; the next cycle begins late, at once."""
    world = World()
    world.delay = lambda k: 0.035 if k == 20 else 0.012 if k == 40 else 0.001
    report = world.run()
    assert report.missed_deadlines == 3 + 1
    assert report.worst_lateness == pytest.approx(0.025, abs=1e-4)
    begins = np.array([t - world.delay(k) for k, t in enumerate(world.times[: world.steps])])
    assert begins[21] - begins[20] == pytest.approx(0.035, abs=1e-4)
    assert begins[22] == pytest.approx(0.24, abs=1e-4)
    assert begins[41] - begins[40] == pytest.approx(0.012, abs=1e-4)
    assert abs(np.modf(begins[45:] * RATE + 0.01)[0]).max() < 0.03


def test_durations_of_steps_are_summarised() -> None:
    world = World()
    world.delay = lambda k: 0.001 * (1 + k % 4)
    times = world.run().step_times
    assert times.mean == pytest.approx(0.0025)
    assert times.worst == pytest.approx(0.004)
    assert 0.0039 < times.p99 <= times.worst + 1e-12


@pytest.mark.parametrize("stamped", [True, False])
def test_speeds_go_to_zero_if_states_are_stale(stamped: bool) -> None:
    """From .1 s after the last state, monotone and within accelerations; and on again with the next one."""
    world = World()
    world.stamped, world.silent = stamped, lambda t: 0.3 < t < 1.2
    accelerations = (1.0, 4.0)
    report = world.run(duration=1.5, acceleration={"arm": 1.0, B: 4.0})
    assert_smooth(world, accelerations)
    times, arm = np.array(world.times), world.of(A)
    assert (arm[times < 0.39] == 0.5).all()
    assert (np.diff(arm[(times > 0.42) & (times < 0.89)]) < 0).all()
    assert (arm[(times > 0.93) & (times < 1.19)] == 0.0).all()
    assert (world.of(B)[(times > 0.68) & (times < 1.19)] == 0.0).all()
    assert (arm[(times > 1.22) & (times < 1.49)] == 0.5).all()
    assert 78 <= report.stale_cycles <= 82
    assert world.resets[-1] == {A: 0.0, B: 0.0}


def test_stamps_of_another_clock_are_stale() -> None:
    for offset in (-5.0, 1.7e9):
        world = World()
        report = world.run(source=lambda w=world, o=offset: kv.State({POSITION: 0.0}, stamp=w.now + o))
        assert report.stale_cycles == 100
        assert world.steps == 0
        assert not world.of(A).any()


def test_nothing_moves_before_the_first_state() -> None:
    world = World()
    world.silent = lambda t: t < 0.5
    assert world.run().stale_cycles == 50
    assert world.commands[0] == {A: 0.0, B: 0.0}
    assert world.of(A)[60] == 0.5


ERRORS = {
    "infeasible": (fail(InfeasibleError("contradict")), InfeasibleError),
    "not finite": (fail(NotFiniteError("singular")), NotFiniteError),
    "NaN": (lambda: {A: math.nan, B: 0.0}, NotFiniteError),
    "infinite": (lambda: {A: 0.0, B: -math.inf}, NotFiniteError),
}


@pytest.mark.parametrize("kind", ERRORS)
def test_errors_of_the_controller_slow_down_and_are_reported(kind: str) -> None:
    fault, error = ERRORS[kind]
    world, told = World(), []
    world.faults = dict.fromkeys(range(30, 40), fault)
    report = world.run(on_error=told.append)
    assert_smooth(world)
    assert report.errors == len(told) == 10
    assert isinstance(report.last_error, error)
    assert report.last_error is told[-1]
    np.testing.assert_allclose(world.of(A)[29:41], [0.5 - 0.02 * k for k in range(11)] + [0.5], atol=1e-12)
    assert world.resets == [{A: 0.0, B: 0.0}, *world.resets[1:]]
    assert world.resets[-1][A] == pytest.approx(0.3)


@pytest.mark.parametrize("part", ["controller", "source", "until", "on_error"])
def test_other_exceptions_stop_the_robot_and_are_raised(part: str) -> None:
    world, error = World(), RuntimeError("cable")
    options: dict[str, Any] = {}

    def late(*arguments: Any) -> Any:
        if world.now - world.start > 0.2:
            raise error
        return world.source() if part == "source" else False

    if part == "controller":
        world.faults[20] = fail(error)
    elif part == "on_error":
        world.faults[20], options["on_error"] = fail(InfeasibleError("contradict")), late
    else:
        options[part] = late
    with pytest.raises(RuntimeError, match="cable"):
        world.run(**options)
    assert_smooth(world)
    assert world.of(A).max() == 0.5
    assert world.commands[-1] == {A: 0.0, B: 0.0}
    assert world.times[-1] < 0.75


def test_an_exception_of_the_sink_is_raised_after_an_attempt_to_stop() -> None:
    world, got = World(), []

    def sink(speeds: dict[kv.Symbol, float]) -> None:
        got.append(speeds)
        if len(got) == 10:
            raise OSError("broken pipe")

    with pytest.raises(OSError, match="broken pipe"):
        world.run(sink=sink)
    assert len(got) == 11
    assert got[-1] == {A: 0.0, B: 0.0}


def test_the_loop_ends_with_zeros() -> None:
    """After the duration, when the condition holds, or by a KeyboardInterrupt, within accelerations."""
    for options in ({"duration": 0.4}, {"until": lambda state: state.stamp > 1000.4}, {}):
        world = World()
        if not options:
            world.faults[40] = fail(KeyboardInterrupt())
        report = world.run(**options)
        assert_smooth(world)
        assert report.interrupted == (not options)
        assert world.commands[-1] == {A: 0.0, B: 0.0}
        assert world.times[-1] == pytest.approx(0.4 + 1.0 / DEFAULT_ACCELERATION, abs=0.04)


def test_a_second_keyboard_interrupt_ends_at_once() -> None:
    world = World()
    world.faults[40] = fail(KeyboardInterrupt())

    def sleep(seconds: float) -> None:
        if world.now - world.start > 0.5:
            raise KeyboardInterrupt
        world.sleep(seconds)

    with pytest.raises(KeyboardInterrupt):
        run_control_loop(
            world, rate=RATE, source=world.source, sink=world.sink, clock=world.clock, sleep=sleep
        )
    assert world.commands[-1] == {A: 0.0, B: 0.0}
    assert world.commands[-2][B] < -0.7


def test_commands_belong_to_the_sink() -> None:
    world = World()

    def sink(speeds: dict[kv.Symbol, float]) -> None:
        world.sink(dict(speeds))
        speeds.clear()

    world.run(sink=sink, duration=0.1)
    assert world.commands[-1] == {A: 0.0, B: 0.0}
    assert_smooth(world)


def test_bad_input_is_told() -> None:
    world = World()
    for options in ({"rate": 0.0}, {"rate": math.nan}, {"stale": -1.0}, {"duration": math.inf}):
        with pytest.raises(InvalidValueError, match="positive number"):
            world.run(**options)
    with pytest.raises(UnknownNameError, match=r"no speed of 'amr'. Did you mean 'arm"):
        world.run(acceleration={"amr": 1.0})
    with pytest.raises(InvalidValueError, match="acceleration of 'arm"):
        world.run(acceleration={"arm": 0.0})
    with pytest.raises(InvalidValueError, match="acceleration of"):
        world.run(acceleration=-1.0)
    assert not world.commands


def test_a_controller_runs_in_a_loop() -> None:
    """A joint reaches its goal in a simulated world, which stamps its states."""
    pytest.importorskip("daqp")
    model = planar_arm(1)
    q = model.symbol("joint1")
    controller = kv.control.Controller(model, [kv.control.Goal(q, 0.7)], dt=1 / RATE)
    world, state = World(), model.default_state()

    def source() -> kv.State:
        return kv.State(state, stamp=world.now)

    def sink(speeds: dict[kv.Symbol, float]) -> None:
        nonlocal state
        state = model.integrate(state, speeds, 1 / RATE)

    report = run_control_loop(
        controller,
        rate=RATE,
        source=source,
        sink=sink,
        until=lambda s: abs(s[q] - 0.7) < 1e-3,
        duration=20.0,
        clock=world.clock,
        sleep=world.sleep,
    )
    assert state[q] == pytest.approx(0.7, abs=2e-3)
    assert report.errors == report.stale_cycles == 0
    assert report.cycles < 1000
