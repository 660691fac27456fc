"""Statistical consistency of a tracker: errors, innovations and covariances against the true noise."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from synthetic_observations import NoisyObserver

import kineverse as kv
from kineverse.estimation import (
    HypothesisBank,
    ObservedExpression,
    ObservedPose,
    ObservedPosition,
    Outliers,
    Tracker,
)

STEPS = 25
CONFIGURATIONS = 40


def fisher_information(observer, state, symbols, deviations):
    """Return the information of 25 observations and the start by differences of poses (Cramér-Rao)."""
    at, h = observer.truth(state), 1e-6
    result = deviations**-2.0
    for i, symbol in enumerate(symbols):
        there = observer.truth({**state, symbol: state[symbol] + h})
        shift = (there[:, :3, 3] - at[:, :3, 3]) / h / observer.position
        turn = Rotation.from_matrix(there[:, :3, :3] @ at[:, :3, :3].transpose(0, 2, 1)).as_rotvec() / h
        result[i] += STEPS * ((shift**2).sum() + (turn**2).sum() / observer.orientation**2)
    return result


@pytest.mark.compiler
@pytest.mark.parametrize(
    ("position", "degrees"), [(0.01, 1), pytest.param(0.05, 5, marks=pytest.mark.long), (0.1, 10)]
)
def test_kitchen_is_consistent_and_efficient(position, degrees):
    """NEES near 1 and errors near the bound; on 920 coordinates the sample mean varies by 5 %."""
    model = kv.load("kitchen")
    frames = [f for f in model.frames if model.speeds_of(f)]
    observer = NoisyObserver(model, frames, position, np.radians(degrees), seed=degrees)
    first = Tracker(model, [ObservedPose(f, covariance=observer.covariance) for f in frames])
    first.wait()
    limits = np.array([first.limits[s] for s in first.symbols])
    names = [str(s) for s in first.symbols]
    rng = np.random.default_rng(degrees)
    errors, bounds, normalised, innovations = [], [], [], []
    for _ in range(CONFIGURATIONS):
        truth = rng.uniform(*limits.T)
        state, tracker = dict(zip(names, truth.tolist(), strict=True)), first.copy()
        for step in range(STEPS):
            estimate = tracker.update_poses(observer.array(state))
            if step:  # the start is uniform and no Gaussian
                innovations.append(estimate.nis)
        error = np.array([estimate.state[s] for s in first.symbols]) - truth
        information = fisher_information(observer, state, names, np.ptp(limits, axis=1) / 2)
        inside = np.minimum(truth - limits[:, 0], limits[:, 1] - truth) > 3 / np.sqrt(information)
        errors.append(error)
        bounds.append(1 / information)
        normalised += list((error**2 * np.diag(estimate.information))[inside])
    assert np.sqrt(np.sum(np.square(errors)) / np.sum(bounds)) < 1.08
    assert 0.87 < np.mean(normalised) < 1.13
    count = len(innovations) * estimate.dof
    low, high = chi2.ppf([0.005, 0.995], count) / count
    assert low < np.mean(innovations) / estimate.dof < high


@pytest.mark.parametrize("count", [20, pytest.param(40, marks=pytest.mark.long)])
def test_covariance_of_a_free_body_equals_the_sample_covariance(count):
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Floating(name="box", parent="world", child="box"))
        edit.apply(kv.Revolute(name="lid", parent="box", child="lid", axis=(0, 1, 0), lower=-1.5, upper=1.5))
    observer = NoisyObserver(model, ["box", "lid"], 0.02, np.radians(3))
    first = Tracker(model, [ObservedPose(f, covariance=observer.covariance) for f in observer.frames])
    turn = Rotation.from_rotvec([2.0, -1.0, 1.0])
    state = dict(zip(("box/x", "box/y", "box/z"), (1.0, -2.0, 0.5), strict=True)) | {"lid": 0.4}
    state |= dict(zip(("box/qx", "box/qy", "box/qz", "box/qw"), turn.as_quat(), strict=True))
    nees = []
    for _ in range(count):
        tracker = first.copy()
        for _ in range(5):
            estimate = tracker.update(observer(state))
        result = estimate.state
        said = Rotation.from_quat([result[f"box/q{c}"] for c in "xyzw"])
        # From the estimate to the truth: angular velocities are in the axes of the body.
        off = {f"box/w{c}:velocity": w for c, w in zip("xyz", (said.inv() * turn).as_rotvec(), strict=True)}
        off |= {f"{s}:velocity": state[s] - result[s] for s in ("box/x", "box/y", "box/z", "lid")}
        error = np.array([off[str(v)] for v in estimate.tangent])
        nees.append(error @ estimate.information @ error)
    low, high = chi2.ppf([0.001, 0.999], 7 * len(nees))
    assert low < sum(nees) < high


def test_process_noise_on_wheels_is_consistent():
    """Process noise enters through the rates, so the lateral error of a driving base is consistent."""
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(
            kv.articulations.DifferentialDrive(
                name="base", parent="world", child="base", radius=0.1, track=0.4
            )
        )
    wheels, spread, dt = model.speeds, 0.5, 0.1
    start = {"base/x": 0.0, "base/y": 0.0, "base/angle": 0.3}
    rng, speeds = np.random.default_rng(0), dict(zip(wheels, (8.0, 6.0), strict=True))
    tracker = Tracker(model, ["base"], start=start, uncertainty=dict.fromkeys(start, 1e-6),
                      process_noise=dict.fromkeys(wheels, spread**2 * dt))  # fmt: skip
    for _ in range(20):
        estimate = tracker.predict(dt, speeds)
    nees, mean = [], np.array([estimate.state[s] for s in tracker.symbols])
    for _ in range(100):
        state = kv.State(start)
        for _ in range(20):
            state = model.integrate(
                state, {v: u + spread * rng.standard_normal() for v, u in speeds.items()}, dt
            )
        error = np.array([state[s] for s in tracker.symbols]) - mean
        nees.append(error @ estimate.information @ error)
    assert 0.7 < np.mean(nees) / 3 < 1.4
    whole = kv.State(start)
    whole = model.integrate(whole, speeds, 2.0)
    assert mean == pytest.approx(np.array([whole[s] for s in tracker.symbols]), abs=1e-6)


def anywhere(rng):
    pose = np.eye(4)
    pose[:3, 3] = rng.uniform(-2, 2, 3)
    pose[:3, :3] = Rotation.from_rotvec(rng.uniform(-2, 2, 3)).as_matrix()
    return pose


def test_outliers_and_occlusion_are_tracked_consistently():
    model = kv.load("kitchen")
    frames = [f for f in model.frames if model.speeds_of(f)][:16]
    observer = NoisyObserver(model, frames, 0.02, np.radians(2), seed=4)
    observed = [ObservedPose(f, covariance=observer.covariance) for f in frames]
    tracker = Tracker(model, observed, outliers=Outliers(fraction=0.2))
    rng = np.random.default_rng(5)
    truth = {str(s): rng.uniform(*tracker.limits[s]) for s in tracker.symbols}
    listed, wrong = [], []
    for _ in range(15):
        data = {f: T for f, T in observer(truth).items() if rng.random() < 0.5}
        bad = [f for f in data if rng.random() < 0.2]
        estimate = tracker.update(data | {f: anywhere(rng) for f in bad})
        listed.append(set(estimate.outliers))
        wrong.append(set(bad))
    assert listed == wrong
    for s in tracker.symbols:
        assert abs(estimate.state[s] - truth[str(s)]) < 4 * estimate.deviation[s]
    assert max(estimate.deviation.values()) < 0.05
    assert min(estimate.confidence.values()) > 0.99


def test_first_measurement_as_outlier_is_corrected():
    """A free body fits any pose: the second observation contradicts the first, the third decides."""
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Floating(name="box", parent="world", child="box"))
    observer = NoisyObserver(model, ["box"])
    tracker, truth = Tracker(model, ["box"], outliers=True), model.default_state()
    tracker.update({"box": anywhere(np.random.default_rng(1))})
    estimate = tracker.update(observer(truth))
    assert max(estimate.confidence.values()) < 0.9
    for _ in range(3):
        estimate = tracker.update(observer(truth))
    assert min(estimate.confidence.values()) > 0.999
    assert abs(estimate.state["box/x"]) < 0.02


def part(joint) -> kv.Model:
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(joint)
    return model


def test_hypothesis_bank_tells_hinge_from_drawer():
    hinge = part(kv.Revolute(name="q", parent="world", child="part", axis=(0, 0, 1), lower=0, upper=1.5))
    drawer = part(kv.Prismatic(name="q", parent="world", child="part", axis=(0, 1, 0), lower=0, upper=0.5))
    for right, model, reach in (("hinge", hinge, 1.0), ("drawer", drawer, 0.4)):
        trackers = {
            name: Tracker(m, ["part"], process_noise={"q:velocity": 0.05})
            for name, m in (("hinge", hinge), ("drawer", drawer))
        }
        hypotheses, observer = HypothesisBank(trackers), NoisyObserver(model, ["part"])
        for k in range(10):
            probabilities = hypotheses.update(observer({"q": reach * k / 10}), at=0.1 * k)
        assert sum(probabilities.values()) == pytest.approx(1.0)
        assert hypotheses.best == right
        assert probabilities[right] > 0.999


@pytest.mark.compiler
@pytest.mark.parametrize("is_compiled", [True, False])
def test_evidence_counts_limits(is_compiled):
    """The evidence inside the limits differs from its integral by one at most."""
    data = [0.09, 0.11, 0.1]
    result, exact = {}, {}
    for lower in (0.0, 0.08, 0.25):
        model = part(
            kv.Prismatic(name="q", parent="world", child="part", axis=(0, 0, 1), lower=lower, upper=0.5)
        )
        tracker = Tracker(model, [ObservedPosition("part", covariance=np.eye(3) * 0.01**2)])
        tracker.wait()
        if not is_compiled:
            tracker._update_step.native = None
        q = np.linspace(lower, 0.5, 100_001)
        prior = np.exp(-(((q - tracker.estimate.state["q"]) / (0.5 - lower) * 2) ** 2) / 2)
        right = np.prod([np.exp(-(((q - z) / 0.01) ** 2) / 2) for z in data], axis=0)
        exact[lower] = np.log((prior * right).sum() / prior.sum())
        for z in data:
            tracker.update({"part": (0, 0, z)})
        result[lower] = tracker.log_evidence
    for lower in (0.08, 0.25):
        assert result[lower] - result[0.0] == pytest.approx(exact[lower] - exact[0.0], rel=0.02, abs=1)


def test_hypothesis_bank_follows_a_lock_that_opens():
    model = part(kv.Revolute(name="q", parent="world", child="part", axis=(0, 0, 1), lower=0, upper=1.5))
    start = {"start": {"q": 0.0}, "uncertainty": {"q": 0.01}}
    hypotheses = HypothesisBank(
        {
            "locked": Tracker(model, ["part"], process="static", **start),
            "free": Tracker(model, ["part"], process_noise={"q:velocity": 0.1}, **start),
        },
        forgetting=1.0,
    )
    observer, result = NoisyObserver(model, ["part"]), []
    for k in range(60):
        angle = max(0.0, 0.1 * (k - 40) / 2)
        result.append(hypotheses.update(observer({"q": angle}), at=0.1 * k)["locked"])
    assert np.mean(result[20:40]) > 0.8
    assert max(result[50:]) < 1e-3


def test_locks_hold_against_noise_and_commands():
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.articulations.GarageDoor(name="g", parent="world"))
    options = {
        "process_noise": {"g/door:velocity": 0.1, "g/bolt:velocity": 0.1},
        "uncertainty": {"g/door": 0.01, "g/bolt": 0.01},
    }
    for bolt, is_locked in ((0.05, True), (0.5, False)):
        tracker = Tracker(
            model, ["g/door", "g/bolt"], start={"g/door": 0.0, "g/bolt": bolt}, locks=True, **options
        )
        estimate = tracker.predict(0.1, {"g/door:velocity": 0.5})
        assert (estimate.state["g/door"] == pytest.approx(0.05, abs=1e-3)) is not is_locked
        assert (estimate.deviation["g/door"] < 0.011) is is_locked
        assert estimate.deviation["g/bolt"] > 0.05


def test_points_determine_a_body_from_any_start():
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Floating(name="b", parent="world", child="b"))
    points = {"o": (0, 0, 0), "x": (0.3, 0, 0), "y": (0, 0.2, 0), "z": (0, 0, 0.25)}
    first = Tracker(model, [ObservedPosition("b", p, name=n) for n, p in points.items()])
    rng = np.random.default_rng(0)
    for seed in range(10):
        turn, place = Rotation.random(random_state=seed), rng.uniform(-2, 2, 3)
        tracker = first.copy()
        for _ in range(3):
            data = {n: place + turn.apply(p) + 0.005 * rng.standard_normal(3) for n, p in points.items()}
            estimate = tracker.update(data)
        said = Rotation.from_quat([estimate.state[f"b/q{c}"] for c in "xyzw"])
        assert (said * turn.inv()).magnitude() < 0.05


def make_vehicle(points):
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.articulations.OmniBase(name="b", parent="world", child="b"))
    data = [ObservedPosition("b", p, name=n) for n, p in points.items()]
    return model, Tracker(model, data, uncertainty={"b/x": 1, "b/y": 1})


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.long) for seed in (1, 2, 3))])
def test_one_point_of_a_body_leaves_its_angle_unknown(seed):
    """The states form a ring; its tangents at two points must not count as two observations."""
    model, tracker = make_vehicle({"p": (0.1, 0.2, 0.3)})
    rng = np.random.default_rng(seed)
    truth = {"b/x": rng.normal(), "b/y": rng.normal(), "b/angle": rng.uniform(-3, 3)}
    there = (model.fk("b")(truth) @ [0.1, 0.2, 0.3, 1])[:3]
    for _ in range(50):
        estimate = tracker.update({"p": there + 0.01 * rng.standard_normal(3)})
    assert estimate.deviation["b/angle"] > 2
    for name in ("b/x", "b/y"):
        assert abs(estimate.state[name] - truth[name]) < 3 * estimate.deviation[name]


@pytest.mark.parametrize("count", [12, pytest.param(20, marks=pytest.mark.long)])
def test_two_alternating_points_determine_a_body(count):
    points = {"p": (0.1, 0.2, 0.3), "q": (-0.4, 0.1, 0.0)}
    model, first = make_vehicle(points)
    first.wait()
    result = []
    for seed in range(count):
        tracker, rng = first.copy(), np.random.default_rng(seed)
        truth = {"b/x": rng.normal(), "b/y": rng.normal(), "b/angle": rng.uniform(-3, 3)}
        body = model.fk("b")(truth)
        for step in range(10):
            name = "pq"[step % 2]
            estimate = tracker.update({name: (body @ [*points[name], 1])[:3] + 0.01 * rng.standard_normal(3)})
        error = np.array([estimate.state[s.position] - truth[str(s.position)] for s in estimate.tangent])
        error[0] = np.remainder(error[0] + np.pi, 2 * np.pi) - np.pi
        result.append(error @ estimate.information @ error / 3)
    assert 0.6 < np.mean(result) < 1.6


@pytest.mark.parametrize("start", [(-5, 0.5), (1, 1), (5, 5), (0, -3)])
def test_position_from_sequential_distances_is_consistent(start):
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Planar(name="p", parent="world", child="p"))
    x, y = model.symbol("p/x"), model.symbol("p/y")
    masts = {"a": (0, 0), "b": (3, 0), "c": (0, 3)}
    tracker = Tracker(
        model,
        [ObservedExpression(n, np.sqrt((x - a) ** 2 + (y - b) ** 2), 0.01**2) for n, (a, b) in masts.items()],
        start=dict(zip(("p/x", "p/y"), start, strict=True)),
    )
    for _ in range(8):
        for name, (a, b) in masts.items():
            estimate = tracker.update({name: np.hypot(1 - a, 2 - b)})
    assert estimate.state["p/x"] == pytest.approx(1, abs=1e-6)
    assert estimate.state["p/y"] == pytest.approx(2, abs=1e-6)
    assert max(estimate.deviation.values()) < 0.006
