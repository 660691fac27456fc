"""Plausibility check of kitchens that are as served, and of kitchens that are not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from observed_frames import NOISE, observe_frames, shift_origin
from scipy.spatial.transform import Rotation

import kineverse as kv
from kineverse.estimation import Family, Plausibility, check_plausibility

DOOR, TAG = "kitchen/fridge_door", "joint kitchen/fridge_door"
HANDLE, FRIDGE = "kitchen/fridge_door_handle", "kitchen/fridge"
SOME = ("rigid", "prismatic", "revolute", "free")


@pytest.fixture(scope="module")
def kitchen() -> kv.Model:
    return kv.load("kitchen")


def replace_hinge(model: kv.Model, change: Callable[[kv.Revolute], kv.Operation]) -> kv.Model:
    """Return a kitchen with another fridge door."""
    truth = model.copy()
    joint = truth.history.operation(TAG)
    assert isinstance(joint, kv.Revolute)
    with truth.edit() as edit:
        edit.replace(TAG, change(joint))
    return truth


def make_slider(joint: kv.Revolute) -> kv.Operation:
    return kv.Prismatic(
        name=joint.name, parent=joint.parent, child=joint.child, origin=joint.origin, axis=(1, 0, 0)
    )


def repair_model(model: kv.Model, report: Plausibility) -> kv.Model:
    result = model.copy()
    with result.edit() as edit:
        for tag, operation in report.replacements.items():
            edit.replace(tag, operation)
    return result


def test_correct_model_explains(kitchen: kv.Model) -> None:
    drawer = "kitchen/oven_left_drawer"
    values = {DOOR: np.linspace(0.0, 1.5, 30), drawer: np.linspace(0.3, 0.0, 30)}
    report = check_plausibility(
        kitchen, observe_frames(kitchen, [HANDLE, FRIDGE, drawer], values, 1), noise=NOISE, families=SOME
    )
    assert {verdict.tag for verdict in report} == {TAG, "joint kitchen/fridge_joint", f"joint {drawer}"}
    assert all(verdict.explains for verdict in report)
    assert report.replacements == {}
    report.raise_if_implausible()
    assert report[TAG].joint.parent == FRIDGE
    again = check_plausibility(
        kitchen.snapshot(),
        observe_frames(kitchen, [HANDLE], values, 1),
        noise=NOISE,
        families=SOME,
        strict=True,
    )
    assert again[TAG].explains


def test_displaced_axis_is_replaced(kitchen: kv.Model) -> None:
    truth = replace_hinge(kitchen, lambda joint: replace(joint, origin=shift_origin(joint, y=0.03)))
    values = {DOOR: np.random.default_rng(0).uniform(0.0, 1.5, 80)}
    observations = observe_frames(truth, [HANDLE, FRIDGE], values, 2)
    report = check_plausibility(kitchen, observations, noise=NOISE, families=SOME)
    assert report[TAG].implausible_since is not None
    assert report[TAG].result is not None
    assert report[TAG].result.best.family == "revolute"
    assert list(report.replacements) == [TAG]

    model = repair_model(kitchen, report)
    again = check_plausibility(model, observations, noise=NOISE, families=SOME)
    assert all(verdict.implausible_since is None for verdict in again)
    for q in (0.1, 0.7, 1.3):
        off = {
            served: np.linalg.norm(m.fk(HANDLE)({DOOR: q})[:3, 3] - truth.fk(HANDLE)({DOOR: q})[:3, 3])
            for served, m in (("old", kitchen), ("new", model))
        }
        assert off["new"] < 0.012 < 0.025 < off["old"]


def test_replacement_keeps_names_limits_and_children(kitchen: kv.Model) -> None:
    served = kitchen.copy()
    with served.edit() as edit:
        lamp = kv.Revolute(name="lamp", parent="world", child="lamp", position=2.0 * kv.position(DOOR))
        edit.apply(lamp, tag="lamp")
    truth = replace_hinge(kitchen, lambda joint: replace(joint, origin=shift_origin(joint, y=0.05)))
    observations = observe_frames(truth, [HANDLE], {DOOR: np.linspace(0.0, 1.2, 50)}, 3)
    model = repair_model(served, check_plausibility(served, observations, noise=NOISE, families=SOME))
    assert model.history.tags == served.history.tags
    assert set(model.frames) == set(served.frames)
    assert model.symbols == served.symbols
    assert set(model.articulations) == set(served.articulations)
    assert model.articulations[DOOR].dynamics == served.articulations[DOOR].dynamics
    assert set(model.constraints) == set(served.constraints)
    assert model.limits(f"{DOOR}:velocity") == served.limits(f"{DOOR}:velocity")
    low, high = model.limits(DOOR)
    assert low <= 0.0
    assert high >= 1.5707
    # A displaced hinge keeps its zero: the door is turned as before.
    turned = model.fk(HANDLE)({DOOR: 0.6})[:3, :3] @ truth.fk(HANDLE)({DOOR: 0.6})[:3, :3].T
    assert abs(np.arctan2(turned[1, 0], turned[0, 0])) < 0.01
    assert np.allclose(model.fk("lamp")({DOOR: 0.5}), served.fk("lamp")({DOOR: 0.5}))


def test_hinge_is_replaced_by_a_drawer(kitchen: kv.Model) -> None:
    values = np.random.default_rng(0).uniform(0.0, 0.4, 60)
    before = observe_frames(kitchen, [HANDLE, FRIDGE], {DOOR: values[:25]}, 4)
    after = observe_frames(replace_hinge(kitchen, make_slider), [HANDLE, FRIDGE], {DOOR: values[25:]}, 5)
    observations = {frame: np.concatenate([before[frame], after[frame]]) for frame in before}
    report = check_plausibility(kitchen, observations, noise=NOISE, families=SOME)
    assert report[TAG].implausible_since in range(24, 29)
    assert report[TAG].verdict == f"stopped explaining at observation {report[TAG].implausible_since}"
    assert report[TAG].probabilities["prismatic"] > 0.9
    with pytest.raises(kv.KineverseError, match=f"'{TAG}' stopped explaining"):
        report.raise_if_implausible()
    with pytest.raises(kv.KineverseError, match="prismatic"):
        check_plausibility(kitchen, observations, noise=NOISE, families=SOME, strict=True)

    model = repair_model(kitchen, report)
    assert model.articulations[DOOR].kind == "prismatic"
    assert model.articulations[DOOR].coordinates == kitchen.articulations[DOOR].coordinates
    assert check_plausibility(model, after, noise=NOISE, families=SOME)[TAG].explains


def test_door_beyond_its_limits_is_rejected(kitchen: kv.Model) -> None:
    truth = replace_hinge(kitchen, lambda joint: replace(joint, upper=2.5))
    observations = observe_frames(truth, [HANDLE], {DOOR: np.linspace(0.0, 2.2, 60)}, 6)
    report = check_plausibility(kitchen, observations, noise=NOISE, families=SOME)
    assert report[TAG].implausible_since is not None
    assert report[TAG].implausible_since >= 40
    assert repair_model(kitchen, report).limits(DOOR)[1] == pytest.approx(2.2, abs=0.1)


def corrupt(observations: dict[str, np.ndarray], rows: list[int], seed: int) -> None:
    """Corrupt some poses of the handle."""
    random = np.random.default_rng(seed)
    observations[HANDLE][rows, :3, 3] += random.normal(0.0, 0.5, (len(rows), 3))
    observations[HANDLE][rows, :3, :3] = Rotation.random(len(rows), random_state=seed).as_matrix()


@pytest.mark.parametrize("row", [0, 14, 29])
def test_single_wrong_pose_is_an_outlier(kitchen: kv.Model, row: int) -> None:
    observations = observe_frames(kitchen, [HANDLE], {DOOR: np.linspace(0.0, 1.5, 30)}, 20)
    corrupt(observations, [row], row)
    verdict = check_plausibility(kitchen, observations, noise=NOISE, families=SOME)[TAG]
    assert verdict.explains
    assert verdict.outliers == (row,)
    assert verdict.replacement is None
    assert "1 of 30 observations left out" in str(verdict)
    # Without an outlier model the pose is evidence against the joint.
    verdict = check_plausibility(kitchen, observations, noise=NOISE, families=SOME, outliers=False)[TAG]
    assert verdict.implausible_since == row


def test_replacement_is_found_despite_outliers(kitchen: kv.Model) -> None:
    values = np.random.default_rng(1).uniform(0.0, 0.4, 40)
    observations = observe_frames(replace_hinge(kitchen, make_slider), [HANDLE], {DOOR: values}, 21)
    corrupt(observations, [6, 11, 30], 22)
    verdict = check_plausibility(kitchen, observations, noise=NOISE, families=SOME)[TAG]
    assert verdict.implausible_since in range(3)
    assert verdict.outliers == (6, 11, 30)
    assert verdict.probabilities["prismatic"] > 0.9
    assert isinstance(verdict.replacement, kv.Prismatic)


def test_many_deviating_poses_are_no_outliers(kitchen: kv.Model) -> None:
    observations = observe_frames(kitchen, [HANDLE], {DOOR: np.linspace(0.0, 1.5, 20)}, 23)
    corrupt(observations, [2, 3, 9, 10, 11, 16], 24)
    assert not check_plausibility(kitchen, observations, noise=NOISE, families=SOME)[TAG].explains
    with pytest.raises(kv.errors.InvalidValueError, match="Outliers are True, False"):
        check_plausibility(kitchen, observations, noise=NOISE, outliers=0.1)  # type: ignore[arg-type]


def test_small_motion_is_undetermined(kitchen: kv.Model) -> None:
    report = check_plausibility(
        kitchen, observe_frames(kitchen, [HANDLE], {DOOR: np.full(20, 0.4)}, 7), noise=NOISE, families=SOME
    )
    assert report[TAG].verdict == "cannot tell"
    assert "hardly moved" in str(report)
    report = check_plausibility(kitchen, observe_frames(kitchen, [HANDLE], {DOOR: [0.4]}, 7), noise=NOISE)
    assert report[TAG].verdict == "cannot tell"


def test_fixed_frame_that_moves_is_rejected(kitchen: kv.Model) -> None:
    loose, tag = kitchen.copy(), "joint kitchen/fridge_joint"
    joint = loose.history.operation(tag)
    assert isinstance(joint, kv.Fixed)
    with loose.edit() as edit:
        sliding = kv.Prismatic(
            name="kitchen/fridge_joint", parent=joint.parent, child=joint.child, origin=joint.origin
        )
        edit.replace(tag, sliding)
    observations = observe_frames(loose, [FRIDGE], {"kitchen/fridge_joint": np.linspace(0.0, 0.5, 40)}, 8)
    report = check_plausibility(kitchen, observations, noise=NOISE, families=SOME)
    assert report[tag].implausible_since is not None
    model = repair_model(kitchen, report)
    assert model.articulations["kitchen/fridge_joint"].kind == "prismatic"
    assert HANDLE in model.frames
    assert check_plausibility(model, observations, noise=NOISE, families=SOME)[tag].explains


def make_garage_door(form: str = "published") -> kv.Model:
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.articulations.GarageDoor(name="garage", parent="world", form=form), tag="garage")
    return model


@pytest.mark.parametrize("form", ["regular", "published"])
def test_correct_garage_door_explains(form: str) -> None:
    model = make_garage_door(form)
    low, high = model.limits("garage/door")
    values = np.concatenate([[low] * 3, np.linspace(low, high, 25), [high] * 3])
    observations = observe_frames(model, ["garage/upper_edge"], {"garage/door": values}, 9)
    assert check_plausibility(model, observations, noise=NOISE, families=SOME)["garage"].explains


def test_garage_door_served_as_a_hinge_is_rejected() -> None:
    served = kv.Model()
    with served.edit() as edit:
        hinge = kv.Revolute(
            name="garage/door", parent="world", child="garage/door", axis=(0, 1, 0), lower=0, upper=1.6
        )
        edit.apply(hinge, tag="door")
        edit.add_frame("garage/upper_edge", parent="garage/door", transform=kv.translation(0, 0, 2))
    observations = observe_frames(
        make_garage_door(), ["garage/upper_edge"], {"garage/door": np.linspace(2.0, 0.0, 40)}, 10
    )
    report = check_plausibility(served, observations, noise=NOISE, families=("revolute", "planar", "free"))
    assert report["door"].implausible_since is not None
    assert report["door"].probabilities["planar"] > 0.9
    model = repair_model(served, report)
    assert set(model.frames) == set(served.frames)
    again = check_plausibility(model, observations, noise=NOISE, families=("revolute", "planar", "free"))
    assert again["door"].implausible_since is None


def test_custom_family_is_proposed() -> None:
    served = kv.Model()
    with served.edit() as edit:
        hinge = kv.Revolute(name="garage/door", parent="world", child="garage/door", axis=(0, 1, 0))
        edit.apply(hinge, tag="door")
        edit.add_frame("garage/upper_edge", parent="garage/door", transform=kv.translation(0, 0, 1.9))
    angle, length = kv.position("angle"), kv.parameter("length", 1.5)
    rising = kv.translation(0, 0, length * (1 - np.cos(angle))) @ kv.rotation_y(angle)
    family = Family(
        "garage", rising @ kv.translation(0, 0, length), {angle: (-0.1, 1.7)}, {length: (1.5, 0.5)}
    )
    observations = observe_frames(
        make_garage_door("regular"), ["garage/upper_edge"], {"garage/door": np.linspace(0.0, 1.5, 40)}, 19
    )
    report = check_plausibility(served, observations, noise=NOISE, families=[family, "revolute", "free"])
    assert report["door"].implausible_since is not None
    assert report["door"].result is not None
    assert report["door"].result.best.parameters["length"] == pytest.approx(2.0, abs=0.02)
    model = repair_model(served, report)
    assert model.degrees_of_freedom == served.degrees_of_freedom
    assert check_plausibility(model, observations, noise=NOISE, families=["revolute", "free"])[
        "door"
    ].explains
    # The range includes observations before the rejection.
    low, high = model.limits("garage/door")
    assert (low, high) == pytest.approx((0.0, 1.5), abs=0.05)


@pytest.mark.parametrize(
    "scene",
    ["cylindrical", "universal", "planar", "ackermann", "door_with_handle", "folding_door", "four_bar"],
)
def test_correct_articulations_explain(scene: str) -> None:
    model = kv.load(f"articulations/{scene}")
    random = np.random.default_rng(0)
    values = {}
    for symbol in model.degrees_of_freedom:
        low, high = np.clip(model.limits(symbol), -1.0, 1.0)
        values[str(symbol)] = random.uniform(low, high, 20)
    report = check_plausibility(
        model, observe_frames(model, model.frames, values, 20), noise=NOISE, families=["rigid"]
    )
    assert len(report) + len(report.untested) == len(model.frames)
    assert report.implausible == ()


def test_custom_articulation_is_tested() -> None:
    a = kv.position("wall/flap")

    def flap(height: float) -> kv.Model:
        model = kv.Model()
        with model.edit() as edit:
            pose = kv.translation(0.0, 0.0, height * np.sin(a)) @ kv.rotation_y(a)
            edit.add_frame("flap", parent="world", transform=pose, tag="flap")
            edit.constrain("flap/range", 0, a, 1.2)
        return model

    values = {"wall/flap": np.linspace(0.0, 1.2, 40)}
    for height, right in ((0.5, True), (0.3, False)):
        report = check_plausibility(
            flap(height),
            observe_frames(flap(0.5), ["flap"], values, 11),
            noise=NOISE,
            families=("revolute", "free"),
        )
        assert report["flap"].explains is right


def test_model_from_a_document_is_tested(kitchen: kv.Model) -> None:
    truth = replace_hinge(kitchen, lambda joint: replace(joint, origin=shift_origin(joint, y=0.05)))
    observations = observe_frames(truth, [HANDLE], {DOOR: np.linspace(0.0, 1.5, 50)}, 12)
    copy = kv.formats.from_bytes(kv.formats.to_bytes(kitchen))
    report = check_plausibility(copy, observations, noise=NOISE, families=SOME)
    assert report[TAG].implausible_since is not None
    model = repair_model(copy, report)
    again = kv.formats.from_bytes(kv.formats.to_bytes(model))
    assert np.array_equal(again.fk(HANDLE)({DOOR: 0.7}), model.fk(HANDLE)({DOOR: 0.7}))
    report = check_plausibility(again, observations, noise=NOISE, families=SOME)
    assert report[TAG].implausible_since is None


def test_one_of_several_joint_values_beyond_its_limits_is_rejected() -> None:
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Planar(name="puck", parent="world", child="puck", lower=-0.5, upper=0.5), tag="puck")
    values = np.random.default_rng(0).uniform(-0.4, 0.4, (3, 30))
    for shift, explained in ((0.0, True), (0.5, False)):
        shifted = dict(zip(("puck/x", "puck/y", "puck/angle"), values, strict=True))
        shifted["puck/x"] = shifted["puck/x"] + shift
        verdict = check_plausibility(model, observe_frames(model, ["puck"], shifted, 25), noise=NOISE)["puck"]
        assert verdict.explains is explained
        assert (verdict.probabilities["served"] > 0.9) is explained
        assert (verdict.implausible_since is None) is explained


def test_ball_joint_is_tested() -> None:
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.articulations.Ball(name="shoulder", parent="world", child="arm"), tag="ball")
        edit.add_frame("hand", parent="arm", transform=kv.translation(0.6, 0, 0))
    turns = np.random.default_rng(13).normal(size=(30, 4))
    values = dict(zip(map(str, model.degrees_of_freedom), turns.T, strict=True))
    observations = observe_frames(model, ["hand"], values, 14)
    report = check_plausibility(model, observations, noise=NOISE, families=("spherical", "free"))
    assert report["ball"].implausible_since is None
    for pose in observations["hand"]:
        pose[:3, 3] *= 0.8
    report = check_plausibility(model, observations, noise=NOISE, families=("spherical", "free"))
    assert report["ball"].implausible_since is not None
    assert repair_model(model, report).articulations["shoulder"].kind == "ball"


def test_missing_poses_and_a_moving_observer_are_handled(kitchen: kv.Model) -> None:
    values, frames = np.random.default_rng(0).uniform(0.0, 0.4, 60), [HANDLE, FRIDGE]
    before = observe_frames(kitchen, frames, {DOOR: values[:30]}, 15)
    after = observe_frames(replace_hinge(kitchen, make_slider), frames, {DOOR: values[30:]}, 16)
    camera_T_world = np.stack([kv.rotation_z(0.1 * k)() @ kv.translation(k, 1, 0)() for k in range(60)])
    observations = {f: camera_T_world @ np.concatenate([before[f], after[f]]) for f in before}
    observations[HANDLE][10:20] = np.nan
    observations[FRIDGE][[0, 50]] = np.nan
    report = check_plausibility(kitchen, observations, noise=NOISE, relative_to=None, families=SOME)
    assert [verdict.tag for verdict in report] == [TAG]
    assert report[TAG].count == 48
    assert report[TAG].implausible_since in range(28, 34)


def test_untestable_frames_are_listed(kitchen: kv.Model) -> None:
    arm = kv.Model()
    with arm.edit() as edit:
        edit.apply(kv.Revolute(name="a", parent="world", child="upper", axis=(0, 0, 1)))
        edit.add_frame("elbow", parent="upper", transform=kv.translation(0.5, 0, 0))
        edit.apply(kv.Revolute(name="b", parent="elbow", child="lower", axis=(0, 0, 1)))
    poses = observe_frames(arm, ["lower", "elbow"], {"a": [0.1, 0.2, 0.3], "b": [0.3, 0.1, 0.2]}, 17)
    report = check_plausibility(arm, {"lower": poses["lower"]}, noise=NOISE)
    assert len(report) == 0
    assert "'joint b', 'joint a'" in report.untested["lower"]
    assert "is untested" in str(report)
    report = check_plausibility(arm, poses, noise=NOISE, families=("revolute", "free"))
    assert {verdict.tag for verdict in report} == {"joint a", "joint b"}
    report = check_plausibility(kitchen, {}, noise=NOISE)
    assert str(report) == "nothing was observed"
    with pytest.raises(kv.errors.UnknownNameError, match="was not judged"):
        report[TAG]


def test_invalid_input_is_refused(kitchen: kv.Model) -> None:
    poses = observe_frames(kitchen, [HANDLE], {DOOR: [0.0, 0.5, 1.0]}, 18)
    with pytest.raises(kv.errors.UnknownNameError, match="fridge_door_handle"):
        check_plausibility(kitchen, {"kitchen/fridge_handle": poses[HANDLE]}, noise=NOISE)
    with pytest.raises(kv.errors.UnknownNameError, match="no frame 'camera'"):
        check_plausibility(kitchen, poses, noise=NOISE, relative_to="camera")
    with pytest.raises(kv.errors.InvalidValueError, match="The noise of"):
        check_plausibility(kitchen, poses)
    with pytest.raises(kv.errors.ShapeError, match=r"\(N, 4, 4\)"):
        check_plausibility(kitchen, {HANDLE: np.eye(4)}, noise=NOISE)
    with pytest.raises(kv.errors.ShapeError, match="different numbers of times"):
        check_plausibility(kitchen, {**poses, FRIDGE: poses[HANDLE][:2]}, noise=NOISE)
    with pytest.raises(kv.errors.InvalidValueError, match="positive definite"):
        check_plausibility(kitchen, {HANDLE: (poses[HANDLE], -NOISE)})
    with pytest.raises(kv.errors.InvalidValueError, match="between 0 and 1"):
        check_plausibility(kitchen, poses, noise=NOISE, false_alarms=0.0)
    some = poses[HANDLE].copy()
    some[1, 0, 3] = np.nan
    with pytest.raises(kv.errors.InvalidValueError, match=f"Pose 1 of the frame '{HANDLE}' is not finite"):
        check_plausibility(kitchen, {HANDLE: some}, noise=NOISE)
    some = poses[HANDLE].copy()
    some[2, :3, :3] *= 1.1
    with pytest.raises(kv.errors.InvalidValueError, match="Pose 2"):
        check_plausibility(kitchen, {HANDLE: some}, noise=NOISE)
    nothing = check_plausibility(kitchen, {HANDLE: np.zeros((0, 4, 4))}, noise=NOISE)
    assert nothing[TAG].verdict == "cannot tell"
    never = check_plausibility(kitchen, {HANDLE: np.full((3, 4, 4), np.nan)}, noise=NOISE)
    assert never[TAG].verdict == "cannot tell"
    assert "never observed together" in never[TAG].reason
