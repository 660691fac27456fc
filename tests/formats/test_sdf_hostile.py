"""Truncated, malformed, deep, large and malicious SDF texts give one format error."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_sdf_joints import Z, joint, mimic
from test_sdf_pose_graph import WORLD, link, model_of, pose, sdf

import kineverse as kv
from kineverse.formats.reader_warnings import Fault
from kineverse.formats.sdf import SdfScene, parse_sdf
from kineverse.formats.sdf.operations import sdf_operations

LINKS = link("a") + link("b") + link("c")


def outcome(data: str | bytes, strict: bool = False) -> SdfScene | str:
    """Return the description or the message; anything but a FormatError fails the test."""
    try:
        return parse_sdf(data, source="x.sdf", strict=strict)
    except kv.errors.FormatError as error:
        return str(error)


def test_truncated_sdf_is_read_or_a_format_error():
    for length in range(0, len(WORLD.rstrip()), 7):
        message = outcome(WORLD[:length])
        assert isinstance(message, str), length
        assert message.startswith("x.sdf, line "), message
    assert isinstance(outcome(WORLD), SdfScene)


CROSSED = "<limit><lower>1</lower><upper>0</upper></limit>"
LIMITED = "<limit><{0}>x</{0}></limit>"
SEEN = "<visual><geometry><sphere><radius>1</radius></sphere></geometry><material>{}</material></visual>"
MESH = "<visual><geometry><mesh><uri>a.stl</uri><scale>{}</scale></mesh></geometry></visual>"


@given(st.integers(0, len(WORLD) - 1), st.binary(max_size=8))
def test_corrupted_sdf_is_read_or_a_format_error(position, replacement):
    data = WORLD.encode()
    result = outcome(data[:position] + replacement + data[position + len(replacement) :])
    assert isinstance(result, SdfScene) or result.startswith("x.sdf")


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (
            '<!DOCTYPE sdf [<!ENTITY a "b">]><sdf version="1.7">&a;</sdf>',
            "document types and entities are refused",
        ),
        ('<!DOCTYPE sdf [<!ENTITY a SYSTEM "/etc/passwd">]><sdf version="1.7">&a;</sdf>', "are refused"),
        ('<sdf version="1.7">' + "<model name='a'>" * 300, "nested more than 200 deep"),
        ("<sdf/>", "has no version"),
        ('<sdf version="2.0"/>', "is not one that is read"),
        ('<sdf version="1.1"/>', "is not one that is read"),
        ('<sdf version="nan"/>', "has no version"),
        ('<sdf version="1.7"/>', "neither a model nor a world"),
        ("<robot name='r'/>", "This is a URDF"),
        ("<sdf version='1.7'><% x %></sdf>", "template that was not expanded"),
        ("<sdf version='1.7'><xacro:macro/></sdf>".replace("<sdf", "<sdf xmlns:xacro='x'"), "xacro"),
        (sdf(), "has no link"),
        (sdf(link("a") + link("a")), "names are unique"),
        (sdf(link("a") + '<frame name="a"/>'), "names are unique"),
        (sdf("<link/>"), "names are required"),
        (sdf(link("a::b")), "separates scopes"),
        (sdf(link("a", pose("1 2 3"))), "6 finite numbers are expected"),
        (sdf(link("a", pose("0 0 0 nan 0 0"))), "6 finite numbers are expected"),
        (sdf(link("a", pose("0 0 0 0 0 0 0", 'rotation_format="quat_xyzw"'))), "length zero"),
        (sdf(link("a", pose("0 0 0 0 0 0", 'rotation_format="matrix"'))), "euler_rpy and quat_xyzw"),
        (sdf(link("a", pose("0 0 0 0 0 0", 'degrees="maybe"'))), "true or false"),
        (sdf(link("a", pose("", 'relative_to="b"')) + link("b", pose("", 'relative_to="a"'))), "in a circle"),
        (sdf(LINKS + '<frame name="f" attached_to="g"/><frame name="g" attached_to="f"/>'), "in a circle"),
        (sdf(LINKS, attributes='canonical_link="d"'), "does not exist"),
        (sdf(LINKS + joint("j", "hinge", "a", "b")), "is no joint type"),
        (sdf(LINKS + '<joint name="j" type="fixed"><child>a</child></joint>'), "has no <parent>"),
        (sdf(LINKS + '<joint name="j" type="fixed"><parent>a</parent></joint>'), "has no <child>"),
        (sdf(LINKS + joint("j", "fixed", "a", "world")), "has the world as its child"),
        (sdf(LINKS + joint("j", "revolute", "a", "b", "<axis><xyz>0 0 0</xyz></axis>")), "length zero"),
        (
            sdf(
                LINKS
                + joint(
                    "j", "revolute", "a", "b", "<axis><limit><lower>1</lower><upper>0</upper></limit></axis>"
                )
            ),
            "no position would be valid",
        ),
        (
            sdf(LINKS + joint("j", "revolute", "a", "b", "<axis><limit><lower>nan</lower></limit></axis>")),
            "a finite number",
        ),
        (sdf(LINKS + joint("j", "screw", "a", "b", Z + "<thread_pitch>0</thread_pitch>")), "without pitch"),
        (sdf(LINKS + joint("j", "universal", "a", "b", Z)), "has no <axis2>"),
        (
            sdf(LINKS + joint("j", "revolute", "a", "b", Z.replace("</axis>", mimic("k", 1)))),
            "does not exist",
        ),
        (sdf(LINKS + joint("j", "revolute", "a", "b", Z.replace("</axis>", mimic("a", 1)))), "no joint"),
        (sdf(LINKS + joint("j", "revolute", "a", "b", Z.replace("</axis>", mimic("j", 1)))), "mimics itself"),
        (
            sdf(
                LINKS
                + joint("j", "revolute", "a", "b", Z.replace("</axis>", mimic("k", 1)))
                + joint("k", "revolute", "b", "c", Z.replace("</axis>", mimic("j", 1)))
            ),
            "mimics itself, by way of",
        ),
        (
            sdf(
                LINKS
                + joint("j", "ball", "a", "b")
                + joint("k", "revolute", "b", "c", Z.replace("</axis>", mimic("j", 1)))
            ),
            "no position",
        ),
        (
            sdf(
                LINKS
                + joint("k", "revolute", "b", "c", Z)
                + joint("j", "revolute", "a", "b", Z.replace("</axis>", mimic("k", 1, axis="axis2")))
            ),
            "one axis only",
        ),
        (sdf(LINKS + joint("j", "gearbox", "a", "b", Z)), "gearbox_reference_body"),
        (
            sdf(
                LINKS
                + joint("j", "gearbox", "a", "b", Z + "<gearbox_reference_body>c</gearbox_reference_body>")
            ),
            "there is no hinge between",
        ),
        (
            sdf(link("a", "<visual><geometry><sphere><radius>-1</radius></sphere></geometry></visual>")),
            "negative",
        ),
        (sdf(link("a", "<visual><geometry><box/></geometry></visual>")), "has no <size>"),
        (sdf(link("a", "<inertial><mass>heavy</mass></inertial>")), "a finite number"),
    ],
)
def test_invalid_sdf_is_refused_with_a_reason(text, reason):
    message = outcome(text, strict=True)
    assert isinstance(message, str)
    assert message.startswith("x.sdf, line ")
    assert reason in message


AXIS = "<axis>{}</axis>"


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (sdf(link("a", pose("0 0 0 0 0 0 0", 'rotation_format="quat_xyzw"'))), "length zero"),
        (sdf(LINKS + joint("j", "revolute", "a", "b", AXIS.format(CROSSED))), "no position would be valid"),
        (sdf(LINKS + joint("j", "universal", "a", "b", Z)), "has no <axis2>"),
        (
            sdf(link("a", "<visual><geometry><sphere><radius>-1</radius></sphere></geometry></visual>")),
            "negative",
        ),
        (sdf(link("a", "<visual><geometry><box/></geometry></visual>")), "has no <size>"),
        (sdf(link("a", "<inertial><mass>heavy</mass></inertial>")), "a finite number"),
        (sdf(link("a", SEEN.format("<diffuse>red</diffuse>"))), "4 finite numbers"),
        (sdf(link("a", SEEN.format("<diffuse>1 0 0 1 1</diffuse>"))), "4 finite numbers"),
        (sdf(link("a", MESH.format("1 1 1 1"))), "3 finite numbers"),
        (
            sdf(LINKS + joint("j", "revolute", "a", "b", AXIS.format(LIMITED.format("effort")))),
            "a finite number",
        ),
        (
            sdf(LINKS + joint("j", "revolute", "a", "b", AXIS.format(LIMITED.format("velocity")))),
            "a finite number",
        ),
        (
            sdf(
                LINKS
                + joint("j", "revolute", "a", "b", AXIS.format("<dynamics><damping>x</damping></dynamics>"))
            ),
            "a finite number",
        ),
        (f"\n<?xml version='1.0'?>{sdf(link('a'))}", "<?xml ...?>"),
        (f"<!-- a -- b -->{sdf(link('a'))}", "<!--"),
    ],
)
def test_malformed_values_without_effect_on_motion_are_warnings(text, reason):
    assert isinstance(outcome(text, strict=True), str)
    scene = outcome(text)
    assert isinstance(scene, SdfScene)
    assert any(isinstance(remark, Fault) and reason in remark for remark in scene.remarks)
    model = kv.Model()
    with model.edit() as edit:
        for operation in sdf_operations(scene):
            edit.apply(operation)
    state = model.default_state()
    assert all(np.isfinite(model.fk(name)(state)).all() for name in model.frames)


def test_crossed_limits_leave_a_joint_free():
    scene = parse_sdf(sdf(LINKS + joint("j", "revolute", "a", "b", AXIS.format(CROSSED))))
    assert [(axis.lower, axis.upper) for axis in scene.joints[0].axes] == [(None, None)]


@pytest.mark.parametrize("root", ["sdf", "gazebo"])
@pytest.mark.parametrize("version", ["1.2", "1.3"])
def test_old_versions_are_read_as_1_4(version, root):
    inside = (
        link("a", MESH.format("1 1 1").replace("uri>", "filename>" if version == "1.2" else "uri>")),
        link("b", pose("1 0 0 0 0 1.5")),
        joint("j", "revolute", "a", "b", "<axis><xyz>1 0 0</xyz></axis>"),
    )
    new = parse_sdf(sdf(*inside, version="1.4").replace("filename>", "uri>"))
    old = parse_sdf(sdf(*inside, version=version).replace("<sdf", f"<{root}").replace("</sdf", f"</{root}"))
    assert old.joints == new.joints
    assert old.links[0].body == new.links[0].body
    assert len(new.links[0].body.visuals) == 1


def test_merged_model_without_links_becomes_part_of_the_world(tmp_path):
    inner = '<sdf version="1.10"><model name="m">{}<model name="n"><link name="l"/></model></model></sdf>'
    world = (
        '<sdf version="1.10"><world name="w"><include merge="true"><uri>m.sdf</uri>'
        "<pose>1 0 0 0 0 0</pose></include></world></sdf>"
    )
    (tmp_path / "m.sdf").write_text(inner.format('<frame name="f"/>'))
    scene = parse_sdf(world, "x.sdf", str(tmp_path))
    assert [link.name for link in scene.links] == ["n/l"]
    assert scene.links[0].pose.matrix[:3, 3].tolist() == [1, 0, 0]
    (tmp_path / "m.sdf").write_text(inner.format('<link name="k"/>'))
    scene = parse_sdf(world, "x.sdf", str(tmp_path))
    assert [link.name for link in scene.links] == ["m/k", "m/n/l"]
    assert "it is a model of its own" in scene.remarks[0]


def test_unknown_sdf_elements_are_left_out_with_a_remark():
    scene = parse_sdf(
        sdf(link("a", "<wheel/>") + "<drake:joint/>", version="1.7").replace("<sdf", "<sdf xmlns:drake='d'")
    )
    assert sorted(remark.partition(": ")[2].partition(" ")[0] for remark in scene.remarks) == [
        "<drake:joint>",
        "<wheel>",
    ]


def test_clashing_names_are_refused():
    text = sdf(
        link("a"),
        link("b", pose("1 0 0 0 0 0")),
        joint("j/first", "revolute", "a", "b", Z),
        joint("j", "universal", "b", "c", Z + "<axis2><xyz>0 1 0</xyz></axis2>"),
        link("c"),
    )
    with pytest.raises(kv.errors.FormatError, match=r"would be called \"j/first\" here"):
        model_of(text)


def steps(text: str) -> int:
    """Return how many lines of this library run while a text is read."""
    count = 0

    def trace(frame, event, _):
        nonlocal count
        if "kineverse" not in frame.f_code.co_filename:
            return None
        count += event == "line"
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        parse_sdf(text)
    finally:
        sys.settrace(before)
    return count


def chain(n: int) -> str:
    parts = [link("l0")]
    for k in range(n):
        parts.append(link(f"l{k + 1}", pose("1 0 0 0 0 0", f'relative_to="l{k}"')))
        parts.append(joint(f"j{k}", "revolute", f"l{k}", f"l{k + 1}", Z))
    return sdf(*parts)


def turned_chain(n: int) -> str:
    return sdf(*map(link, map("l{}".format, range(n + 1)))).replace(
        "</model>",
        "".join(joint(f"j{k}", "revolute", f"l{k + 1}", f"l{k}", Z) for k in range(n)) + "</model>",
    )


@pytest.mark.parametrize("shape", [chain, turned_chain])
def test_sdf_reading_takes_linear_time(shape):
    few, many = steps(shape(100)), steps(shape(400))
    assert many < 4.2 * few


def test_long_sdf_chains_are_read():
    scene = parse_sdf(chain(5_000))
    assert len(scene.joints) == 5_000
    assert scene.links[-1].pose.matrix[0, 3] == 5_000
