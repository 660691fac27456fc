"""Laws of a tracker: equalities with reference solutions, and invariances."""

from __future__ import annotations

import pickle
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from scipy.optimize import least_squares, nnls
from scipy.spatial.transform import Rotation
from synthetic_observations import NoisyObserver, add_pose_noise, make_slides

import kineverse as kv
from kineverse.estimation import ObservedExpression, ObservedPose, Outliers, Tracker, pose_covariance
from kineverse.estimation.tracking.bounds import solve_bounded_qp


def make_arm(tilt: object = None) -> kv.Model:
    """Return two hinges in a chain, possibly in a tilted world."""
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("foot", parent="world", transform=kv.translation(0, 0, 0) if tilt is None else tilt)
        edit.apply(
            kv.Revolute(name="one", parent="foot", child="upper", axis=(0, 0, 1), lower=-1.5, upper=1.5)
        )
        edit.add_frame("elbow", parent="upper", transform=kv.translation(0.5, 0, 0))
        edit.apply(
            kv.Revolute(name="two", parent="elbow", child="lower", axis=(0, 1, 0), lower=-1.5, upper=1.5)
        )
        edit.add_frame("tip", parent="lower", transform=kv.translation(0.4, 0, 0.1))
    return model


def test_linear_model_equals_a_kalman_filter():
    a, b = kv.position("a"), kv.position("b")
    R = np.array([[0.04, 0.01], [0.01, 0.09]])
    data = ObservedExpression("z", kv.array([a + 2 * b, a - b]), R)
    tracker = Tracker(
        make_slides(),
        [data],
        start={"a": 0.3, "b": -0.2},
        uncertainty={"a": 0.5, "b": 2.0},
        process_noise={"a:velocity": 0.02, "b:velocity": 0.3},
    )
    H = np.array([[1.0, 2.0], [1.0, -1.0]])
    x, P = np.array([0.3, -0.2]), np.diag([0.25, 4.0])
    rng, log_density = np.random.default_rng(0), 0.0
    for _ in range(10):
        z, u = rng.standard_normal(2), rng.standard_normal(2)
        x, P = x + 0.1 * u, P + 0.1 * np.diag([0.02, 0.3])
        S = H @ P @ H.T + R
        gain, innovation = P @ H.T @ np.linalg.inv(S), z - H @ x
        nis = innovation @ np.linalg.solve(S, innovation)
        log_density -= (nis + np.log(np.linalg.det(2 * np.pi * S))) / 2
        x, P = x + gain @ innovation, P - gain @ S @ gain.T
        tracker.predict(0.1, {"a:velocity": u[0], "b:velocity": u[1]})
        estimate = tracker.update({"z": z})
        assert [estimate.state["a"], estimate.state["b"]] == pytest.approx(x.tolist(), abs=1e-9)
        assert np.allclose(estimate.covariance, P, atol=1e-12)
        assert estimate.nis == pytest.approx(nis)
        assert tracker.log_evidence == pytest.approx(log_density)


def test_two_observations_equal_one_with_the_summed_information():
    a, b = kv.position("a"), kv.position("b")
    first, second = np.diag([0.04, 0.01]), np.array([[0.02, 0.01], [0.01, 0.05]])
    together = np.linalg.inv(np.linalg.inv(first) + np.linalg.inv(second))
    z1, z2 = np.array([0.1, 0.2]), np.array([0.3, -0.1])
    both = together @ (np.linalg.solve(first, z1) + np.linalg.solve(second, z2))
    once = Tracker(make_slides(), [ObservedExpression("z", kv.array([a, b]), together)])
    twice = once.copy()
    merged = once.update({"z": both})
    twice.update({"z": (z2, second)})
    apart = twice.update({"z": (z1, first)})
    assert np.allclose(merged.information, apart.information, rtol=1e-12)
    assert np.allclose(list(merged.state.values()), list(apart.state.values()), atol=1e-9)


def test_order_of_observations_hardly_matters():
    model = make_arm()
    observer = NoisyObserver(model, ["lower", "tip"], 0.002, np.radians(0.2))
    readings = [observer({"one": 0.4, "two": -0.7}) for _ in range(6)]
    observed = [ObservedPose(f, covariance=observer.covariance) for f in observer.frames]
    results = []
    for order in (readings, readings[::-1]):
        tracker = Tracker(
            model, observed, uncertainty={"one": 0.01, "two": 0.01}, start={"one": 0.4, "two": -0.7}
        )
        for data in order:
            estimate = tracker.update(data)
        results.append(np.array([estimate.state["one"], estimate.state["two"]]))
    # The remaining difference is second order in the noise, from linearisation.
    assert np.abs(results[0] - results[1]).max() < 0.02 * min(estimate.deviation.values())


def test_estimate_is_invariant_to_the_world_frame():
    place = np.array(kv.translation(3, -2, 1)() @ kv.rpy(0.3, -1.1, 2.0)())
    plain, moved = make_arm(), make_arm(kv.translation(3, -2, 1) @ kv.rpy(0.3, -1.1, 2.0))
    observer = NoisyObserver(plain, ["lower", "tip"], 0.05, np.radians(5))
    covariance = np.diag([0.01, 0.02, 0.03, 0.004, 0.005, 0.006])
    turn = np.kron(np.eye(2), place[:3, :3])
    here = Tracker(plain, [ObservedPose(f, covariance=covariance) for f in observer.frames])
    there = Tracker(moved, [ObservedPose(f, covariance=turn @ covariance @ turn.T) for f in observer.frames])
    for _ in range(4):
        data = observer({"one": 0.4, "two": -0.7})
        a, b = here.update(data), there.update({f: place @ T for f, T in data.items()})
        assert np.allclose(list(a.state.values()), list(b.state.values()), atol=1e-7)
        assert np.allclose(a.covariance, b.covariance, rtol=1e-5)
        assert a.nis == pytest.approx(b.nis, rel=1e-6)


def residuals(x, model, data, covariance, prior):
    """Compute whitened residuals of a state with scipy."""
    parts, whiten = [(x - prior[0]) / prior[1]], np.linalg.inv(np.linalg.cholesky(covariance))
    for frame, T in data.items():
        said = model.fk(frame)(
            {str(s): v for s, v in zip(model.symbols, x, strict=True) if s in model.fk(frame).symbols}
        )
        turned = Rotation.from_matrix(T[:3, :3] @ said[:3, :3].T).as_rotvec()
        parts.append(whiten @ np.concatenate([T[:3, 3] - said[:3, 3], turned]))
    return np.concatenate(parts)


@pytest.mark.parametrize("truth", [(0.4, -0.7), (1.5, 1.5), (1.45, -1.5)])
def test_estimate_minimises_the_cost_inside_the_limits(truth):
    model, covariance = make_arm(), pose_covariance(0.1, np.radians(10))
    observer = NoisyObserver(model, ["lower", "tip"], 0.1, np.radians(10), seed=3)
    prior = np.zeros(2), np.full(2, 1.5)
    for _ in range(3):
        data = observer(dict(zip(("one", "two"), truth, strict=True)))
        tracker = Tracker(model, [ObservedPose(f, covariance=covariance) for f in observer.frames])
        estimate = tracker.update(data)
        result = least_squares(
            residuals,
            [0.0, 0.0],
            bounds=(-1.5, 1.5),
            args=(model, data, covariance, prior),
            xtol=1e-12,
            ftol=1e-12,
            gtol=1e-12,
        )
        assert [estimate.state["one"], estimate.state["two"]] == pytest.approx(result.x.tolist(), abs=2e-6)


def test_jacobians_equal_finite_differences_of_residuals():
    """Geometric Jacobian and Jr⁻¹ equal finite differences of the residual, also for large residuals."""
    model = make_arm()
    tracker, rng = Tracker(model, ["tip"]), np.random.default_rng(0)
    update_step = tracker._update_step
    for _ in range(20):
        x = rng.uniform(-1.4, 1.4, 2)
        data = add_pose_noise(model.fk("tip")(dict(zip(("one", "two"), x, strict=True))), 0.3, 0.8, rng)
        reading = update_step.reader.read({"tip": data})

        def error(at, reading=reading):
            return update_step.residuals.errors(
                update_step.residuals.evaluate(at, np.empty(0)), reading, [0]
            )[0]

        _, slope = error(x)
        h = 1e-6
        numeric = np.stack([(error(x + h * e)[0] - error(x - h * e)[0]) / (2 * h) for e in np.eye(2)], axis=1)
        assert np.allclose(slope, -numeric, atol=1e-4 * np.abs(slope).max())


def test_multi_start_finds_periodic_angles_and_they_count_turns():
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Continuous(name="wheel", parent="world", child="wheel", axis=(0, 0, 1)))
    at = kv.estimation.ObservedPosition("wheel", (1.0, 0.0, 0.0))
    rng = np.random.default_rng(0)
    for start in np.linspace(-3, 3, 3):
        tracker = Tracker(model, [at])
        for k in range(40):
            angle = start + 0.1 * k
            estimate = tracker.update(
                {"wheel": [np.cos(angle), np.sin(angle), 0] + 0.01 * rng.standard_normal(3)}
            )
            assert abs(estimate.state["wheel"] - angle) < 5 * estimate.deviation["wheel"]
            tracker.predict(1.0, {"wheel:velocity": 0.1})


def test_model_is_never_evaluated_outside_its_limits():
    """The published garage door has arccos(a/l), which is undefined beyond its limit."""
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.articulations.GarageDoor(name="g", parent="world", form="published"))
    observer = NoisyObserver(model, ["g/door", "g/upper_edge"], 0.1, np.radians(10), seed=1)
    tracker = Tracker(model, [ObservedPose(f, covariance=observer.covariance) for f in observer.frames])
    for _ in range(20):
        estimate = tracker.update(observer({"g/door": 1.999, "g/bolt": 0.1}))
        assert 0 <= estimate.state["g/door"] <= 2
        assert np.isfinite(estimate.covariance).all()


def test_limits_on_several_coordinates_hold():
    model = make_slides()
    a, b = kv.position("a"), kv.position("b")
    with model.edit() as edit:
        edit.constrain("circle", 0, a * a + b * b, 1)
        edit.constrain("a/position", -2, a, 2)
    tracker = Tracker(model, [ObservedExpression("a", a, 0.01), ObservedExpression("b", b, 0.01)])
    assert tracker.groups == ((a, b),)
    for _ in range(10):
        estimate = tracker.update({"a": 1.2, "b": 0.9})
    x = np.array([estimate.state["a"], estimate.state["b"]])
    assert np.linalg.norm(x) == pytest.approx(1.0, abs=1e-6)
    assert x == pytest.approx(np.array([0.8, 0.6]), abs=1e-2)
    # The Gaussian ignores the circle, so new measurements can lead away from it.
    assert x + estimate.mean == pytest.approx(np.array([1.2, 0.9]), abs=2e-2)


def test_limits_that_depend_on_coordinates_hold():
    """A door limits the drawer next to it, and a bolt holds the door near zero."""
    model = make_slides()
    a, b = kv.position("a"), kv.position("b")
    with model.edit() as edit:
        edit.constrain("a/position", 0, a, kv.articulations.tabulated_limit(b, {0.0: 0.2, 1.0: 1.0}))
        edit.constrain("b/position", 0, b, 1)
        edit.constrain("held", *kv.articulations.position_lock(b, open_if=a < 0.9, upper=0.8))
    data = ObservedExpression("z", kv.array([a, b]), 0.01 * np.eye(2))
    tracker = Tracker(model, [data], uncertainty={"a": 10.0, "b": 10.0})
    for _ in range(3):
        estimate = tracker.update({"z": [0.9, 0.3]})
    # The nearest point on the line a = 0.2 + 0.8 b.
    along = np.array([0.8, 1.0]) / np.hypot(0.8, 1.0)
    wanted = np.array([0.2, 0.0]) + along * (along @ (np.array([0.9, 0.3]) - [0.2, 0.0]))
    assert [estimate.state["a"], estimate.state["b"]] == pytest.approx(wanted.tolist(), abs=1e-4)
    assert not model.violations(estimate.state, tolerance=1e-7)


def test_estimate_leaves_a_limit_when_measurements_do():
    a, model = kv.position("a"), make_slides()
    with model.edit() as edit:
        edit.constrain("a/position", 0, a, 1)
    tracker = Tracker(model, [ObservedExpression("z", a, 1.0)], uncertainty={"a": 100.0})
    for z in (1.5, 1.5, 0.6, 0.6):
        estimate = tracker.update({"z": z})
    assert estimate.state["a"] == pytest.approx(1.0)
    for z in (0.6, 0.6):
        estimate = tracker.update({"z": z})
    assert estimate.state["a"] == pytest.approx(0.9, abs=1e-3)


@pytest.mark.compiler
def test_compiled_and_numpy_updates_agree():
    model = kv.load("kitchen")
    observer = NoisyObserver(model, [f for f in model.frames if model.speeds_of(f)], 0.1, np.radians(10))
    observed = [ObservedPose(f, covariance=observer.covariance) for f in observer.frames]
    noise = dict.fromkeys(model.speeds, 1e-3)
    fast, slow = (Tracker(model, observed, process_noise=noise) for _ in range(2))
    slow._update_step.native = None
    assert fast.wait()
    rng = np.random.default_rng(2)
    for _ in range(3):
        truth = {str(s): rng.choice([*fast.limits[s], rng.uniform(*fast.limits[s])]) for s in fast.symbols}
        one, other = fast.copy(), slow.copy()
        for _ in range(4):
            data, mask = observer.array(truth), rng.random(len(observer.frames)) < 0.7
            a, b = one.update_poses(data, mask), other.update_poses(data, mask)
            assert np.allclose(list(a.state.values()), list(b.state.values()), rtol=0, atol=1e-12)
            assert np.allclose(a.information, b.information, rtol=1e-12)
            assert np.allclose(a.mean, b.mean, rtol=0, atol=1e-9)
            assert (a.nis, a.dof, a.rounds) == (pytest.approx(b.nis), b.dof, b.rounds)
            assert one.log_evidence == pytest.approx(other.log_evidence)
            a, b = (tracker.predict(0.1, {"kitchen/fridge_door:velocity": 3.0}) for tracker in (one, other))
            assert np.allclose(list(a.state.values()), list(b.state.values()), rtol=0, atol=1e-12)
            assert np.allclose(a.information, b.information, rtol=1e-12)
            assert np.allclose(a.mean, b.mean, rtol=0, atol=1e-9)


@pytest.mark.compiler
@pytest.mark.parametrize("place", [0.3, 1.5])
def test_compiled_and_numpy_updates_agree_on_floating_bodies(place):
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Floating(name="box", parent="world", child="box"))
        edit.apply(kv.Revolute(name="lid", parent="box", child="lid", axis=(0, 1, 0), lower=-1.5, upper=1.5))
        edit.apply(kv.articulations.Ball(name="ball", parent="lid", child="hook"))
    observer = NoisyObserver(model, ["box", "lid", "hook"], 0.05, 0.05)
    observed = [ObservedPose(f, covariance=observer.covariance) for f in observer.frames]
    noise = dict.fromkeys(model.speeds, 0.001)
    fast, slow = (Tracker(model, observed, process_noise=noise) for _ in range(2))
    slow._update_step.native = None
    assert fast.wait()
    turns = Rotation.random(2, random_state=0).as_quat()
    truth = {"box/x": 0.5, "box/y": 1.0, "box/z": -2.0, "lid": place}
    for name, turn in zip(("box", "ball"), turns, strict=True):
        truth |= dict(zip((f"{name}/q{c}" for c in "xyzw"), turn, strict=True))
    for step in range(5):
        data = observer(truth)
        native = fast._update_step.native.update(
            fast._now.mixture.best, fast._update_step.reader.read(data), np.empty(0), [0]
        )
        assert native is not None
        for a, b in [
            (fast.update(data), slow.update(data)),
            tuple(tracker.predict(0.1, {"box/wx:velocity": 4.0 * (step == 2)}) for tracker in (fast, slow)),
        ]:
            assert np.allclose(list(a.state.values()), list(b.state.values()), rtol=0, atol=1e-10)
            assert np.allclose(
                a.information, b.information, rtol=1e-8, atol=1e-8 * np.abs(a.information).max()
            )
            assert (a.nis, a.dof, a.rounds) == (pytest.approx(b.nis), b.dof, b.rounds)
            assert fast.log_evidence == pytest.approx(slow.log_evidence)


@pytest.mark.compiler
def test_compiled_and_numpy_updates_agree_on_inliers():
    model = kv.load("kitchen")
    observer = NoisyObserver(model, [f for f in model.frames if model.speeds_of(f)][:12])
    fast, slow = (Tracker(model, observer.frames, outliers=True) for _ in range(2))
    slow._update_step.native = None
    assert fast.wait()
    truth = {str(s): np.mean(fast.limits[s]) for s in fast.symbols}
    for step in range(4):
        data = observer(truth)
        data[observer.frames[2 * step]][:3, 3] += 1.0
        a, b = fast.update(data), slow.update(data)
        assert a.outliers == b.outliers == (observer.frames[2 * step],)
        assert np.allclose(list(a.state.values()), list(b.state.values()), rtol=0, atol=1e-9)
        assert np.allclose(a.information, b.information, rtol=1e-6)
        assert a.log_evidence == pytest.approx(b.log_evidence, rel=1e-6)


@pytest.mark.sampled(2)
@pytest.mark.compiler
@pytest.mark.parametrize(("gross", "steps"), [(0.1, 4), (1.0, 8)])
def test_compiled_and_numpy_updates_agree_on_outliers(gross, steps, monkeypatch):
    model = kv.load("kitchen")
    observer = NoisyObserver(model, [f for f in model.frames if model.speeds_of(f)], 0.02, np.radians(2))
    observed = [ObservedPose(f, covariance=observer.covariance) for f in observer.frames]
    fast, slow = (Tracker(model, observed, outliers=Outliers(0.3)) for _ in range(2))
    slow._update_step.native = None
    assert fast.wait()
    monkeypatch.setattr(fast._update_step.solver, "update", None)  # all of it runs in C
    rng = np.random.default_rng(3)
    truth = {str(s): rng.uniform(*fast.limits[s]) for s in fast.symbols}
    for _ in range(steps):
        data, mask = observer.array(truth), rng.random(len(observer.frames)) < 0.7
        wrong = rng.random(len(observer.frames)) < 0.3
        turns = Rotation.from_rotvec(gross * rng.standard_normal((len(data), 3))).as_matrix()
        data[wrong, :3, 3] += gross * rng.choice([-1, 1], (wrong.sum(), 3))
        data[wrong, :3, :3] = turns[wrong] @ data[wrong, :3, :3]
        b, a = slow.update_poses(data, mask), fast.update_poses(data, mask)
        assert a.outliers == b.outliers
        assert a.dof == b.dof
        assert np.allclose(list(a.state.values()), list(b.state.values()), rtol=0, atol=1e-7)
        assert np.allclose(a.information, b.information, rtol=1e-5)
        assert a.log_evidence == pytest.approx(b.log_evidence, rel=1e-6)


@pytest.mark.compiler
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.long) for seed in (1, 2))])
def test_compiled_and_numpy_agree_about_groups_with_several_active_bounds(seed):
    model, rng = kv.Model(), np.random.default_rng(seed)
    with model.edit() as edit:
        before = "world"
        for name in "abcde":
            axis, step = rng.standard_normal(3), rng.standard_normal(3)
            edit.apply(
                kv.Revolute(name=name, parent=before, child=f"{name} link", axis=axis, lower=-0.5, upper=0.5)
            )
            before = f"{name} end"
            edit.add_frame(before, parent=f"{name} link", transform=kv.translation(*step))
        a, b = kv.position("a"), kv.position("b")
        edit.constrain("curved", 0, a**2 + b**2, 0.3)
        edit.constrain("conditional", *kv.articulations.position_lock(a, open_if=b < 0.2, upper=0.45))
    observed = [
        ObservedPose("e end", covariance=0.01 * np.eye(6) + 0.005),
        kv.estimation.ObservedPosition("c end", (0.1, 0.2, 0.3)),
        ObservedExpression("sum", kv.array([a + b, a * b]), 0.02 * np.eye(2)),
    ]
    noise = dict.fromkeys(model.speeds, 0.01)
    fast, slow = (Tracker(model, observed, process_noise=noise) for _ in range(2))
    slow._update_step.native = None
    assert fast.wait()
    assert len(fast.groups) == 1
    truth = {str(s): rng.choice([-0.5, 0.5, 0.1]) for s in fast.symbols}
    at_bounds = 0
    for _ in range(4):
        data = {
            "e end": add_pose_noise(model.fk("e end")(truth), 0.1, 0.1, rng),
            "c end": rng.standard_normal(3) * 0.01
            + (model.fk("c end") @ [0.1, 0.2, 0.3, 1])({s: truth[s] for s in "abc"})[:3],
            "sum": [truth["a"] + truth["b"], truth["a"] * truth["b"]] + 0.1 * rng.standard_normal(2),
        }
        one, other = fast.update(data), slow.update(data)
        assert (
            fast._update_step.native.update(
                fast._now.mixture.best, fast._update_step.reader.read(data), np.empty(0), [0]
            )
            is not None
        )
        for _ in range(2):
            assert np.allclose(list(one.state.values()), list(other.state.values()), rtol=0, atol=1e-9)
            assert np.allclose(one.information, other.information, rtol=1e-8, atol=1e-8)
            assert np.allclose(one.mean, other.mean, rtol=0, atol=1e-8)
            assert fast.log_evidence == pytest.approx(slow.log_evidence)
            at_bounds += sum(abs(abs(x) - 0.5) < 1e-12 for x in one.state.values())
            one, other = (t.predict(0.1, {"b:velocity": 1.0}) for t in (fast, slow))
    assert at_bounds > 0


def test_solve_bounded_qp_equals_nonnegative_least_squares():
    rng = np.random.default_rng(0)
    for _ in range(60):
        n, m = rng.integers(1, 7), rng.integers(0, 7)
        half = rng.standard_normal((n, n))
        A, g = half @ half.T + 0.1 * np.eye(n), 3 * rng.standard_normal(n)
        rows = rng.standard_normal((m, n))
        inside = rows @ rng.standard_normal(n)
        low, high = inside - rng.uniform(0, 1, m), inside + rng.uniform(0, 1, m)
        low[rng.random(m) < 0.3] = -np.inf
        x = solve_bounded_qp(A, -g, rows, low, high)
        assert (rows @ x >= low - 1e-8).all()
        assert (rows @ x <= high + 1e-8).all()
        # Karush-Kuhn-Tucker: the gradient is a combination of active rows with the correct signs.
        gradient = A @ x + g
        at_low, at_high = np.abs(rows @ x - low) < 1e-8, np.abs(rows @ x - high) < 1e-8
        normals = np.concatenate([rows[at_low], -rows[at_high]])
        left = nnls(normals.T, gradient)[1] if len(normals) else np.linalg.norm(gradient)
        assert left < 1e-7
    assert (
        solve_bounded_qp(
            np.eye(1), np.zeros(1), np.ones((2, 1)), np.array([1.0, -np.inf]), np.array([np.inf, 0.0])
        )
        is None
    )


@pytest.mark.compiler
def test_copies_are_usable_in_several_threads():
    model = kv.load("kitchen")
    observer = NoisyObserver(model, [f for f in model.frames if model.speeds_of(f)])
    first = Tracker(model, observer.frames, process_noise=dict.fromkeys(model.speeds, 1e-3))
    first.wait()
    rng = np.random.default_rng(0)
    truths = [{str(s): rng.uniform(*first.limits[s]) for s in first.symbols} for _ in range(4)]
    readings = [[observer.array(truth) for _ in range(30)] for truth in truths]

    def follow(some):
        tracker = first.copy()
        for step, poses in enumerate(some):
            estimate = tracker.update_poses(poses, at=0.1 * step)
        return estimate.state

    alone = [follow(some) for some in readings]
    with ThreadPoolExecutor(4) as threads:
        assert list(threads.map(follow, readings)) == alone


@pytest.mark.compiler
def test_tracker_is_picklable():
    model = kv.load("kitchen")
    frames = [f for f in model.frames if model.speeds_of(f)]
    observer, tracker = NoisyObserver(model, frames), Tracker(model, frames, outliers=True)
    truth = {str(s): 0.2 for s in tracker.symbols}
    tracker.wait()
    tracker.update(observer(truth))
    there, data = pickle.loads(pickle.dumps(tracker)), observer(truth)
    here, again = tracker.update(data), there.update(data)
    assert again.state == pytest.approx(dict(here.state), abs=1e-9)
    np.testing.assert_allclose(again.covariance, here.covariance, rtol=1e-9)
