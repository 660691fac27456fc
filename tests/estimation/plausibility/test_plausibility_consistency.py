"""Limits on several coordinates, coordinates that move several parts, and their replacements."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from observed_frames import NOISE, observe_frames

import kineverse as kv
from kineverse.estimation import Plausibility, PlausibilityMonitor, check_plausibility
from kineverse.estimation.identification.observations import check_tracks, exact_track, pair_tracks
from kineverse.estimation.plausibility.consistency import ConsistencyTests
from kineverse.estimation.plausibility.e_process import SequentialTest
from kineverse.estimation.plausibility.report import find_testable_joints
from kineverse.estimation.plausibility.residuals import (
    JointObservations,
    KnownJoint,
    KnownResiduals,
    compute_residuals,
)

Array = npt.NDArray[np.float64]
SOME = ("rigid", "prismatic", "revolute", "free")


def make_cupboard() -> kv.Model:
    """Return a door, and a drawer that opens only as far as the door."""
    model = kv.Model()
    door, drawer = kv.position("door"), kv.position("drawer")
    with model.edit() as edit:
        edit.apply(kv.Revolute(name="door", parent="world", child="door", lower=0, upper=1.5), tag="door")
        edit.add_frame("handle", parent="door", transform=kv.translation(0, 0.4, 0))
        slide = kv.Prismatic(name="drawer", parent="world", child="drawer", lower=0, upper=0.6)
        edit.apply(slide, tag="drawer")
        edit.constrain("clear of the door", 0, drawer, 0.1 + 0.3 * np.sin(door))
    return model


def repair_model(model: kv.Model, report: Plausibility) -> kv.Model:
    """Return the model with its replacements, read back from a document."""
    copy = model.copy()
    with copy.edit() as edit:
        for tag, operation in report.replacements.items():
            edit.replace(tag, operation)
    return kv.formats.from_bytes(kv.formats.to_bytes(copy))


def add_consistency(model: kv.Model, observations: dict[str, Array]) -> dict[str, KnownResiduals]:
    """Return the residuals with consistency tests by tag."""
    result = find_testable_joints(model, observations, "world")
    known = {
        "world": exact_track(len(next(iter(observations.values())))),
        **check_tracks(observations, NOISE),
    }
    judged = {joint: KnownJoint(model, joint.child, joint.parent) for joint in result.joints}
    each = {}
    for joint, served in judged.items():
        times = np.flatnonzero(known[joint.parent].observed & known[joint.child].observed)
        poses = pair_tracks(known[joint.parent], known[joint.child], times)
        each[joint] = JointObservations(joint, served, poses, compute_residuals(served, poses), times, times)
    tested = ConsistencyTests(model, judged, "world").apply(each)
    return {joint.tag: data.residuals for joint, data in tested.items()}


def is_standard_normal(z: Array) -> bool:
    """Return True if numbers are standard normal; a correct set fails once in ten thousand."""
    count = len(z)
    mean, squares = abs(float(z.mean())), float(np.sum(z**2))
    return mean < 4.0 / np.sqrt(count) and abs(squares - count) < 4.0 * np.sqrt(2.0 * count)


def test_limit_set_by_another_coordinate_is_tested() -> None:
    model, random = make_cupboard(), np.random.default_rng(0)
    doors = random.uniform(0.1, 1.4, 40)
    inside = random.uniform(0.0, 1.0, 40) * (0.1 + 0.3 * np.sin(doors))
    for drawers, explained in ((inside, True), (np.minimum(inside + 0.25, 0.55), False)):
        observations = observe_frames(model, ["handle", "drawer"], {"door": doors, "drawer": drawers}, 1)
        report = check_plausibility(model, observations, noise=NOISE, families=SOME)
        assert report["door"].explains
        assert report["drawer"].explains is explained
        if not explained:
            assert report["drawer"].implausible_since is not None
            assert report["drawer"].replacement is None
            assert "together with the limits" in report["drawer"].reason
        # Without observations of the door the limit is unknown.
        alone = check_plausibility(model, {"drawer": observations["drawer"]}, noise=NOISE, families=SOME)
        assert alone["drawer"].explains


def test_limit_excess_is_standard_normal_at_the_limit() -> None:
    """Both coordinates contribute; without the door's share the deviation would be 1.4."""
    model, doors = make_cupboard(), np.random.default_rng(2).uniform(0.3, 1.2, 400)
    observations = observe_frames(
        model, ["handle", "drawer"], {"door": doors, "drawer": 0.1 + 0.3 * np.sin(doors)}, 3
    )
    observations["handle"][:7] = np.nan
    tied = add_consistency(model, observations)["drawer"].limit_excess
    above = tied[:, -1]  # below, the limit is 0
    assert np.isnan(above[:7]).all()
    assert is_standard_normal(above[7:])


def test_limit_excess_is_nan_at_a_jump() -> None:
    model = kv.Model()
    door, drawer = kv.position("door"), kv.position("drawer")
    with model.edit() as edit:
        edit.apply(kv.Revolute(name="door", parent="world", child="door"), tag="door")
        edit.apply(kv.Prismatic(name="drawer", parent="world", child="drawer"), tag="drawer")
        edit.constrain("latch", -np.inf, drawer, kv.where(door > 0.5, 0.4, 0.1))
    doors = np.array([0.2, 0.49, 0.51, 0.9])
    tied = add_consistency(
        model, observe_frames(model, ["door", "drawer"], {"door": doors, "drawer": np.full(4, 0.2)}, 0)
    )
    z = tied["drawer"].limit_excess[:, 0]
    assert z[0] > 5.0
    assert np.isnan(z[1:3]).all()
    assert z[3] < -10.0


def test_limit_on_several_own_coordinates_is_tested() -> None:
    x, y = kv.position("puck/x"), kv.position("puck/y")
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Planar(name="puck", parent="world", child="puck"), tag="puck")
        edit.constrain("rim", -np.inf, x**2 + y**2, 0.25)
    around, angle, inwards = np.random.default_rng(4).uniform((0, -1, 0.7), (6, 1, 1), (30, 3)).T
    for radius, explained in ((0.49, True), (0.6, False)):
        x, y = radius * inwards * np.cos(around), radius * inwards * np.sin(around)
        values = {"puck/x": x, "puck/y": y, "puck/angle": angle}
        verdict = check_plausibility(
            model, observe_frames(model, ["puck"], values, 4), noise=NOISE, families=SOME
        )["puck"]
        assert verdict.explains is explained
        assert (verdict.implausible_since is None) is explained


def test_cone_of_a_ball_joint_is_tested() -> None:
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(
            kv.articulations.Ball(name="arm", parent="world", child="arm", axis=(0, 0, 1), cone=0.5),
            tag="arm",
        )
        edit.add_frame("hand", parent="arm", transform=kv.translation(0, 0, 0.5))
    around = np.linspace(0.0, 6.0, 30)
    for lean, explained in ((0.45, True), (0.7, False)):
        half = np.sin(lean / 2)
        quaternion = half * np.cos(around), half * np.sin(around), 0 * around, np.cos(lean / 2) + 0 * around
        values = dict(zip((f"arm/q{c}" for c in "xyzw"), quaternion, strict=True))
        verdict = check_plausibility(
            model, observe_frames(model, ["hand"], values, 5), noise=NOISE, families=SOME
        )["arm"]
        assert (verdict.implausible_since is None) is explained


def make_gripper(factor: float = -1.0, shift: float = 0.0) -> kv.Model:
    """Return two fingers, the second of which mimics the first."""
    model = kv.Model()
    with model.edit() as edit:
        finger = kv.Prismatic(name="left", parent="world", child="left", axis=(0, 1, 0), lower=0, upper=0.4)
        edit.apply(finger, tag="left")
        other = replace(
            finger,
            name="right",
            child="right",
            origin=kv.model.Pose.from_matrix(kv.translation(0.1, shift, 0)()),
            position=factor * kv.position("left"),
            lower=-0.4,
        )
        edit.apply(other, tag="right")
    return model


FINGERS = {"left": np.random.default_rng(0).uniform(0.0, 0.4, 40)}


def test_correct_mimic_fingers_explain() -> None:
    observations = observe_frames(make_gripper(), ["right", "left"], FINGERS, 6)
    report = check_plausibility(make_gripper(), observations, noise=NOISE, families=SOME)
    assert report["left"].explains
    assert report["right"].explains
    many = {"left": np.random.default_rng(1).uniform(0.0, 0.4, 400)}
    left = add_consistency(make_gripper(), observe_frames(make_gripper(), ["right", "left"], many, 7))
    assert left["left"].disagreement.shape == (400, 0)
    assert is_standard_normal(left["right"].disagreement[:, 0])


@pytest.mark.parametrize(("factor", "shift"), [(-0.5, 0.0), (-1.0, 0.06)])
def test_wrong_mimic_joint_is_replaced(factor: float, shift: float) -> None:
    served = make_gripper()
    observations = observe_frames(make_gripper(factor, shift), ["right", "left"], FINGERS, 8)
    report = check_plausibility(served, observations, noise=NOISE, families=SOME)
    assert report["left"].explains
    assert report["right"].implausible_since is not None
    model = repair_model(served, report)
    assert model.degrees_of_freedom == served.degrees_of_freedom
    assert check_plausibility(model, observations, noise=NOISE, families=SOME)["right"].explains
    slope = model.fk("right")[1, 3].gradient()[kv.position("left").derivative()]
    assert float(slope({})) == pytest.approx(factor, abs=0.05)


def test_replacement_of_a_mimic_joint_follows_an_unobserved_leader() -> None:
    served, truth = make_gripper(), make_gripper()
    with truth.edit() as edit:
        turned = kv.model.Pose.from_matrix((kv.translation(0.1, 0, 0) @ kv.rotation_z(0.4))())
        edit.replace("right", replace(truth.history.operation("right"), origin=turned))
    observations = observe_frames(truth, ["right"], FINGERS, 9)
    report = check_plausibility(served, observations, noise=NOISE, families=SOME)
    assert report["right"].implausible_since is not None
    model = repair_model(served, report)
    assert model.degrees_of_freedom == served.degrees_of_freedom
    assert model.fk("left") == served.fk("left")
    assert (
        check_plausibility(model, observations, noise=NOISE, families=SOME)["right"].implausible_since is None
    )


def make_linkage(pivot: float = 1.0, coupler: float = 1.1) -> kv.Model:
    model = kv.Model()
    with model.edit() as edit:
        bars = [
            ("crank", "world", 0.0, 0.4),
            ("coupler", "crank_end", 0.0, coupler),
            ("rocker", "world", pivot, 0.9),
        ]
        for name, parent, x, length in bars:
            hinge = kv.model.Pose.from_matrix(kv.translation(x, 0, 0)())
            joint = kv.Revolute(name=name, parent=parent, child=name, origin=hinge, axis=(0, 0, 1))
            edit.apply(joint, tag=name)
            edit.add_frame(f"{name}_end", name, kv.translation(length, 0, 0))
        edit.close_loop("coupler_end", "rocker_end", mask=("x", "y"), home={"coupler": 1, "rocker": 1.5})
    return model


@pytest.fixture(scope="module")
def served_linkage() -> kv.Model:
    return make_linkage()


def test_bars_of_a_linkage_are_tested_together_and_replaced(served_linkage: kv.Model) -> None:
    served, frames = served_linkage, ["rocker", "crank", "coupler"]
    cranks = {"crank": np.random.default_rng(0).uniform(-3.0, 3.0, 24)}
    report = check_plausibility(
        served, observe_frames(served, frames, cranks, 10), noise=NOISE, families=SOME
    )
    assert len(report) == 3
    assert all(verdict.explains and not verdict.outliers for verdict in report)

    observations = observe_frames(make_linkage(pivot=1.08), frames, cranks, 11)
    report = check_plausibility(served, observations, noise=NOISE, families=SOME)
    assert [verdict.tag for verdict in report.implausible] == ["rocker"]
    copy = served.copy()
    with copy.edit() as edit:
        edit.replace("rocker", report.replacements["rocker"])
    assert copy.degrees_of_freedom == served.degrees_of_freedom
    assert "rocker" in copy.articulations
    assert check_plausibility(copy, observations, noise=NOISE, families=SOME).implausible == ()

    # The hinge is unchanged; a bar of another length moves it.
    observations = observe_frames(make_linkage(coupler=1.2), frames, cranks, 12)
    report = check_plausibility(served, observations, noise=NOISE, families=SOME)
    assert [verdict.tag for verdict in report.implausible] == ["rocker"]
    assert report["rocker"].replacement is None
    assert "it explains the poses alone" in report["rocker"].reason


def test_monitor_applies_consistency_tests() -> None:
    served = make_gripper()
    monitor = PlausibilityMonitor(served, ["right", "left"], noise=NOISE, families=SOME)
    right = observe_frames(make_gripper(), ["right", "left"], FINGERS, 13)
    wrong = observe_frames(make_gripper(-0.5), ["right", "left"], {"left": np.full(20, 0.3)}, 14)
    for observations, noticed in ((right, ()), (wrong, ("right",))):
        for k in range(len(observations["left"])):
            monitor.update({name: poses[k] for name, poses in observations.items()})
        assert tuple(monitor.implausible_since) == noticed
    assert monitor.implausible_since["right"] == pytest.approx(40, abs=3)
    assert monitor.report()["right"].implausible_since == monitor.implausible_since["right"]
    # Missing frames are ignored.
    monitor.update({"right": wrong["right"][0]})
    # A later limit belongs to the joint that it limits.
    with served.edit() as edit:
        edit.constrain("narrow", -np.inf, kv.position("left") ** 2, 0.01)
    for k in range(10):
        monitor.update({name: poses[k] for name, poses in wrong.items()})
    assert "left" in monitor.implausible_since


def test_singular_linkages_raise_no_alarm(served_linkage: kv.Model) -> None:
    """Near the dead centre the rocker hardly determines the crank; 18 tests run."""
    model, alarms = served_linkage, 0
    for seed in range(3, 9):
        cranks = {"crank": np.random.default_rng(seed).uniform(-3.0, 3.0, 40)}
        for left in add_consistency(
            model, observe_frames(model, ["rocker", "crank", "coupler"], cranks, seed)
        ).values():
            test = SequentialTest(1e-3)
            for row in zip(left.orthogonal, left.displacement_jacobian, left.one_sided, strict=True):
                test.add(*row)
            alarms += test.implausible_since is not None
    assert alarms == 0
