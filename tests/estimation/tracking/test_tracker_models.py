"""Tracking of all kinds of models: doors, mechanisms, bases, free bodies, cameras."""

from __future__ import annotations

import numpy as np
import pytest
from synthetic_observations import NoisyObserver

import kineverse as kv
from kineverse.estimation import ObservedExpression, ObservedPose, ObservedPosition, Tracker


def moving(model: kv.Model) -> list[str]:
    return [name for name in model.frames if model.speeds_of(name)]


def is_consistent(estimate, truth, deviations=4.0):
    """Return True if all coordinates are within some deviations of the truth."""
    return {
        str(s): (estimate.state[s], truth[str(s)], estimate.deviation[s])
        for s in estimate.state.keys() - estimate.speeds.keys()
        if abs(estimate.state[s] - truth[str(s)]) > deviations * estimate.deviation[s]
    }


@pytest.mark.parametrize(
    ("mechanism", "truth"),
    [
        (kv.articulations.FoldingDoor(name="m", parent="world"), {"m": 1.5}),
        (kv.articulations.FoldingDoor(name="m", parent="world"), {"m": 0.02}),
        (kv.articulations.GarageDoor(name="m", parent="world"), {"m/door": 0.7, "m/bolt": 0.2}),
        (
            kv.articulations.GarageDoor(name="m", parent="world", form="published"),
            {"m/door": 0.7, "m/bolt": 0.2},
        ),
        (
            kv.articulations.GarageDoor(name="m", parent="world", form="published"),
            {"m/door": 1.9, "m/bolt": 0.2},
        ),
    ],
)
def test_mechanism_is_tracked(mechanism, truth):
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(mechanism)
    observer = NoisyObserver(model, moving(model), 0.02, np.radians(2))
    tracker = Tracker(model, [ObservedPose(f, covariance=observer.covariance) for f in observer.frames])
    for _ in range(25):
        estimate = tracker.update(observer(truth))
    assert not is_consistent(estimate, truth)
    assert max(estimate.deviation.values()) < 0.02


def test_kitchen_splits_into_groups():
    model = kv.load("kitchen")
    observer = NoisyObserver(model, moving(model))
    tracker = Tracker(model, observer.frames)
    assert tracker.symbols == model.degrees_of_freedom
    assert len(tracker.groups) == 23
    assert tracker.limits[model.symbol("kitchen/fridge_door")] == (0.0, pytest.approx(np.pi / 2))
    rng = np.random.default_rng(1)
    truth = {str(s): rng.uniform(*model.limits(s)) for s in tracker.symbols}
    for _ in range(5):
        estimate = tracker.update(observer(truth))
    assert not is_consistent(estimate, truth)
    assert estimate.dof == 6 * len(observer.frames)


def test_free_body_with_a_joint_is_tracked():
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Floating(name="box", parent="world", child="box"))
        edit.apply(kv.Revolute(name="lid", parent="box", child="lid", axis=(0, 0, 1), lower=-1, upper=1))
    observer = NoisyObserver(model, ["box", "lid"])
    tracker = Tracker(model, observer.frames, uncertainty={"box/x": 3, "box/y": 3, "box/z": 3})
    truth = dict(
        zip(
            ("box/x", "box/y", "box/z", "box/qx", "box/qy", "box/qz", "box/qw", "lid"),
            (1, 2, 3, 0.5, 0.5, -0.5, 0.5, 0.7),
            strict=True,
        )
    )
    for _ in range(20):
        estimate = tracker.update(observer(truth))
    assert not is_consistent(estimate, truth)
    assert len(estimate.tangent) == 7  # six of the body, not seven


def test_wheeled_base_is_tracked_along_its_rates():
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(
            kv.articulations.DifferentialDrive(
                name="base", parent="world", child="base", radius=0.06, track=0.37
            )
        )
    left, right = model.speeds
    observer = NoisyObserver(model, ["base"])
    tracker = Tracker(model, ["base"], process_noise={left: 0.01, right: 0.01})
    state = kv.State({"base/x": 1.0, "base/y": -1.0, "base/angle": 2.0})
    for _ in range(30):
        state = model.integrate(state, {left: 5.0, right: 3.0}, 0.1)
        tracker.predict(0.1, {left: 5.0, right: 3.0})
        estimate = tracker.update(observer(state))
    assert not is_consistent(estimate, {str(s): v for s, v in state.items()})
    assert [str(v) for v in estimate.tangent] == ["base/angle:velocity", "base/x:velocity", "base/y:velocity"]


def test_positions_and_expressions_from_a_moving_camera_are_tracked():
    model = kv.load("kitchen")
    with model.edit() as edit:
        pan = kv.position("pan")
        edit.add_frame("camera", parent="world", transform=kv.translation(0, 0, 1.5) @ kv.rotation_z(pan))
    door, handle = "kitchen/fridge_door", "kitchen/fridge_door_handle"
    tracker = Tracker(
        model,
        [
            ObservedPosition(handle, (0.1, 0.0, 0.0), relative_to="camera", covariance=1e-4 * np.eye(3)),
            ObservedExpression("potentiometer", 2 * kv.position(door), covariance=0.01),
        ],
        inputs=["pan"],
    )
    point = model.fk(handle, "camera") @ [0.1, 0, 0, 1]
    for pan_now in np.linspace(0, 1, 10):
        data = {handle: point({door: 0.9, "pan": pan_now})[:3], "potentiometer": 1.8}
        estimate = tracker.update(data, inputs={"pan": pan_now})
    assert estimate.state[door] == pytest.approx(0.9, abs=1e-3)
    assert estimate.dof == 4


@pytest.mark.parametrize(
    ("name", "truth"),
    [
        (
            "differential_drive",
            {
                "base/x": 0.5,
                "base/y": -0.3,
                "base/angle": 2.0,
                "base/left_wheel": 0.7,
                "base/right_wheel": -0.4,
            },
        ),
        ("screw_and_nut", {"vise": 20.9}),
        ("ball", {"stick/qx": 0.1, "stick/qy": -0.2, "stick/qz": 0.1, "stick/qw": 0.97}),
        ("jansen_leg", None),
    ],
)
def test_redundant_coordinates_and_multi_turn_joints_are_tracked(name, truth):
    """Observed wheels, screws of many turns, quaternions within a cone, closed loops."""
    model = kv.load(f"articulations/{name}")
    observer = NoisyObserver(model, moving(model))
    tracker = Tracker(model, observer.frames)
    if truth is None:
        state = model.default_state()
    else:
        state = kv.State({f"{name}/{s}": value for s, value in truth.items()})
    for _ in range(4):
        estimate = tracker.update(observer(state))
    coordinates = [s for s in tracker.symbols if str(s)[-3:-1] != "/q"]
    for s in coordinates:
        off = estimate.state[s] - state[s]
        if s in tracker.periodic:
            off = np.angle(np.exp(1j * off))
        assert abs(off) < 5 * estimate.deviation[s]
    assert np.abs(observer.truth(estimate.state) - observer.truth(state)).max() < 0.05


def test_unknown_camera_pose_is_estimated_from_static_frames():
    model = kv.Model()
    hinge = kv.model.Pose.from_matrix(kv.translation(1, 0, 0))
    with model.edit() as edit:
        edit.apply(kv.Floating(name="camera", parent="world", child="camera"))
        edit.apply(
            kv.Revolute(
                name="door", parent="world", child="door", axis=(0, 0, 1), lower=0, upper=1.5, origin=hinge
            )
        )
        edit.add_frame("marker", "world", kv.translation(1, 1, 0.3))
    observer = NoisyObserver(model, ["marker", "door"], relative_to="camera")
    tracker = Tracker(model, [ObservedPose(f, relative_to="camera") for f in observer.frames])
    turn = {"camera/qx": 0.5, "camera/qy": -0.5, "camera/qz": 0.5, "camera/qw": 0.5}
    truth = model.default_state().updated({"camera/x": 0.3, "door": 0.8, **turn})
    for _ in range(10):
        estimate = tracker.update(observer(truth))
    assert estimate.state["door"] == pytest.approx(0.8, abs=4 * estimate.deviation["door"])
    assert estimate.state["camera/x"] == pytest.approx(0.3, abs=4 * estimate.deviation["camera/x"])
    assert len(estimate.tangent) == 7


@pytest.mark.parametrize("name", ["bare", "drawn"])
def test_periodic_dial_is_tracked_beyond_a_turn(name):
    """A turntable turns twice, and its dial wraps after a turn; in C and numpy."""
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Continuous(name="q", parent="world", child="plate"))
    q = model.symbol("q")
    says = {"bare": q, "drawn": np.arctan2(np.sin(q), np.cos(q))}[name]
    tracker = Tracker(
        model,
        [ObservedExpression("dial", says, 0.01**2, period=2 * np.pi)],
        start={"q": 3.0},
        uncertainty={"q": 0.1},
        process_noise={"q:velocity": 0.1},
    )
    assert tracker.periodic == {q}
    for step in range(100):
        tracker.wait() if step == 50 else None
        truth = 3.0 + 0.13 * step
        estimate = tracker.update({"dial": np.remainder(truth, 2 * np.pi)}, at=0.1 * step)
        assert abs(estimate.state["q"] - truth) < 0.02
        assert estimate.nis < 5
    with pytest.raises(kv.KineverseError, match="period of 'dial' is positive"):
        Tracker(model, [ObservedExpression("dial", q, 1.0, period=0.0)])
