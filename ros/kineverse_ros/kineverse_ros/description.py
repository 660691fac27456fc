"""URDF and markers of a model, which are said once, and again after edits."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any
from urllib.parse import quote
from xml.etree import ElementTree

import numpy as np

from kineverse.formats.resource_paths import mesh_reference
from kineverse.formats.urdf.writer import to_urdf
from kineverse.lie import Array, to_quaternion, translation
from kineverse.model.body import Box, Capsule, Cone, Cylinder, Ellipsoid, Geometry, Mesh, Shape, Sphere
from kineverse.model.model_view import ModelView

from .names import NameMap

UNPAINTED = (0.72, 0.74, 0.77, 1.0)  # colour of shapes without one
_CORNERS = 24  # of the base of a cone
_FOLDER = Path("/")  # of descriptions, which are in no folder


def describe(
    model: ModelView, frames: NameMap, joints: NameMap, published: Collection[str]
) -> tuple[str, list[str]]:
    """Return the URDF of a model with the names of ROS, and remarks on what URDF cannot say.

    Links are the frames of the model and no others, so all of them are in TF. Those that move as no single
    joint of URDF are floating. Links that are not published have no shapes, which somebody else shows.

    Raises
    ------
    FormatError
        If the model has something that no URDF can have.
    """
    written = to_urdf(model, _FOLDER / "robot_description.urdf", loose=True)
    robot = ElementTree.fromstring(written.content)
    for link in robot.iter("link"):
        if link.attrib["name"] not in published:
            for kind in ("visual", "collision"):
                for element in link.findall(kind):
                    link.remove(element)
        link.set("name", frames.to_ros(link.attrib["name"]))
    for kind in ("parent", "child"):
        for element in robot.iterfind(f"joint/{kind}"):
            element.set("link", frames.to_ros(element.attrib["link"]))
    for joint in robot.iterfind("joint"):
        joint.set("name", joints.translate(joint.attrib["name"]))
    for mimic in robot.iterfind("joint/mimic"):
        mimic.set("joint", joints.translate(mimic.attrib["joint"]))
    for kind in ("mesh", "texture"):
        for element in robot.iter(kind):
            element.set("filename", _address(element.attrib["filename"]))
    return ElementTree.tostring(robot, encoding="unicode"), [*written.remarks]


def make_markers(ros: Any, model: ModelView, frames: NameMap, published: Collection[str]) -> Any:
    """Return a MarkerArray of the visual shapes on published frames, in place of all markers before.

    Each frame is a namespace. Markers are locked to their frames, so they move with TF and need no update.
    Where a model has no visual shapes at all, those for collisions are shown.
    """
    is_bare = not any(body.visuals for body in model.bodies.values())
    markers = [ros.Marker(action=ros.Marker.DELETEALL)]
    for name, body in model.bodies.items():
        if name not in published:
            continue
        shapes = body.collisions if is_bare else body.visuals
        parts = [part for shape in shapes for part in _make_parts(ros, shape)]
        for number, marker in enumerate(parts):
            marker.header.frame_id = marker.ns = frames.to_ros(name)
            marker.id, marker.action, marker.frame_locked = number, ros.Marker.ADD, True
            markers.append(marker)
    return ros.MarkerArray(markers=markers)


def _make_parts(ros: Any, shape: Shape) -> Iterator[Any]:
    """Yield the markers of a shape, with pose, scale and colour."""
    form, origin = shape.geometry, shape.origin.matrix
    color = shape.color or UNPAINTED
    if isinstance(form, Capsule):
        width = 2 * form.radius
        yield _make_marker(ros, ros.Marker.CYLINDER, origin, (width, width, form.length), color)
        for side in (-0.5, 0.5):
            end = origin @ translation(np.array([0.0, 0.0, side * form.length]))
            yield _make_marker(ros, ros.Marker.SPHERE, end, (width, width, width), color)
        return
    if isinstance(form, Mesh):
        # A mesh without a colour has its own materials, which RViz takes where the colour is all zeros.
        marker = _make_marker(
            ros, ros.Marker.MESH_RESOURCE, origin, form.scale, shape.color or (0.0, 0.0, 0.0, 0.0)
        )
        marker.mesh_resource = _address(mesh_reference(form, _FOLDER, lambda _: None))
        marker.mesh_use_embedded_materials = shape.color is None
        yield marker
        return
    kind, scale = _find_primitive(ros, form)
    marker = _make_marker(ros, kind, origin, scale, color)
    if isinstance(form, Cone):
        marker.points = [ros.Point(x=x, y=y, z=z) for x, y, z in _cone_corners(form)]
    yield marker


def _find_primitive(ros: Any, form: Geometry) -> tuple[int, tuple[float, float, float]]:
    """Return the type and scale of the marker of a primitive."""
    if isinstance(form, Box):
        return ros.Marker.CUBE, form.size
    if isinstance(form, Cylinder):
        return ros.Marker.CYLINDER, (2 * form.radius, 2 * form.radius, form.length)
    if isinstance(form, Sphere):
        return ros.Marker.SPHERE, (2 * form.radius, 2 * form.radius, 2 * form.radius)
    if isinstance(form, Ellipsoid):
        x, y, z = form.radii
        return ros.Marker.SPHERE, (2 * x, 2 * y, 2 * z)
    return ros.Marker.TRIANGLE_LIST, (1.0, 1.0, 1.0)


def _cone_corners(cone: Cone) -> Iterator[tuple[float, float, float]]:
    """Yield the corners of the triangles of a cone, each with its front outside."""
    angles = np.linspace(0.0, 2 * np.pi, _CORNERS + 1)
    rim = [(cone.radius * float(np.cos(a)), cone.radius * float(np.sin(a)), -cone.length / 2) for a in angles]
    for one, other in pairwise(rim):
        yield from (one, other, (0.0, 0.0, cone.length / 2))
        yield from (other, one, (0.0, 0.0, -cone.length / 2))


def _make_marker(
    ros: Any,
    kind: int,
    pose: Array,
    scale: tuple[float, float, float],
    color: tuple[float, float, float, float],
) -> Any:
    marker = ros.Marker(type=kind)
    place, turn = marker.pose.position, marker.pose.orientation
    place.x, place.y, place.z = pose[:3, 3].tolist()
    turn.x, turn.y, turn.z, turn.w = to_quaternion(pose[:3, :3]).tolist()
    marker.scale.x, marker.scale.y, marker.scale.z = map(float, scale)
    marker.color.r, marker.color.g, marker.color.b, marker.color.a = map(float, color)
    return marker


def _address(reference: str) -> str:
    """Return the address of a file, which others find on this computer; package:// and others stay."""
    return reference if "://" in reference else f"file://{quote(str(_FOLDER / reference))}"
