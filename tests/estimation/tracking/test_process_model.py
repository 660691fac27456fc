"""Prediction: integration of rates, estimated speeds, process noise of one step."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation
from synthetic_observations import NoisyObserver, make_slides

import kineverse as kv
from kineverse.errors import InvalidValueError, ShapeError, UnknownNameError
from kineverse.estimation import ObservedExpression, ObservedPose, Tracker, pose_covariance
from kineverse.lie import retract


def make_floating_body() -> kv.Model:
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Floating(name="box", parent="world", child="box"))
    return model


def make_drive() -> kv.Model:
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.articulations.Ackermann(name="car", parent="world", child="car", wheelbase=2.5))
    return model


@pytest.mark.parametrize("make", [make_floating_body, make_drive])
def test_flow_and_its_derivatives_equal_model_integration(make):
    model = make()
    (frame,) = [f for f in model.frames if model.speeds_of(f)][:1]
    motion = Tracker(model, [frame])._update_step.process_model._flows[0]
    rng, h = np.random.default_rng(0), 1e-5

    def integrated(q, u):
        after = model.integrate(
            kv.State(dict(zip(motion.coordinates, q, strict=True))),
            dict(zip(motion.speeds, u, strict=True)),
            1.0,
        )
        return np.array([after[s] for s in motion.coordinates])

    for _ in range(3):
        q, u = rng.uniform(0.2, 0.8, len(motion.coordinates)), rng.uniform(-0.6, 0.6, len(motion.speeds))
        after, by_start, by_speeds = motion.integrate(q, u, np.empty(0))
        assert np.allclose(after, integrated(q, u), atol=1e-7)
        columns = [(integrated(q + d, u) - integrated(q - d, u)) / (2 * h) for d in h * np.eye(len(q))]
        assert np.allclose(by_start, np.transpose(columns), atol=1e-5)
        columns = [(integrated(q, u + d) - integrated(q, u - d)) / (2 * h) for d in h * np.eye(len(u))]
        assert np.allclose(by_speeds, np.transpose(columns), atol=1e-5)


@pytest.mark.parametrize("place", [(0.5, 1.0, -2.0), (300.0, -4000.0, 20.0)])
def test_floating_body_is_found_at_any_pose(place):
    model = make_floating_body()
    observer = NoisyObserver(model, ["box"])
    options = {"uncertainty": dict.fromkeys(("box/x", "box/y", "box/z"), 1e4)}
    first = Tracker(model, [ObservedPose("box", covariance=observer.covariance)], **options)
    for seed in range(8):
        turn = Rotation.random(random_state=seed)
        state = dict(zip(("box/x", "box/y", "box/z"), place, strict=True))
        state |= dict(zip(("box/qx", "box/qy", "box/qz", "box/qw"), turn.as_quat(), strict=True))
        tracker = first.copy()
        for _ in range(3):
            estimate = tracker.update(observer(state))
        said = Rotation.from_quat([estimate.state[f"box/q{c}"] for c in "xyzw"])
        assert (said * turn.inv()).magnitude() < np.radians(4)
        assert np.allclose([estimate.state[f"box/{c}"] for c in "xyz"], place, atol=0.05)


def make_body(*, wheels: bool) -> kv.Model:
    model = kv.Model()
    with model.edit() as edit:
        if wheels:
            edit.apply(
                kv.articulations.DifferentialDrive(name="b", parent="world", child="b", radius=0.1, track=0.4)
            )
        else:
            edit.apply(kv.articulations.Floating(name="b", parent="world", child="b"))
    return model


def white_acceleration(q: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Return transition and noise of [x; u] by Van Loan's matrix exponential (1978)."""
    n = len(q)
    rate, noise = np.zeros((2 * n, 2 * n)), np.zeros((2 * n, 2 * n))
    rate[:n, n:], noise[n:, n:] = np.eye(n), np.diag(q)
    both = expm(np.block([[-rate, noise], [np.zeros_like(rate), rate.T]]) * dt)
    transition = both[2 * n :, 2 * n :].T
    return transition, transition @ both[: 2 * n, 2 * n :]


def test_linear_model_equals_a_constant_velocity_kalman_filter():
    a, b = kv.position("a"), kv.position("b")
    R, q = np.array([[0.04, 0.01], [0.01, 0.09]]), np.array([0.2, 0.7])
    tracker = Tracker(
        make_slides(),
        [ObservedExpression("z", kv.array([a + 2 * b, a - b]), R)],
        start={"a": 0.3, "b": -0.2},
        uncertainty={"a": 0.5, "b": 2.0},
        process="velocity",
        process_noise={"a": q[0], "b:velocity": q[1]},
    )
    H = np.hstack([np.array([[1.0, 2.0], [1.0, -1.0]]), np.zeros((2, 2))])
    x, P = np.array([0.3, -0.2, 0, 0]), np.diag([0.25, 4.0, *(3.0 * q)])
    rng, log_density, time = np.random.default_rng(0), 0.0, 0.0
    for k in range(12):
        time += (0.0, 0.1, 0.4)[k % 3] if k else 0.0
        if k:
            F, Q = white_acceleration(q, (0.0, 0.1, 0.4)[k % 3])
            x, P = F @ x, F @ P @ F.T + Q
        z = rng.standard_normal(2)
        estimate = tracker.update({"z": z}, at=time)
        S, r = H @ P @ H.T + R, z - H @ x
        log_density -= 0.5 * (r @ np.linalg.solve(S, r) + np.linalg.slogdet(2 * np.pi * S)[1])
        K = P @ H.T @ np.linalg.inv(S)
        x, P = x + K @ r, P - K @ S @ K.T
        result = [estimate.state[s] for s in ("a", "b", "a:velocity", "b:velocity")]
        np.testing.assert_allclose(result, x, atol=1e-9)
        np.testing.assert_allclose(estimate.covariance, P[:2, :2], atol=1e-9)
        np.testing.assert_allclose(estimate.speed_covariance, P[2:, 2:], atol=1e-9)
        assert estimate.log_evidence == pytest.approx(log_density)
        assert estimate.deviation["b:velocity"] == pytest.approx(np.sqrt(P[3, 3]))


@pytest.mark.parametrize("wheels", [True, pytest.param(False, marks=pytest.mark.long)])
def test_speeds_of_a_base_and_of_a_free_body_are_consistent(wheels):
    """Rates carry the body, speeds change at random, and errors have the stated covariance."""
    model = make_body(wheels=wheels)
    speeds = sorted(model.speeds, key=lambda s: s.sort_key)
    q = dict.fromkeys(speeds, 4.0 if wheels else 0.05)
    observed = ObservedPose("b", covariance=pose_covariance(0.01, 0.01))
    first = Tracker(model, [observed], process="velocity", process_noise=q)
    integrator, rng, dt = model.integrator(), np.random.default_rng(3), 0.05
    assert list(first.estimate.speeds) == speeds
    squares, fk = [], kv.compile(model.fk("b"), integrator.symbols)
    order = [list(integrator.speeds).index(v) for v in speeds]
    for _ in range(6):
        tracker = first.copy()
        x, u = model.default_state().vector(integrator.symbols), np.zeros(len(speeds))
        for k in range(40):
            pose = retract(fk(x), rng.normal(0, 0.01, 6))
            estimate = tracker.update({"b": pose}, at=k * dt)
            if k > 15 and k % 4 == 0:
                off = np.array([estimate.speeds[v] for v in speeds]) - u
                squares.append(off @ np.linalg.solve(estimate.speed_covariance, off) / len(off))
            for _ in range(5):
                u = u + rng.normal(0, np.sqrt(dt / 5 * q[speeds[0]]), len(speeds))
                v = np.zeros(len(u))
                v[order] = u
                x = integrator(x, v, dt / 5)
    assert 0.7 < np.mean(squares) < 1.35


def test_speed_of_a_periodic_angle_does_not_jump_after_a_turn():
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Continuous(name="q", parent="world", child="part"))
    tracker, observer = Tracker(model, ["part"], process="velocity"), NoisyObserver(model, ["part"])
    result = [tracker.update(observer({"q": 2.0 * 0.05 * k}), at=0.05 * k).speeds for k in range(100)]
    np.testing.assert_allclose(np.array([next(iter(one.values())) for one in result])[20:], 2.0, atol=0.5)
    assert tracker.estimate.state["q"] == pytest.approx(9.9, abs=0.1)


def test_commanded_and_locked_speeds_are_known():
    tracker = Tracker(make_slides(), ["cart"], process="velocity", start={"a": 0.0, "b": 0.0})
    estimate = tracker.predict(2.0, {"a:velocity": 0.5})
    assert estimate.state["a"] == pytest.approx(1.0)
    assert estimate.state["a:velocity"] == pytest.approx(0.5)
    assert estimate.deviation["a:velocity"] < 1e-6 < estimate.deviation["b:velocity"]


def test_without_a_velocity_process_there_are_no_speeds():
    estimate = Tracker(make_slides(), ["cart"]).estimate
    assert dict(estimate.speeds) == {}
    assert estimate.speed_covariance.shape == (0, 0)
    assert "a:velocity" not in estimate.state


def test_initial_speeds_are_given_by_name():
    options = {"start": {"a": 1.0, "b:velocity": 0.4}, "uncertainty": {"a": 0.1, "a:velocity": 0.2}}
    tracker = Tracker(make_slides(), ["cart"], process="velocity", **options)
    estimate = tracker.estimate
    assert estimate.state["b:velocity"] == 0.4
    assert estimate.deviation["a"] == pytest.approx(0.1)
    assert estimate.deviation["a:velocity"] == pytest.approx(0.2)
    estimate = tracker.reset({"a:velocity": -1.0}, uncertainty={"a:velocity": 0.3})
    assert estimate.state["a:velocity"] == -1.0
    assert estimate.deviation["a:velocity"] == pytest.approx(0.3)
    assert estimate.state["a"] == 1.0
    assert estimate.deviation["a"] == pytest.approx(0.1)
    for wrong in ({"start": {"a:velocity": 1.0}}, {"uncertainty": {"a:velocity": 1.0}}):
        with pytest.raises(UnknownNameError, match="'a:velocity' is not estimated"):
            Tracker(make_slides(), ["cart"], **wrong)


def test_compiled_and_numpy_predictions_agree_at_a_limit():
    """A door hits its limit at speed: the predicted state stays inside."""
    model, trackers = kv.Model(), []
    with model.edit() as edit:
        edit.apply(kv.Revolute(name="q", parent="world", child="door", axis=(0, 0, 1), lower=0, upper=1.5))
    for compiled in (True, False):
        tracker = Tracker(model, ["door"], process="velocity")
        if compiled and not tracker.wait():
            pytest.skip("there is no compiler")
        if not compiled:
            tracker._update_step.native = None
        observer = NoisyObserver(model, ["door"])
        for k in range(20):
            tracker.update(observer({"q": min(1.5, 1.1 + 0.03 * k)}), at=k / 30)
        trackers.append(tracker)
    for _ in range(3):
        one, other = (tracker.predict(0.2) for tracker in trackers)
        assert one.state["q"] <= 1.5
        assert one.state["q"] == pytest.approx(other.state["q"])
        np.testing.assert_allclose(one.mean, other.mean, atol=1e-9)
        assert one.state["q:velocity"] == pytest.approx(other.state["q:velocity"], abs=1e-9)
        np.testing.assert_allclose(one.covariance, other.covariance, rtol=1e-9)


def test_a_reset_keeps_the_speeds_of_other_coordinates():
    a, b = kv.position("a"), kv.position("b")
    observed = ObservedExpression("z", kv.array([a + b, a - b]), 0.01 * np.eye(2))
    tracker = Tracker(make_slides(), [observed], process="velocity")
    for k in range(30):
        before = tracker.update({"z": np.array([0.2 * k, -0.2 * k])}, at=0.1 * k)
    after = tracker.reset({"a": 1.0}, uncertainty={"a": 0.1})
    assert after.state["b:velocity"] == before.state["b:velocity"]
    assert before.state["b:velocity"] > 1.0
    assert after.deviation["b:velocity"] == pytest.approx(before.deviation["b:velocity"])
    assert after.state["a:velocity"] == 0.0


FRAMES = ["left_leaf", "right_leaf"]


@pytest.fixture(scope="module")
def model():
    model = kv.Model()
    with model.edit() as edit:
        for side, y in ("left", 0.5), ("right", -0.5):
            origin, leaf = kv.translation(0, y, 0), f"{side}_leaf"
            edit.apply(
                kv.Revolute(
                    name=side, parent="world", child=leaf, axis=(0, 0, 1), origin=origin, lower=0, upper=2
                )
            )
    return model


def look(model, rng, **values):
    true = np.array([model.fk(name)(kv.State(values)) for name in FRAMES])
    return retract(true, 0.01 * rng.standard_normal((len(FRAMES), 6)))


def test_covariances_of_an_array_are_those_of_pairs(model):
    rng = np.random.default_rng(0)
    by_array, by_pairs = Tracker(model, FRAMES), Tracker(model, FRAMES)
    for step in range(5):
        poses, factors = look(model, rng, left=0.5, right=1.0), rng.normal(size=(2, 6, 6))
        covariances = 1e-4 * (factors @ np.swapaxes(factors, 1, 2) + np.eye(6))
        data = np.array([True, step % 2 == 0])
        covariances[~data] = np.nan  # those of missing poses are not read
        pairs = {n: (poses[k], covariances[k]) for k, n in enumerate(FRAMES) if data[k]}
        here = by_array.update_poses(poses, data, covariances=covariances, at=0.1 * step)
        there = by_pairs.update(pairs, at=0.1 * step)
        assert dict(here.state) == pytest.approx(dict(there.state), abs=1e-12)
        np.testing.assert_allclose(here.covariance, there.covariance, rtol=1e-9)
        assert here.log_evidence == pytest.approx(there.log_evidence)


def test_process_noise_of_a_step_stands_for_that_of_the_tracker(model):
    rng = np.random.default_rng(1)
    usual, other = Tracker(model, FRAMES), Tracker(model, FRAMES, process_noise={"left": 0.3})
    for step in range(1, 5):
        poses = look(model, rng, left=0.5, right=1.0)
        here = usual.update_poses(poses, at=0.1 * step, process_noise={"left": 0.3})
        there = other.update_poses(poses, at=0.1 * step)
        np.testing.assert_allclose(here.covariance, there.covariance, rtol=1e-9)
    here, there = usual.predict(0.5, process_noise={"left:velocity": 0.0}), other.predict(0.5)
    assert here.deviation["left"] < there.deviation["left"]
    assert here.deviation["right"] == pytest.approx(there.deviation["right"])


def test_late_measurements_repeat_steps_with_their_own_noise(model):
    rng = np.random.default_rng(2)
    readings = [look(model, rng, left=0.5, right=1.0) for _ in range(4)]
    noises = [{"left": 0.2}, {}, {"right": 0.5}, {"left": 0.0}]

    def follow(order, lag):
        tracker = Tracker(model, FRAMES, lag=lag)
        for k in order:
            tracker.update_poses(readings[k], at=0.1 * (k + 1), process_noise=noises[k])
        return tracker.estimate

    np.testing.assert_allclose(
        follow((0, 1, 2, 3), 0.0).covariance, follow((0, 1, 2, 3), 1.0).covariance, rtol=1e-9
    )


def test_refuted_groups_are_those_that_moved(model):
    rng, tracker = np.random.default_rng(3), Tracker(model, FRAMES, process="static")
    covariances = np.tile(pose_covariance(0.01, 0.01), (2, 1, 1))
    for step in range(10):
        poses = look(model, rng, left=0.5, right=1.0)
        estimate = tracker.update_poses(poses, covariances=covariances, at=0.1 * step)
        assert estimate.refuted_groups == ()
    poses = look(model, rng, left=0.7, right=1.0)
    estimate = tracker.update_poses(poses, covariances=covariances, at=1.0)
    assert estimate.refuted_groups == ((model.symbol("left"),),)
    assert not estimate.lost


def test_wrong_noise_is_refused(model):
    tracker, poses = Tracker(model, FRAMES), np.tile(np.eye(4), (2, 1, 1))
    good = np.tile(np.eye(6), (2, 1, 1))
    with pytest.raises(ShapeError, match=r"covariances.*\(2, 6, 6\)"):
        tracker.update_poses(poses, covariances=good[0])
    for wrong in (np.nan, -1.0):
        bad = good.copy()
        bad[1, 2, 2] = wrong
        with pytest.raises(InvalidValueError, match="observation 'right_leaf'"):
            tracker.update_poses(poses, covariances=bad)
    with pytest.raises(InvalidValueError, match=r"process_noise= need the time"):
        tracker.update_poses(poses, process_noise={"left": 0.1})
    with pytest.raises(InvalidValueError, match="process noise of 'left'"):
        tracker.predict(0.1, process_noise={"left": -1.0})
    assert tracker.estimate.stamp is None
