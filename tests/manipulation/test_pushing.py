"""Pushing: contact points, the controller, the skill in the kinematic world, and base placement."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import kineverse as kv
from cupboards import box
from kineverse.articulations import OmniBase
from kineverse.control.contact_constraints import ContactSlots
from kineverse.errors import InvalidValueError, UnknownNameError
from kineverse.geometry import Scene
from kineverse.manipulation.belief import TrackedBelief
from kineverse.manipulation.outcome import Outcome
from kineverse.manipulation.pushing import base_placement, push_program, vectors
from kineverse.manipulation.pushing.base_placement import RollOut, find_push_start, roll_out
from kineverse.manipulation.pushing.contact_selection import PushSurface, find_push_tool
from kineverse.manipulation.pushing.guarded_contact import PushPress
from kineverse.manipulation.pushing.push_controller import Pushing
from kineverse.manipulation.pushing.push_program import ContactRates, PushNumbers, PushPair
from kineverse.manipulation.pushing.push_skill import PushRun, plan_push_approach, push
from kineverse.manipulation.pushing.vectors import move_point
from kineverse.manipulation.robot_sources import SHIPPED
from kineverse.manipulation.session import Session
from kineverse.worlds import KinematicWorld, MujocoWorld, Observation, Robot, RunMetrics, Sensors, TrueBelief
from kineverse_studies.experiments.table1_push import SHIPPED_KITCHEN, make_push_setup
from robot_interface_proxy import InterfaceOnly

PUSHER = "robot/finger"
TIP = kv.array([0.0, 0.0, 0.0])


@cache
def room() -> kv.Model:
    """A base with a lift and a finger, before a door about z, a flap about y, and a drawer."""
    model = kv.Model()
    lift, door, flap, drawer = (kv.position(n) for n in ("robot/lift", "door", "flap", "drawer"))
    with model.edit() as edit:
        edit.apply(OmniBase(name="robot/base", parent="world", child="robot/base", speed=1.0, turn=1.0))
        edit.add_frame("robot/torso", "robot/base", np.eye(4), body=box(0.3, 0.3, 0.3, at=(0, 0, 0.2)))
        edit.add_frame("robot/arm", "robot/torso", kv.translation(0, 0, lift), body=box(0.1, 0.1, 0.1))
        edit.add_frame(PUSHER, "robot/arm", kv.translation(0.5, 0, 0), body=box(0.2, 0.03, 0.03))
        edit.add_frame("wall", "world", kv.translation(2.2, 0, 1), body=box(0.1, 3, 2))
        edit.add_frame("door", "world", kv.translation(1.6, 1.2, 1) @ kv.rotation_z(-door))
        edit.add_frame("door/panel", "door", np.eye(4), body=box(0.02, 0.5, 0.6, at=(0, -0.25, 0)))
        edit.add_frame("flap", "world", kv.translation(1.6, 0, 0.6) @ kv.rotation_y(-flap))
        edit.add_frame("flap/panel", "flap", np.eye(4), body=box(0.02, 0.5, 0.5, at=(0, 0, 0.25)))
        edit.add_frame("drawer", "world", kv.translation(1.6 - drawer, -1, 0.8), body=box(0.02, 0.5, 0.3))
        edit.add_frame("drawer/handle", "drawer", kv.translation(-0.05, 0, 0), body=box(0.02, 0.2, 0.02))
        edit.constrain("lift", 0.3, lift, 1.6)
        edit.constrain("lift/speed", -0.5, lift.derivative(), 0.5)
        for symbol, most in ((door, 1.5), (flap, 1.5), (drawer, 0.4)):
            edit.constrain(f"{symbol}/range", 0, symbol, most)
            edit.constrain(f"{symbol}/speed", -1, symbol.derivative(), 1)
    return model


def opened(**values: float) -> kv.State:
    """Return the state with a lifted arm and open objects."""
    return room().default_state().updated({"robot/lift": 0.8, **values})


def begin(
    world: KinematicWorld | MujocoWorld,
    *watchers: Callable[[Session], object],
    sensors: Sensors | None = None,
) -> Session:
    """Return a session with the interface of a world alone, which knows its truth or estimates from sensors."""

    def look(session: Session) -> None:
        for watch in watchers:
            watch(session)

    belief = TrueBelief(world) if sensors is None else TrackedBelief(world.model, "robot", sensors)
    return Session(InterfaceOnly(world), belief=belief, on_step=look)


class FaultyReadings:
    """Interface of a world whose readings are wrong for a time, from when a coordinate has moved by 2 cm or 0.02 rad.

    Attributes
    ----------
    moving
        Time after the begin of the fault at which the robot still moved [s].
    """

    def __init__(self, world: KinematicWorld, watched: str, fault: str, seconds: float) -> None:
        self._world, self._watched, self._fault, self._seconds = world, watched, fault, seconds
        self.name, self.model, self.robot = world.name, world.model, world.robot
        self.remarks, self.timeout = world.remarks, world.timeout
        self._first, self._begin, self._last = world.state[watched], math.inf, world.observe()
        self.moving = 0.0

    @property
    def time(self) -> float:
        return self._world.time

    def apply(self, speeds: kv.StateLike, duration: float, *, stamp: float | None = None) -> None:
        before = self._world.state
        self._world.apply(speeds, duration, stamp=stamp)
        after = self._world.state
        if math.isinf(self._begin) and abs(after[self._watched] - self._first) > 0.02:
            self._begin = self.time
        elif self.is_faulty and any(abs(after[s] - before[s]) > 1e-6 for s in self.robot.coordinates):
            self.moving = self.time - self._begin

    @property
    def is_faulty(self) -> bool:
        return 0.0 <= self.time - self._begin < self._seconds

    def observe(self) -> Observation:
        reading = self._world.observe()
        if not self.is_faulty:
            self._last = reading
        elif self._fault == "not a number":
            return replace(reading, joints=dict.fromkeys(reading.joints, math.nan))
        return self._last


READING_FAULTS = (
    ("missing", 0.3, ""), ("missing", 1.0, ""), ("missing", math.inf, "was observed last at"),
    ("not a number", 0.3, ""), ("not a number", math.inf, "are no finite numbers"),
)  # fmt: skip
"""Faults, how long they last [s], and what the outcome says of those that do not end."""


class Locked(KinematicWorld):
    """World in which a coordinate does not move."""

    def apply(self, speeds: object, duration: float, *, stamp: float | None = None) -> None:
        value = self.state["door"]
        super().apply(speeds, duration, stamp=stamp)  # type: ignore[arg-type]
        time = self.time
        self.reset(self.state.updated({"door": value}))
        self._time = time


def test_contact_points_lie_on_the_surface_and_move_as_finite_differences_say() -> None:
    model, start = room(), opened(flap=0.7)
    flap = model.symbol("flap")
    own = [b for b in Scene(model).bodies if b.startswith("robot/")]
    surface = PushSurface(model, flap, ["flap/panel"], own, start, [0.7, 0.0], TIP)
    scene = Scene(model, leave_out=own)
    at, after = surface.at(start), surface.at(start.updated({flap: 0.7 - 1e-6}))
    np.testing.assert_allclose((after.points - at.points) / 1e-6, at.velocities, atol=1e-5)
    scene.update(start)
    for k in range(len(surface)):
        near = scene.point(at.points[k] + 0.01 * at.normals[k])
        assert near is not None
        assert near.body == "flap/panel"
        assert near.distance == pytest.approx(0.01, abs=1e-9)
        _, one = surface.locate(start, k)
        np.testing.assert_allclose(one.velocity, at.velocities[k], atol=1e-12)
        assert one.alignment == pytest.approx(at.alignment[k])
    # Pushed perpendicularly, with the shorter lever near the hinge.
    assert at.alignment.min() > 0.9
    np.testing.assert_allclose(at.normals @ [-np.cos(0.7), 0, -np.sin(0.7)], 1.0, atol=1e-9)


def test_pusher_points_away_from_what_carries_it() -> None:
    tool = find_push_tool(room(), [PUSHER], opened())
    assert tool.frame == PUSHER
    np.testing.assert_allclose(tool.axis, [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(tool.tip, [0.1, 0, 0], atol=1e-6)


def test_contact_slots_keep_a_margin_for_each_pair_and_know_velocities_of_points() -> None:
    model = room()
    scene, speeds = Scene(model), tuple(model.speeds)
    slots = ContactSlots(scene, speeds, 4, margin=0.005, radius=0.3, gain=10.0)
    state = opened(drawer=0.4) | {"robot/base/x": 0.4, "robot/base/y": -1.0}
    slots.update(state.vector(slots.inputs))
    nearest = slots.found[0]
    assert {nearest.a, nearest.b} == {PUSHER, "drawer/handle"}
    n = len(speeds)

    def lower() -> float:
        arrays = np.zeros((n, n)), np.zeros(n), np.zeros((4, n)), np.full(4, -np.inf)
        slots.bind(*arrays)
        slots.write(5.0)
        return float(arrays[3][0])

    assert lower() == pytest.approx(-10 * (nearest.distance - 0.005))
    slots.set_margin(PUSHER, ["drawer", "drawer/*"], -0.001)
    assert lower() == pytest.approx(-10 * (nearest.distance + 0.001))
    point, step = np.array([0.9, -1.0, 0.8]), 1e-6
    finger, handle = (scene.bodies.index(name) for name in (PUSHER, "drawer/handle"))
    twist, still = slots.twist(finger), slots.twist(handle)
    in_finger = np.linalg.inv(model.fk(PUSHER)(state)) @ [*point, 1]
    for k, speed in enumerate(speeds):
        moved = model.integrate(state, {speed: 1.0}, step)
        change = (model.fk(PUSHER)(moved) @ in_finger)[:3] - point
        np.testing.assert_allclose(move_point(twist[:, k].tolist(), tuple(point)), change / step, atol=1e-5)
    along = np.array([str(speed) == "drawer:velocity" for speed in speeds])
    assert np.abs(still[:3, along]).max() > 0.99
    assert not still[:, ~along].any()
    with pytest.raises(UnknownNameError, match="flnger"):
        slots.set_margin("robot/flnger", "*", 0.0)
    with pytest.raises(InvalidValueError, match="margin"):
        slots.set_margin(PUSHER, "drawer", 1.0)


def test_rates_of_a_contact_are_those_of_finite_differences() -> None:
    """Of the gap and of the way of the tip on the object, along tangents of any normal."""
    model = room()
    scene, speeds = Scene(model), tuple(model.speeds)
    slots = ContactSlots(scene, speeds, 4, margin=0.005, radius=0.3, gain=10.0)
    state = opened(flap=0.6) | {"robot/base/x": 0.8, "robot/base/angle": 0.2}
    slots.update(state.vector(slots.inputs))
    hand, thing = scene.bodies.index(PUSHER), scene.bodies.index("flap/panel")
    columns = [3, 0, len(speeds) - 1, 1, 5]
    rates = ContactRates(slots, columns, hand)

    def place(at: kv.State, frame: str, point: Sequence[float]) -> np.ndarray:
        """Return where a point of a body that is at `point` now is at another state."""
        local = np.linalg.inv(model.fk(frame)(state)) @ [*point, 1.0]
        return np.asarray(model.fk(frame)(at) @ local)[:3]

    r, p, tip = (1.3, 0.1, 0.8), (1.5, 0.05, 0.7), (1.4, 0.2, 0.8)
    for normal in (0.0, 0.0, -1.0), (0.6, 0.0, 0.8), (-0.36, 0.48, -0.8):
        pair = PushPair(hand, thing, r, p, normal, 0.1, (0.0, 0.0, 0.0), 1.0)
        frame = np.array([normal, *pair.tangents])
        np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-12)
        found = rates(pair, pair.tangents, tip).reshape(3, -1)
        for k, column in enumerate(columns):
            after = model.integrate(state, {speeds[column]: 1.0}, 1e-6)
            moved = {"r": place(after, PUSHER, r), "p": place(after, "flap/panel", p)}
            gap = (moved["r"] - moved["p"] - np.subtract(r, p)) @ frame[0]
            way = frame[1:] @ (place(after, PUSHER, tip) - place(after, "flap/panel", tip))
            np.testing.assert_allclose(found[:, k], np.array([gap, *way]) / 1e-6, atol=1e-5)


def test_numbers_of_a_push_are_listed_as_its_parameters_are_made() -> None:
    sizes = push_program._SIZES
    assert list(sizes) == [field.name for field in fields(PushNumbers)]
    ends = np.cumsum(list(sizes.values())).tolist()
    values = [
        tuple(map(float, range(end - size, end))) for end, size in zip(ends, sizes.values(), strict=True)
    ]
    numbers = PushNumbers(*(v if len(v) > 1 else v[0] for v in values))  # type: ignore[arg-type]
    assert numbers.listed == [float(k) for k in range(ends[-1])]


@pytest.mark.parametrize(
    ("what", "value"),
    [
        ("door", 0.6),
        *(pytest.param(*one, marks=pytest.mark.long) for one in (("flap", 0.7), ("drawer", 0.4))),
    ],
)
def test_push_shuts_what_touch_alone_can_move(what: str, value: float) -> None:
    """The world reads no speed of the object; the finger stays where it touched, and nothing else is hit."""
    world, start = KinematicWorld(room(), "robot"), opened(**{what: value})
    world.reset(start)
    pushing = Pushing(world.model, "robot", world.model.symbol(what), PUSHER, start, target=0.0)
    metrics = RunMetrics(world, pushing.coordinate)
    outcome = push(begin(world, metrics), what, pushing=pushing, seconds=18.0, plan=True)
    assert outcome, outcome.reason
    assert abs(world.state[what]) < 0.02
    assert outcome.measures["losses"] == metrics.measures["contact_losses"] == 0
    assert metrics.overlap is None
    assert metrics.measures["pressed"] <= 1e-3
    assert metrics.measures["limit_violation"] <= 1e-6
    assert metrics.measures["jitter"] < 0.1


SENSORS = Sensors.parse("3mm+3mm/m,0.5deg,30Hz")


def test_push_on_estimates_feels_for_the_object() -> None:
    world = KinematicWorld(room(), "robot", sensors=SENSORS)
    world.reset(opened(door=0.3) | {"robot/base/y": 1.0})
    outcome = push(begin(world, sensors=SENSORS), "door", bodies=PUSHER)
    assert outcome, outcome.reason
    assert abs(world.state["door"]) < 0.02
    assert abs(outcome.value - world.state["door"]) < 0.01
    assert outcome.measures["losses"] <= 1


def test_push_begins_at_the_present_of_a_robot_whose_time_runs_on() -> None:
    world = KinematicWorld(room(), "robot")
    world.reset(opened(drawer=0.1) | {"robot/base/y": -1.0, "robot/base/x": 0.4})
    session = begin(world)
    world.apply({"robot/base/x:velocity": 0.1}, 0.1)
    world.apply({}, 60.0)
    outcome = push(session, "drawer", bodies=PUSHER, seconds=20.0)
    assert outcome, outcome.reason
    assert outcome.seconds < 20.0


class LateSteps(FaultyReadings):
    """Interface whose steps last up to 30 ms longer than they should, each in its own way."""

    random = np.random.default_rng(0)

    def apply(self, speeds: kv.StateLike, duration: float, *, stamp: float | None = None) -> None:
        super().apply(speeds, duration, stamp=stamp)
        self._world.apply(speeds, self.random.uniform(0.001, 0.03))


def test_push_counts_the_time_that_steps_really_last() -> None:
    world = KinematicWorld(room(), "robot", sensors=SENSORS)
    world.reset(opened(door=0.3) | {"robot/base/y": 1.0})
    metrics = RunMetrics(world, room().symbol("door"))
    session = Session(
        InterfaceOnly(LateSteps(world, "door", "", 0.0)),
        belief=TrackedBelief(room(), "robot", SENSORS),
        on_step=metrics,
    )
    outcome = push(session, "door", bodies=PUSHER)
    assert outcome, outcome.reason
    assert abs(world.state["door"]) < 0.02
    assert metrics.measures["contact_losses"] <= 1
    assert metrics.overlap is None


@pytest.mark.sampled(3)
@pytest.mark.parametrize(("fault", "seconds", "says"), READING_FAULTS)
def test_push_waits_for_readings_and_says_which_have_ended(fault: str, seconds: float, says: str) -> None:
    world = KinematicWorld(room(), "robot", sensors=SENSORS)
    world.reset(opened(drawer=0.2) | {"robot/base/y": -1.0, "robot/base/x": 0.5})
    faulty, fastest = FaultyReadings(world, "drawer", fault, seconds), [0.0]

    def look(session: Session) -> None:
        fastest.append(max(map(abs, session.commands.values()), default=0.0))

    session = Session(
        InterfaceOnly(faulty), belief=TrackedBelief(room(), "robot", SENSORS), on_step=look, patience=3.0
    )
    outcome = push(session, "drawer", bodies=PUSHER)
    assert (bool(outcome), says in outcome.reason) == (not says, True), outcome.reason
    assert (abs(world.state["drawer"]) < 0.02) == (not says)
    assert not any(session.commands.values())
    assert faulty.moving <= 0.1
    assert max(fastest) < 0.5


@pytest.mark.parametrize(
    "sensors", [pytest.param(None, marks=pytest.mark.long), SENSORS], ids=["truth", "estimates"]
)
def test_push_with_physics_is_gentle(sensors: Sensors | None) -> None:
    """A drawer is shut, and one that sticks is told; neither is pressed with more than 100 N."""
    pytest.importorskip("mujoco")
    start = opened(drawer=0.3) | {"robot/base/y": -1.0, "robot/base/x": 0.4}
    pushing = Pushing(room(), "robot", "drawer", PUSHER, start, target=0.0)
    forces: list[float] = []

    def try_friction(friction: float) -> Outcome:
        world = MujocoWorld(room(), "robot", sensors=sensors, door_friction={"drawer": friction})
        world.reset(start)
        forces.clear()
        session = begin(world, lambda session: forces.append(world.peak_force), sensors=sensors)
        outcome = push(session, "drawer", pushing=pushing, plan=False)
        assert not outcome or abs(world.state["drawer"]) < 0.02
        return outcome

    outcome = try_friction(3.0)
    assert outcome, outcome.reason
    assert 1.0 < max(forces) < 100.0
    outcome = try_friction(2000.0)
    assert not outcome
    assert "does not move" in outcome.reason
    assert 1.0 < max(forces) < 100.0


@pytest.mark.long
@pytest.mark.parametrize("robot", ["fetch", "hsr", "pr2"])
def test_heavy_robot_presses_a_drawer_that_sticks_with_some_120_newtons(robot: str) -> None:
    pytest.importorskip("mujoco")
    setup = make_push_setup(SHIPPED[robot], SHIPPED_KITCHEN, "sink left upper drawer")
    hand = Robot.of(setup.model, robot).gripper().bodies
    pushing = Pushing(setup.model, robot, setup.what, hand, setup.start, target=0.0)
    start = find_push_start(pushing, setup.start).state
    assert start is not None
    world, forces = MujocoWorld(setup.model, robot, door_friction={setup.what: 2e4}), []
    world.reset(start)
    session = begin(world, lambda session: forces.append(world.peak_force))
    outcome = push(session, setup.what, pushing=pushing, plan=False)
    assert not outcome
    assert "it stays at 0.39" in outcome.reason
    touching = [force for force in forces if force > 1.0]
    assert 30.0 < np.median(touching) < 130.0
    assert np.percentile(touching, 95) < 160.0
    assert max(forces) < 300.0


def test_object_that_no_camera_sees_is_not_pushed() -> None:
    blind = Sensors.parse("3mm,0.5deg,30Hz,drop=1")
    world = KinematicWorld(room(), "robot", sensors=blind)
    world.reset(opened(door=0.6))
    outcome = push(begin(world, sensors=blind), "door", bodies=PUSHER)
    assert not outcome
    assert "not known" in outcome.reason
    assert world.state["door"] == 0.6


def test_press_grows_with_the_lag_no_more_and_corrects_what_is_touched() -> None:
    """A wall stops the tip: the planned way ends within the largest lag. A touch moves the object with it."""
    press = PushPress(0.02, -1.0)
    tip, velocity = (0.0, 0.0, 0.0), (0.8, 0.0, 0.0)
    planned = 0.0
    for _ in range(200):
        press.advance(0.5, tip, True)
        planned += 0.02 * press.pace()
        press.plan(velocity, (press.pace(), 0.0, 0.0))
    assert press.reserve < 0.05
    assert press.lag == pytest.approx(8e-4, rel=0.05)
    assert planned < 5e-3

    def value(gap: float, estimate: float) -> float:
        press.correct(gap, 0.8)
        return press.advance(estimate, tip, True)

    assert value(0.004, 0.5) == 0.5  # known exactly
    press.deviation = 0.004
    assert value(0.004, 0.5) == 0.5  # not touched
    assert value(-0.004, 0.5) == pytest.approx(0.5 + 0.005, abs=1e-3)  # none penetrates
    press.reset()
    press.advance(0.5, tip, True, touched=True)
    press.plan(velocity, (0.0, 0.0, 0.0))
    assert value(0.004, 0.5) == pytest.approx(0.495)
    tip = (0.008, 0.0, 0.0)
    assert value(0.0, 0.53) == pytest.approx(0.485)  # as the tip moved, whatever is estimated
    press.advance(0.53, tip, True, passed=0.2)
    assert not press.touched


def test_press_of_a_robot_that_stood_meanwhile_grows_by_no_lag() -> None:
    press, tip = PushPress(0.02, -1.0), (0.0, 0.0, 0.0)
    for passed in 0.02, 0.02, 1.0:
        press.advance(0.5, tip, True, passed=passed)
        press.plan((0.8, 0.0, 0.0), (0.02, 0.0, 0.0))
    assert press.lag == pytest.approx(4e-4 * np.exp(-1.0))
    press.advance(0.5, (0.0008, 0.0, 0.0), True, passed=0.03)  # a step that came late
    assert press.speed == 0.0
    assert press.lag < 4e-4 * np.exp(-1.0)


def test_surface_without_a_side_that_opposes_the_motion_is_refused() -> None:
    model = room()
    with pytest.raises(InvalidValueError, match="No surface of wall opposes"):
        PushSurface(model, model.symbol("door"), ["wall"], (), opened(), [0.3, 0.0], TIP)


def test_start_is_placed_and_rolled_out_and_trends_make_it_touch() -> None:
    model = room()
    away = opened(door=0.6) | {"robot/base/x": -2.0, "robot/base/angle": 2.5}
    pushing = Pushing(model, "robot", "door", PUSHER, away, target=0.0)
    found = find_push_start(pushing, away, seed=1)
    assert found, found.why
    assert sum(found.reasons.values()) == found.samples - 1
    assert found.state is not None
    assert found.state["door"] == 0.6
    assert roll_out(pushing, found.state, 600)[0] == ""

    def touches(logic: str | None) -> bool:
        other, state = Pushing(model, "robot", "door", PUSHER, away, target=0.0, logic=logic), found.state
        for _ in range(120):
            command = other.step(state)
            if other.touching:
                return True
            assert command.speeds[model.symbol("door:velocity")] == pytest.approx(0.0, abs=1e-9)
            state = model.integrate(state, command.speeds, 0.02)
        return False

    assert touches("and")
    assert touches("product")
    assert not touches(None)
    never = find_push_start(pushing, away, samples=2, accept=lambda state: "not today")
    assert not never
    assert "not today" in never.why


def test_points_beyond_one_that_was_out_of_reach_are_given_up_too() -> None:
    model, start = room(), opened(door=0.6)
    pushing = Pushing(model, "robot", "door", PUSHER, start, target=0.0)
    choice, points = pushing.choice, pushing.surface.at(start).points
    first = choice.rank(start, (0.0, 0.0, 0.0), np.inf)[0]
    choice.choose(start, (0.0, 0.0, 0.0), first)
    for way in ((0.0, 0.0, 0.3), (0.0, 0.0, -0.3)):
        choice.reset()
        choice.chosen = first
        choice.give_up(False, way)
        assert (np.array(choice.choose(start, (0.0, 0.0, 0.0)).point) - points[first]) @ way <= 1e-9
        assert choice.blocked == 1


def test_search_of_a_start_ends_where_no_push_moves_the_object(monkeypatch: pytest.MonkeyPatch) -> None:
    state, ends = opened(door=0.6), iter([0.6] * 1000)
    pushing = Pushing(room(), "robot", "door", PUSHER, state, target=0.0)
    monkeypatch.setattr(base_placement._Sampler, "sample", lambda self: state)
    monkeypatch.setattr(base_placement, "roll_out", lambda *args: RollOut("blocked", 9, next(ends)))
    assert find_push_start(pushing, state).samples == 60
    ends = iter([0.6, 0.5, 0.3, *[0.31] * 1000])
    assert find_push_start(pushing, state).samples == 123
    monkeypatch.setattr(base_placement._Sampler, "sample", lambda self: base_placement._UNREACHED)
    assert find_push_start(pushing, state, samples=3).failure == "reach"


def test_start_of_the_push_that_goes_furthest_is_taken_where_none_goes_through(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    state, ends = opened(door=0.6), (0.5, 0.3, 0.45)
    starts = [state.updated({"robot/base/x": -k / 10}) for k in range(3)]
    pushing = Pushing(room(), "robot", "door", PUSHER, state, target=0.0)
    drawn, rolled = iter(starts), iter([RollOut("blocked", 9, end) for end in ends])
    monkeypatch.setattr(base_placement._Sampler, "sample", lambda self: next(drawn))
    monkeypatch.setattr(base_placement, "roll_out", lambda *args: next(rolled))
    found = find_push_start(pushing, state, samples=3, least=0.4)
    assert found.state is starts[1]
    assert not found.whole
    drawn, rolled = iter(starts), iter([RollOut("blocked", 9, end) for end in ends])
    none = find_push_start(pushing, state, samples=3, least=0.9)
    assert none.state is None
    assert none.failure == "collision"


def test_approach_is_planned_to_a_contact_point() -> None:
    model, start = room(), opened(drawer=0.4)
    pushing = Pushing(model, "robot", "drawer", PUSHER, start, target=0.0)
    path, point = plan_push_approach(pushing, start)
    assert path.found, path.why
    tip = model.fk(PUSHER)(path.at(1.0)) @ [*pushing.tool.tip, 1]
    assert np.linalg.norm(tip[:3] - pushing.surface.at(start).points[point]) == pytest.approx(0.03, abs=1e-4)


def test_approach_that_is_followed_waits_for_a_robot_that_has_stopped() -> None:
    model, start, sensors = room(), opened(drawer=0.4), Sensors.parse("1mm,0.1deg,30Hz")
    pushing = Pushing(model, "robot", "drawer", PUSHER, start, target=0.0)
    path, _ = plan_push_approach(pushing, start)

    def follow(stop: float) -> float:
        """Return the largest speed on the path with a stop [s]."""
        world, speeds = KinematicWorld(model, "robot", sensors=sensors), [0.0]
        world.reset(start)
        session = Session(
            InterfaceOnly(FaultyReadings(world, "robot/base/x", "missing", stop)),
            belief=TrackedBelief(model, "robot", sensors),
            on_step=lambda session: speeds.extend(map(abs, session.commands.values())),
        )
        PushRun(session, pushing.coordinate, 30.0, 0.0, True)._follow(path)
        goal = np.array([path.at(1.0)[s] for s in path.symbols])
        np.testing.assert_allclose(world.state.vector(path.symbols), goal, atol=5e-3)
        return max(speeds)

    assert follow(1.0) < 1.2 * follow(0.0)


def test_locked_object_is_told_and_not_penetrated() -> None:
    world = Locked(room(), "robot")
    world.reset(opened(door=0.6) | {"robot/base/y": 0.8, "robot/base/x": 0.3})
    deepest = []
    pushing = Pushing(room(), "robot", "door", PUSHER, world.state, target=0.0)
    session = begin(world, lambda session: deepest.append(pushing.gap))
    outcome = push(session, "door", pushing=pushing, plan=False)
    assert not outcome
    assert "does not move" in outcome.reason
    assert outcome.measures["failure"] == "collision"
    assert outcome.value == pytest.approx(0.6)
    assert min(deepest) > -2.2e-3


def test_push_of_what_its_limits_hold_is_not_tried() -> None:
    model = room().copy()
    with model.edit() as edit:
        edit.constrain("bolt", 0.6, kv.position("door"), 0.6)
    world = KinematicWorld(model, "robot")
    world.reset(opened(door=0.6))
    outcome = push(begin(world), "door", bodies=PUSHER, target=0.0)
    assert not outcome
    assert (outcome.steps, outcome.value, outcome.measures["failure"]) == (0, 0.6, "other")
    assert "cannot move" in outcome.reason


def test_push_says_what_is_wrong() -> None:
    model, start = room(), opened(door=0.6)

    def refuse(error: type[Exception], match: str, **changes: object) -> None:
        values = {"what": "door", "bodies": PUSHER, "target": 0.0} | changes
        what, bodies = values.pop("what"), values.pop("bodies")
        with pytest.raises(error, match=match):
            Pushing(model, "robot", what, bodies, start, **values)  # type: ignore[arg-type]

    refuse(UnknownNameError, "robot/finger", bodies="robot/fingr")
    refuse(InvalidValueError, "lists no body", bodies=())
    refuse(InvalidValueError, "between 0 and 1.5", target=2.0)
    refuse(InvalidValueError, "'and', 'product' or None", logic="or")
    refuse(InvalidValueError, "moves no body", what="robot/lift", target=1.0)
    refuse(UnknownNameError, "dor", what="dor")
    with pytest.raises(InvalidValueError, match="samples= is an integer of at least 1"):
        find_push_start(Pushing(model, "robot", "door", PUSHER, start, target=0.0), start, samples=0)
    world = KinematicWorld(model, "robot")
    world.reset(start | {"robot/base/x": 1.75})
    outcome = push(begin(world), "door", bodies=PUSHER)
    assert not outcome
    assert "contact of" in outcome.reason
    with pytest.raises(InvalidValueError, match="of the robot"):
        push(begin(world), "robot/lift", bodies=PUSHER)
    for wrong in ({"dt": 0.0}, {"dt": np.nan}, {"timeout": 0.0}):
        with pytest.raises(InvalidValueError, match="time"):
            Session(InterfaceOnly(world), **wrong)
    with pytest.raises(InvalidValueError, match="tolerance="):
        push(begin(world), "door", tolerance=-1.0)
    with pytest.raises(UnknownNameError, match="no robot 'rbt'"):
        Pushing(model, "rbt", "door", PUSHER, start, target=0.0)


def test_locked_door_that_is_open_can_be_pushed_shut() -> None:
    """A bolt holds the door at the default state; it is out while the door stands open."""
    model, bolt = room().copy(), kv.position("bolt")
    with model.edit() as edit:
        edit.constrain("bolt/range", 0, bolt, 1)
        lock = kv.articulations.position_lock(model.symbol("door"), open_if=bolt > 0.5, lower=0, upper=0)
        edit.constrain("door/lock", *lock)
    start = model.default_state().updated({"robot/lift": 0.8, "door": 1.0, "bolt": 1.0})
    Pushing(model, "robot", "door", PUSHER, start, target=0.4)
    with pytest.raises(InvalidValueError, match=r"between 0 and 1\.5"):
        Pushing(model, "robot", "door", PUSHER, start, target=1.6)


# -- vectors of three in plain Python

NUMBER = st.floats(-10.0, 10.0)
VECTOR = st.tuples(NUMBER, NUMBER, NUMBER)
POSE = st.lists(st.lists(NUMBER, min_size=4, max_size=4), min_size=3, max_size=3)


@given(VECTOR, VECTOR, NUMBER)
def test_sums_and_products_are_those_of_numpy(a, b, factor):
    x, y = np.array(a), np.array(b)
    np.testing.assert_allclose(vectors.add(a, b, factor), x + factor * y, atol=1e-12)
    np.testing.assert_allclose(vectors.subtract(a, b), x - y)
    np.testing.assert_allclose(vectors.scale(factor, a), factor * x)
    np.testing.assert_allclose(vectors.inner_product(a, b), x @ y, atol=1e-12)
    np.testing.assert_allclose(vectors.cross_product(a, b), np.cross(x, y), atol=1e-12)
    np.testing.assert_allclose(vectors.length(a), np.linalg.norm(x))


@given(POSE, VECTOR)
def test_poses_place_and_rotate(rows, a):
    R, t = np.array(rows)[:, :3], np.array(rows)[:, 3]
    np.testing.assert_allclose(vectors.rotate(rows, a), R @ a, atol=1e-11)
    np.testing.assert_allclose(vectors.rotate_back(rows, a), R.T @ a, atol=1e-11)
    np.testing.assert_allclose(vectors.transform_point(rows, a), R @ a + t, atol=1e-11)


@given(VECTOR, VECTOR, VECTOR)
def test_points_move_with_the_twist_of_their_body(linear, angular, point):
    twist = (*linear, *angular)
    moved = vectors.move_point(twist, point)
    np.testing.assert_allclose(moved, np.array(linear) + np.cross(angular, point), atol=1e-11)
