"""Refusals of a tracker: each names the input and leaves the belief unchanged."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import kineverse as kv
from hypothesis_profiles import attempts
from kineverse.estimation import (
    HypothesisBank,
    ObservedExpression,
    ObservedPose,
    ObservedPosition,
    Outliers,
    Tracker,
)

DOOR, HANDLE = "kitchen/fridge_door", "kitchen/fridge_door_handle"


@pytest.fixture(scope="module")
def model():
    return kv.load("kitchen")


@pytest.fixture
def tracker(model):
    return Tracker(model, [DOOR, HANDLE])


def pose(model, angle=0.4):
    return np.array(model.fk(DOOR)({DOOR: angle}))


def broken(model, **entries):
    T = pose(model)
    for place, value in entries.items():
        T[int(place[1]), int(place[2])] = value
    return T


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda m: {DOOR: broken(m, e03=np.nan)}, "fridge_door' is not finite"),
        (lambda m: {DOOR: broken(m, e03=np.inf)}, "fridge_door' is not finite"),
        (
            lambda m: {DOOR: broken(m, e00=1.5)},
            r"fridge_door' is no rigid transform: its matrix is off by [\d.]+",
        ),
        (lambda m: {DOOR: np.diag([-1.0, 1, 1, 1])}, "its matrix mirrors"),
        (lambda m: {DOOR: broken(m, e33=2.0)}, "its matrix is off by 1"),
        (lambda m: {DOOR: np.eye(3)}, "4×4"),
        (lambda m: {DOOR: "here"}, "no array of numbers"),
        (lambda m: {DOOR: pose(m) * (1 + 0j)}, "no array of numbers"),
        (lambda m: {"kitchen/fridge_dor": np.eye(4)}, "fridge_dor' is not observed. Did you mean"),
        (lambda m: {DOOR: (pose(m), -np.eye(6))}, "observation 'kitchen/fridge_door' is not positive"),
        (lambda m: {DOOR: (pose(m), np.zeros((6, 6)))}, "is not positive"),
        (lambda m: {DOOR: (pose(m), np.full((6, 6), np.nan))}, "is not finite"),
        (lambda m: {DOOR: (pose(m), np.triu(np.ones((6, 6))))}, "is not symmetric"),
        (lambda m: {DOOR: (pose(m), np.eye(3))}, r"shape \(6, 6\)"),
        (lambda m: [pose(m)], "a mapping"),
    ],
)
@pytest.mark.parametrize("outliers", [None, True])
def test_invalid_measurement_is_refused_by_name(model, make, message, outliers):
    tracker = Tracker(model, [DOOR, HANDLE], outliers=outliers)
    tracker.update({DOOR: pose(model)}, at=1.0)
    before = tracker.estimate
    with pytest.raises(kv.KineverseError, match=message):
        tracker.update(make(model), at=2.0)
    after = tracker.estimate
    assert after.state == before.state
    assert np.array_equal(after.information, before.information)


def test_update_poses_checks_shapes_and_matches_update(model, tracker):
    poses = np.stack([pose(model), np.full((4, 4), np.nan)])
    tracker.update_poses(poses, np.array([True, False]))  # missing poses are not checked
    with pytest.raises(kv.KineverseError, match="fridge_door_handle' is not finite"):
        tracker.update_poses(poses)
    with pytest.raises(kv.errors.ShapeError, match=r"\(2, 4, 4\)"):
        tracker.update_poses(poses[:1])
    with pytest.raises(kv.errors.ShapeError, match="mask= has 2 booleans"):
        tracker.update_poses(poses, [1, 0])
    with pytest.raises(kv.KineverseError, match="poses alone, which z is not"):
        Tracker(model, [DOOR, ObservedExpression("z", kv.position(DOOR), 1.0)]).update_poses(poses)


def test_time_steps_are_checked_and_accumulate(model, tracker):
    tracker.update({DOOR: pose(model)}, at=5.0)
    with pytest.raises(
        kv.KineverseError, match="Time goes backwards: an observation at 4 s after one at 5 s"
    ):
        tracker.update({DOOR: pose(model)}, at=4.0)
    for dt in (-1.0, np.nan, np.inf):
        with pytest.raises(kv.KineverseError, match="The length of a step"):
            tracker.predict(dt)
    with pytest.raises(kv.KineverseError, match=r"length of a step .* is a finite number"):
        tracker.predict("long")
    with pytest.raises(kv.KineverseError, match="time of an observation is a finite number"):
        tracker.update({DOOR: pose(model)}, at="now")
    with pytest.raises(kv.KineverseError, match="finite number of seconds"):
        tracker.update({DOOR: pose(model)}, at=np.nan)
    with pytest.raises(kv.KineverseError, match="Commands need the time"):
        tracker.update({DOOR: pose(model)}, commands={f"{DOOR}:velocity": 1.0})
    assert tracker.update({DOOR: pose(model)}, at=5.5).stamp == 5.5


@pytest.mark.parametrize(
    ("observed", "options", "message"),
    [
        ([], {}, "at least one frame"),
        (["kitchen/fridge_dor"], {}, "Did you mean"),
        ([DOOR, DOOR], {}, "Two observations have the name"),
        (["kitchen/room"], {}, "does not move with any estimated coordinate"),
        ([DOOR, 3], {}, "names of frames"),
        ([ObservedPose(DOOR, covariance=np.zeros((6, 6)))], {}, "not positive"),
        ([ObservedPosition(DOOR, (1, 2))], {}, "three numbers"),
        ([ObservedExpression("z", np.eye(2) * kv.position(DOOR), 1.0)], {}, "a scalar or a vector"),
        ([DOOR], {"start": {"kitchen/fridge_dor": 1.0}}, "is not estimated. Did you mean"),
        ([DOOR], {"uncertainty": {"kitchen/fridge_dor": 1.0}}, "is not estimated. Did you mean"),
        ([DOOR], {"start": {DOOR: np.inf}}, "must be finite"),
        ([DOOR], {"uncertainty": {DOOR: 0.0}}, "positive and finite"),
        ([DOOR], {"uncertainty": {DOOR: "wide"}}, "is positive and finite, not 'wide'"),
        ([DOOR], {"process_noise": {f"{DOOR}:velocity": np.nan}}, "finite number from 0"),
        ([DOOR], {"process_noise": {"wheel:velocity": 1.0}}, "No estimated coordinate moves with"),
        ([DOOR], {"outliers": 3}, "Outliers are"),
        ([DOOR], {"inputs": ["kitchen/fridge_dor"]}, "Did you mean"),
        ([DOOR], {"inputs": [DOOR]}, "does not move with any estimated coordinate"),
    ],
)
def test_invalid_tracker_options_are_refused(model, observed, options, message):
    frames = [name for name in model.frames if not model.speeds_of(name)]
    observed = [frames[0] if o == "kitchen/room" else o for o in observed]
    with pytest.raises(kv.KineverseError, match=message):
        Tracker(model, observed, **options)


def test_commands_and_inputs_are_checked(model, tracker):
    with pytest.raises(kv.KineverseError, match="No estimated coordinate moves with 'fridge:velocity'"):
        tracker.predict(0.1, {"fridge:velocity": 1.0})
    with pytest.raises(kv.KineverseError, match="is a finite number"):
        tracker.predict(0.1, {f"{DOOR}:velocity": np.nan})
    with pytest.raises(kv.KineverseError, match="is a finite number, not 'fast'"):
        tracker.predict(0.1, {f"{DOOR}:velocity": "fast"})
    with model.edit() as edit:
        edit.add_frame("eye", parent="world", transform=kv.rotation_z(kv.position("pan")))
    with_camera = Tracker(model, [ObservedPose(DOOR, relative_to="eye")], inputs=["pan"])
    with pytest.raises(kv.KineverseError, match="no finite value of 'pan'"):
        with_camera.update({DOOR: pose(model)})
    with pytest.raises(kv.KineverseError, match="'pam' is not in inputs="):
        with_camera.update({DOOR: pose(model)}, inputs={"pam": 0.0})
    with_camera.update({DOOR: pose(model)}, inputs={"pan": 0.0})
    at_rest = kv.State({DOOR: 0.5}, stamp=0.0)
    begun = Tracker(model, [ObservedPose(DOOR, relative_to="eye")], inputs=["pan"], start=at_rest)
    assert begun.update({DOOR: pose(model)}, at=1.0, inputs={"pan": 0.0}).stamp == 1.0


def test_tuple_of_two_numbers_is_a_vector():
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Planar(name="p", parent="world", child="p"))
    where = kv.array([kv.position("p/x"), kv.position("p/y")])
    tracker = Tracker(model, [ObservedExpression("p", where, np.eye(2) * 1e-4)])
    assert tracker.update({"p": (1.0, 2.0)}).state["p/y"] == pytest.approx(2.0, abs=1e-3)
    assert tracker.update({"p": ((1.0, 2.0), np.eye(2))}).state["p/x"] == pytest.approx(1.0, abs=1e-3)


def test_invalid_outlier_models_are_refused():
    for options in ({"fraction": 0.0}, {"fraction": 1.0}, {"reach": 0.0}, {"reach": np.inf}):
        with pytest.raises(kv.KineverseError):
            Outliers(**options)


def test_invalid_hypothesis_banks_are_refused(model, tracker):
    with pytest.raises(kv.KineverseError, match="no hypothesis"):
        HypothesisBank({})
    with pytest.raises(kv.KineverseError, match="observe different things"):
        HypothesisBank({"a": tracker, "b": Tracker(model, [DOOR])})
    with pytest.raises(kv.KineverseError, match="prior does not fit"):
        HypothesisBank({"a": tracker}, {"b": 1.0})
    with pytest.raises(kv.KineverseError, match="positive"):
        HypothesisBank({"a": tracker}, {"a": 0.0})
    with pytest.raises(kv.KineverseError, match="forgetting"):
        HypothesisBank({"a": tracker}, forgetting=-1.0)


def test_contradicting_limits_are_reported():
    model = kv.Model()
    a, b = kv.position("a"), kv.position("b")
    with model.edit() as edit:
        edit.add_frame("cart", parent="world", transform=kv.translation(a, b, 0))
        edit.constrain("sum", 3, a + b, 4)
        edit.constrain("a/position", 0, a, 1)
        edit.constrain("b/position", 0, b, 1)
    tracker = Tracker(model, ["cart"])
    with pytest.raises(kv.KineverseError, match="The limits of a, b leave no state between them"):
        tracker.update({"cart": np.eye(4)})


TOY = kv.Model()
with TOY.edit() as _edit:
    _edit.apply(kv.Floating(name="box", parent="world", child="box"))
    _edit.apply(kv.Revolute(name="lid", parent="box", child="lid", axis=(0, 1, 0), lower=-1.0, upper=1.0))
FIRST = {
    wrong: Tracker(TOY, ["box", "lid"], outliers=wrong, process_noise={"lid:velocity": 0.1})
    for wrong in (False, True)
}

sizes = st.floats(-1e12, 1e12)
poses = st.tuples(st.tuples(sizes, sizes, sizes), st.tuples(*[st.floats(-4, 4)] * 3), st.floats(-20, 20))
steps = st.lists(st.dictionaries(st.sampled_from(["box", "lid"]), poses, min_size=1), min_size=1, max_size=3)


@given(steps, st.booleans())
@settings(max_examples=attempts(10))
def test_estimate_is_finite_for_any_measurement(steps, wrong):
    tracker = FIRST[wrong].copy()
    for k, step in enumerate(steps):
        data = {}
        for name, (place, vector, log_scale) in step.items():
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = Rotation.from_rotvec(vector).as_matrix(), place
            data[name] = (T, np.eye(6) * 10.0**log_scale)
        before = tracker.estimate
        try:
            estimate = tracker.update(data, at=float(k))
        except kv.KineverseError:
            estimate = tracker.estimate
            assert estimate.state == before.state
        assert np.isfinite(list(estimate.state.values())).all()
        assert np.isfinite(estimate.covariance).all()
        assert -1.0 <= estimate.state["lid"] <= 1.0
