"""Errors that are correlated in time: their measurement, verdicts, and the residuals of single observations."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import numpy.typing as npt
import pytest
from observed_frames import NOISE, observe_frames, shift_origin

import kineverse as kv
from kineverse.estimation import (
    ImplausibleError,
    ObservedPose,
    PlausibilityMonitor,
    Tracker,
    check_plausibility,
    pose_covariance,
)
from kineverse.estimation.correlation import CorrelationSettings
from kineverse.estimation.identification.observations import check_observations
from kineverse.estimation.plausibility.residuals import KnownJoint, compute_residuals
from kineverse.lie import exp_so3
from kineverse_studies.experiments.stream import (
    DOOR,
    FRAMES,
    ORIENTATION,
    POSITION,
    StreamErrors,
    correlated_errors,
    simulate_stream,
)

Array = npt.NDArray[np.float64]

TAG, HANDLE = "joint kitchen/fridge_door", "kitchen/fridge_door_handle"
WHITE = StreamErrors(correlation=0.0, share=0.0)
SOME = ("rigid", "prismatic", "revolute", "free")


@pytest.fixture(scope="module")
def kitchen() -> kv.Model:
    return kv.load("kitchen")


@pytest.mark.parametrize("offset", [0.0, 6.0])
def test_measured_correlation_ignores_an_offset(offset: float) -> None:
    for errors, low, high in ((WHITE, 1.0, 2.0), (StreamErrors(), 10.0, 50.0)):
        looks = [
            CorrelationSettings(None, True).measure(
                correlated_errors(600, (6,), np.random.default_rng(seed), errors) + offset,
                6,
                np.arange(600) / 30.0,
            )
            for seed in range(4)
        ]
        assert low <= np.median(looks) <= high
    # The same errors half a minute apart.
    errors = correlated_errors(100, (6,), np.random.default_rng(0), StreamErrors(0.0, 0.0))
    assert CorrelationSettings(None, True).measure(errors, 6, 30.0 * np.arange(100)) == pytest.approx(1.0)


def test_stated_decorrelation_time() -> None:
    errors, stamps = np.zeros((100, 6)), np.arange(100) / 30.0
    assert CorrelationSettings(0.0, True).measure(errors, 6, stamps) == 1.0
    assert CorrelationSettings(1.0, True).measure(errors, 6, stamps) == pytest.approx(60.0, rel=0.01)
    assert CorrelationSettings(30.0, False).measure(errors, 6, np.arange(100.0)) == pytest.approx(
        60.0, rel=0.01
    )


def test_monitor_of_a_correlated_stream(kitchen: kv.Model) -> None:
    # Where correlation is denied, the same stream raises an alarm at once.
    stream = simulate_stream(kitchen, np.linspace(0.2, 1.2, 300), np.random.default_rng(0))
    measured, denied = (
        PlausibilityMonitor(
            kitchen,
            FRAMES,
            noise=pose_covariance(POSITION, ORIENTATION),
            families=SOME,
            decorrelation_time=time,
        )
        for time in (None, 0.0)
    )
    for k, at in enumerate(stream.times):
        for monitor in (measured, denied):
            monitor.update(stream.look(k), at=at)
    assert measured.implausible_since == {}
    assert denied.implausible_since
    report = measured.report()
    assert not report.replacements
    assert all(verdict.implausible_since is None for verdict in report)
    with pytest.raises(kv.errors.InvalidValueError, match="not later"):
        measured.update({}, at=1.0)
    with pytest.raises(kv.errors.InvalidValueError, match="Either all"):
        measured.update({})
    with pytest.raises(kv.errors.InvalidValueError, match="finite"):
        measured.update({}, at=float("nan"))


def test_verdict_on_correlated_observations_is_not_over_sure(kitchen: kv.Model) -> None:
    # One second at 30 Hz: errors that last as long look like a displaced joint.
    over_sure, surest = 0, 0.0
    for seed in range(4):
        stream = simulate_stream(
            kitchen,
            np.linspace(0.2, 1.2, 40),
            np.random.default_rng(seed),
            StreamErrors(0.95, 0.95, 0.0, 0.0),
        )
        noise, poses = pose_covariance(POSITION, ORIENTATION), {FRAMES[0]: stream.poses[:, 0]}
        result, denied = (
            check_plausibility(
                kitchen, poses, times=stream.times, noise=noise, families=SOME, decorrelation_time=time
            )[TAG]
            for time in (None, 0.0)
        )
        over_sure += denied.probabilities["served"] < 0.05
        surest = max(surest, 1.0 - result.probabilities["served"])
    assert over_sure >= 2
    assert surest < 0.9


@pytest.mark.parametrize(("frame", "parent"), [(FRAMES[0], None), (FRAMES[1], FRAMES[0])])
def test_single_observation_has_the_residuals_of_many(
    kitchen: kv.Model, frame: str, parent: str | None
) -> None:
    angles = np.concatenate([np.zeros(5), np.linspace(0.0, 1.5, 20)])
    poses = observe_frames(kitchen, FRAMES, {DOOR: angles}, 3)
    served = KnownJoint(kitchen, frame, parent or "world")
    observations = check_observations(poses.get(parent or ""), poses[frame], NOISE, NOISE)
    many = compute_residuals(served, observations)
    for k in range(len(angles)):
        one = compute_residuals(served, observations.select(slice(k, k + 1)))
        for field in fields(many):
            if field.name not in ("orthogonal", "displacement_jacobian"):
                expected = getattr(many, field.name)[k]
                assert getattr(one, field.name)[0] == pytest.approx(expected, abs=2e-3), field.name
        # The basis of ρ is arbitrary, but not the products.
        a, b = many.orthogonal[k], one.orthogonal[0]
        g, h = many.displacement_jacobian[k], one.displacement_jacobian[0]
        assert a @ a == pytest.approx(b @ b, abs=2e-3)
        assert g.T @ g == pytest.approx(h.T @ h, rel=1e-3, abs=0.1)


def track(model: kv.Model, poses: Array) -> Tracker:
    """Return a tracker of a model that has taken poses of the handle (N, 4, 4)."""
    tracker = Tracker(model, [ObservedPose(HANDLE, covariance=NOISE)], outliers=True)
    for k, pose in enumerate(poses):
        tracker.update({} if np.isnan(pose).any() else {HANDLE: pose}, at=0.5 * k)
    return tracker


def test_tracker_is_checked_and_its_model_repaired(kitchen: kv.Model) -> None:
    truth, model = kitchen.copy(), kitchen.copy()
    joint = truth.history.operation(TAG)
    assert isinstance(joint, kv.Revolute)
    with truth.edit() as edit:
        edit.replace(TAG, replace(joint, origin=shift_origin(joint, y=0.05)))
    poses = observe_frames(truth, [HANDLE], {DOOR: np.linspace(0.0, 1.2, 50)}, 3)
    poses[HANDLE][7] = np.nan
    tracker = track(model, poses[HANDLE])
    report = check_plausibility(tracker, families=SOME)
    assert report[TAG].count == 49
    assert report.repair(model) == (TAG,)
    again = check_plausibility(tracker, families=SOME)
    assert again.implausible == ()
    assert again.repair(model) == ()

    # Outliers only: nothing is proposed, and the repair says so.
    random, wrong = np.random.default_rng(0), np.tile(poses[HANDLE][0], (20, 1, 1))
    wrong[:, :3, 3] = random.uniform(-1.0, 1.0, (20, 3))
    lost = check_plausibility(track(model, wrong), families=SOME)
    assert lost[TAG].probabilities == {}
    with pytest.raises(ImplausibleError, match="unrelated"):
        lost.repair(model)


def test_tracker_with_a_moving_camera_is_checked(kitchen: kv.Model) -> None:
    """The camera's coordinate is an input, and the door is displaced."""
    model = kitchen.copy()
    with model.edit() as edit:
        place = kv.translation(0.0, -1.0, 1.0) @ kv.rotation_z(kv.position("pan"))
        edit.add_frame("camera", parent="world", transform=place)
    pans = 0.5 * np.sin(np.arange(30.0))
    cameras = kv.compile(model.fk("camera")).batch(pans[:, None])
    observed = observe_frames(model, [HANDLE], {DOOR: np.linspace(0.0, 1.2, 30)}, 3)[HANDLE]
    observed[:, 1, 3] += 0.05
    poses = np.linalg.inv(cameras) @ observed
    observation = ObservedPose(HANDLE, relative_to="camera", covariance=NOISE)
    tracker = Tracker(model, [observation], inputs=["pan"], outliers=True)
    for k, pan in enumerate(pans.tolist()):
        tracker.update({HANDLE: poses[k]}, at=0.5 * k, inputs={"pan": pan})
    assert tracker.recent.relative_to == "world"
    assert np.allclose(tracker.recent.poses[HANDLE], observed)
    assert check_plausibility(tracker, families=SOME).repair(model) == (TAG,)


@pytest.mark.parametrize(("factor", "most_probable"), [(2.2, "served"), (4.0, "free")])
def test_joints_stay_if_only_the_errors_are_larger_than_stated(
    kitchen: kv.Model, factor: float, most_probable: str
) -> None:
    random = np.random.default_rng(0)
    poses = kv.compile(kitchen.fk(HANDLE)).batch(np.linspace(0.0, 1.2, 50)[:, None])
    poses[:, :3, 3] += factor * random.normal(0.0, 0.01, (50, 3))
    poses[:, :3, :3] = exp_so3(factor * random.normal(0.0, 0.02, (50, 3))) @ poses[:, :3, :3]
    report = check_plausibility(kitchen, {HANDLE: poses}, noise=NOISE, families=SOME)
    assert report[TAG].probabilities[most_probable] > 0.9
    with pytest.raises(ImplausibleError, match="larger than stated"):
        report.repair(kitchen)


def test_exchanged_frames_are_told(kitchen: kv.Model) -> None:
    poses = observe_frames(kitchen, FRAMES, {DOOR: np.linspace(0.0, 1.2, 30)}, 3)
    exchanged = dict(zip(FRAMES, reversed([poses[f] for f in FRAMES]), strict=True))
    monitor = PlausibilityMonitor(kitchen, FRAMES, noise=NOISE, families=SOME)
    for k in range(30):
        monitor.update({frame: track[k] for frame, track in exchanged.items()})
    for report in (check_plausibility(kitchen, exchanged, noise=NOISE, families=SOME), monitor.report()):
        assert report.implausible
        assert not report.replacements
        assert all("exchanged" in verdict.reason for verdict in report)


@pytest.mark.parametrize("angle", [0.0, 0.4])
def test_equal_poses_are_undetermined(kitchen: kv.Model, angle: float) -> None:
    poses = observe_frames(kitchen, FRAMES, {DOOR: np.full(1, angle)}, 5)
    report = check_plausibility(
        kitchen, {f: np.tile(p, (60, 1, 1)) for f, p in poses.items()}, noise=NOISE, families=SOME
    )
    assert [verdict.verdict for verdict in report] == ["cannot tell"] * 2


def test_few_observations_are_undetermined(kitchen: kv.Model) -> None:
    assert len(check_plausibility(kitchen, {})) == 0
    one = observe_frames(kitchen, FRAMES, {DOOR: np.full(1, 0.3)}, 5)
    none, unseen = np.zeros((0, 4, 4)), np.full((3, 4, 4), np.nan)
    for poses in (one, dict.fromkeys(FRAMES, none), dict.fromkeys(FRAMES, unseen)):
        for verdict in check_plausibility(kitchen, poses, noise=NOISE, families=SOME):
            assert verdict.verdict == "cannot tell"


@pytest.mark.parametrize(
    ("times", "message"),
    [
        ([0.0, 2.0, 1.0], "not later"),
        ([0.0, 1.0, 1.0], "not later"),
        ([0.0, 1.0, np.inf], "finite"),
        ([0.0, 1.0], "one time"),
        (["a", "b", "c"], "no array"),
    ],
)
def test_invalid_times_are_refused(kitchen: kv.Model, times: list[float], message: str) -> None:
    poses = observe_frames(kitchen, [HANDLE], {DOOR: np.full(3, 0.3)}, 5)
    with pytest.raises(kv.KineverseError, match=message):
        check_plausibility(kitchen, poses, times=times, noise=NOISE)


def test_invalid_poses_and_correlation_times_are_refused(kitchen: kv.Model) -> None:
    poses = observe_frames(kitchen, [HANDLE], {DOOR: np.full(3, 0.3)}, 5)[HANDLE]
    partly, mirrored = poses.copy(), poses.copy()
    partly[1, 0, 3] = np.nan
    mirrored[1, :3, 0] *= -1.0
    monitor = PlausibilityMonitor(kitchen, [HANDLE], noise=NOISE)
    monitor.update({HANDLE: poses[0]})
    for wrong in (partly, mirrored):
        with pytest.raises(kv.errors.InvalidValueError):
            check_plausibility(kitchen, {HANDLE: wrong}, noise=NOISE)
        with pytest.raises(kv.errors.InvalidValueError):
            monitor.update({HANDLE: wrong[1]})
    for covariance in (-NOISE, np.zeros((6, 6)), np.triu(np.ones((6, 6)))):
        with pytest.raises(kv.errors.InvalidValueError):
            check_plausibility(kitchen, {HANDLE: poses}, noise=covariance)
        with pytest.raises(kv.errors.InvalidValueError):
            PlausibilityMonitor(kitchen, [HANDLE], noise=covariance).update({HANDLE: poses[0]})
    for time in (-1.0, np.nan, np.inf):
        with pytest.raises(kv.errors.InvalidValueError, match="decorrelation time"):
            PlausibilityMonitor(kitchen, [HANDLE], noise=NOISE, decorrelation_time=time)
