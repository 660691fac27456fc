import math

import numpy as np
import pytest

import kineverse as kv
from cupboards import box
from kineverse.errors import InvalidValueError, ShapeError, UnknownNameError
from kineverse.manipulation import Session, TrackedBelief
from kineverse.state import State
from kineverse.worlds import Observation, Robot, Sensors
from kineverse.worlds.sensor_sampler import SensorSampler
from robot_interface_proxy import InterfaceOnly

NOISE = "3mm+3mm/m,0.5deg,30Hz,drop=0.1"
DT = 0.02


@pytest.fixture(scope="module")
def model():
    """A robot with an arm and a camera on a base, a cupboard with a door and a drawer, and a post."""
    arm, door, drawer = map(kv.position, ("rover/arm", "door", "drawer"))
    model, body = kv.Model(), box(0.1, 0.1, 0.1)
    with model.edit() as edit:
        edit.apply(kv.articulations.OmniBase(name="rover/base", parent="world", child="rover/carrier"))
        edit.add_frame("rover/camera", "rover/carrier", kv.translation(0, 0, 1), body=body)
        edit.add_frame("rover/hand", "rover/carrier", kv.rotation_z(arm), body=body)
        edit.add_frame("post", "world", kv.translation(1.5, -1.5, 0.5), body=body)
        edit.add_frame("cupboard", "world", kv.translation(2, 0.3, 0.5), body=body)
        edit.add_frame("door_leaf", "cupboard", kv.translation(0, 0.3, 0) @ kv.rotation_z(door), body=body)
        edit.add_frame("drawer_box", "cupboard", kv.translation(-drawer, 0, 0), body=body)
        for symbol, lower, upper in (arm, -2, 2), (door, 0, 1.6), (drawer, 0, 0.4):
            edit.constrain(f"{symbol}/range", lower, symbol, upper)
    return model


class Told:
    """Robot that moves as it is told, with the interface of a robot and no more, but for the tests."""

    name, remarks, timeout = "told", (), 1.0

    def __init__(self, model, sensors, seed=0, **values):
        self.model, self.robot, self.sensors = model, Robot.of(model, "rover"), sensors
        self._sampler = SensorSampler(sensors, model, self.robot, seed)
        self.reset(values)

    def reset(self, values):
        self.truth, self.time = self.model.default_state().updated(values), 0.0
        self._sampler.reset()

    def apply(self, speeds, duration, *, stamp=None, really=()):
        every = {str(k): v for k, v in dict(speeds).items()} | dict(really)
        self.truth = self.model.integrate(self.truth, every, duration)
        self.time += duration

    def observe(self):
        return self._sampler.observe(self.time, self.truth)


def look(world, belief):
    return belief.update(world.observe(), world.time)


def run(world, belief, steps, speeds=None, planned=None, really=None, note=None):
    """Move a world for some steps; ``planned`` speeds are told to the belief, ``really`` to the world."""
    state = None
    for k in range(steps):
        commands = {} if speeds is None else speeds(k)
        world.apply(commands, DT, really=really or {})
        told = {**commands, **(planned or {})}
        told = State({world.model.symbol(name): value for name, value in told.items()})
        state = belief.update(world.observe(), world.time, told)
        if note is not None:
            note(state)
    return state


def start(model, noise=NOISE, seed=0, **values):
    sensors = Sensors.parse(noise) if isinstance(noise, str) else noise
    world = Told(model, sensors, seed, **values)
    belief = TrackedBelief(model, "rover", sensors)
    assert look(world, belief).stamp == 0.0
    return world, belief


def test_pictures_average_while_nothing_moves(model):
    squares = []
    _, belief = start(model)
    for seed in range(10):
        world = Told(model, belief.sensors, seed, door=0.7, drawer=0.15)
        look(world, belief)
        first, state = belief.deviation(model.symbol("door")), run(world, belief, 40)
        for name in ("door", "drawer"):
            deviation = belief.deviation(model.symbol(name))
            squares.append(((state[name] - world.truth[name]) / deviation) ** 2)
        assert belief.deviation(model.symbol("door")) < 0.4 * first
        assert state["rover/arm"] == world.truth["rover/arm"]
    # 20 numbers: the mean of χ² is within 1 ± 4 √(2/20), and a part at rest is known better than stated.
    assert 0.1 < np.mean(squares) < 2.3


def test_planned_speeds_bridge_delay_and_slow_pictures(model):
    for noise in ("0.5mm,0.1deg,5Hz,delay=60ms", "0.5mm,0.1deg,5Hz"):
        world, belief = start(model, noise, door=0.1)
        errors = []
        run(
            world, belief, 150, planned={"door:velocity": 0.4}, really={"door:velocity": 0.4},
            note=lambda state, world=world, errors=errors: errors.append(state["door"] - world.truth["door"]),
        )  # fmt: skip
        assert np.abs(errors[30:]).max() < 0.006  # it moves by 0.08 between two pictures


def test_pictures_may_be_older_than_the_encoders(model):
    """Cameras are slow; the poses say of when they are."""

    class Slow(Told):
        def reset(self, values):
            super().reset(values)
            self.past = [(self.time, super().observe().poses)]

        def observe(self):
            now = super().observe()
            self.past.append((self.time, now.poses))
            seen, poses = self.past[max(len(self.past) - 5, 0)]  # of 80 ms before
            return Observation(now.stamp, now.joints, poses, seen=seen)

    sensors = Sensors.parse("0.5mm,0.1deg,50Hz")
    world, belief = Slow(model, sensors, door=0.1), TrackedBelief(model, "rover", sensors)
    errors = []
    run(
        world, belief, 100, planned={"door:velocity": 0.4}, really={"door:velocity": 0.4},
        note=lambda state: errors.append(state["door"] - world.truth["door"]),
    )  # fmt: skip
    assert np.abs(errors[30:]).max() < 0.006  # it moves by 0.03 meanwhile


def test_joints_are_predicted_over_the_delay(model):
    world, belief = start(model, "0.5mm,0.1deg,delay=100ms")
    state = run(world, belief, 40, lambda k: {"rover/arm:velocity": 0.5, "rover/base/x:velocity": 0.2})
    assert state["rover/arm"] == pytest.approx(world.truth["rover/arm"], abs=1e-9)
    assert state["rover/base/x"] == pytest.approx(world.truth["rover/base/x"], abs=1e-9)
    assert state.stamp == pytest.approx(world.time)


def test_a_door_that_somebody_moves_is_followed(model):
    world, belief = start(model, door=0.2)
    run(world, belief, 50)
    state = run(world, belief, 60, really={"door:velocity": 0.6})
    assert state["door"] == pytest.approx(world.truth["door"], abs=0.05)
    state = run(world, belief, 100)
    assert state["door"] == pytest.approx(world.truth["door"], abs=0.01)
    assert belief.deviation(model.symbol("door")) < 0.004


def test_unseen_coordinates_stay_at_their_default_with_a_large_deviation(model):
    sensors = Sensors(position=0.003, orientation=0.01, marked=("door_leaf",))
    world, belief = start(model, sensors, door=0.7, drawer=0.2)
    state = run(world, belief, 30)
    assert state["door"] == pytest.approx(0.7, abs=0.02)
    assert (state["drawer"], belief.deviation(model.symbol("drawer"))) == (0.0, math.inf)
    world, belief = start(model, "3mm,0.5deg,drop=1", door=0.7)
    state = run(world, belief, 30)
    assert state["door"] == 0.0
    assert belief.deviation(model.symbol("door")) >= 0.75
    assert not belief.seen


def test_reset_of_the_world_begins_anew(model):
    world, belief = start(model, door=0.7, drawer=0.3)
    run(world, belief, 50, lambda k: {"rover/base/x:velocity": 0.3})
    tight = belief.deviation(model.symbol("drawer"))
    world.reset({"door": 0.2, "drawer": 0.3, "rover/base/y": 0.4})
    look(world, belief)
    state = run(world, belief, 50)
    assert state["rover/base/y"] == 0.4
    assert state["door"] == pytest.approx(0.2, abs=0.01)
    assert belief.deviation(model.symbol("drawer")) < 1.2 * tight
    world.sensors = None
    world._sampler = SensorSampler(Sensors.parse("3mm,0.5deg,drop=1"), model, "rover")
    world.reset({"door": 0.2})
    state = look(world, belief)
    assert state["door"] == pytest.approx(0.2, abs=0.01)  # it was seen there last
    assert belief.deviation(model.symbol("door")) > 0.5


def drive(k):
    return {
        "rover/base/x:velocity": 0.5 * math.cos(0.02 * k),
        "rover/base/y:velocity": 0.2 * math.sin(0.03 * k),
        "rover/base/angle:velocity": 0.9 * math.sin(0.01 * k),
    }


def test_landmarks_correct_the_drift_of_odometry(model):
    base = [model.symbol(f"rover/base/{name}") for name in ("x", "y", "angle")]
    squares, read, errors, doors = [], [], [], []
    _, belief = start(model, f"{NOISE},odometry=30mm/m,turn=3deg")
    for seed in range(6):
        world = Told(model, belief.sensors, seed, door=0.7)
        look(world, belief)
        state = run(world, belief, 100, drive)
        error = state.vector(base) - world.truth.vector(base)
        squares.append((error / [belief.deviation(s) for s in base]) ** 2)
        errors.append(error)
        doors.append(state["door"] - world.truth["door"])
        joints = world.observe().joints
        read.append([joints[s] - world.truth[s] for s in base])
    assert np.sqrt(np.mean(np.square(errors))) < 0.3 * np.sqrt(np.mean(np.square(read)))
    assert 0.3 < np.mean(squares) < 2.0
    assert np.abs(doors).max() < 0.02


def test_turns_of_base_and_turntable_are_counted():
    """Both turn on, the base with an odometry that drifts; controllers and integrators count the turns."""
    model, body, plate = kv.Model(), box(0.1, 0.1, 0.1), kv.position("plate")
    with model.edit() as edit:
        edit.apply(kv.articulations.OmniBase(name="rover/base", parent="world", child="rover/carrier"))
        edit.add_frame("rover/camera", "rover/carrier", kv.translation(0, 0, 1), body=body)
        edit.add_frame("post", "world", kv.translation(1.5, -1.5, 0.5), body=body)
        edit.add_frame("turntable", "world", kv.translation(1, 1, 0.5) @ kv.rotation_z(plate), body=body)
    world, belief = start(model, f"{NOISE},odometry=30mm/m,turn=3deg")
    symbols = [model.symbol("rover/base/angle"), model.symbol("plate")]
    turning = {"rover/base/angle:velocity": 4.0, "plate:velocity": -4.0}
    for _ in range(5):
        state = run(world, belief, 50, lambda _: turning)
        np.testing.assert_allclose(state.vector(symbols), world.truth.vector(symbols), atol=0.3)
    assert np.abs(state.vector(symbols)).min() > 6 * np.pi


def test_drift_without_landmarks_is_said(model):
    sensors = Sensors(position=0.003, orientation=0.01, odometry=0.03, turn=0.05, marked=("door_leaf",))
    world, belief = start(model, sensors, door=0.7)
    assert "nothing corrects the drift" in " ".join(belief.remarks)
    run(world, belief, 100, drive)
    assert belief.deviation(model.symbol("rover/base/x")) > 0.005
    # The door is no more certain than the base from which it is seen.
    assert belief.deviation(model.symbol("door")) > 0.005


def test_noisy_encoders_are_filtered(model):
    world, belief = start(model, "1mm,0.1deg,encoders=0.01")
    arm, rests, moves = model.symbol("rover/arm"), [], []
    run(world, belief, 100, note=lambda state: rests.append(state[arm]))
    run(
        world, belief, 100, lambda k: {"rover/arm:velocity": 0.3},
        note=lambda state: moves.append(state[arm] - world.truth[arm]),
    )  # fmt: skip
    assert np.sqrt(np.mean(np.square(rests[30:]))) < 0.003
    assert np.sqrt(np.mean(np.square(moves))) < 0.006
    assert 0.0 < belief.deviation(arm) < 0.006


def test_outliers_are_left_out(model):
    world, belief = start(model, f"{NOISE},outliers=0.2", seed=3, door=0.7, drawer=0.15)
    errors = []
    run(world, belief, 100, note=lambda state: errors.append(state["door"] - world.truth["door"]))
    assert np.abs(errors[50:]).max() < 0.02


def test_session_tells_deviations_and_observations(model):
    world, belief = start(model, door=0.7)
    world.reset({"door": 0.7})
    session = Session(InterfaceOnly(world), belief=belief)
    session.stop()
    assert session.observation.stamp == session.time == 0.02
    door = session.deviation("door")
    assert 0.0 < door < 0.02
    tip = (model.fk("door_leaf") @ np.array([0.0, -2.0, 0.0, 1.0]))[:3]
    deviations = [session.deviation(tip[k]) for k in range(3)]
    assert np.linalg.norm(deviations) == pytest.approx(2.0 * door, rel=1e-6)
    with pytest.raises(ShapeError):
        session.deviation(tip)
    with pytest.raises(UnknownNameError, match="door"):
        session.deviation("dor")


def test_what_cannot_be_tracked_is_refused(model):
    with pytest.raises(UnknownNameError, match="rover"):
        TrackedBelief(model, "rovr")
    with pytest.raises(UnknownNameError, match="cupboard"):
        TrackedBelief(model, "rover", Sensors(marked=("cupbord",)))
    with pytest.raises(UnknownNameError, match="rover/camera"):
        TrackedBelief(model, "rover", Sensors(camera="rover/camra"))
    with pytest.raises(InvalidValueError, match=r"nothing can be tracked.*post"):
        TrackedBelief(model, "rover", Sensors(marked=("post", "rover/hand")))
    rail = kv.Model()
    with rail.edit() as edit:
        edit.apply(kv.Prismatic(name="lift/rail", parent="world", child="lift/car", axis=(1, 0, 0)))
        drawer = kv.translation(kv.position("drawer"), 0, 0)
        edit.add_frame("box", "world", drawer, body=box(0.1, 0.1, 0.1))
    with pytest.raises(InvalidValueError, match="drifts"):
        TrackedBelief(rail, "lift", Sensors(odometry=0.01))
    assert "no frame" in TrackedBelief(rail, "lift").remarks[0].lower()


def test_door_with_a_position_lock_is_believed_where_it_is(model):
    """The bolt holds the door shut at the default state, and is out now."""
    locked, door, bolt = model.copy(), kv.position("door"), kv.position("bolt")
    with locked.edit() as edit:
        edit.constrain("bolt/range", 0, bolt, 1)
        lock = kv.articulations.position_lock(door, open_if=bolt > 0.5, lower=0.0, upper=0.0)
        edit.constrain("door/lock", *lock)
    world, belief = start(locked, bolt=1.0, door=0.5)
    assert run(world, belief, 20)["door"] == pytest.approx(0.5, abs=0.02)
    assert belief.deviation(locked.symbol("door")) < 0.02
