"""The descriptions that ship: names, limits and masses, and that no part of them runs through another."""

from __future__ import annotations

import subprocess
import sys
from functools import cache
from math import pi
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

pin = pytest.importorskip("pinocchio")
pytest.importorskip("coal")

from shipped_scene import SHIPPED, Scene  # noqa: E402

HAIR = 1e-4
"""How deep [m] two parts may meet where both are exact: less than the gap between any two of them."""

FURNITURE = ("kitchen", "shelf_door", "shelf_drawers")
ROBOTS = ("pr2", "fetch", "hsr")
ALL = FURNITURE + ROBOTS

DRAWERS = (
    "sink_left_upper_drawer",
    "sink_left_middle_drawer",
    "sink_left_bottom_drawer",
    "sink_trash_drawer",
    "oven_left_drawer",
    "oven_middle_upper_drawer",
    "oven_middle_lower_drawer",
    "oven_right_drawer",
    "island_left_upper_drawer",
    "island_left_lower_drawer",
    "island_middle_upper_drawer",
    "island_middle_lower_drawer",
    "island_right_upper_drawer",
    "island_right_lower_drawer",
    "fridge_lower_drawer",
)
DOORS = ("fridge_door", "oven_door", "dishwasher_door")
KNOBS = ("stove_knob_1", "stove_knob_2", "stove_knob_3", "stove_knob_4", "oven_knob")

ARM = (
    "shoulder_pan",
    "shoulder_lift",
    "upper_arm_roll",
    "elbow_flex",
    "forearm_roll",
    "wrist_flex",
    "wrist_roll",
)
DOF = {
    "kitchen": {*DRAWERS, *DOORS, *KNOBS},
    "shelf_door": {"door"},
    "shelf_drawers": {"upper_drawer", "lower_drawer"},
    "pr2": {
        "torso_lift_joint",
        "head_pan_joint",
        "head_tilt_joint",
        *(f"{side}_{name}_joint" for side in "lr" for name in (*ARM, "gripper")),
    },
    "fetch": {
        "r_wheel_joint",
        "l_wheel_joint",
        "torso_lift_joint",
        "head_pan_joint",
        "head_tilt_joint",
        *(f"{name.replace('upper_arm', 'upperarm')}_joint" for name in ARM),
        "r_gripper_finger_joint",
    },
    "hsr": {
        "arm_lift_joint",
        "arm_flex_joint",
        "arm_roll_joint",
        "wrist_flex_joint",
        "wrist_roll_joint",
        "head_pan_joint",
        "head_tilt_joint",
        "hand_motor_joint",
    },
}
MIMIC = {
    "pr2": {
        f"{side}_gripper_{finger}_finger_joint": (f"{side}_gripper_joint", 0.5, 0.0)
        for side in "lr"
        for finger in "lr"
    },
    "fetch": {"l_gripper_finger_joint": ("r_gripper_finger_joint", 1.0, 0.0)},
    "hsr": {
        "torso_lift_joint": ("arm_lift_joint", 0.5, 0.0),
        "hand_r_proximal_joint": ("hand_motor_joint", 1.0, 0.0),
        "hand_l_distal_joint": ("hand_motor_joint", -1.0, 0.0),
        "hand_r_distal_joint": ("hand_motor_joint", -1.0, 0.0),
    },
}
ROOT = {"kitchen": "kitchen", "shelf_door": "shelf", "shelf_drawers": "shelf"} | dict.fromkeys(
    ROBOTS, "base_footprint"
)
FRAMES = {
    "kitchen": {*DOF["kitchen"], *(f"{part}_handle" for part in (*DRAWERS, *DOORS))},
    "shelf_door": {"door", "door_handle"},
    "shelf_drawers": {"upper_drawer_handle", "lower_drawer_handle"},
    "pr2": {
        "base_link",
        "l_gripper_tool_frame",
        "r_gripper_tool_frame",
        "r_gripper_r_finger_tip_link",
        "l_gripper_r_finger_tip_link",
    },
    "fetch": {"base_link", "gripper_link"},
    "hsr": {"base_link", "hand_palm_link", "hand_l_distal_link", "hand_r_distal_link", "hand_tool_frame"},
}

POSES = {
    "pr2": {
        "l_elbow_flex_joint": -2.1213,
        "l_shoulder_lift_joint": 1.2963,
        "l_wrist_flex_joint": -1.16,
        "r_shoulder_pan_joint": -1.2963,
        "r_shoulder_lift_joint": 1.2963,
        "r_upper_arm_roll_joint": -1.2,
        "r_elbow_flex_joint": -2.1213,
        "r_wrist_flex_joint": -1.05,
        "r_forearm_roll_joint": 3.14,
        "torso_lift_joint": 0.32,
    },
    "fetch": {
        "shoulder_pan_joint": 0.3,
        "shoulder_lift_joint": 1.4,
        "upperarm_roll_joint": -1.57,
        "elbow_flex_joint": 1.72,
        "forearm_roll_joint": -1.2,
        "wrist_flex_joint": 1.66,
        "torso_lift_joint": 0.2,
    },
    "hsr": {"arm_lift_joint": 0.4},
}
"""Where the papers' experiments start; the HSR's torso rises by half of what its arm does."""


@cache
def scene(name: str) -> Scene:
    return Scene(name)


def test_shipped_models_are_the_known_ones() -> None:
    assert {path.stem for path in SHIPPED.glob("*.urdf")} == set(ALL)


def test_shipped_files_equal_the_output_of_their_source() -> None:
    tools = SHIPPED.parents[2] / "tools" / "models"
    done = subprocess.run([sys.executable, tools, "--check"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("name", ALL)
def test_shipped_degrees_of_freedom(name: str) -> None:
    assert set(scene(name).dof) == DOF[name]
    mimics = {joint.name: joint.mimic for joint in scene(name).joints.values() if joint.mimic}
    assert mimics == MIMIC.get(name, {})


@pytest.mark.parametrize("name", ALL)
def test_shipped_frames(name: str) -> None:
    assert scene(name).links[0] == ROOT[name]
    assert FRAMES[name] <= set(scene(name).links)


@pytest.mark.parametrize("name", ALL)
def test_root_link_is_a_frame_only(name: str) -> None:
    root = scene(name).xml.find(f"link[@name='{ROOT[name]}']")
    assert root is not None
    assert len(root) == 0


@pytest.mark.parametrize("name", ALL)
def test_shipped_limits_are_plausible(name: str) -> None:
    for joint in scene(name).joints.values():
        assert joint.velocity > 0, joint
        assert sorted(np.abs(joint.axis)) == [0, 0, 1], joint
        if joint.kind == "continuous":
            assert joint.range == (-np.inf, np.inf)
        else:
            assert joint.lower <= 0 < joint.upper or joint.lower < 0 <= joint.upper, joint


@pytest.mark.parametrize("name", sorted(MIMIC))
def test_mimic_joints_stay_within_their_own_limits(name: str) -> None:
    for joint in scene(name).joints.values():
        if joint.mimic:
            master, factor, offset = joint.mimic
            ends = sorted(factor * end + offset for end in scene(name).dof[master].range)
            assert joint.lower <= ends[0] + 1e-9
            assert joint.upper >= ends[1] - 1e-9


def test_limits_of_the_kitchen() -> None:
    dof = scene("kitchen").dof
    assert len(dof) == 23
    for parts, kind, upper, velocity in (
        (DRAWERS, "prismatic", 0.48, 1.0),
        (DOORS, "revolute", pi / 2, 1.5),
        (KNOBS, "revolute", pi, 3.0),
    ):
        for part in parts:
            joint = dof[part]
            assert (joint.kind, joint.lower, joint.velocity) == (kind, 0, velocity)
            assert joint.upper == upper
            assert joint.child == part
    assert dof["fridge_door"].axis == (0, 0, 1)
    assert dof["oven_door"].axis == dof["dishwasher_door"].axis == (0, 1, 0)


def test_limits_of_the_shelves() -> None:
    door = scene("shelf_door").dof["door"]
    assert (*door.range, door.velocity) == (0, 1.57, 1)
    for drawer in scene("shelf_drawers").dof.values():
        assert (drawer.kind, *drawer.range, drawer.velocity) == ("prismatic", 0, 0.22, 1)


def test_wheels_of_the_fetch() -> None:
    s = scene("fetch")
    pin.framesForwardKinematics(s.model, s.data, pin.neutral(s.model))
    left, right = (s.data.oMf[s.model.getFrameId(f"{side}_wheel_link")].translation for side in "lr")
    np.testing.assert_allclose(left - right, [0, 0.3748, 0], atol=1e-9)
    np.testing.assert_allclose((left + right) / 2, [0, 0, 0.06], atol=1e-9)


@pytest.mark.parametrize("name", ROBOTS)
def test_start_poses_are_within_limits(name: str) -> None:
    for joint, position in POSES[name].items():
        lower, upper = scene(name).dof[joint].range
        assert lower <= position <= upper, joint


@pytest.mark.parametrize("name", ALL)
def test_physical_links_have_visuals_collisions_and_mass(name: str) -> None:
    for link in scene(name).xml.iterfind("link"):
        parts = {tag: len(link.findall(tag)) for tag in ("visual", "collision", "inertial")}
        assert not len(link) or all(parts.values()), (link.get("name"), parts)
        assert parts["inertial"] <= 1
    assert not scene(name).xml.findall(".//mesh")


@pytest.mark.parametrize("name", ALL)
def test_materials_are_named_once_and_all_used(name: str) -> None:
    xml = scene(name).xml
    named = [material.get("name") for material in xml.iterfind("material")]
    used = {visual.find("material").get("name") for visual in xml.iterfind("link/visual")}
    assert len(named) == len(set(named))
    assert set(named) == used


@pytest.mark.parametrize("name", ALL)
def test_inertias_equal_those_of_solids(name: str) -> None:
    for link in scene(name).xml.iterfind("link/inertial"):
        moments = np.linalg.eigvalsh(_inertia(link))
        assert float(link.find("mass").get("value")) > 0
        assert moments[0] > 0
        assert moments[0] + moments[1] > moments[2] * (1 + 1e-6)


@pytest.mark.parametrize("name", ALL)
def test_inertias_agree_with_coal(name: str) -> None:
    """Of links of one material, whose density cancels out."""
    s, checked = scene(name), 0
    for link in s.xml.iterfind("link"):
        if len({material.get("name") for material in link.iterfind("visual/material")}) != 1:
            continue
        frame = s.model.getFrameId(link.get("name"), pin.FrameType.BODY)
        to_link, solids = s.model.frames[frame].placement.inverse(), []
        for shape in s.visuals.geometryObjects:
            if shape.parentFrame == frame:
                volume = shape.geometry.computeVolume()
                moment = shape.geometry.computeMomentofInertiaRelatedToCOM()
                solids.append((to_link * shape.placement) * pin.Inertia(volume, np.zeros(3), moment))
        whole, inertial = sum(solids[1:], start=solids[0]), link.find("inertial")
        density = float(inertial.find("mass").get("value")) / whole.mass
        centre = [float(v) for v in inertial.find("origin").get("xyz").split()]
        np.testing.assert_allclose(whole.lever, centre, atol=1e-6)
        scale = np.trace(whole.inertia) * density
        np.testing.assert_allclose(whole.inertia * density, _inertia(inertial), atol=1e-5 * scale)
        checked += 1
    assert checked > 0


@pytest.mark.parametrize("name", ["kitchen", *ROBOTS])
@pytest.mark.parametrize("kind", ["shapes", "visuals"])
def test_models_stand_on_the_floor(name: str, kind: str) -> None:
    lowest, _ = scene(name).bounds(kind, {})
    assert lowest[:, 2].min() == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("name", FURNITURE)
def test_furniture_parts_do_not_collide_when_closed(name: str) -> None:
    s = scene(name)
    assert not list(s.penetrations({}, lambda a, b: s.link_of(a) != s.link_of(b), HAIR))


@pytest.mark.parametrize(
    ("name", "dof"), [(name, dof) for name in FURNITURE for dof in sorted(DOF[name])], ids=lambda part: part
)
@pytest.mark.sampled(2)
def test_furniture_parts_do_not_collide_during_motion(name: str, dof: str) -> None:
    s = scene(name)
    body = s.model.getJointId(dof)

    def one_of_them_moves(a: int, b: int) -> bool:
        return s.is_below(s.body_of(a), body) != s.is_below(s.body_of(b), body)

    for position in np.linspace(*s.dof[dof].range, 5):
        assert not list(s.penetrations({dof: float(position)}, one_of_them_moves, HAIR))
        lowest, _ = s.bounds("shapes", {dof: float(position)})
        assert lowest[:, 2].min() >= (0 if name == "kitchen" else -1)


@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize("pose", ["zero", "start"])
def test_robots_have_no_self_collision(name: str, pose: str) -> None:
    """Parts on both sides of one joint overlap on purpose, as an elbow does; no others."""
    s = scene(name)
    positions = POSES[name] if pose == "start" else {}

    def far_apart(a: int, b: int) -> bool:
        return s.joints_between(s.body_of(a), s.body_of(b)) > 1

    assert not list(s.penetrations(positions, far_apart, HAIR))


def test_grippers_close_without_overlap_and_open_by_their_joint() -> None:
    for name, joint, a, b, gap in (
        ("pr2", "r_gripper_joint", "r_gripper_l_finger_tip_link", "r_gripper_r_finger_tip_link", 1.0),
        ("fetch", "r_gripper_finger_joint", "l_gripper_finger_link", "r_gripper_finger_link", 2.0),
    ):
        s = scene(name)
        low, high = s.dof[joint].range
        between = [_distance_across(s, {joint: q}, a, b) for q in (low, high)]
        assert 0 < between[0] < 0.005
        assert between[1] - between[0] == pytest.approx(gap * (high - low), abs=1e-6)
    s = scene("hsr")
    tips = ("hand_l_distal_link", "hand_r_distal_link")
    between = [_distance_across(s, {"hand_motor_joint": q}, *tips) for q in s.dof["hand_motor_joint"].range]
    assert 0 < between[0] < 0.005
    assert between[1] > 0.1


@pytest.mark.parametrize("name", ALL)
def test_mujoco_compiles_shipped_models(name: str) -> None:
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_path(str(SHIPPED / f"{name}.urdf"))
    assert model.njnt - model.neq == len(DOF[name])


@pytest.mark.parametrize("name", ALL)
def test_yourdfpy_accepts_shipped_models(name: str) -> None:
    yourdfpy = pytest.importorskip("yourdfpy")
    robot = yourdfpy.URDF.load(str(SHIPPED / f"{name}.urdf"))
    assert robot.validate()
    assert set(robot.actuated_joint_names) == DOF[name]


@pytest.mark.parametrize("name", ALL)
def test_shipped_files_are_small(name: str) -> None:
    assert Path(SHIPPED / f"{name}.urdf").stat().st_size < 120_000


def _inertia(inertial: ElementTree.Element) -> np.ndarray:
    entries = {key: float(value) for key, value in inertial.find("inertia").attrib.items()}
    return np.array([[entries["i" + "".join(sorted(a + b))] for b in "xyz"] for a in "xyz"])


def _distance_across(s: Scene, positions: dict[str, float], a: str, b: str) -> float:
    """Return the gap between two links along y, the way fingers close in the zero configuration."""
    lowest, highest = s.bounds("shapes", positions)
    first, second = ([i for i in range(len(lowest)) if s.link_of(i) == link] for link in (a, b))
    low, high = lowest[:, 1], highest[:, 1]
    return max(low[first].min() - high[second].max(), low[second].min() - high[first].max())
