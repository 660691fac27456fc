"""Mistakes are errors with source, line, element and reason, or warnings if other parsers accept them."""

from __future__ import annotations

import numpy as np
import pytest
from urdf_texts import LIMIT, joint, pair, robot

import kineverse as kv
from kineverse.errors import FormatError
from kineverse.formats.reader_warnings import Fault
from kineverse.formats.urdf import parse_urdf, read_urdf
from kineverse.formats.urdf.operations import urdf_operations

J = 'r.urdf, line 4, <joint name="j">: '
MIMIC = 'r.urdf, line 4, <mimic> of <joint name="j">: '


def refusal(text: str | bytes) -> str:
    with pytest.raises(FormatError) as info:
        parse_urdf(text, source="r.urdf", strict=True)
    return str(info.value)


CASES = {
    "not a robot": (
        "<sdf/>",
        "r.urdf, line 1, <sdf>: is not <robot>, the root element of a URDF. This is an SDF file.",
    ),
    "no name": (robot(links=1, attributes=""), "r.urdf, line 1, <robot>: has no name"),
    "no links": (robot(), 'r.urdf, line 1, <robot name="r">: has no <link>'),
    "only xacro": (robot("<xacro:arm/>"), "A file called robot.urdf.xacro is expanded"),
    "version 2": (
        robot(links=1, attributes='name="r" version="2.0"'),
        'version="2.0" is not one that is read',
    ),
    "version 1.3": (robot(links=1, attributes='name="r" version="1.3"'), "1.0, 1.1, 1.2 are"),
    "version 1": (robot(links=1, attributes='name="r" version="1"'), 'version="1" is not one that is read'),
    "no version": (robot(links=1, attributes='name="r" version=""'), 'version="" is not one that is read'),
    "capital robot": (robot(links=1).replace("robot", "Robot"), "is not <robot>, the root element of a URDF"),
    "spherical": (pair(kind="spherical"), J + 'type="spherical" is no joint type of URDF'),
    "1.2 without lower": (
        pair('<limit upper="1"/>', attributes='name="r" version="1.2"'),
        J + "<limit> has no lower",
    ),
    "1.2 with negative velocity": (
        pair('<limit velocity="-1"/>', "continuous", attributes='name="r" version="1.2"'),
        J + "<limit> has velocity=-1.0; URDF 1.2 refuses negative magnitudes",
    ),
    "nameless link": (robot("<link/>"), "r.urdf, line 2, <link>: has no name"),
    "empty name": (robot('<link name=""/>'), 'r.urdf, line 2, <link name="">: has an empty name'),
    "two links": (
        robot('<link name="l0"/>', links=1),
        'r.urdf, line 3, <link name="l0">: has the name of the link on line 2',
    ),
    "two joints": (
        robot(joint("j", "l0", "l1"), joint("j", "l1", "l2"), links=3),
        'r.urdf, line 6, <joint name="j">: has the name of the joint on line 5',
    ),
    "nameless joint": (robot("<joint/>"), "r.urdf, line 2, <joint>: has no name"),
    "no type": (robot('<joint name="j"/>'), "has no type; the specification requires one of fixed, revolute"),
    "unknown type": (
        pair(kind="revolut"),
        J + "type=\"revolut\" is no joint type of URDF. Did you mean 'revolute'?",
    ),
    "no parent": (robot('<joint name="j" type="fixed"><child link="l0"/></joint>'), "has no <parent"),
    "empty child": (
        robot('<joint name="j" type="fixed"><parent link="a"/><child/></joint>'),
        "<child> does not name a link",
    ),
    "no limit": (pair(""), J + "is revolute but has no <limit>"),
    "no limit of a slider": (pair("", "prismatic"), J + "is prismatic but has no <limit>"),
    "no effort": (pair('<limit velocity="1"/>'), J + "<limit> has no effort"),
    "no velocity": (pair('<limit effort="1"/>', "continuous"), J + "<limit> has no velocity"),
    "empty range": (
        pair('<limit lower="1" upper="-1" effort="1" velocity="1"/>'),
        J + "<limit> has lower=1.0 above",
    ),
    "zero axis": (pair('<axis xyz="0 0 0"/>' + LIMIT), J + '<axis> xyz="0 0 0" has length zero'),
    "zero normal": (pair('<axis xyz="0 0 0"/>', "planar"), J + "<axis>"),
    "two numbers": (
        pair('<axis xyz="0 1"/>' + LIMIT),
        J + '<axis> xyz="0 1" has 2 words, where 3 finite numbers',
    ),
    "nan": (pair('<origin xyz="0 nan 0"/>' + LIMIT), J + "<origin> xyz=\"0 nan 0\" has 'nan', where 3"),
    "infinity": (pair('<limit lower="-inf" upper="1" effort="1" velocity="1"/>'), "leave a limit out"),
    "overflow": (
        pair('<limit upper="1e999" effort="1" velocity="1"/>'),
        "has '1e999', where a finite number",
    ),
    "commas": (pair('<origin xyz="0,5 0 0"/>' + LIMIT), "decimal point"),
    "xacro number": (pair('<origin xyz="${pi} 0 0"/>' + LIMIT), "this is xacro, expand it first"),
    "empty number": (pair('<limit effort="" velocity="1"/>', "continuous"), 'effort="" is empty'),
    "long number": (pair(f'<origin xyz="{"0 " * 9999}"/>' + LIMIT), "is 19998 characters long"),
    "both rotations": (
        pair('<origin rpy="0 0 0" quat_xyzw="0 0 0 1"/>', "fixed", 'name="r" version="1.1"'),
        J + "<origin> has both rpy and quat_xyzw",
    ),
    "zero quaternion": (
        pair('<origin quat_xyzw="0 0 0 0"/>', "fixed", 'name="r" version="1.2"'),
        J + '<origin> quat_xyzw="0 0 0 0" has length zero',
    ),
    "no k_velocity": (pair(LIMIT + "<safety_controller/>"), J + "<safety_controller> has no k_velocity"),
    "empty soft range": (
        pair(LIMIT + '<safety_controller k_velocity="1" soft_lower_limit="1"/>'),
        J + "<safety_controller> has soft_lower_limit=1.0 above soft_upper_limit=0.0",
    ),
    "soft range elsewhere": (
        pair(LIMIT + '<safety_controller k_velocity="1" soft_lower_limit="3" soft_upper_limit="4"/>'),
        J + "<safety_controller> has soft limits [3.0, 4.0] outside of the limits [-1.0, 2.0]",
    ),
    "mimics nothing": (pair(LIMIT + "<mimic/>"), J + "<mimic> does not name a joint"),
    "mimics nobody": (
        pair(LIMIT + '<mimic joint="jj"/>'),
        MIMIC + 'it mimics "jj", and there is no joint of that name',
    ),
    "mimics itself": (pair(LIMIT + '<mimic joint="j"/>'), MIMIC + "it mimics itself."),
    "floating mimic": (pair('<mimic joint="j"/>', "floating"), J + "<mimic> cannot drive a floating joint"),
    "no filename": (
        robot('<link name="l"><visual><geometry><mesh/></geometry></visual></link>'),
        'r.urdf, line 2, <link name="l">: <mesh> has no filename',
    ),
    "no size": (
        robot('<link name="l"><visual><geometry><box/></geometry></visual></link>'),
        "<box> has no size",
    ),
    "negative size": (
        robot('<link name="l"><visual><geometry><box size="1 -1 1"/></geometry></visual></link>'),
        "<box> has a negative size",
    ),
    "negative radius": (
        robot('<link name="l"><collision><geometry><sphere radius="-1"/></geometry></collision></link>'),
        "<sphere> has a negative radius",
    ),
    "bad mass": (
        robot('<link name="l">\n<inertial>\n<mass value="heavy"/></inertial></link>'),
        'r.urdf, line 4, <link name="l">: <mass> value="heavy" has \'heavy\', where a finite number',
    ),
    "bad colour": (
        robot('<material name="m"><color rgba="red"/></material>', links=1),
        '<material name="m">: <color> rgba="red"',
    ),
    "two materials": (
        robot(
            '<material name="m"><color rgba="1 0 0 1"/></material>',
            '<material name="m"><texture filename="a"/></material>',
            '<link name="l"/>',
        ),
        'r.urdf, line 3, <material name="m">: is texture "a" here and rgba 1 0 0 1 before',
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_invalid_urdf_is_refused_with_a_reason(case):
    text, expected = CASES[case]
    message = refusal(text)
    assert message.startswith("r.urdf, line ")
    assert expected in message


REFUSED = frozenset(
    (
        *("not a robot", "no links", "only xacro", "two links", "two joints"),
        *("nameless joint", "no type", "unknown type", "no parent", "empty child", "mimics nothing"),
        *("two numbers", "nan", "commas", "xacro number", "long number"),
    )
)
"""Files that no parser reads, or that have no useful meaning."""


@pytest.mark.parametrize("case", CASES)
def test_mistakes_that_other_parsers_accept_are_warnings(case):
    text, expected = CASES[case]
    if case in REFUSED:
        with pytest.raises(FormatError):
            parse_urdf(text, source="r.urdf")
        return
    read = parse_urdf(text, source="r.urdf")
    (fault,) = (remark for remark in read.remarks if isinstance(remark, Fault))
    start, _, end = fault.rpartition("; ")
    assert expected.removeprefix("r.urdf, ").removesuffix(".").partition(";")[0] in start
    assert end.endswith((".", "?"))
    model = kv.Model()
    with model.edit() as edit:
        for operation in urdf_operations(read):
            edit.apply(operation)
    state = model.default_state()
    assert all(np.isfinite(model.fk(name)(state)).all() for name in model.frames)


def test_invalid_magnitudes_are_no_limits():
    (joint,) = parse_urdf(pair('<limit lower="-1" upper="2"/>')).joints
    assert (joint.limits.lower, joint.limits.upper) == (-1.0, 2.0)
    assert (joint.limits.velocity, joint.limits.effort) == (None, None)


@pytest.mark.parametrize(
    "limit",
    [
        "",
        '<limit lower="2" upper="1"/>',
        '<limit lower="nan" upper="1"/>',
        '<limit lower="-inf" upper="inf"/>',
    ],
)
def test_invalid_ranges_leave_a_joint_unlimited(limit):
    (joint,) = parse_urdf(pair(limit)).joints
    assert (joint.limits.lower, joint.limits.upper) == (None, None)


@pytest.mark.parametrize(
    ("inside", "scale"),
    [("0.001 0.001 0.002 1", (0.001, 0.001, 0.002)), ("2", (2.0, 2.0, 2.0)), ("a b c", (1.0, 1.0, 1.0))],
)
def test_mesh_scales_of_one_or_four_numbers_are_read(inside, scale):
    text = f'<link name="l"><visual><geometry><mesh filename="a.stl" scale="{inside}"/></geometry></visual></link>'
    (shape,) = parse_urdf(robot(text)).links[0].body.visuals
    assert shape.geometry.scale == scale


def test_colours_of_five_numbers_are_read_as_four():
    look = '<material name="m"><color rgba="1 0.5 0 1 9"/></material>'
    text = f'<link name="l"><visual>{look}<geometry><sphere radius="1"/></geometry></visual></link>'
    (shape,) = parse_urdf(robot(text)).links[0].body.visuals
    assert shape.color == (1.0, 0.5, 0.0, 1.0)


def test_a_bad_inertia_is_left_out_and_the_rest_of_the_body_stays():
    text = (
        '<link name="l"><inertial><mass value="x"/></inertial>'
        '<visual><geometry><sphere radius="1"/></geometry></visual></link>'
    )
    body = parse_urdf(robot(text)).links[0].body
    assert body.inertia is None
    assert len(body.visuals) == 1


def test_zero_axis_fixes_a_joint_and_makes_a_plane_horizontal():
    (joint,) = parse_urdf(pair('<axis xyz="0 0 0"/>' + LIMIT)).joints
    assert joint.kind == "fixed"
    (joint,) = parse_urdf(pair('<axis xyz="0 0 0"/>', "planar")).joints
    assert joint.axis == (0.0, 0.0, 1.0)


def test_rpy_precedes_quaternion_and_zero_quaternion_is_the_identity():
    attributes = 'name="r" version="1.1"'
    (joint,) = parse_urdf(pair('<origin rpy="0 0 1" quat_xyzw="0 0 0 1"/>', "fixed", attributes)).joints
    assert joint.origin == parse_urdf(pair('<origin rpy="0 0 1"/>', "fixed", attributes)).joints[0].origin
    (joint,) = parse_urdf(pair('<origin xyz="1 2 3" quat_xyzw="0 0 0 0"/>', "fixed", attributes)).joints
    np.testing.assert_array_equal(joint.origin.matrix[:3, :3], np.eye(3))


@pytest.mark.parametrize("kind", ["fixed", "planar", "floating"])
def test_only_one_position_can_be_followed(kind):
    text = robot(
        joint("a", "l0", "l1", kind, ""), joint("j", "l1", "l2", inside=LIMIT + '<mimic joint="a"/>'), links=3
    )
    assert f'mimics "a" (line 5), which is {kind} and so has no single position' in refusal(text)


def test_names_in_messages_are_bounded_and_printable():
    message = refusal(robot(f'<link name="{"x" * 10_000}&#10;"/>' * 2))
    assert len(message) < 400
    message = refusal(robot('<link name="a&#10;b"/>' * 2))
    assert "a\\nb" in message


def test_unreadable_files_are_errors(tmp_path):
    (tmp_path / "other.urdf").touch()
    with pytest.raises(FormatError, match=r"there is no such file. The folder has: other.urdf"):
        read_urdf(tmp_path / "robot.urdf")
    with pytest.raises(FormatError, match="it is a folder"):
        read_urdf(tmp_path)
    with pytest.raises(FormatError, match="Check the path"):
        read_urdf(tmp_path / "no" / "robot.urdf")


def test_files_are_named_in_messages(tmp_path):
    path = tmp_path / "robot.urdf"
    path.write_text(pair(""))
    with pytest.raises(FormatError, match=r'^robot.urdf, line 4, <joint name="j">: '):
        read_urdf(path, strict=True)
