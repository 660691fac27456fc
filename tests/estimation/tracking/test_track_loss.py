"""Lost estimates, restarts, resets, gates and late measurements of a tracker."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from scipy.stats import chi2
from synthetic_observations import NoisyObserver

import kineverse as kv
from kineverse.errors import InvalidValueError, ShapeError, UnknownNameError
from kineverse.estimation import ObservedExpression, Outliers, Tracker
from kineverse.estimation.tracking.estimate import chi_squared_quantile


def make_door(upper: float = 1.5) -> kv.Model:
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Revolute(name="q", parent="world", child="hinge", axis=(0, 0, 1), lower=0, upper=upper))
        edit.add_frame("handle", parent="hinge", transform=kv.translation(0.5, 0, 0))
        edit.apply(kv.Prismatic(name="d", parent="world", child="drawer", axis=(1, 0, 0), lower=0, upper=0.5))
    return model


def make_slide() -> kv.Model:
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("cart", parent="world", transform=kv.translation(kv.position("a"), 0, 0))
    return model


MODEL = make_door()


def test_quantiles_are_those_of_chi_squared():
    dof = np.array([3.0, 6, 12, 60])
    np.testing.assert_allclose(chi_squared_quantile(dof), chi2.isf(1e-6, dof), rtol=0.08)
    assert chi2.isf(1e-6, 1) < chi_squared_quantile(np.array([1.0]))[0] < 28


@pytest.mark.parametrize(
    ("process", "outliers"),
    [
        ("velocity", True),
        ("static", True),
        ("position", None),
        *(
            pytest.param(*case, marks=pytest.mark.long)
            for case in (("position", True), ("velocity", None), ("static", None))
        ),
    ],
)
def test_a_group_that_jumped_is_lost_and_then_found(process, outliers):
    """A door is opened unobserved, without time passing; the drawer next to it is not lost."""
    tracker = Tracker(MODEL, ["hinge", "handle", "drawer"], process=process, outliers=outliers, lost_after=5)
    observer = NoisyObserver(MODEL, ["hinge", "handle", "drawer"])
    for k in range(30):
        estimate = tracker.update(observer({"q": 0.1, "d": 0.2}), at=k / 30)
        assert not estimate.lost
        assert estimate.lost_groups == ()
    flags = []
    for k in range(30, 50):
        estimate = tracker.update(observer({"q": 1.2, "d": 0.2}), at=k / 30)
        flags.append(estimate.lost)
        # Two rejections in a row are a motion, of both markers.
        assert estimate.lost or abs(estimate.state["q"] - 1.2) < 0.1 or k < (31 if outliers else 34)
        assert all(str(group[0]) == "q" for group in estimate.lost_groups)
    assert not flags[-1]
    assert estimate.state["q"] == pytest.approx(1.2, abs=0.05)
    assert estimate.state["d"] == pytest.approx(0.2, abs=0.02)
    assert not (outliers and any(flags))


def test_without_restarts_a_lost_group_stays_lost_and_says_so():
    tracker = Tracker(MODEL, ["handle"], process="static", outliers=True, lost_after=3, restart=False)
    observer = NoisyObserver(MODEL, ["handle"])
    for _ in range(20):
        tracker.update(observer({"q": 0.1}))
    for k in range(12):
        estimate = tracker.update(observer({"q": 1.2}))
        assert estimate.lost is (k >= 2)
    assert estimate.state["q"] == pytest.approx(0.1, abs=0.02)
    assert estimate.outliers == ("handle",)
    assert estimate.dof == estimate.nis == 0
    assert estimate.residuals["handle"].nis > 1000
    assert estimate.residuals["handle"].is_outlier


def test_a_wrong_model_stays_lost():
    """The handle is observed half a metre from where the model has it: no angle explains that."""
    tracker = Tracker(MODEL, ["hinge", "handle"], outliers=True, lost_after=4)
    observer, flags = NoisyObserver(MODEL, ["handle"]), []
    for k in range(20):
        data = observer({"q": 0.3 + 0.01 * k})
        data["handle"][2, 3] += 0.5
        flags.append(tracker.update(data, at=k / 30).lost)
    assert not any(flags[:3])
    assert all(flags[3:])


def test_outliers_alone_are_no_track():
    model, rng = kv.Model(), np.random.default_rng(0)
    with model.edit() as edit:
        edit.apply(kv.Floating(name="box", parent="world", child="box"))
    tracker, lost = Tracker(model, ["box"], outliers=True), []
    for k in range(25):
        pose = kv.axis_angle(rng.standard_normal(3), rng.uniform(0, 3))()
        pose[:3, 3] = rng.uniform(-1, 1, 3)
        estimate = tracker.update({"box": pose}, at=k / 30)
        lost.append(estimate.lost)
        assert not estimate.lost or set(estimate.confidence.values()) == {0.0}
    assert np.mean(lost[15:]) > 0.9


def test_swapped_frames_are_lost():
    tracker, observer = (
        Tracker(MODEL, ["hinge", "handle"], outliers=True),
        NoisyObserver(MODEL, ["hinge", "handle"]),
    )
    for k in range(20):
        data = observer({"q": 0.4})
        estimate = tracker.update({"hinge": data["handle"], "handle": data["hinge"]}, at=k / 30)
    assert estimate.lost


def test_a_single_gross_error_loses_nothing():
    tracker = Tracker(MODEL, ["hinge", "handle"], outliers=True, lost_after=2)
    observer = NoisyObserver(MODEL, ["hinge", "handle"])
    for k in range(40):
        data = observer({"q": 0.7})
        if k % 5 == 4:
            for pose in data.values():
                pose[:3, 3] += 0.8
        estimate = tracker.update(data, at=k / 30)
        assert not estimate.lost
    assert estimate.state["q"] == pytest.approx(0.7, abs=0.05)


def test_reset_sets_some_coordinates_and_keeps_others():
    tracker = Tracker(MODEL, ["handle", "drawer"], process="static")
    observer = NoisyObserver(MODEL, ["handle", "drawer"])
    for _ in range(5):
        before = tracker.update(observer({"q": 0.5, "d": 0.2}))
    estimate = tracker.reset({"d": 0.4}, uncertainty={"d": 0.03})
    assert estimate.state["d"] == 0.4
    assert estimate.deviation["d"] == pytest.approx(0.03)
    assert estimate.state["q"] == before.state["q"]
    assert estimate.deviation["q"] == before.deviation["q"]
    estimate = tracker.reset()
    assert estimate.state["q"] == 0.75
    assert estimate.deviation["q"] == pytest.approx(0.75)
    assert tracker.reset(at=-3.0).stamp == -3.0
    with pytest.raises(UnknownNameError, match="'r' is not estimated"):
        tracker.reset({"r": 1.0})
    with pytest.raises(InvalidValueError, match="NaN"):
        tracker.reset({"d": np.nan})


def test_late_measurements_are_applied_in_order_of_time():
    model, rng = make_slide(), np.random.default_rng(0)
    observed = ObservedExpression("z", kv.position("a"), 0.01)
    looks = [(t, rng.normal(t, 0.1)) for t in np.arange(12) * 0.1]
    swapped = [looks[k] for k in (0, 1, 3, 2, 6, 4, 5, 7, 10, 9, 8, 11)]
    for process in ("position", "velocity"):
        trackers = [Tracker(model, [observed], process=process, lag=0.5, start={"a": 0}) for _ in range(2)]
        for tracker, order in zip(trackers, (looks, swapped), strict=True):
            for t, z in order:
                estimate = tracker.update({"z": z}, at=t)
        one, other = (tracker.estimate for tracker in trackers)
        assert one.state["a"] == pytest.approx(other.state["a"], rel=1e-9)
        assert one.deviation["a"] == pytest.approx(other.deviation["a"], rel=1e-9)
        assert one.log_evidence == pytest.approx(other.log_evidence, rel=1e-9)
        assert estimate.stamp == pytest.approx(1.1)


def test_a_late_measurement_within_a_commanded_step_moves_with_it():
    model, observed = make_slide(), ObservedExpression("z", kv.position("a"), 0.01)
    one, other = (Tracker(model, [observed], process="static", lag=2.0, start={"a": 0}) for _ in range(2))
    one.update({"z": 0.0}, at=0.0)
    other.update({"z": 0.0}, at=0.0)
    one.update({"z": 0.5}, at=0.5, commands={"a:velocity": 1.0})
    one.update({"z": 1.1}, at=1.0, commands={"a:velocity": 1.0})
    other.update({"z": 1.1}, at=1.0, commands={"a:velocity": 1.0})
    other.update({"z": 0.5}, at=0.5)
    assert one.estimate.state["a"] == pytest.approx(other.estimate.state["a"])


def test_measurements_beyond_the_lag_or_given_twice_are_refused():
    tracker = Tracker(make_slide(), ["cart"], lag=0.2)
    observer = NoisyObserver(make_slide(), ["cart"])
    for k in range(10):
        tracker.update(observer({"a": 0.0}), at=0.1 * k)
    before = tracker.estimate
    with pytest.raises(InvalidValueError, match=r"later than the lag of 0\.2 s"):
        tracker.update(observer({"a": 0.0}), at=0.3)
    data = observer({"a": 0.0})
    tracker.update(data, at=1.0)
    with pytest.raises(InvalidValueError, match="'cart' came twice for 1 s"):
        tracker.update(data, at=1.0)
    tracker.update(observer({"a": 0.0}), at=1.0)
    assert tracker.estimate.deviation["a"] < before.deviation["a"]
    with pytest.raises(InvalidValueError, match="lag="):
        Tracker(make_slide(), ["cart"], lag=-1.0)
    with pytest.raises(InvalidValueError, match="lost_after="):
        Tracker(make_slide(), ["cart"], lost_after=0)
    with pytest.raises(InvalidValueError, match="no process 'speed'"):
        Tracker(make_slide(), ["cart"], process="speed")


def test_equal_measurements_count_once_for_each_time():
    """A door at rest is measured without noise; measurements of other frames come in between."""
    poses = {name: MODEL.fk(name)({"q": 0.3}) for name in ("hinge", "handle")}
    tracker = Tracker(MODEL, ["hinge", "handle"], lag=1.0)
    tracker.update(poses, at=0.0)
    tracker.predict(0.1)
    tracker.update(poses, at=0.1)
    tracker.update(poses, at=0.05)
    tracker.update({"hinge": poses["hinge"]}, at=0.2)
    tracker.update({"handle": poses["handle"]}, at=0.2)
    with pytest.raises(InvalidValueError, match=r"'hinge' came twice for 0\.2 s"):
        tracker.update({"hinge": poses["hinge"]}, at=0.2)


def test_gate_is_a_number_of_standard_deviations():
    observed = ObservedExpression("z", kv.position("a"), 0.01)
    for gate, is_outlier in ((3.0, True), (5.0, False)):
        start = {"start": {"a": 0.0}, "uncertainty": {"a": 1e-4}}
        tracker = Tracker(make_slide(), [observed], process="static", outliers=Outliers(gate=gate), **start)
        for covariance in (0.01, 0.25):
            data = {"z": (4.0 * np.sqrt(covariance), covariance)}
            assert bool(tracker.copy().update(data).outliers) is is_outlier
    with pytest.raises(InvalidValueError, match="gate"):
        Outliers(gate=0.0)
    with pytest.raises(InvalidValueError, match="Only a tracker has a gate"):
        kv.estimation.identify(None, np.stack([np.eye(4)] * 8), outliers=Outliers(gate=3.0))


@pytest.mark.parametrize("pair", [tuple, list])
def test_position_and_quaternion_are_told_from_pose_and_covariance(pair):
    tracker = Tracker(MODEL, ["handle"])
    with pytest.raises(ShapeError, match="not a position and an orientation"):
        tracker.update({"handle": pair(((0.1, 0.2, 0.3), (0, 0, 0, 1)))})


def test_recent_poses_and_a_rebuilt_tracker():
    model = make_door()
    tracker = Tracker(model, ["hinge", "handle"], keep=50)
    observer = NoisyObserver(model, ["hinge", "handle"])
    for k in range(60):
        data = observer({"q": 0.01 * k})
        if k % 2:
            del data["hinge"]
        tracker.update(data, at=0.1 * k)
    recent = tracker.recent
    assert recent.relative_to == "world"
    assert recent.times is not None
    assert recent.times[0] == pytest.approx(1.0)
    assert len(recent.times) == 50
    assert recent.poses["hinge"].shape == (50, 4, 4)
    assert np.isnan(recent.poses["hinge"][1]).all()
    assert np.isfinite(recent.poses["handle"]).all()
    with model.edit() as edit:
        edit.replace(
            "joint q",
            kv.Revolute(name="q", parent="world", child="hinge", axis=(0, 0, 1), lower=0, upper=0.2),
        )
    again = tracker.rebuild()
    assert tracker.estimate.state["q"] > 0.5
    assert again.estimate.state["q"] == pytest.approx(0.2)
    assert again.estimate.stamp == tracker.estimate.stamp


def make_cart_pose(x: float) -> np.ndarray:
    pose = np.eye(4)
    pose[0, 3] = x
    return pose


def test_a_free_body_that_jumped_is_found_again():
    """Its broad prior explains a pose no better than an outlier does; two poses that agree decide."""
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Floating(name="box", parent="world", child="box"))
    tracker, rng = Tracker(model, ["box"], outliers=True), np.random.default_rng(0)
    for k in range(40):
        pose = kv.rotation_x(2.5 * (k >= 20))()
        pose[:3, 3] = (3.0 * (k >= 20), 0, 0) + 0.005 * rng.standard_normal(3)
        estimate = tracker.update({"box": pose}, at=k / 30)
        if k >= 22:
            assert estimate.state["box/x"] == pytest.approx(3.0, abs=0.02)


def test_late_measurements_repeat_all_that_happened():
    """Updates without a time, steps with inputs, arrays that are used again, and the first two swapped."""
    model, buffer = make_slide(), np.empty((1, 4, 4))
    with model.edit() as edit:
        edit.add_frame("box", parent="cart", transform=kv.translation(kv.position("p"), 0, 0))
    looks = [(1.0, 0.1), (1.1, 0.2), (1.2, 0.4), (None, 0.6), (1.3, 0.5)]
    result = []
    for order in ((0, 1, 2, 3, 4), (1, 0, 2, 3, 4), (0, 2, 3, 4, 1)):
        tracker = Tracker(model, ["box"], lag=0.5, inputs=["p"], start={"a": 0.0})
        for k in order:
            at, x = looks[k]
            buffer[0] = make_cart_pose(x)
            given = {"p": 0.1 * (at is not None and at >= 1.2)}
            estimate = tracker.update_poses(buffer, at=at, inputs=given)
            if k == 4:
                given = {"p": 0.3}
                tracker.predict(0.2, inputs=given)
                given["p"] = 9.0
        tracker = pickle.loads(pickle.dumps(tracker))
        estimate = tracker.update({"box": make_cart_pose(0.7)}, at=1.6)
        result.append((estimate.state["a"], estimate.deviation["a"], estimate.log_evidence))
    np.testing.assert_allclose(result[1:], [result[0]] * 2, rtol=1e-12)


def test_a_measurement_is_repeated_only_within_its_time():
    tracker, poses = Tracker(MODEL, ["hinge", "drawer"]), {"hinge": np.eye(4)}
    tracker.update(poses, at=1.0)
    tracker.update({"drawer": make_cart_pose(0.2)}, at=1.0)
    with pytest.raises(InvalidValueError, match="'hinge' came twice"):
        tracker.update(poses, at=1.0)
    tracker.predict(0.5)
    assert tracker.update(poses, at=1.5).stamp == 1.5


def test_a_tracker_is_rebuilt_after_late_measurements_and_resets():
    tracker = Tracker(make_slide(), ["cart"], lag=0.5, keep=3)
    for at in (0.0, 0.1, 0.3, 0.2, 0.25):
        tracker.update({"cart": make_cart_pose(at)}, at=at)
    assert tracker.rebuild().estimate.stamp == 0.3
    with pytest.raises(InvalidValueError, match="before the start or a reset"):
        tracker.reset({"a": 0.1})
        tracker.update({"cart": np.eye(4)}, at=0.29)
    tracker.reset(at=0.0)
    tracker.update({"cart": (make_cart_pose(0.1), 1e-6 * np.eye(6))}, at=0.1)
    assert tracker.rebuild().estimate.stamp == 0.1
    np.testing.assert_allclose(tracker.recent.covariances["cart"], 1e-6 * np.eye(6))


def test_start_and_reset_stay_inside_limits():
    tracker = Tracker(MODEL, ["hinge"], start=kv.State({"q": 7.0}))
    assert tracker.estimate.state["q"] == 1.5
    assert tracker.reset(kv.State({"q": -7.0})).state["q"] == 0.0
    # Degrees in place of radians, likely.
    with pytest.raises(InvalidValueError, match=r"'q' is 7, beyond its limits 0 to 1\.5"):
        Tracker(MODEL, ["hinge"], start={"q": 7.0})
    with pytest.raises(InvalidValueError, match="beyond its limits"):
        tracker.reset({"q": -7.0})


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"process_noise": {"q": -1.0}}, "0 for a part that never moves"),
        ({"process_noise": 0.1}, "process_noise= is a mapping"),
        ({"uncertainty": 0.1}, "uncertainty= is a mapping"),
        ({"uncertainty": {"q": 1e-300}}, "too small for floating point"),
        ({"inputs": 5}, "inputs= has names"),
        ({"lag": np.inf}, "lag= .* is a finite number"),
    ],
)
def test_invalid_options_say_what_to_give(options, message):
    with pytest.raises(InvalidValueError, match=message):
        Tracker(MODEL, ["hinge"], **options)


def test_a_part_without_process_noise_never_moves():
    for process in ("position", "velocity"):
        tracker = Tracker(MODEL, ["hinge"], process=process, process_noise={"q": 0.0})
        assert tracker.predict(10.0).deviation["q"] == pytest.approx(0.75)


@pytest.mark.parametrize("outliers", [True, None])
@pytest.mark.filterwarnings("ignore:overflow")
def test_numbers_beyond_floating_point_are_refused(outliers):
    tracker = Tracker(MODEL, ["hinge"], process="velocity", outliers=outliers)
    before = tracker.update({"hinge": np.eye(4)}, at=0.0)
    for step in (
        lambda: tracker.update({"hinge": make_cart_pose(1e200)}, at=0.1),
        lambda: tracker.update({"hinge": np.eye(4)}, at=1e300),
        lambda: tracker.predict(1e10, {"q:velocity": 1e300}),
    ):
        with pytest.raises(InvalidValueError, match=r"floating point|expected above"):
            step()
    assert tracker.estimate.state == before.state
    assert tracker.estimate.stamp == 0.0


def test_a_reset_quaternion_is_as_uncertain_as_at_the_start():
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Floating(name="box", parent="world", child="box"))
    for process in ("position", "velocity"):
        tracker = Tracker(model, ["box"], process=process)
        for k in range(5):
            before = tracker.update({"box": kv.rotation_z(1.0)()}, at=k / 30)
        after = tracker.reset({"box/qw": 1.0, "box/qz": 0.0})
        turns = [k for k, v in enumerate(after.tangent) if str(v).startswith("box/w")]
        np.testing.assert_allclose(np.sqrt(np.diag(after.covariance))[turns], np.pi)
        assert after.deviation["box/x"] == pytest.approx(before.deviation["box/x"])
        result = tracker.update({"box": kv.rotation_z(1.0)()}).state
        assert 2 * np.arctan2(result["box/qz"], result["box/qw"]) == pytest.approx(1.0, abs=1e-3)
