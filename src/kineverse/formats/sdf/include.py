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
from kineverse.model.body import Geometry, Mesh, Pose, Shape, Vector3

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
    children += [_joint(joint, names, robot) for joint in robot.joints if joint.kind != "floating"]
    return _with_line(_element("model", *children, name=robot.name or "robot"), 1)


def _with_line(element: Element, line: int) -> Element:
    """Return an element whose line, and those of all parts without one, is that of the URDF."""
    tag, attributes, children, own = element
    return tag, attributes, [_with_line(child, own or line) for child in children], own or line


def _element(tag: str, *children: Element, text: str = "", line: int = 0, **attributes: str) -> Element:
    if text:
        attributes[TEXT] = text
    return tag, attributes, list(children), line


def _number(tag: str, value: float | tuple[float, ...]) -> Element:
    return _element(tag, text=format_numbers(value))


def _pose(pose: Pose, relative_to: str = "") -> Element:
    matrix = pose.matrix
    numbers = (*matrix[:3, 3].tolist(), *rpy_angles(matrix))
    return _element("pose", text=format_numbers(numbers), relative_to=relative_to)


def _link(link: UrdfLink, joint: UrdfJoint | None, names: dict[str, str]) -> Element:
    parts = []
    if joint is not None and joint.kind == "floating":
        parts.append(_pose(joint.origin, _frame(joint.parent)))
    elif joint is not None:
        parts.append(_pose(Pose(), names[joint.name]))
    inertia = link.body.inertia
    if inertia is not None:
        moments = [_number(key, value) for key, value in zip(_TENSOR, inertia.tensor, strict=True)]
        tensor = _element("inertia", *moments)
        parts.append(_element("inertial", _pose(inertia.origin), _number("mass", inertia.mass), tensor))
    for tag, shapes in (("visual", link.body.visuals), ("collision", link.body.collisions)):
        parts += [_shape(tag, f"{tag}_{k}", shape) for k, shape in enumerate(shapes)]
    return _element("link", *parts, line=link.line, name=link.name)


def _frame(link: str) -> str:
    """Return the frame of a link; the link "world" is the world, at the origin of the model."""
    return MODEL_FRAME if link == WORLD else link


def _shape(tag: str, name: str, shape: Shape) -> Element:
    parts = [_pose(shape.origin), _element("geometry", _geometry(shape.geometry))]
    if shape.color is not None:
        parts.append(_element("material", _number("diffuse", shape.color)))
    return _element(tag, *parts, name=shape.name or name)


def _geometry(form: Geometry) -> Element:
    if isinstance(form, Mesh):
        return _element("mesh", _element("uri", text=form.uri), _number("scale", form.scale))
    sizes = [_number(key, getattr(form, key)) for key in form.__struct_fields__]
    return _element(form.kind, *sizes)


def _joint(joint: UrdfJoint, names: dict[str, str], robot: UrdfRobot) -> Element:
    if joint.kind in ("planar", "spherical"):
        raise FormatError(
            f"{robot.source}, line {joint.line}, <joint name={quote(joint.name)}>: is {joint.kind}, which no "
            "joint of an SDF is. Load this file by itself."
        )
    parts = [_pose(joint.origin, _frame(joint.parent))]
    parts += [_element(role, text=link) for role, link in (("parent", joint.parent), ("child", joint.child))]
    if joint.axis is not None:
        parts.append(_axis(joint, joint.axis, names))
    return _element("joint", *parts, line=joint.line, name=names[joint.name], type=joint.kind)


def _axis(joint: UrdfJoint, xyz: Vector3, names: dict[str, str]) -> Element:
    limits, dynamics, mimic = joint.limits, joint.dynamics, joint.mimic
    bounds = {key: getattr(limits, key) for key in ("lower", "upper", "effort", "velocity")}
    parts = [
        _number("xyz", xyz),
        _element("limit", *(_number(key, value) for key, value in bounds.items() if value is not None)),
        _element("dynamics", _number("damping", dynamics.damping), _number("friction", dynamics.friction)),
    ]
    if mimic is not None:
        follows = (_number("multiplier", mimic.multiplier), _number("offset", mimic.offset))
        parts.append(_element("mimic", *follows, joint=names[mimic.leader]))
    return _element("axis", *parts)
