"""URDF joints of all types: their elements, defaults and normalised axes."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from urdf_texts import LIMIT, joint, model_of, pair, robot

import kineverse as kv
from kineverse.errors import FormatError
from kineverse.formats.mimic import MimicRelation
from kineverse.formats.urdf import UrdfDynamics, UrdfLimits, UrdfSafetyController, parse_urdf


def test_defaults_are_those_of_the_specification():
    (j,) = parse_urdf(pair()).joints
    assert (j.name, j.kind, j.parent, j.child, j.line) == ("j", "revolute", "l0", "l1", 4)
    assert np.array_equal(j.origin.matrix, np.eye(4))
    assert j.axis == (1.0, 0.0, 0.0)
    assert j.limits == UrdfLimits(-1.0, 2.0, 3.0, 10.0)
    assert (j.safety, j.mimic, j.dynamics) == (None, None, UrdfDynamics(0.0, 0.0))


@pytest.mark.parametrize(
    ("kind", "dof", "axis"),
    [
        ("fixed", 0, None),
        ("revolute", 1, (0.0, 0.0, 1.0)),
        ("continuous", 1, (0.0, 0.0, 1.0)),
        ("prismatic", 1, (0.0, 0.0, 1.0)),
        ("planar", 3, (0.0, 0.0, 1.0)),
        ("floating", 6, None),
    ],
)
def test_all_urdf_joint_types_are_read(kind, dof, axis):
    robot = parse_urdf(pair('<axis xyz="0 0 2"/>' + LIMIT, kind))
    assert robot.dof == dof
    assert robot.joints[0].axis == axis


INSIDE = (
    '<axis xyz="0 0 1"/><limit lower="-1" upper="2" effort="10" velocity="3"/>'
    '<dynamics damping="0.5" friction="0.25"/>'
    '<safety_controller soft_lower_limit="-0.5" soft_upper_limit="1" k_position="20" k_velocity="30"/>'
)


def test_planar_joints_have_the_limits_of_their_file_in_both_directions():
    model = model_of(pair(INSIDE, "planar"))
    assert [model.limits(f"j/{c}") for c in ("x", "y", "angle")] == [(-1, 2), (-1, 2), (-np.inf, np.inf)]
    names = {"j/x/position", "j/y/position", "j/x/velocity", "j/y/velocity"}
    assert set(model.constraints) == names
    assert model.violations(
        {"j/x": 0.0, "j/y": 2.5, "j/angle": 0.0, "j/x:velocity": 4.0, "j/y:velocity": 0.0}
    )
    known = {"effort": 10, "damping": 0.5, "friction": 0.25, "k_position": 20, "k_velocity": 30}
    assert dict(model.articulations["j"].dynamics) == known


@pytest.mark.parametrize("attributes", ["", 'name="r" version="1.2"'])
def test_a_planar_limit_of_speed_alone_leaves_the_position_free(attributes):
    robot = parse_urdf(
        pair('<limit effort="1" velocity="2"/>', "planar", *([attributes] if attributes else []))
    )
    assert robot.joints[0].limits == UrdfLimits(velocity=2.0, effort=1.0)
    assert robot.remarks == ()


@pytest.mark.parametrize("kind", ["planar", "floating", "continuous"])
def test_what_a_joint_does_not_have_is_ignored_with_a_remark(kind):
    robot = parse_urdf(pair(INSIDE, kind))
    said = [r for r in robot.remarks if "ignored" in r]
    assert any("soft limits" in r for r in said)
    assert any("lower and upper" in r for r in said) == (kind != "planar")
    assert any("has velocity" in r for r in said) == (kind == "floating")
    joint = robot.joints[0]
    assert (joint.limits.effort, joint.dynamics, joint.safety.k_velocity) == (10, UrdfDynamics(0.5, 0.25), 30)
    assert (joint.limits.velocity, joint.safety.has_limits) == (None if kind == "floating" else 3, False)


@pytest.mark.parametrize("kind", ["planar", "floating", "continuous", "prismatic", "revolute"])
def test_limits_and_dynamics_of_all_joints_are_written_as_they_were_read(kind, tmp_path):
    model = model_of(pair(INSIDE, kind))
    model.save(tmp_path / "r.urdf")
    again = kv.load(tmp_path / "r.urdf")
    assert dict(again.articulations) == dict(model.articulations)
    assert again.constraints == model.constraints


@pytest.mark.parametrize("kind", ["planar", "floating", "spherical"])
def test_dynamics_of_joints_with_several_coordinates_are_in_mjcf_or_in_a_remark(kind, tmp_path):
    mujoco = pytest.importorskip("mujoco")
    body = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
    text = pair('<dynamics damping="0.5" friction="0.25"/>', kind)
    text = text.replace('<link name="l1"/>', f'<link name="l1">{body}</link>').replace("l0", "world")
    saved = model_of(text).save(tmp_path / "r.xml")
    said = any("damping and friction of all is left out" in r for r in saved.remarks)
    engine = mujoco.MjModel.from_xml_path(str(tmp_path / "r.xml"))
    assert said == (kind == "planar")
    if not said:
        assert set(engine.dof_damping) == {0.5}
        assert set(engine.dof_frictionloss) == {0.25}
        read = dict(kv.load(tmp_path / "r.xml").articulations["j"].dynamics)
        assert (read["damping"], read["friction"]) == (0.5, 0.25)


@pytest.mark.parametrize("kind", ["continuous", "fixed", "planar", "floating"])
def test_types_without_limits_need_none(kind):
    assert parse_urdf(pair("", kind)).joints[0].limits == UrdfLimits()


def test_a_continuous_joint_keeps_speed_and_effort_but_has_no_range():
    assert parse_urdf(pair(LIMIT, "continuous")).joints[0].limits == UrdfLimits(None, None, 3.0, 10.0)


def test_a_missing_limit_is_zero():
    text = pair('<limit lower="-1" effort="1" velocity="1"/>')
    assert parse_urdf(text).joints[0].limits == UrdfLimits(-1.0, 0.0, 1.0, 1.0)
    robot = parse_urdf(pair('<limit effort="1" velocity="1"/>'))
    assert robot.joints[0].limits == UrdfLimits(0.0, 0.0, 1.0, 1.0)
    assert "neither lower nor upper" in robot.remarks[0]


@pytest.mark.parametrize("velocity", ["-1", "0"])
def test_velocity_without_effect_is_no_limit_with_a_remark(velocity):
    robot = parse_urdf(pair(f'<limit lower="0" upper="1" effort="1" velocity="{velocity}"/>'))
    assert robot.joints[0].limits.velocity is None
    assert 'line 4, <joint name="j">: <limit> has velocity' in robot.remarks[0]


def test_efforts_are_magnitudes():
    # |applied effort| < |effort| is what the specification says.
    text = pair('<limit lower="0" upper="1" effort="-5" velocity="1"/>')
    assert parse_urdf(text).joints[0].limits.effort == 5.0


V1_2 = 'name="r" version="1.2"'


def test_missing_limits_of_version_1_2_are_no_limits():
    text = pair('<limit lower="-1" upper="1" velocity="0" acceleration="3" jerk="9"/>', attributes=V1_2)
    assert parse_urdf(text).joints[0].limits == UrdfLimits(-1.0, 1.0, 0.0, None, 3.0, 3.0, 9.0)
    text = pair('<limit deceleration="4"/>', "continuous", attributes=V1_2)
    assert parse_urdf(text).joints[0].limits == UrdfLimits(deceleration=4.0)


def test_limits_of_version_1_2_are_ignored_in_earlier_versions():
    robot = parse_urdf(pair('<limit upper="1" effort="1" velocity="1" acceleration="x" jerk="1"/>'))
    assert robot.joints[0].limits == UrdfLimits(0.0, 1.0, 1.0, 1.0)
    assert ["acceleration" in robot.remarks[0], "jerk" in robot.remarks[1]] == [True, True]


def test_safety_mimic_and_dynamics_are_read():
    text = robot(
        joint("a", "l0", "l1"),
        joint(
            "b",
            "l1",
            "l2",
            inside=LIMIT
            + '<safety_controller k_velocity="5" k_position="7"'
            + ' soft_lower_limit="-.5" soft_upper_limit=".5"/>'
            + '<mimic joint="a" multiplier="-2" offset=".1"/><dynamics damping="3"/>',
        ),
        links=3,
    )
    b = parse_urdf(text).joints[1]
    assert b.safety == UrdfSafetyController(-0.5, 0.5, 7.0, 5.0)
    assert b.mimic == MimicRelation("a", -2.0, 0.1)
    assert b.dynamics == UrdfDynamics(3.0, 0.0)


def test_an_empty_dynamics_is_the_default():
    # urdfdom refuses it; by the specification both attributes are optional.
    assert parse_urdf(pair(LIMIT + "<dynamics/>")).joints[0].dynamics == UrdfDynamics(0.0, 0.0)


def test_an_axis_without_xyz_is_the_default():
    # urdfdom makes it zero; by the specification the attribute's default is x.
    robot = parse_urdf(pair("<axis/>" + LIMIT))
    assert robot.joints[0].axis == (1.0, 0.0, 0.0)
    assert any("<axis> has no xyz; it is 1 0 0, the default" in remark for remark in robot.remarks)


@given(st.tuples(*[st.floats(-1e3, 1e3)] * 3).filter(lambda v: math.hypot(*v) > 1e-3))
def test_axes_are_unit_vectors_in_their_direction(xyz):
    (x, y, z) = xyz
    axis = parse_urdf(pair(f'<axis xyz="{x!r} {y!r} {z!r}"/>' + LIMIT)).joints[0].axis
    assert math.isclose(math.hypot(*axis), 1.0, abs_tol=1e-14)
    assert np.allclose(np.cross(axis, xyz), 0.0, atol=1e-11 * math.hypot(*xyz))
    assert np.dot(axis, xyz) > 0.0


def test_axis_components_of_rounding_size_are_zero():
    assert parse_urdf(pair('<axis xyz="2.2e-16 0 1"/>' + LIMIT)).joints[0].axis == (0.0, 0.0, 1.0)


def test_an_axis_that_is_far_from_unit_length_is_remarked():
    assert "has length 2" in parse_urdf(pair('<axis xyz="0 0 2"/>' + LIMIT)).remarks[0]


def test_elements_without_meaning_for_fixed_joints_are_ignored():
    inside = '<axis xyz="0 0 0"/><limit effort="what"/><mimic joint="nobody"/><dynamics damping="a b"/>'
    assert parse_urdf(pair(inside, "fixed")).dof == 0


def test_the_first_of_two_elements_counts_and_the_other_is_remarked():
    robot = parse_urdf(pair('<origin xyz="0 0 1"/><origin xyz="0 0 2"/><origin xyz="0 0 1"/>' + LIMIT))
    assert robot.joints[0].origin.matrix[2, 3] == 1.0
    assert len(robot.remarks) == 1
    assert "<origin> is ignored" in robot.remarks[0]


def test_quaternions_came_with_version_1_1():
    inside = '<origin xyz="1 2 3" quat_xyzw="0 0 2 2"/>' + LIMIT
    (j,) = parse_urdf(pair(inside, attributes='name="r" version="1.1"')).joints
    assert np.array_equal(j.origin.matrix, [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])


def test_quaternions_are_ignored_in_version_1_0_with_a_remark():
    robot = parse_urdf(pair('<origin xyz="1 2 3" quat_xyzw="0 0 2 2"/>' + LIMIT))
    assert np.array_equal(robot.joints[0].origin.matrix[:3, :3], np.eye(3))
    assert '<joint name="j">: <origin> has quat_xyzw, which is ignored' in robot.remarks[0]


@pytest.mark.parametrize("version", ["1.0", "1.1", "1.2"])
def test_versions_are_read(version):
    assert parse_urdf(pair(attributes=f'name="r" version="{version}"')).dof == 1


def test_gazebo_transmissions_sensors_and_unknown_elements_are_ignored():
    text = robot(
        "<gazebo/>",
        '<gazebo reference="l0"><joint name="no" type="ball"><x><y/></x></joint><gazebo/></gazebo>',
        '<transmission name="t"><joint name="also_no"/></transmission>',
        '<sensor name="s"><parent link="l0"/></sensor>',
        "<!-- <joint/> -->",
        '<whatever><link name="no"/></whatever>',
        joint(
            "j",
            "l0",
            "l1",
            inside=LIMIT + "<calibration rising='x'/><hardwareInterface/><hardwareInterface/>",
        ),
        links=2,
    )
    description = parse_urdf(text)
    assert [j.name for j in description.joints] == ["j"]
    assert [link.name for link in description.links] == ["l0", "l1"]
    assert description.remarks == ()


def test_unexpanded_macros_beside_joints_are_warnings():
    text = robot(
        "<m:arm/>",
        joint("j", "l0", "l1"),
        links=2,
        attributes='name="r" xmlns:m="http://www.ros.org/wiki/xacro"',
    )
    (remark,) = parse_urdf(text).remarks
    assert remark == (
        "line 4, <m:arm>: is xacro that was not expanded. A file called robot.urdf.xacro is expanded; "
        "it is passed over, and what it would add is missing."
    )
    with pytest.raises(FormatError, match="is expanded"):
        parse_urdf(text, strict=True)


@pytest.mark.parametrize(
    "left", ["<xacro:arm/>", '<xacro:include filename="arm.xacro"/>', "<xacro:macro name='a'/>"]
)
def test_file_with_only_unexpanded_macros_is_refused(left):
    with pytest.raises(FormatError, match=r"<xacro:.*A file called robot\.urdf\.xacro is expanded"):
        parse_urdf(robot('<link name="world"/>', left))


def test_unexpanded_macros_in_links_and_joints_are_warnings():
    text = robot(joint("j", "l0", "l1", "fixed", "<xacro:origin/>"), '<link name="${a}"/>', links=2)
    remarks = parse_urdf(text.replace("</robot>", joint("k", "l0", "${a}", "fixed", "") + "</robot>")).remarks
    assert [remark.partition(":")[0] for remark in remarks] == [
        'line 4, <joint name="j">',
        'line 5, <link name="${a}">',
    ]
