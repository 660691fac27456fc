"""Models that an SDF includes, as SDF or URDF."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import unquote

from kineverse.errors import FormatError
from kineverse.formats.files import read_file
from kineverse.formats.poses import rpy_angles
from kineverse.formats.resource_paths import counts_as_package, model_paths
from kineverse.formats.root_folder import declared_roots, is_below, outside_root_error
from kineverse.formats.urdf.description import UrdfJoint, UrdfLink, UrdfRobot
from kineverse.formats.urdf.reader import parse_urdf
from kineverse.formats.xml_reader import TEXT, Element, parse_xml, quote
from kineverse.formats.xml_values import read_text
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
from .pose_graph import MODEL_FRAME, SdfVersion

_LATEST = (1, 12)
_FILES = (".sdf", ".world", ".urdf")


def find_included(uri: str, folder: str, root: str) -> Path:
    """Find the file of an include: the file itself, or the one that the manifest of a model folder names.

    ``model://name/...`` and paths are searched below the folder of the document, then below the folders of
    ``GZ_SIM_RESOURCE_PATH``, ``IGN_GAZEBO_RESOURCE_PATH``, ``GAZEBO_MODEL_PATH`` and ``SDF_PATH``, then below
    the parent folders of the document. The file has to be within the root, or below a folder that one of
    these variables or ``KINEVERSE_ROOT`` names. A model may also be in a parent folder of the document that
    holds models.
    """
    scheme, colon, rest = uri.partition("://")
    if not colon:
        scheme, rest = "", uri
    if scheme not in ("", "model", "package", "file"):
        raise FormatError(
            f"{quote(uri)} is not fetched from a network. Download the model, and name it "
            "by model:// or a path."
        )
    here = Path(folder).absolute()
    declared = [path for _, path in model_paths()]
    rest = unquote(rest)
    if "\0" in rest or not rest.strip("/. \\"):
        raise FormatError(f"{quote(uri)} names no model.")
    parts = re.split(r"[/\\]", rest)
    named = scheme in ("model", "package")
    if named and ".." in parts:
        raise FormatError(f"{quote(uri)} leads out of the folder of models with '..', which is refused.")
    # A declared folder may itself be the model.
    own = [(str(place), place.parent / rest) for place in declared if place.name == parts[0]]
    candidates = [(root, here / rest)]
    if ".." not in parts:
        candidates += [*((str(place), place / rest) for place in declared), *own]
    if not os.path.isabs(rest) and scheme != "file":
        for above in here.parents:
            model = above / parts[0]
            bound = str(model) if named and counts_as_package(model, here, root) else root
            candidates.append((bound, above / rest))
    outside = False
    for bound, candidate in candidates:
        real = os.path.realpath(candidate)
        # An allowed folder may be a symbolic link; files below it may not lead out of it.
        if not any(is_below(real, os.path.realpath(place)) for place in (bound, *declared_roots()) if place):
            outside = outside or bound == root
            continue
        if _is_model(candidate):
            return _model_file(candidate) if candidate.is_dir() else candidate
    if outside and not named and (os.path.isabs(rest) or _is_model(here / rest)):
        raise outside_root_error(uri, root)
    variables = ", ".join(dict.fromkeys(variable for variable, _ in model_paths())) or "none is set"
    raise FormatError(
        f"{quote(uri)} is not there. Looked below {here}, the folders of GZ_SIM_RESOURCE_PATH, "
        f"GAZEBO_MODEL_PATH and SDF_PATH ({variables}), and the folders above. Set "
        "one of these to the folder that holds it."
    )


def _is_model(path: Path) -> bool:
    if os.path.isdir(path):  # False rather than an error for a name that is too long
        return (path / "model.config").is_file() or (path / "model.sdf").is_file()
    return path.suffix in _FILES and os.path.isfile(path)


def _model_file(folder: Path) -> Path:
    """Return the description of the newest supported version that the manifest of a model names."""
    manifest = folder / "model.config"
    if not manifest.is_file():
        return folder / "model.sdf"
    root = parse_xml(read_file(manifest), manifest.name, texts=True)
    found = [(version, name) for version, name in _listed_files(root) if version <= _LATEST]
    if not found:
        raise FormatError(f"{quote(str(manifest))} names no <sdf> of a version up to 1.12.")
    _, name = max(found)
    path = folder / name
    if not path.resolve().is_relative_to(folder.resolve()):
        raise FormatError(f"{quote(str(manifest))} names {quote(name)}, which is outside of its folder.")
    if not os.path.isfile(path):
        raise FormatError(f"{quote(str(manifest))} names {quote(name)}, and there is no such file.")
    return path


def _listed_files(root: Element) -> Iterator[tuple[SdfVersion, str]]:
    for element in root[2]:
        if element[0] == "sdf" and read_text(element):
            match = re.fullmatch(r"1\.(\d{1,3})", element[1].get("version", "1.0").strip())
            yield (1, int(match[1])) if match else (1, 0), read_text(element)


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
