"""Unobservable directions: redundant arms, mirror images, vanishing Jacobians."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from synthetic_observations import NoisyObserver

import kineverse as kv
from kineverse.estimation import ObservedExpression, ObservedPose, ObservedPosition, Tracker

AXES = [(0, 0, 1), (0, 1, 0), (0, 0, 1), (0, -1, 0), (0, 0, 1), (0, -1, 0), (0, 0, -1)]
OFFSETS = [(0, 0, 0.3), (0, 0, 0), (0, 0, 0.3), (0.1, 0, 0), (-0.1, 0, 0.4), (0, 0, 0), (0.1, 0, 0)]
BENT = dict(zip("abcdefg", (0.3, 0.5, 0.2, 1.5, 0.4, 1.4, 0.3), strict=True))


def make_arm() -> kv.Model:
    """Return an arm of seven joints, one more than the degrees of freedom of its tip."""
    model = kv.Model()
    with model.edit() as edit:
        before = "world"
        for name, axis, offset in zip(BENT, AXES, OFFSETS, strict=True):
            origin = kv.translation(*offset)
            edit.apply(kv.Revolute(name=name, parent=before, child=f"{name} end", axis=axis, origin=origin))
            before = f"{name} end"
        edit.add_frame("tip", parent=before, transform=kv.translation(0.1, 0, -0.1))
    return model


def make_tip_tracker(model: kv.Model, observer: NoisyObserver, deviation: float, **options) -> Tracker:
    observed = [ObservedPose("tip", covariance=observer.covariance)]
    return Tracker(model, observed, start=BENT, uncertainty=dict.fromkeys(BENT, deviation), **options)


@pytest.mark.parametrize(("runs", "off"), [(24, 0.2), pytest.param(45, 0.1, marks=pytest.mark.long)])
def test_covariance_of_a_redundant_arm_is_consistent(runs, off):
    """The sample mean of NEES varies by 7 % between 45 runs, by 10 % between 24; over many it is 0.95."""
    model, rng = make_arm(), np.random.default_rng(1)
    observer = NoisyObserver(model, ["tip"], seed=1)
    first = make_tip_tracker(model, observer, 0.2)
    first.wait()
    result = []
    for _ in range(runs):
        truth = {name: value + 0.2 * rng.standard_normal() for name, value in BENT.items()}
        tracker = first.copy()
        for _ in range(6):
            estimate = tracker.update(observer(truth))
        error = np.array([estimate.state[s] - truth[str(s)] for s in tracker.symbols])
        result.append(error @ estimate.information @ error / len(error))
    assert np.mean(result) == pytest.approx(1.0, abs=off)


@pytest.mark.parametrize(
    ("noise", "runs", "looks"),
    [(1e-2, 24, 5), *(pytest.param(noise, 24, 10, marks=pytest.mark.long) for noise in (1e-4, 1e-2))],
)
@pytest.mark.long
def test_covariance_of_a_redundant_arm_with_process_noise_is_consistent(noise, runs, looks):
    """The sample mean of NEES varies by 12 %; over many runs it is 0.95 to 1.05."""
    model, rng = make_arm(), np.random.default_rng(2)
    observer = NoisyObserver(model, ["tip"], seed=2)
    first = make_tip_tracker(model, observer, 0.2, process_noise={f"{name}:velocity": noise for name in BENT})
    first.wait()
    result = []
    for _ in range(runs):
        truth = {name: value + 0.2 * rng.standard_normal() for name, value in BENT.items()}
        tracker = first.copy()
        for step in range(looks):
            if step:
                truth = {q: x + np.sqrt(noise * 0.1) * rng.standard_normal() for q, x in truth.items()}
            estimate = tracker.update(observer(truth), at=0.1 * step)
        error = np.array([estimate.state[s] - truth[str(s)] for s in tracker.symbols])
        result.append(error @ estimate.information @ error / len(error))
    assert 0.8 < np.mean(result) < 1.2


def test_covariance_of_a_robot_seen_at_one_point_is_consistent_after_a_motion():
    """Its possible poses are a ring, whose tangent turns; nine in ten have a NEES below 2.3."""
    model, rng, deviations = kv.Model(), np.random.default_rng(7), {"p/x": 1.0, "p/y": 1.0, "p/angle": 0.5}
    with model.edit() as edit:
        edit.apply(kv.Planar(name="p", parent="world", child="p"))
    look = kv.compile(model.fk("p")[:3, :3] @ [1.0, 0.0, 0.0] + model.fk("p")[:3, 3])
    observed = [ObservedPosition("p", (1, 0, 0))]
    first = Tracker(
        model, observed, start=dict.fromkeys(deviations, 0.0), uncertainty=deviations, process="static"
    )
    result = []
    for _ in range(40):
        truth = {name: deviation * rng.standard_normal() for name, deviation in deviations.items()}
        tracker = first.copy()
        for step in range(7):
            if step == 4:
                tracker.predict(1.0, {"p/x:velocity": 0.5, "p/angle:velocity": 0.3})
                truth["p/x"], truth["p/angle"] = truth["p/x"] + 0.5, truth["p/angle"] + 0.3
            estimate = tracker.update({"p": look(truth) + 0.01 * rng.standard_normal(3)})
        error = np.array([estimate.state[name] - truth[name] for name in ("p/angle", "p/x", "p/y")])
        error[0] = np.remainder(error[0] + np.pi, 2 * np.pi) - np.pi
        result.append(error @ np.linalg.solve(estimate.covariance, error) / 3)
    assert np.quantile(result, 0.85) < 3.0


def test_linear_unobservable_model_equals_a_kalman_filter_over_time():
    """Observe the sum of two slides."""
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Planar(name="p", parent="world", child="p"))
    x, y = model.symbol("p/x"), model.symbol("p/y")
    tracker = Tracker(
        model,
        [ObservedExpression("sum", x + y, 0.1**2)],
        uncertainty={x: 3, y: 3},
        process_noise={"p/x:velocity": 0.02, "p/y:velocity": 0.03},
    )
    h, mean, covariance, evidence = np.ones(2), np.zeros(2), 9 * np.eye(2), 0.0
    for step, value in enumerate([1.0, 1.2, 0.7, 0.9]):
        estimate = tracker.update({"sum": value}, at=2.0 * step)
        covariance += np.diag([0.04, 0.06]) * (step > 0)
        variance, error = h @ covariance @ h + 0.1**2, value - h @ mean
        evidence -= (error**2 / variance + np.log(2 * np.pi * variance)) / 2
        gain = covariance @ h / variance
        mean, covariance = mean + gain * error, covariance - np.outer(gain, h @ covariance)
        assert np.allclose([estimate.state[s] for s in (x, y)], mean, rtol=0, atol=1e-9)
        assert np.allclose(estimate.covariance, covariance, rtol=1e-9)
        assert tracker.log_evidence == pytest.approx(evidence)


def test_tracker_with_unobservable_directions_is_picklable():
    model = make_arm()
    observer = NoisyObserver(model, ["tip"])
    tracker = make_tip_tracker(model, observer, 0.2)
    truth = {name: value + 0.1 for name, value in BENT.items()}
    tracker.update(observer(truth))
    there, data = pickle.loads(pickle.dumps(tracker)), observer(truth)
    here, again = tracker.update(data), there.update(data)
    np.testing.assert_allclose(again.covariance, here.covariance, rtol=1e-6)


def test_covariance_of_a_redundant_arm_with_outliers_is_consistent():
    model = make_arm()
    observer = NoisyObserver(model, ["tip"])
    one, other = (make_tip_tracker(model, observer, 0.2, outliers=wrong) for wrong in (False, True))
    # In numpy the iterations with outliers end elsewhere along the arm's free motion.
    one.wait()
    other.wait()
    truth = {name: value + 0.1 for name, value in BENT.items()}
    for _ in range(5):
        data = observer(truth)
        a, b = one.update(data), other.update(data)
    assert np.allclose(a.covariance, b.covariance, rtol=0, atol=1e-3 * np.abs(a.covariance).max())
    data["tip"][:3, 3] += 0.5
    assert other.update(data).outliers == ("tip",)


def test_static_updates_equal_one_batch_estimate():
    model = make_arm()
    observer = NoisyObserver(model, ["tip"], 0.02, np.radians(2))
    tracker = make_tip_tracker(model, observer, 0.3)
    truth = {name: value + 0.3 for name, value in BENT.items()}
    names = [str(s) for s in tracker.symbols]
    readings = [observer(truth)["tip"] for _ in range(8)]

    def residuals(x):
        pose = observer.truth(dict(zip(names, x, strict=True)))[0]
        errors = [(x - [BENT[name] for name in names]) / 0.3]
        for data in readings:
            turned = Rotation.from_matrix(data[:3, :3] @ pose[:3, :3].T).as_rotvec()
            errors += [(data[:3, 3] - pose[:3, 3]) / 0.02, turned / np.radians(2)]
        return np.concatenate(errors)

    for data in readings:
        estimate = tracker.update({"tip": data})
    best = least_squares(residuals, list(estimate.state.values()), xtol=1e-12, ftol=1e-12, gtol=1e-12)
    # Equal up to the mean of rotations, which averages rotation vectors to first order.
    assert np.allclose(list(estimate.state.values()), best.x, rtol=0, atol=2e-4)
    assert np.linalg.eigvalsh(tracker._now.mixture.best.information)[0] == pytest.approx(0.3**-2, rel=1e-6)


def test_linear_model_keeps_its_covariance_in_unobservable_directions():
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Planar(name="p", parent="world", child="p"))
    x, y = model.symbol("p/x"), model.symbol("p/y")
    tracker = Tracker(model, [ObservedExpression("sum", x + y, 0.1**2)], uncertainty={x: 3, y: 3})
    for value in (1.0, 1.2, 0.9):
        estimate = tracker.update({"sum": value})
    information = np.eye(2) / 9 + 300 * np.ones((2, 2))
    assert np.allclose(estimate.covariance, np.linalg.inv(information), rtol=1e-9)
    spread, data = 0.1**2 * np.eye(3) + 18 * np.ones((3, 3)), np.array([1.0, 1.2, 0.9])
    density = -data @ np.linalg.inv(spread) @ data / 2 - np.linalg.slogdet(2 * np.pi * spread)[1] / 2
    assert tracker.log_evidence == pytest.approx(density, rel=1e-9)


@pytest.mark.parametrize("outliers", [False, True])
@pytest.mark.parametrize("limit", [1.5, 3.0, None])
def test_update_leaves_a_vanishing_jacobian_of_a_cosine(outliers, limit):
    model = kv.Model()
    limits = {} if limit is None else {"lower": -limit, "upper": limit}
    with model.edit() as edit:
        edit.apply(kv.Revolute(name="q", parent="world", child="hand", axis=(0, 0, 1), **limits))
    q = model.symbol("q")
    tracker = Tracker(
        model, [ObservedExpression("cosine", np.cos(q), 0.01**2)], start={"q": 0.0}, outliers=outliers
    )
    for _ in range(3):
        estimate = tracker.update({"cosine": 0.5})
    assert abs(estimate.state["q"]) == pytest.approx(np.pi / 3, abs=1e-3)
    assert estimate.confidence[(q,)] == pytest.approx(0.5, abs=0.01)
    assert estimate.deviation["q"] < 0.01


def test_update_leaves_the_singularity_of_a_stretched_arm():
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Revolute(name="a", parent="world", child="upper", axis=(0, 0, 1), lower=-1, upper=1))
        origin = kv.translation(1, 0, 0)
        edit.apply(
            kv.Revolute(
                name="b", parent="upper", child="lower", axis=(0, 0, 1), origin=origin, lower=-1, upper=1
            )
        )
    tracker = Tracker(model, [ObservedPosition("lower", (1, 0, 0))])
    for _ in range(3):
        estimate = tracker.update({"lower": (1.9, 0, 0)})
    bent = 2 * np.arccos(0.95)
    assert abs(estimate.state["b"]) == pytest.approx(bent, abs=2e-3)
    assert estimate.state["a"] == pytest.approx(-estimate.state["b"] / 2, abs=1e-3)


def test_later_observation_selects_the_mirror_image():
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Planar(name="p", parent="world", child="p"))
    x, y = model.symbol("p/x"), model.symbol("p/y")
    masts = {"a": (0, 0), "b": (3, 0), "c": (0, 3)}
    observed = [
        ObservedExpression(n, np.sqrt((x - a) ** 2 + (y - b) ** 2), 0.01**2) for n, (a, b) in masts.items()
    ]
    tracker = Tracker(model, observed, start={x: 0.5, y: -3})
    for name in "ababab":
        a, b = masts[name]
        estimate = tracker.update({name: np.hypot(1 - a, 2 - b)})
    assert estimate.state[y] == pytest.approx(-2, abs=0.01)
    estimate = tracker.update({"c": np.hypot(1, 1)})
    assert estimate.state[y] == pytest.approx(2, abs=0.01)
    assert estimate.nis < 9


def test_static_record_is_dropped_when_inputs_change():
    """Projections of a point at three known angles determine both of its coordinates."""
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Planar(name="p", parent="world", child="p"))
    x, y, pan = model.symbol("p/x"), model.symbol("p/y"), kv.position("pan")
    data = ObservedExpression("bearing", np.cos(pan) * x + np.sin(pan) * y, 0.01**2)
    tracker = Tracker(model, [data], inputs=[pan], uncertainty={x: 3, y: 3})
    for angle in (0.0, 0.5, 1.5):
        value = np.cos(angle) * 1.0 + np.sin(angle) * 2.0
        estimate = tracker.update({"bearing": value}, inputs={pan: angle})
    assert estimate.state[x] == pytest.approx(1, abs=1e-3)
    assert estimate.state[y] == pytest.approx(2, abs=1e-3)
    assert max(estimate.deviation[s] for s in (x, y)) < 0.02


def make_hinge(**options) -> kv.Model:
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Revolute(name="q", parent="world", child="door", axis=(0, 0, 1), **options))
    return model


@pytest.mark.parametrize("truth", [0.3, 0.5, 0.9, 1.2])
@pytest.mark.parametrize("kind", ["distance", "wave", "saw"])
def test_equally_likely_components_are_kept(kind, truth):
    """Two states predict the same number; a pose selects one of them."""
    model = make_hinge(lower=0.0, upper=1.5)
    q = model.symbol("q")
    value = {"distance": np.abs(q - 0.7), "wave": np.cos(4 * q), "saw": kv.where(q < 0.75, q, q - 0.75)}[kind]
    tracker = Tracker(model, ["door", ObservedExpression(kind, value, 0.01**2)])
    for _ in range(5):
        estimate = tracker.update({kind: float(value({"q": truth}))})
    assert 0.45 < estimate.confidence[(q,)] < 0.6
    estimate = tracker.update({"door": model.fk("door")({"q": truth})})
    assert estimate.state["q"] == pytest.approx(truth, abs=1e-3)
    assert estimate.confidence[(q,)] > 0.999


def test_estimate_at_a_limit_has_the_bias_of_the_truncated_gaussian():
    """The estimate is max(0, z) with z about 0: biased by 0.4 deviations, with a NEES of one half."""
    model, rng = make_hinge(lower=0.0, upper=1.5), np.random.default_rng(0)
    first = Tracker(model, [ObservedExpression("dial", model.symbol("q"), 0.02**2)])
    errors, means = [], []
    for _ in range(400):
        tracker = first.copy()
        for _ in range(3):
            estimate = tracker.update({"dial": 0.02 * rng.standard_normal()})
        errors.append(estimate.state["q"] / estimate.deviation["q"])
        means.append(errors[-1] + estimate.mean[0] / estimate.deviation["q"])
    assert np.mean(errors) == pytest.approx((2 * np.pi) ** -0.5, abs=0.1)
    assert np.mean(np.square(errors)) == pytest.approx(0.5, abs=0.15)
    assert np.mean(means) == pytest.approx(0, abs=0.15)
    assert np.mean(np.square(means)) == pytest.approx(1, abs=0.25)
