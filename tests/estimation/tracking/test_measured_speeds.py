"""Measured speeds, moving bases, redundant arms in motion, residuals of measurements."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import block_diag
from synthetic_observations import NoisyObserver, make_slides
from test_observability import BENT, make_arm
from test_process_model import make_body, white_acceleration

import kineverse as kv
from kineverse.errors import InvalidValueError
from kineverse.estimation import ObservedExpression, ObservedPose, Tracker, pose_covariance
from kineverse.lie import retract


def test_linear_model_with_measured_speeds_equals_a_kalman_filter():
    a, b = kv.position("a"), kv.position("b")
    R, S, q = np.array([[0.04, 0.01], [0.01, 0.09]]), np.array([[0.05, 0.01], [0.01, 0.02]]), (0.2, 0.7)
    speeds = kv.array([a.derivative() + 0.5 * b.derivative() + 0.3 * a, b.derivative()])
    tracker = Tracker(
        make_slides(),
        [ObservedExpression("z", kv.array([a + 2 * b, a - b]), R), ObservedExpression("s", speeds, S)],
        uncertainty={"a": 0.5, "b": 2.0},
        process="velocity",
        process_noise={"a": q[0], "b": q[1]},
    )
    rows = {"z": [[1.0, 2, 0, 0], [1, -1, 0, 0]], "s": [[0.3, 0, 1, 0.5], [0, 0, 0, 1]]}
    x, P, log_density, time = np.zeros(4), np.diag([0.25, 4.0, 0.6, 2.1]), 0.0, 0.0
    rng = np.random.default_rng(0)
    for k in range(12):
        dt = (0.0, 0.1, 0.4)[k % 3] if k else 0.0
        time += dt
        if k:
            F, Q = white_acceleration(np.array(q), dt)
            x, P = F @ x, F @ P @ F.T + Q
        names = [("z",), ("s",), ("z", "s")][k % 3]
        values = {name: rng.standard_normal(2) for name in names}
        estimate = tracker.update(values, at=time)
        H, noise = np.vstack([rows[n] for n in names]), block_diag(*({"z": R, "s": S}[n] for n in names))
        spread, r = H @ P @ H.T + noise, np.concatenate(list(values.values())) - H @ x
        nis = r @ np.linalg.solve(spread, r)
        log_density -= 0.5 * (nis + np.linalg.slogdet(2 * np.pi * spread)[1])
        for n, part in zip(names, (slice(2), slice(2, 4)), strict=False):
            np.testing.assert_allclose(estimate.residuals[n].value, r[part], atol=1e-9)
            np.testing.assert_allclose(estimate.residuals[n].covariance, spread[part, part], atol=1e-9)
        K = P @ H.T @ np.linalg.inv(spread)
        x, P = x + K @ r, P - K @ spread @ K.T
        found = [estimate.state[s] for s in ("a", "b", "a:velocity", "b:velocity")]
        np.testing.assert_allclose(found, x, atol=1e-9)
        np.testing.assert_allclose(estimate.covariance, P[:2, :2], atol=1e-9)
        np.testing.assert_allclose(estimate.speed_covariance, P[2:, 2:], atol=1e-9)
        assert estimate.log_evidence == pytest.approx(log_density)
        assert estimate.nis == pytest.approx(nis)


def drive(tracker, seconds, *, poses, odometry=False, slip=None, seed=0, dt=0.1):
    """Return errors of the position of a base on a circle [m], and the last estimate."""
    rng, errors = np.random.default_rng(seed), []
    for k in range(round(seconds / dt)):
        angle = 0.5 * k * dt
        true = kv.rotation_z(angle)()
        true[:2, 3] = np.sin(angle), 1 - np.cos(angle)
        data = {}
        if poses(k):
            data["b"] = retract(true, rng.normal(0, [0.005] * 3 + [0.02] * 3))
        if odometry:
            data["odometry"] = np.array([0.5, 0.5]) + rng.normal(0, [0.02, 0.01])
        if slip is not None and slip(k):
            data["odometry"] = np.array([5.0, 0.0])
        estimate = tracker.update(data, at=k * dt)
        errors.append(np.hypot(estimate.state["b/x"] - true[0, 3], estimate.state["b/y"] - true[1, 3]))
    return np.array(errors), estimate


def observe_base(*, has_odometry=True, **options):
    model = make_body(wheels=True)
    left, right = model.speeds
    speed = kv.array([0.05 * (left + right), 0.25 * (right - left)])
    observed = [
        ObservedPose("b", covariance=pose_covariance(0.005, 0.02)),
        ObservedExpression("odometry", speed, np.diag([0.02, 0.01]) ** 2),
    ]
    start = dict.fromkeys(("b/x", "b/y", "b/angle"), 0.0)
    observed = observed if has_odometry else observed[:1]
    return Tracker(model, observed, start=start, uncertainty=dict.fromkeys(start, 0.05), **options)


def test_wheel_odometry_bridges_rare_poses():
    errors, estimate = drive(observe_base(outliers=True), 6.0, poses=lambda k: k % 20 == 0, odometry=True)
    blind, _ = drive(observe_base(outliers=True), 6.0, poses=lambda k: k % 20 == 0)
    assert np.sqrt(np.mean(errors[20:] ** 2)) < 0.02
    assert np.sqrt(np.mean(blind[20:] ** 2)) > 0.1
    assert estimate.residuals["odometry"].nis < 14


def test_slipping_wheels_are_outliers():
    errors, estimate = drive(
        observe_base(outliers=True), 4.0, poses=lambda k: True, odometry=True, slip=lambda k: k >= 30
    )
    assert estimate.outliers == ("odometry",)
    assert errors[10:].max() < 0.02


def test_a_base_is_followed_by_default():
    """With the default process, an outlier model and a start that is known to 5 cm."""
    tracker = observe_base(has_odometry=False, outliers=True)
    errors, estimate = drive(tracker, 6.0, poses=lambda k: True)
    assert np.sqrt(np.mean(errors[10:] ** 2)) < 0.008
    assert not estimate.lost


def test_a_full_pose_finds_a_base_that_started_elsewhere():
    model, start = make_body(wheels=True), dict.fromkeys(("b/x", "b/y", "b/angle"), 0.0)
    known = {"start": start, "uncertainty": dict.fromkeys(start, 0.05)}
    tracker = Tracker(model, ["b"], outliers=True, process="position", **known)
    pose = kv.rotation_z(2.0)()
    for at in (0.0, 0.1):
        tracker.update({"b": np.eye(4)}, at=at)
    pose[:2, 3] = 3.0, -2.0
    for k in range(3):
        estimate = tracker.update({"b": pose}, at=20.0 + k / 30)
    assert estimate.state["b/x"] == pytest.approx(3.0, abs=0.02)
    assert estimate.deviation["b/x"] < 0.02


def test_measured_speeds_need_estimated_ones():
    model, a = make_slides(), kv.position("a")
    speed = ObservedExpression("s", a.derivative(), 0.01)
    assert "a:velocity" in Tracker(model, ["cart", speed]).estimate.state
    with pytest.raises(InvalidValueError, match='process="velocity"'):
        Tracker(model, ["cart", speed], process="static")
    with pytest.raises(InvalidValueError, match="no estimated speed"):
        Tracker(model, ["cart", ObservedExpression("s", kv.position("c").derivative(), 0.01)])


def test_parts_that_move_against_each_other_are_followed():
    """A folding door is opened within 2 s: both leaves turn, one by twice the angle of the other."""
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Revolute(name="a", parent="world", child="A", axis=(0, 0, 1), lower=0, upper=1.6))
        origin = kv.translation(0.4, 0, 0)
        edit.apply(
            kv.Revolute(name="c", parent="A", child="C", axis=(0, 0, 1), origin=origin, lower=-3.2, upper=0)
        )
    observer = NoisyObserver(model, ["C"], 0.005, 0.02)
    tracker = Tracker(model, [ObservedPose("C", covariance=observer.covariance)], outliers=True)
    errors = []
    for k in range(100):
        share = np.clip((k - 20) / 60, 0, 1)
        angle = 1.5 * share**3 * (10 - 15 * share + 6 * share**2)
        estimate = tracker.update(observer({"a": angle, "c": -2 * angle}), at=k / 30)
        errors.append(abs(estimate.state["c"] + 2 * angle))
    assert max(errors[15:]) < np.radians(12)


@pytest.mark.parametrize("count", [3, pytest.param(24, marks=pytest.mark.long)])
def test_a_redundant_arm_in_motion_states_no_more_than_it_knows(count):
    """Seven joints follow the process and are seen at the tip, which leaves one direction free."""
    model = make_arm()
    observer, normalised = NoisyObserver(model, ["tip"], seed=1), []
    observed = [ObservedPose("tip", covariance=observer.covariance)]
    noise = dict.fromkeys(BENT, 0.01)
    first = Tracker(
        model,
        observed,
        start=BENT,
        uncertainty=dict.fromkeys(BENT, 0.2),
        process="velocity",
        process_noise=noise,
    )
    for seed in range(count):
        rng, tracker, u = np.random.default_rng(seed), first.copy(), np.zeros(7)
        x = np.array(list(BENT.values())) + 0.2 * rng.standard_normal(7)
        for k in range(40):
            if k:
                change = np.sqrt(0.01 * 0.1) * rng.standard_normal(7)
                x, u = x + 0.1 * (u + change / 2), u + change
            truth = dict(zip(BENT, x, strict=True))
            estimate = tracker.update(observer(truth), at=0.1 * k)
            if k % 5 == 4:
                error = np.array([estimate.state[s] - truth[str(s)] for s in tracker.symbols])
                normalised.append(error @ np.linalg.solve(estimate.covariance, error) / 7)
    assert np.mean(normalised) < 2
    assert normalised[0] > 0.1
    # Nothing is known about the joints in the end.
    assert min(estimate.deviation[s] for s in tracker.symbols) > 0.5
