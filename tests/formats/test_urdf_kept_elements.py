"""URDF to URDF: names, materials and elements that no model says are there again."""

from __future__ import annotations

import math
from pathlib import Path
from xml.etree import ElementTree

import pytest

import kineverse as kv
from kineverse.formats.reader_warnings import collect_warnings
from kineverse.formats.urdf.kept_elements import find_elements, find_references
from kineverse.model.basic_operations import SetBody, SetData
from kineverse.model.body import Body, Box, Shape
from published_data import published_path

ROBOT = """<?xml version="1.0"?>
<robot name="Duo" xmlns:c="http://example.org/c">
  <!-- <gazebo reference="arm"/> is a comment, and no element -->
  <material name="Blue"><color rgba="0 0 0.8 1"/></material>
  <material name="Unused"><color rgba="1 1 1 1"/></material>
  <link name="base">
    <visual><geometry><box size="1 1 1"/></geometry><material name="Blue"/></visual>
    <visual><geometry><box size="1 1 2"/></geometry></visual>
    <visual><geometry><box size="1 1 3"/></geometry><material name="Red"><color rgba="1 0 0 1"/></material></visual>
    <self_collision_checking/>
  </link>
  <link name="arm">
    <visual><geometry><box size="1 1 1"/></geometry><material name="Red"/></visual>
  </link>
  <link name="tool"/>
  <joint name="hinge" type="revolute">
    <parent link="base"/><child link="arm"/>
    <calibration rising="-0.5"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/>
  </joint>
  <joint name="mount" type="fixed"><parent link="arm"/><child link="tool"/></joint>
  <gazebo reference="arm"><mu1 value="0.5"/><c:note text="a &gt; b">arm</c:note></gazebo>
  <gazebo><plugin name="hinge" filename="lib.so"><jointName> hinge </jointName><text>hinge</text></plugin></gazebo>
  <transmission name="hinge_trans">
    <type>transmission_interface/SimpleTransmission</type>
    <joint name="hinge"><hardwareInterface>PositionJointInterface</hardwareInterface></joint>
    <actuator name="hinge_motor"/>
  </transmission>
  <ros2_control name="Duo" type="system"><joint name="hinge"><param name="mimic">hinge</param></joint></ros2_control>
  <gazebo/>
</robot>
"""


@pytest.fixture
def robot(tmp_path: Path) -> Path:
    path = tmp_path / "robot.urdf"
    path.write_text(ROBOT)
    return path


def written(model: kv.Model, folder: Path) -> ElementTree.Element:
    model.save(folder / "out.urdf")
    return ElementTree.parse(folder / "out.urdf").getroot()


def texts(root: ElementTree.Element, *tags: str) -> list[str]:
    """Return elements in canonical form, without white space."""
    found = (element for tag in tags for element in root.iter(tag))
    return ["".join(ElementTree.canonicalize(ElementTree.tostring(e), strip_text=True)) for e in found]


TAGS = ("gazebo", "transmission", "ros2_control", "calibration", "self_collision_checking")


def test_everything_is_there_again(robot: Path, tmp_path: Path) -> None:
    before, after = ElementTree.parse(robot).getroot(), written(kv.load(robot), tmp_path)
    assert after.get("name") == "Duo"
    assert texts(after, *TAGS) == texts(before, *TAGS)
    assert texts(after, "material") == texts(before, "material")
    assert (tmp_path / "out.urdf").read_text() != ROBOT
    again = written(kv.load(tmp_path / "out.urdf"), tmp_path)
    assert texts(again, "robot") == texts(after, "robot")
    joint, link = after.find("joint[@name='hinge']"), after.find("link[@name='base']")
    assert joint is not None
    assert joint.find("calibration") is not None
    assert link is not None
    assert link.find("self_collision_checking") is not None


def test_a_prefix_is_that_of_names_of_links_and_joints_alone(robot: Path, tmp_path: Path) -> None:
    root = written(kv.load(robot, "left"), tmp_path)
    assert [e.get("reference") for e in root.iter("gazebo")] == ["left/arm", None, None]
    plugin = root.find("gazebo/plugin")
    assert plugin is not None
    assert plugin.get("name") == "hinge"
    assert plugin.findtext("jointName") == " left/hinge "
    assert plugin.findtext("text") == "hinge"
    assert [e.get("name") for e in root.findall("transmission")] == ["left/hinge_trans"]
    assert [e.get("name") for e in root.findall("transmission/joint")] == ["left/hinge"]
    assert root.findtext("ros2_control/joint/param") == "left/hinge"
    assert root.find("joint[@name='left/hinge']/calibration") is not None
    assert root.find("transmission/actuator[@name='hinge_motor']") is not None


def test_references_and_comments_do_not_hide_a_name(tmp_path: Path) -> None:
    (tmp_path / "r.urdf").write_text(
        "<robot name='r'><link name='b&#228;r'/><gazebo reference='b&#xe4;r'><x><link/>bär</x>"
        "<link><!-- bär -->b&#228;r<!-- --></link></gazebo></robot>"
    )
    gazebo = written(kv.load(tmp_path / "r.urdf", "L"), tmp_path).find("gazebo")
    assert gazebo is not None
    assert (gazebo.get("reference"), gazebo.findtext("link")) == ("L/bär", "L/bär")
    assert "".join(gazebo.itertext()) == "bärL/bär"


def test_two_robots_in_one_model_keep_theirs(robot: Path, tmp_path: Path) -> None:
    model = kv.Model()
    for side in ("left", "right"):
        model.include(robot, prefix=side)
    root = written(model, tmp_path)
    assert root.get("name") == "out"
    names = [e.get("name") for e in root.findall("transmission")]
    assert names == ["left/hinge_trans", "right/hinge_trans"]
    assert [e.get("name") for e in root.findall("material")] == ["Blue", "Unused"]


def test_a_document_keeps_them_below_another_prefix(robot: Path, tmp_path: Path) -> None:
    kv.load(robot).save(tmp_path / "m.kv.json")
    assert texts(written(kv.load(tmp_path / "m.kv.json"), tmp_path), *TAGS) == texts(
        ElementTree.parse(robot).getroot(), *TAGS
    )
    root = written(kv.load(tmp_path / "m.kv.json", "b"), tmp_path)
    assert [e.get("name") for e in root.findall("transmission")] == ["b/hinge_trans"]


def test_what_names_a_removed_joint_is_left_out_with_a_remark(robot: Path, tmp_path: Path) -> None:
    model = kv.load(robot)
    with model.edit() as edit:
        edit.replace("joint hinge", kv.Fixed(name="weld", parent="base", child="arm"))
    result = model.save(tmp_path / "out.urdf")
    root = ElementTree.parse(tmp_path / "out.urdf").getroot()
    assert (
        "'hinge' is gone, and so is what the URDF that was read says of it: "
        "<calibration>, <gazebo>, <transmission>, <ros2_control>" in result.remarks
    )
    kept = texts(ElementTree.fromstring(ROBOT), "gazebo")[::2]
    assert texts(root, *TAGS) == [*kept, "<self_collision_checking></self_collision_checking>"]


def test_an_edited_colour_has_a_material_of_its_own(robot: Path, tmp_path: Path) -> None:
    model = kv.load(robot)
    box = Shape(Box((1, 1, 1)), color=(0.0, 1.0, 0.0, 1.0))
    with model.edit() as edit:
        edit.replace("body base", SetBody("base", Body((box,))))
    root = written(model, tmp_path)
    material = root.find("link[@name='base']/visual/material")
    assert material is not None
    assert (material.get("name"), material[0].get("rgba")) == ("material_1", "0 1 0 1")
    red = root.find("link[@name='arm']/visual/material")
    assert red is not None
    assert [e.get("rgba") for e in red] == ["1 0 0 1"]  # what defined it is gone


def test_other_formats_say_that_they_leave_them_out(robot: Path, tmp_path: Path) -> None:
    remarks = kv.load(robot).save(tmp_path / "m.sdf").remarks
    counts = "1 <self_collision_checking>, 1 <calibration>, 3 <gazebo>, 1 <transmission>, 1 <ros2_control>"
    assert f"elements of URDF that say nothing of motion are not written: {counts}" in remarks
    assert not any(remark.startswith("data are") for remark in remarks)


@pytest.mark.parametrize("encoding", ["latin-1", "utf-16"])
def test_other_encodings_are_read(encoding: str, tmp_path: Path) -> None:
    text = f'<?xml version="1.0" encoding="{encoding}"?><robot name="ä"><link name="a"/><gazebo reference="a" t="ö"/></robot>'
    (tmp_path / "r.urdf").write_bytes(text.encode(encoding))
    root = written(kv.load(tmp_path / "r.urdf"), tmp_path)
    assert [(e.get("reference"), e.get("t")) for e in root.iter("gazebo")] == [("a", "ö")]


@pytest.mark.parametrize("value", [("urdf",), ("urdf", 3, "a"), ("urdf", "r", "base", "x"), "urdf", None])
def test_data_that_only_look_like_it_are_plain_data(value: object, tmp_path: Path) -> None:
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("base", parent="world", transform=kv.translation(0, 0, 1))
        edit.apply(SetData("base/urdf", value))
    assert written(model, tmp_path).get("name") == "out"


def test_elements_are_found_as_a_parser_finds_them() -> None:
    text = (
        '<robot name="r"><!-- <gazebo> --><a x="1 > 2"><a><b/></a><![CDATA[</a>]]></a><?pi <x> ?>'
        '<joint name="j"><parent link="p"/><c><parent/></c></joint><xacro:x/><link name="l"><!-- </link> --></link>'
        "<link name='m'><visual><origin/></visual></link><d/></robot>"
    )
    found = list(find_elements(text, {("joint", "j")}, "xacro:"))
    assert [(e.place, e.owner, e.text) for e in found] == [
        ("robot", "", '<a x="1 > 2"><a><b/></a><![CDATA[</a>]]></a>'),
        ("joint", "j", "<c><parent/></c>"),
        ("robot", "", "<d/>"),
    ]
    places = [text[a:b] for a, b, _ in find_references('<joint name="x" y="x">z</joint>')]
    assert len(places) == 2


@pytest.mark.data
def test_pr2_keeps_all_of_it(tmp_path: Path) -> None:
    file = published_path("pr2", "pr2_description", "robots", "pr2.urdf")
    with collect_warnings():
        model = kv.load(file)
        root, before = written(model, tmp_path), ElementTree.parse(file).getroot()
    for tag, count in (("transmission", 30), ("gazebo", 106), ("calibration", 22)):
        assert sorted(texts(root, tag)) == sorted(texts(before, tag))
        assert len(texts(root, tag)) == count
    names, kept = ([e.get("name", "") for e in r.iter("material")] for r in (before, root))
    assert (sorted(kept), len(kept)) == (sorted(names), 93)
    pytest.importorskip("pinocchio")
    largest = kv.formats.check_conversion(model, tmp_path / "out.urdf").largest
    assert math.hypot(largest.position, largest.angle) < 1e-12
