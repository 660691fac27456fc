"""Grippers: made of boxes with known pads, of the shipped robots, and of published descriptions."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import kineverse as kv
from kineverse import lie
from kineverse.errors import UnknownNameError
from kineverse.expressions.expression import Expression
from kineverse.formats.srdf.reader import parse_srdf
from kineverse.geometry import Scene
from kineverse.grasping import find_gripper, find_grippers
from kineverse.model.body import Body, Box, Mesh, Pose, Shape

PAD, OPEN = 0.12, 0.04  # middle of the pads along the hand, largest motion of a finger [m]


def box(*size: float, at: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Body:
    return Body(collisions=(Shape(Box(size), Pose.from_matrix(lie.translation(np.array(at)))),))


def limited(edit: kv.model.Edit, name: str, lower: float, upper: float) -> Expression:
    q = kv.position(name)
    edit.constrain(f"{name}/position", lower, q, upper)
    return q


def hand_of_boxes(motions: str, hand: np.ndarray, fingers: int = 2) -> kv.Model:
    """Return a wrist with a hand and fingers; in the frame of the fingers x is out, y across."""
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("r/base", "world")
        edit.add_frame(
            "r/wrist", "r/base", kv.rotation_x(limited(edit, "r/roll", -3.0, 3.0)), box(0.05, 0.05, 0.05)
        )
        edit.add_frame(
            "r/hand", "r/wrist", lie.translation(np.array([0.1, 0.0, 0.0])) @ hand, box(0.04, 0.1, 0.04)
        )
        q = limited(edit, "r/q", 0.0, OPEN)
        root = lie.inverse(hand)  # where the hand's frame points does not matter to the fingers
        for name, sign in (("right", -1.0), ("left", 1.0)):
            pad = box(0.05, 0.01, 0.02, at=(PAD, 0.005 * sign, 0.0))
            if motions == "hinges":
                hinge = kv.translation(0.03, 0.03 * sign, 0) @ kv.rotation_z(20 * sign * q)
                transform = root @ hinge @ kv.translation(-0.03, -0.03 * sign, 0)
            else:
                own = {"two joints": f"r/{name}_joint"}.get(motions)
                amount = limited(edit, own, 0.0, OPEN) if own else q
                amount = OPEN - q if motions == "opens backwards" else amount
                transform = root @ kv.translation(0, sign * amount, 0)
            edit.add_frame(f"r/{name}", "r/hand", transform, pad)
        if fingers == 3:
            amount = limited(edit, "r/thumb_joint", 0.0, OPEN)
            pad = box(0.05, 0.02, 0.01, at=(PAD, 0.0, -0.02))
            edit.add_frame("r/thumb", "r/hand", kv.translation(0, 0, -amount), pad)
    return model


@pytest.mark.parametrize(
    ("motions", "axes"),
    [("one joint", "xyz"), ("two joints", "skew"), ("opens backwards", "zxy"), ("hinges", "skew")],
)
def test_pads_of_known_fingers(motions: str, axes: str) -> None:
    hand = np.eye(4)
    if axes == "skew":
        hand[:3, :3] = Rotation.from_euler("xyz", [0.3, -0.5, 0.4]).as_matrix()
    elif axes == "zxy":
        hand[:3, :3] = np.eye(3)[:, [2, 0, 1]]
    gripper = find_gripper(hand_of_boxes(motions, hand), "r")
    assert gripper.hand == "r/hand"
    assert set(gripper.bodies) == {"r/hand", "r/right", "r/left"}
    pose = hand @ gripper.grasp_pose  # with x out of the hand and y across, wherever the hand's frame points
    assert np.allclose(pose[:3, 0], [1, 0, 0], atol=1e-6)
    assert np.allclose(np.abs(pose[:3, 1]), [0, 1, 0], atol=1e-6)
    first, second = (("r/right",), ("r/left",))
    assert gripper.fingers == ((first, second) if pose[1, 1] > 0 else (second, first))
    assert len(gripper.joints) == (2 if motions == "two joints" else 1)
    if motions == "hinges":
        assert 0.1 < gripper.width < 0.15
        return
    assert gripper.width == pytest.approx(2 * OPEN, abs=1e-6)
    assert np.allclose(pose[:3, 3], [PAD, 0, 0], atol=5e-4)
    assert gripper.pads.size == pytest.approx((0.05, 0.02), abs=5e-4)
    opened = 0.0 if motions == "opens backwards" else OPEN
    assert all(value == opened for value in gripper.opened.values())
    assert all(value == pytest.approx(OPEN - opened, abs=1e-3) for value in gripper.closed.values())


@pytest.mark.parametrize("robot", ["pr2", "fetch", "hsr"])
def test_gaps_of_the_shipped_grippers(robot: str) -> None:
    model = kv.load(robot)
    grippers = find_grippers(model, robot)
    assert [g.hand.removeprefix(f"{robot}/") for g in grippers] == {
        "pr2": ["r_gripper_palm_link", "l_gripper_palm_link"],
        "fetch": ["gripper_link"],
        "hsr": ["hand_palm_link"],
    }[robot]
    gripper, scene = grippers[0], Scene(model)
    if robot == "pr2":
        assert find_gripper(model, "pr2", "pr2/l_gripper_tool_frame").hand == "pr2/l_gripper_palm_link"
    for gap in (0.003, 0.015, 0.03, gripper.width):
        scene.update(model.default_state().updated(gripper.values_at(gap)))
        assert scene.distance(*gripper.pads.frames).distance == pytest.approx(gap, abs=6e-4)
        # Between the pads stands the grasp pose: rays along y hit one finger on each side, equally far.
        pose = scene.pose(gripper.hand) @ gripper.grasp_pose_at(gap)
        for finger, sign in zip(gripper.fingers, (-1.0, 1.0), strict=True):
            hit = scene.ray(pose[:3, 3], sign * pose[:3, 1])
            assert hit is not None
            assert hit.body in finger
            assert hit.distance == pytest.approx(gap / 2, abs=6e-4)
        # Out of the hand nothing is in the way.
        assert scene.ray(pose[:3, 3], pose[:3, 0], 0.5) is None


def test_end_effectors_of_an_srdf_come_first() -> None:
    model = kv.load("pr2")
    srdf = parse_srdf(
        '<robot name="pr2"><group name="left"><link name="l_gripper_l_finger_link"/></group>'
        '<end_effector name="hand" parent_link="l_wrist_roll_link" group="left"/></robot>',
        model,
        "pr2",
    )
    assert find_gripper(model, "pr2", srdf=srdf).hand == "pr2/l_gripper_palm_link"
    with pytest.raises(
        UnknownNameError, match=r"no gripper at 'pr2/torso_lift_link'\. .* 'pr2/l_gripper_palm"
    ):
        find_gripper(model, "pr2", "pr2/torso_lift_link", srdf)


def test_robots_without_two_opposed_fingers_are_told_why() -> None:
    three = hand_of_boxes("two joints", np.eye(4), fingers=3)
    assert find_grippers(three, "r") == ()
    with pytest.raises(UnknownNameError, match="r/right, r/left, r/thumb are three fingers"):
        find_gripper(three, "r")
    with pytest.raises(
        UnknownNameError, match=r"'shelf_drawers' has no gripper .*\n.* is .* m large, more than"
    ):
        find_gripper(kv.load("shelf_drawers"), "shelf_drawers")
    many = kv.Model()
    with many.edit() as edit:
        for i, parent in enumerate(["world", *(f"hand{k}" for k in range(4))]):
            edit.add_frame(f"hand{i}", parent, transform=kv.rotation_z(kv.position(f"j{i}")))
            for k in range(5):
                edit.apply(kv.Continuous(name=f"w{i}-{k}", parent=f"hand{i}", child=f"wheel{i}-{k}"))
    with pytest.raises(
        UnknownNameError, match=r"^The model has no gripper .*\n  At hand4: .*3 more"
    ) as caught:
        find_gripper(many, "")
    assert "\n  Further links without fingers: 3." in str(caught.value), (
        "a robot of many links gives a short reason"
    )
    assert len(str(caught.value).splitlines()) == 4


def test_fingers_without_readable_shapes_are_where_their_frames_are() -> None:
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("hand", "world", body=box(0.1, 0.1, 0.1))
        q = limited(edit, "q", 0.0, OPEN)
        for name, sign in (("right", -1.0), ("left", 1.0)):
            lost = Body(collisions=(Shape(Mesh("package://nowhere/finger.stl")),))
            edit.add_frame(name, "hand", kv.translation(0.06, sign * q, 0), lost)
    gripper = find_gripper(model, "")
    assert gripper.width == pytest.approx(2 * OPEN, abs=2e-3)
    assert np.allclose(gripper.grasp_pose, lie.translation(np.array([0.06, 0.0, 0.0])), atol=1e-3)
    assert [remark.split(":")[0] for remark in gripper.remarks] == ["right", "left"]
    assert "2 shapes are missing" in str(gripper)


@pytest.mark.parametrize(
    ("path", "hand", "joints", "width"),
    [
        ("pr2/pr2_description/robots/pr2.urdf", "r_gripper_palm_link", ["r_gripper_l_finger_joint"], 0.0923),
        ("hsrb/hsrb_description/robots/hsrb4s.urdf", "hand_palm_link", ["hand_motor_joint"], 0.136),
        (
            "fetch/fetch_description/robots/fetch.urdf",
            "gripper_link",
            ["r_gripper_finger_joint", "l_gripper_finger_joint"],
            0.0994,
        ),
        (
            "urdf_files_dataset_sample/matlab__robotiq2F85__urdf__robotiq2F85.urdf",
            "robotiq_arg2f_base_link",
            ["finger_joint"],
            0.086,
        ),
        (
            "urdf_files_dataset_sample/matlab__franka_description__robots__frankaEmikaPanda.urdf",
            "panda_hand",
            ["panda_finger_joint1"],
            0.079,
        ),
    ],
)
def test_published_grippers(
    path: str, hand: str, joints: list[str], width: float, published: Callable[..., Path]
) -> None:
    gripper = find_grippers(kv.load(str(published(*path.split("/"))), prefix="r"), "r")[0]
    assert gripper.hand == f"r/{hand}"
    assert [str(s) for s in gripper.joints] == [f"r/{name}" for name in joints]
    assert gripper.width == pytest.approx(width, abs=1e-3)


def test_a_gripper_opens_within_the_limits_of_joints_that_mimic(published: Callable[..., Path]) -> None:
    model = kv.load(str(published("hsrb", "hsrb_description", "robots", "hsrb4s.urdf")), prefix="r")
    gripper, start = find_grippers(model, "r")[0], model.default_state()
    assert max(gripper.opened.values()) < model.limits("r/hand_motor_joint")[1] - 0.05
    for values in (gripper.opened, gripper.closed):
        assert not model.violations(start.updated(values))
