"""Speeds that a tracker estimates beside the state."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm
from synthetic_observations import NoisyObserver

import kineverse as kv
from kineverse.errors import UnknownNameError
from kineverse.estimation import ObservedExpression, ObservedPose, Tracker, pose_covariance
from kineverse.lie import retract


def make_slides() -> kv.Model:
    """Return two coordinates with linear observations."""
    model = kv.Model()
    a, b = kv.position("a"), kv.position("b")
    with model.edit() as edit:
        edit.add_frame("cart", parent="world", transform=kv.translation(a, b, 0))
    return model


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
        S = H @ P @ H.T + R
        r = z - H @ x
        log_density -= 0.5 * (r @ np.linalg.solve(S, r) + np.linalg.slogdet(2 * np.pi * S)[1])
        K = P @ H.T @ np.linalg.inv(S)
        x, P = x + K @ r, P - K @ S @ K.T
        found = [estimate.state[s] for s in ("a", "b", "a:velocity", "b:velocity")]
        np.testing.assert_allclose(found, x, atol=1e-9)
        np.testing.assert_allclose(estimate.covariance, P[:2, :2], atol=1e-9)
        np.testing.assert_allclose(estimate.speed_covariance, P[2:, 2:], atol=1e-9)
        assert estimate.log_evidence == pytest.approx(log_density)
        assert estimate.deviation["b:velocity"] == pytest.approx(np.sqrt(P[3, 3]))


@pytest.mark.parametrize("wheels", [True, pytest.param(False, marks=pytest.mark.long)])
def test_speeds_of_a_base_and_of_a_free_body_are_consistent(wheels):
    """Rates carry the body, speeds change at random, and errors have the covariance that is told."""
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
    found = [tracker.update(observer({"q": 2.0 * 0.05 * k}), at=0.05 * k).speeds for k in range(100)]
    speeds = np.array([next(iter(one.values())) for one in found])
    np.testing.assert_allclose(speeds[20:], 2.0, atol=0.5)
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
