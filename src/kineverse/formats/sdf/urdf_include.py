"""URDF files that an SDF includes, as elements of an SDF model."""

from __future__ import annotations

from collections.abc import Iterator

from kineverse.errors import FormatError
from kineverse.formats.export.poses import rpy_angles
from kineverse.formats.urdf.description import UrdfJoint, UrdfLink, UrdfRobot
from kineverse.formats.urdf.reader import parse_urdf
from kineverse.formats.xml_reader import TEXT, Element, quote
from kineverse.formats.xml_writer import format_numbers
from kineverse.model.body import (
    Box,
    Capsule,
    Cone,
    Cylinder,
    Ellipsoid,
    Geometry,
    Inertia,
    Mesh,
    Pose,
    Shape,
    Sphere,
)

from .description import WORLD
from .pose_graph import MODEL_FRAME

_TENSOR = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")


def read_urdf_as_sdf(content: bytes, source: str, folder: str, root: str, strict: bool) -> Element:
    """Return the ``<model>`` element of a URDF.

    Its joints are placed in their parent links and its links in their joints, as the URDF says. A floating
    joint is left out, which leaves its link free. A joint that has the name of a link is renamed.
    """
    robot = parse_urdf(content, source, folder, root, strict)
    above = {joint.child: joint for joint in robot.joints}
    links = {link.name for link in robot.links}
    names = {j.name: f"{j.name}_joint" if j.name in links else j.name for j in robot.joints}
    children = [_link(link, above.get(link.name), names) for link in robot.links if link.name != WORLD]
    for joint in robot.joints:
        children += _joint(joint, names, robot)
    return _element("model", *children, line=1, name=robot.name or "robot")


def _element(tag: str, *children: Element, text: str = "", line: int = 0, **attributes: str) -> Element:
    if text:
        attributes[TEXT] = text
    return tag, attributes, list(children), line


def _number(tag: str, value: float | tuple[float, ...], line: int) -> Element:
    return _element(tag, text=format_numbers(value), line=line)


def _pose(pose: Pose, line: int, relative_to: str = "") -> Element:
    matrix = pose.matrix
    numbers = (*matrix[:3, 3].tolist(), *rpy_angles(matrix))
    return _element("pose", text=format_numbers(numbers), line=line, relative_to=relative_to)


def _link(link: UrdfLink, joint: UrdfJoint | None, names: dict[str, str]) -> Element:
    """Return the element of a link, at the origin of the joint above it."""
    line, parts = link.line, []
    if joint is not None and joint.kind == "floating":
        parts.append(_pose(joint.origin, line, _frame(joint.parent)))
    elif joint is not None:
        parts.append(_pose(Pose(), line, names[joint.name]))
    if link.body.inertia is not None:
        parts.append(_inertial(link.body.inertia, line))
    for tag, shapes in (("visual", link.body.visuals), ("collision", link.body.collisions)):
        parts += [_shape(tag, f"{tag}_{k}", shape, line) for k, shape in enumerate(shapes)]
    return _element("link", *parts, line=line, name=link.name)


def _frame(link: str) -> str:
    """Return the frame of a link; the link "world" is the world, at the origin of the model."""
    return MODEL_FRAME if link == WORLD else link


def _inertial(inertia: Inertia, line: int) -> Element:
    moments = [_number(k, v, line) for k, v in zip(_TENSOR, inertia.tensor, strict=True)]
    return _element(
        "inertial",
        _pose(inertia.origin, line),
        _number("mass", inertia.mass, line),
        _element("inertia", *moments, line=line),
        line=line,
    )


def _shape(tag: str, name: str, shape: Shape, line: int) -> Element:
    parts = [_pose(shape.origin, line), _element("geometry", _geometry(shape.geometry, line), line=line)]
    if shape.color is not None:
        parts.append(_element("material", _number("diffuse", shape.color, line), line=line))
    return _element(tag, *parts, line=line, name=shape.name or name)


def _geometry(form: Geometry, line: int) -> Element:
    if isinstance(form, Mesh):
        uri = _element("uri", text=form.uri, line=line)
        return _element("mesh", uri, _number("scale", form.scale, line), line=line)
    sizes: dict[str, float | tuple[float, ...]]
    if isinstance(form, Box):
        sizes = {"size": form.size}
    elif isinstance(form, Sphere):
        sizes = {"radius": form.radius}
    elif isinstance(form, (Cylinder, Capsule, Cone)):
        sizes = {"radius": form.radius, "length": form.length}
    else:
        assert isinstance(form, Ellipsoid)
        sizes = {"radii": form.radii}
    return _element(form.kind, *(_number(k, v, line) for k, v in sizes.items()), line=line)


def _joint(joint: UrdfJoint, names: dict[str, str], robot: UrdfRobot) -> Iterator[Element]:
    """Yield the element of a joint; none for a floating one."""
    line = joint.line
    if joint.kind == "floating":
        return
    if joint.kind in ("planar", "spherical"):
        raise FormatError(
            f"{robot.source}, line {line}, <joint name={quote(joint.name)}>: is {joint.kind}, which no joint "
            "of an SDF is. Load this file by itself."
        )
    parts = [
        _pose(joint.origin, line, _frame(joint.parent)),
        _element("parent", text=joint.parent, line=line),
        _element("child", text=joint.child, line=line),
    ]
    if joint.axis is not None:
        parts.append(_axis(joint, names))
    yield _element("joint", *parts, line=line, name=names[joint.name], type=joint.kind)


def _axis(joint: UrdfJoint, names: dict[str, str]) -> Element:
    assert joint.axis is not None
    line, limits = joint.line, joint.limits
    bounds = {
        "lower": limits.lower,
        "upper": limits.upper,
        "effort": limits.effort,
        "velocity": limits.velocity,
    }
    parts = [
        _number("xyz", joint.axis, line),
        _element("limit", *(_number(k, v, line) for k, v in bounds.items() if v is not None), line=line),
        _element(
            "dynamics",
            _number("damping", joint.dynamics.damping, line),
            _number("friction", joint.dynamics.friction, line),
            line=line,
        ),
    ]
    if joint.mimic is not None:
        follows = [
            _number("multiplier", joint.mimic.multiplier, line),
            _number("offset", joint.mimic.offset, line),
        ]
        parts.append(_element("mimic", *follows, line=line, joint=names[joint.mimic.joint]))
    return _element("axis", *parts, line=line)
