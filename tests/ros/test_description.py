"""URDF and markers of a model: what they say of motions and shapes that URDF does not have."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import numpy as np
import pytest
from fake_rclpy import FakeRos

import kineverse as kv
from kineverse.model.basic_operations import SetBody
from kineverse.model.body import Body, Box, Capsule, Cone, Cylinder, Ellipsoid, Mesh, Shape, Sphere
from kineverse_ros.description import describe, make_markers
from kineverse_ros.names import NameMap

EVERYTHING = ("world", "lid", "follower", "slider", "box")


def names_of(model):
    return NameMap(("world", *model.frames), {}), NameMap(map(str, model.symbols), {})


@pytest.fixture
def model():
    """A lid that turns about an axis outside of its frame, a frame that turns with it, and a plain slider."""
    made, q, x = kv.Model(), kv.position("lid"), kv.position("slider")
    with made.edit() as edit:
        edit.add_frame("lid", "world", kv.rotation_z(q) @ kv.translation(0.5, 0, 0))
        edit.add_frame("follower", "world", kv.rotation_z(2 * q))
        edit.add_frame("slider", "world", kv.translation(0, x, 0))
        edit.add_frame("box", "slider", kv.translation(0, 0, 1))
    return made


def test_links_are_the_frames_and_what_is_no_single_joint_floats(model):
    text, remarks = describe(model, *names_of(model), EVERYTHING)
    robot = ET.fromstring(text)
    assert {link.attrib["name"] for link in robot.iter("link")} == set(EVERYTHING)
    kinds = {joint.find("child").attrib["link"]: joint.attrib["type"] for joint in robot.iter("joint")}
    # The follower mimics a joint that is not there.
    assert kinds == {"lid": "floating", "follower": "floating", "slider": "prismatic", "box": "fixed"}
    assert [text for text in remarks if "floating" in text] == [
        "'lid' is floating, as no single joint of URDF moves so",
        "'follower' is floating, as no single joint of URDF moves so",
    ]
    origin = next(j for j in robot.iter("joint") if j.find("child").attrib["link"] == "lid").find("origin")
    assert origin.attrib["xyz"].split()[0] == "0.5"
    assert robot.find("joint[@name='slider']") is not None


def test_shapes_are_markers_and_meshes_have_addresses(model, tmp_path):
    (tmp_path / "a mesh.stl").write_text("solid nothing\nendsolid\n", "utf-8")
    mesh = Mesh("a mesh.stl", scale=(2.0, 2.0, 2.0), folder=str(tmp_path))
    shapes = (
        Shape(Box((1.0, 2.0, 3.0)), color=(0.1, 0.2, 0.3, 0.4)),
        Shape(Cylinder(0.5, 2.0)),
        Shape(Sphere(0.5)),
        Shape(Ellipsoid((1.0, 2.0, 3.0))),
        Shape(Cone(0.5, 2.0)),
        Shape(mesh),
        Shape(mesh, color=(1.0, 0.0, 0.0, 1.0)),
        Shape(Capsule(0.5, 2.0)),
    )
    with model.edit() as edit:
        edit.apply(SetBody("lid", Body(visuals=shapes)))
        edit.apply(SetBody("slider", Body(visuals=(Shape(Sphere(1.0)),))))
    ros = FakeRos()
    _, *markers = make_markers(ros, model, names_of(model)[0], {"lid"}).markers
    kind = ros.Marker
    assert [marker.ns for marker in markers] == ["lid"] * 10
    assert [marker.type for marker in markers] == [
        kind.CUBE,
        kind.CYLINDER,
        kind.SPHERE,
        kind.SPHERE,
        kind.TRIANGLE_LIST,
        kind.MESH_RESOURCE,
        kind.MESH_RESOURCE,
        kind.CYLINDER,
        kind.SPHERE,
        kind.SPHERE,
    ]
    box, cylinder, _, ellipsoid, cone, plain, red, *_, top = markers
    assert (box.scale.x, box.scale.y, box.scale.z) == (1.0, 2.0, 3.0)
    assert (box.color.r, box.color.a) == (0.1, 0.4)
    assert (cylinder.scale.x, cylinder.scale.z) == (1.0, 2.0)
    assert (ellipsoid.scale.x, ellipsoid.scale.z) == (2.0, 6.0)
    corners = np.array([[p.x, p.y, p.z] for p in cone.points]).reshape(-1, 3, 3)
    outward = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (np.einsum("ij,ij->i", outward, corners.mean(axis=1)) > 0).all()
    assert plain.mesh_resource == red.mesh_resource == f"file://{tmp_path}/a%20mesh.stl"
    assert (plain.mesh_use_embedded_materials, red.mesh_use_embedded_materials) == (True, False)
    assert (plain.color.a, red.color.a) == (0.0, 1.0)
    assert plain.scale.x == 2.0
    assert top.pose.position.z == 1.0
    text, _ = describe(model, *names_of(model), EVERYTHING)
    assert f'filename="file://{tmp_path}/a%20mesh.stl"' in text
