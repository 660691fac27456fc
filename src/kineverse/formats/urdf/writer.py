"""Models as URDF text.

Every frame becomes a link and every coordinate a joint of its name. A link that moves by several coordinates,
or about a line that does not pass through its origin, has intermediate links without body. A joint that moves
by a multiple of a coordinate mimics the joint of that coordinate.
"""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from msgspec.structs import replace

from kineverse.articulations.multi_axis import rotation_from_z
from kineverse.errors import list_some
from kineverse.formats.description import (
    IDENTITY_COEFFICIENTS,
    BallJointDescription,
    JointBounds,
    JointDescription,
    LinkDescription,
    Matrix,
    RobotDescription,
    WrittenFile,
    dynamics_number,
)
from kineverse.formats.export.capabilities import FormatCapabilities, UnsupportedFeatures
from kineverse.formats.export.link_tree import LinkTreeBuilder, check_rotation
from kineverse.formats.loader import check_readable
from kineverse.formats.names import TakenNames
from kineverse.formats.poses import IDENTITY, ROTATION_TOLERANCE, rpy_angles
from kineverse.formats.resource_paths import mesh_reference
from kineverse.formats.xml_writer import Tag, format_xml
from kineverse.lie import translation
from kineverse.model.body import (
    NO_BODY,
    Body,
    Box,
    Capsule,
    Cone,
    Cylinder,
    Ellipsoid,
    Geometry,
    Mesh,
    Pose,
    Rgba,
    Shape,
    Sphere,
)
from kineverse.model.frame import WORLD
from kineverse.model.model_view import ModelView
from kineverse.symbols import Symbol

from .kept_elements import KeptPartsWriter

_TENSOR = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")


class UrdfBodyWriter:
    """Writer of the bodies of one file."""

    def __init__(self, folder: Path, remarks: list[str], kept: KeptPartsWriter) -> None:
        self._folder = folder
        self._remarks = remarks
        self._kept = kept
        self._materials: dict[object, str] = {}
        self._appearances: dict[str, tuple[Rgba | None, str]] = {}

    def write(self, link: Tag, body: Body) -> None:
        """Add the elements of a body to its link."""
        name = link.attributes["name"]
        if body.inertia is not None:
            element = link.add("inertial")
            add_origin(element, body.inertia.origin)
            element.add("mass", value=body.inertia.mass)
            element.add("inertia", **dict(zip(_TENSOR, body.inertia.tensor, strict=True)))
        for k, shape in enumerate(body.visuals):
            visual = self._shape(link, "visual", shape, name)
            if visual is not None:
                self._material(visual, shape, *self._kept.visual_material(name, k))
        for shape in body.collisions:
            self._shape(link, "collision", shape, name)
            if shape.color is not None or shape.texture:
                self._remark(f"the colours of the collision shapes of '{name}' are left out")

    def _shape(self, link: Tag, tag: str, shape: Shape, name: str) -> Tag | None:
        if isinstance(shape.geometry, (Ellipsoid, Cone)):
            self._remark(f"URDF has no {shape.geometry.kind}: one of '{name}' is left out ({tag})")
            return None
        element = link.add(tag, name=shape.name or None)
        add_origin(element, shape.origin)
        self._geometry(element.add("geometry"), shape.geometry)
        return element

    def _geometry(self, element: Tag, form: Geometry) -> None:
        if isinstance(form, Box):
            element.add("box", size=form.size)
        elif isinstance(form, Cylinder):
            element.add("cylinder", radius=form.radius, length=form.length)
        elif isinstance(form, Capsule):
            element.add("capsule", radius=form.radius, length=form.length)
        elif isinstance(form, Sphere):
            element.add("sphere", radius=form.radius)
        elif isinstance(form, Mesh):
            scale = None if form.scale == (1.0, 1.0, 1.0) else form.scale
            element.add("mesh", filename=mesh_reference(form, self._folder, self._remark), scale=scale)

    def define_materials(self, root: Tag, bodies: Iterable[Body]) -> None:
        """Add the materials that the file that was read defined for the whole robot."""
        textured = {s.texture: s for body in bodies for s in body.visuals if s.texture}
        for material in self._kept.materials:
            element = root.add("material", name=material.name)
            look = material.color, material.texture
            shape = textured.get(material.texture, Shape(Mesh(""), texture=material.texture))
            self._define(element, material.color, shape)
            if look != (None, ""):
                self._appearances[material.name] = look

    def _material(self, visual: Tag, shape: Shape, name: str, is_defined: bool) -> None:
        look = shape.color, shape.texture
        if name and self._appearances.get(name, look) == look:
            element = visual.add("material", name=name)
            # What no element before has defined is defined here: that element may be gone.
            if is_defined or (name not in self._appearances and look != (None, "")):
                self._define(element, shape.color, shape)
                self._appearances[name] = look
            return
        if look == (None, ""):
            return
        folder = shape.geometry.folder if shape.texture and isinstance(shape.geometry, Mesh) else ""
        key = shape.color, shape.texture, folder
        # Equal materials share a name; different materials of one name are an error for some readers.
        if key not in self._materials:
            taken = {*self._appearances, *self._materials.values()}
            number = len(self._materials) + 1
            while f"material_{number}" in taken:
                number += 1
            self._materials[key] = f"material_{number}"
        self._define(visual.add("material", name=self._materials[key]), shape.color, shape)

    def _define(self, material: Tag, color: Rgba | None, shape: Shape) -> None:
        if color is not None:
            material.add("color", rgba=color)
        if shape.texture:
            material.add("texture", filename=self._texture(shape))

    def _texture(self, shape: Shape) -> str:
        if isinstance(shape.geometry, Mesh) and shape.geometry.folder:
            texture = replace(shape.geometry, uri=shape.texture)
            return mesh_reference(texture, self._folder, self._remark)
        if "://" not in shape.texture and not os.path.isabs(shape.texture):
            self._remark(f"the texture {shape.texture} is written as it is, relative to some other folder")
        return shape.texture

    def _remark(self, text: str) -> None:
        if text not in self._remarks:
            self._remarks.append(text)


def add_origin(element: Tag, pose: Pose) -> None:
    """Add the ``<origin>`` of an element, unless it is the identity."""
    if pose == IDENTITY:
        return
    matrix = pose.matrix
    rpy = rpy_angles(matrix)
    element.add("origin", xyz=matrix[:3, 3].tolist(), rpy=None if rpy == (0.0, 0.0, 0.0) else rpy)


URDF_CAPABILITIES = FormatCapabilities("URDF", keeps_urdf_elements=True)
LARGEST_FLOAT = sys.float_info.max  # number written in place of no limit, where URDF requires a number

_NEWER = ("acceleration", "deceleration", "jerk")
_KNOWN = frozenset(("effort", "damping", "friction", "k_position", "k_velocity", *_NEWER))


def to_urdf(
    model: ModelView,
    path: Path,
    leave_out: Iterable[str] = (),
    tolerance: float | None = None,
    strict: bool = False,
    loose: bool = False,
) -> WrittenFile:
    """Convert a model to URDF.

    With ``loose``, links are the frames of the model and no others, for readers that have the poses from
    elsewhere: what moves as no single joint of URDF is a floating joint, at home where the model is.
    """
    builder = LinkTreeBuilder(model, URDF_CAPABILITIES, leave_out, tolerance, strict, loose)
    description = builder.build()
    if loose:
        _loosen_links(description)
    elif lost := list(_lost_homes(description, builder.home_positions())):
        description.remarks.append(
            f"URDF has no default positions: those of {list_some(lost, 4)} are left out"
        )
    kept = KeptPartsWriter({} if loose else model.data)
    content = UrdfWriter(description, path, builder.unsupported, kept).document()
    check_readable(content, path)
    return WrittenFile(content, tuple(description.remarks), description.errors, builder.unsupported.left_out)


def _lost_homes(description: RobotDescription, values: Mapping[str, float]) -> Iterator[str]:
    """Yield the joints that a reader of URDF has elsewhere by default than at home."""
    for link in description.links:
        for joint in link.joints:
            if isinstance(joint, BallJointDescription):
                if any(values.get(f"{joint.name}/{c}", 0.0) for c in ("qx", "qy", "qz")):
                    yield joint.name
            elif joint.is_independent and joint.name in values:
                lower, upper = joint.bounds.soft or (-math.inf, math.inf)
                if values[joint.name] != min(max(joint.bounds.home, lower), upper):
                    yield joint.name


def _loosen_links(description: RobotDescription) -> None:
    """Have all links loose that more than one joint of URDF would move, or one that mimics their joints."""
    single: set[Symbol] = set()
    for link in description.links:
        joints = [joint for joint in link.joints if isinstance(joint, JointDescription)]
        is_single = len(joints) == len(link.joints) == 1 and not any(joints[0].point)
        if link.joints and not is_single:
            link.is_loose = True
        elif is_single and joints[0].is_independent:
            single.add(joints[0].symbol)
    for link in description.links:
        if any(isinstance(joint, JointDescription) and joint.symbol not in single for joint in link.joints):
            link.is_loose = True


class UrdfWriter:
    """Writer of one robot description as URDF."""

    def __init__(
        self,
        description: RobotDescription,
        path: Path,
        unsupported: UnsupportedFeatures,
        kept: KeptPartsWriter,
    ) -> None:
        self._kept = kept
        self._description, self._path, self._unsupported = description, path, unsupported
        self._links = TakenNames([WORLD, *(link.name for link in description.links)])
        fixed = [link.fixed_joint_name for link in description.links]
        self._joints = TakenNames([*fixed, *(joint.name for joint in description.joints)])
        self._bodies = UrdfBodyWriter(path.absolute().parent, description.remarks, kept)
        name = kept.robot or path.name.removesuffix(path.suffix) or "model"
        self._root = Tag("robot", {"name": name, **kept.namespaces})

    def document(self) -> bytes:
        """Return the text of the file."""
        links = self._description.links
        root = self._root_link()
        self._bodies.define_materials(self._root, [self._description.world_body, *(k.body for k in links)])
        if root is None:
            self._bodies.write(self._root.add("link", name=WORLD), self._description.world_body)
        for link in links:
            self._link(link, link is root)
        self._unsupported.check(self._path.name)
        self._description.remarks += [*self._kept.add_elements(self._root), *self._unsupported.remarks]
        self._root.give("version", self._version())
        return format_xml(self._root, [*self._description.remarks, *self._description.error_lines])

    def _version(self) -> str | None:
        """Return the version of URDF that the file needs; None for the first, which all parsers read."""
        tags = list(self._root.inside)
        for tag in tags:
            tags += tag.inside
        limits = [tag.attributes for tag in tags if tag.name == "limit"]
        if any(key in attributes for attributes in limits for key in _NEWER):
            return "1.2"
        if any(tag.name == "capsule" for tag in tags):
            # urdfdom passes over all shapes of a link with a capsule in a file of version 1.0.
            self._description.remarks.append(
                "the capsules need version 1.1 of URDF, which urdfdom reads since 5.1 only"
            )
            return "1.1"
        return None

    def _root_link(self) -> LinkDescription | None:
        roots = [link for link in self._description.links if link.parent == WORLD]
        if len(roots) != 1 or self._description.world_body != NO_BODY:
            return None
        if (
            roots[0].joints
            or roots[0].is_loose
            or roots[0].is_articulation
            or not np.array_equal(roots[0].pose, np.eye(4))
        ):
            return None
        return roots[0]

    def _link(self, link: LinkDescription, is_root: bool) -> None:
        check_rotation(link, self._unsupported)
        if is_root:
            self._bodies.write(self._root.add("link", name=link.name), link.body)
            return
        parent, pose = link.parent, link.pose
        compound = self._compound(link)
        if compound is None and link.is_loose:
            self._bodies.write(self._root.add("link", name=link.name), link.body)
            name = self._joints.take(link.name, f"{link.name}/floating")
            self._description.remarks.append(
                f"'{link.name}' is floating, as no single joint of URDF moves so"
            )
            self._joint(name, "floating", parent, link.name, pose)
            return
        if compound is not None:
            name, kind, axis = compound
            self._bodies.write(self._root.add("link", name=link.name), link.body)
            element = self._joint(name, kind, parent, link.name, pose, axis)
            bounds = JointBounds()
            if isinstance(link.joints[0], JointDescription):
                bounds = link.joints[0].bounds
            self._limit(element, name, kind, bounds, link.dynamics)
            self._dynamics(element, name, link.dynamics)
            return
        if link.dynamics:
            self._description.remarks.append(
                f"'{link.name}' is moved by several joints in URDF: "
                f"the {' and '.join(link.dynamics)} of all is left out"
            )
        offset = np.zeros(3)
        for k, joint in enumerate(link.joints):
            if isinstance(joint, BallJointDescription):
                self._unsupported.refuse(
                    joint.name, "turns by a quaternion, which URDF has for free motion only"
                )
                return
            point = np.array(joint.point) if joint.is_rotation else offset
            last = k == len(link.joints) - 1 and not point.any()
            child = link.name if last else self._links.take(f"{link.name}/{joint.name.rpartition('/')[2]}")
            element = self._root.add("link", name=child)
            if last:
                self._bodies.write(element, link.body)
            self._axis_joint(joint, parent, child, pose @ translation(point - offset))
            parent, pose, offset = child, np.eye(4), point
        if offset.any() or not link.joints:
            name = link.fixed_joint_name or self._joints.take(f"{link.name}/fixed")
            self._bodies.write(self._root.add("link", name=link.name), link.body)
            self._joint(name, "fixed", parent, link.name, pose @ translation(-offset))

    def _compound(self, link: LinkDescription) -> tuple[str, str, tuple[float, ...] | None] | None:
        """Return name, type and axis of the floating or planar joint that moves a link; None for others."""
        if len(link.joints) not in (3, 4) or self._description.has_followers(link):
            return None
        axes = [j for j in link.joints if isinstance(j, JointDescription)]
        if any(not j.is_independent or j.dynamics or j.bounds.soft is not None for j in axes):
            return None
        names, bounds = [j.name for j in axes], [j.bounds for j in axes]
        if len(link.joints) == 4:
            free = link.free_motion
            return (free, "floating", None) if free and bounds == [JointBounds()] * 3 else None
        if (
            len(axes) != 3
            or bounds[0] != bounds[1]
            or bounds[2] != JointBounds()
            or not bounds[0].max_velocity > 0
        ):
            return None
        name, n = names[2].removesuffix("/angle"), axes[2].axis
        rotation = rotation_from_z(n)
        first, second = (tuple((rotation[:3, k] + 0.0).tolist()) for k in (0, 1))
        flat = [(f"{name}/x", False, first), (f"{name}/y", False, second), (f"{name}/angle", True, n)]
        same = all(
            a[:2] == b[:2] and np.abs(np.subtract(a[2], b[2])).max() < ROTATION_TOLERANCE
            for a, b in zip(flat, map(_axis_key, axes), strict=True)
        )
        return (name, "planar", n) if same and not any(axes[2].point) else None

    def _axis_joint(self, joint: JointDescription, parent: str, child: str, pose: Matrix) -> None:
        kind = "prismatic"
        if joint.is_rotation:
            kind = "continuous" if joint.bounds.is_unbounded else "revolute"
        element = self._joint(joint.name, kind, parent, child, pose, joint.axis)
        self._limit(element, joint.name, kind, joint.bounds, joint.dynamics)
        if joint.coefficients != IDENTITY_COEFFICIENTS or not joint.is_independent:
            offset, factor = (*joint.coefficients, 0.0)[:2]
            element.add(
                "mimic", joint=joint.symbol.path, multiplier=factor, offset=offset if offset else None
            )
        soft = joint.bounds.soft
        if soft is not None and kind == "continuous":
            self._unsupported.leave_out(
                f"{joint.name}/soft_limits", "are soft limits of a joint that has no others"
            )
            soft = None
        self._dynamics(element, joint.name, joint.dynamics, soft)

    def _dynamics(
        self, element: Tag, name: str, known: Mapping[str, Any], soft: tuple[float, float] | None = None
    ) -> None:
        if known.get("damping") or known.get("friction"):
            element.add(
                "dynamics",
                damping=dynamics_number(known, "damping"),
                friction=dynamics_number(known, "friction"),
            )
        if soft is not None or "k_velocity" in known:
            lower, upper = soft or (None, None)
            element.add(
                "safety_controller",
                soft_lower_limit=lower,
                soft_upper_limit=upper,
                k_position=dynamics_number(known, "k_position"),
                k_velocity=dynamics_number(known, "k_velocity") or 0.0,
            )
        for key in known:
            if key not in _KNOWN:
                self._description.remarks.append(f"URDF has no {key}: that of '{name}' is left out")

    def _limit(
        self, element: Tag, name: str, kind: str, bounds: JointBounds, known: Mapping[str, Any]
    ) -> None:
        effort, max_velocity = dynamics_number(known, "effort"), bounds.max_velocity
        newer = {key: dynamics_number(known, key) for key in _NEWER}
        has_range = kind in ("revolute", "prismatic") or not bounds.is_unbounded
        if not has_range and effort is None and max_velocity == math.inf and not any(newer.values()):
            return
        if not max_velocity > 0:
            self._unsupported.refuse(name, "may not move at all, by a limit of its speed that is 0")
        limit = element.add("limit")
        if has_range:
            limit.give("lower", max(bounds.lower, -LARGEST_FLOAT))
            limit.give("upper", min(bounds.upper, LARGEST_FLOAT))
        limit.give("effort", LARGEST_FLOAT if effort is None else min(effort, LARGEST_FLOAT))
        limit.give("velocity", min(max_velocity, LARGEST_FLOAT))
        for key, value in newer.items():
            limit.give(key, value)

    def _joint(
        self, name: str, kind: str, parent: str, child: str, pose: Matrix, axis: Iterable[float] | None = None
    ) -> Tag:
        element = self._root.add("joint", name=name, type=kind)
        xyz, rpy = pose[:3, 3].tolist(), rpy_angles(pose)
        if any(xyz) or any(rpy):
            element.add("origin", xyz=xyz, rpy=rpy if any(rpy) else None)
        element.add("parent", link=parent)
        element.add("child", link=child)
        if axis is not None:
            element.add("axis", xyz=axis)
        return element


def _axis_key(joint: JointDescription) -> tuple[str, bool, tuple[float, ...]]:
    return joint.name, joint.is_rotation, joint.axis
