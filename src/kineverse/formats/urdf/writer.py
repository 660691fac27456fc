"""Models as URDF text.

Every frame is a link and every coordinate a joint of its name. What moves by several coordinates, or about a
line that does not pass through its origin, hangs on links in between that carry nothing; what moves by a
multiple of a coordinate mimics it.
"""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from kineverse._gc import no_collection
from kineverse.articulations.multi_axis import rotation_from_z
from kineverse.errors import FormatError, KineverseError
from kineverse.formats.description import (
    IDENTITY_COEFFICIENTS,
    NO_BODY,
    BallJointDescription,
    JointDescription,
    LinkDescription,
    RobotDescription,
    WrittenFile,
)
from kineverse.formats.export.capabilities import FormatCapabilities, UnsupportedFeatures
from kineverse.formats.export.link_tree import LinkTreeBuilder
from kineverse.formats.export.mesh_paths import mesh_reference
from kineverse.formats.export.poses import ROTATION_TOLERANCE, rotation_deviation, rpy_angles
from kineverse.formats.names import TakenNames
from kineverse.formats.reader_warnings import collect_warnings
from kineverse.formats.urdf.operations import urdf_operations
from kineverse.formats.urdf.reader import parse_urdf
from kineverse.formats.xml_writer import Tag, format_xml
from kineverse.lie import translation
from kineverse.model.body import (
    Body,
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
from kineverse.model.frame import WORLD
from kineverse.model.model import Model
from kineverse.model.model_view import ModelView

_IDENTITY = Pose()
_TENSOR = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")


class UrdfBodyWriter:
    """Writes the bodies of one file.

    Parameters
    ----------
    folder
        Where the file will lie.
    remarks
        What is left out is said here.
    """

    def __init__(self, folder: Path, remarks: list[str]) -> None:
        self._folder = folder
        self._remarks = remarks
        self._materials: dict[object, str] = {}

    def write(self, link: Tag, body: Body) -> None:
        """Put a body into the element of its link."""
        name = link.attributes["name"]
        if body.inertia is not None:
            _add_inertia(link, body.inertia)
        for shape in body.visuals:
            visual = self._shape(link, "visual", shape, name)
            if visual is not None:
                self._material(visual, shape)
        for shape in body.collisions:
            self._shape(link, "collision", shape, name)
            if shape.color is not None or shape.texture:
                self._remark(f"the colours of what is to be touched of '{name}' are left out")

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

    def _material(self, visual: Tag, shape: Shape) -> None:
        if shape.color is None and not shape.texture:
            return
        folder = shape.geometry.folder if shape.texture and isinstance(shape.geometry, Mesh) else ""
        key = shape.color, shape.texture, folder
        # Equal ones share a name, because a name that means two things is an error for some readers.
        name = self._materials.setdefault(key, f"material_{len(self._materials) + 1}")
        material = visual.add("material", name=name)
        if shape.color is not None:
            material.add("color", rgba=shape.color)
        if shape.texture:
            material.add("texture", filename=self._texture(shape))

    def _texture(self, shape: Shape) -> str:
        """Return what the file calls a texture; where a relative one is, only a mesh beside it knows."""
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
    """Say where something is, unless it is where it is by default."""
    if pose == _IDENTITY:
        return
    matrix = pose.matrix
    turned = rpy_angles(matrix)
    element.add("origin", xyz=matrix[:3, 3].tolist(), rpy=None if turned == (0.0, 0.0, 0.0) else turned)


def _add_inertia(link: Tag, inertia: Inertia) -> None:
    element = link.add("inertial")
    add_origin(element, inertia.origin)
    element.add("mass", value=inertia.mass)
    element.add("inertia", **dict(zip(_TENSOR, inertia.tensor, strict=True)))


Matrix = npt.NDArray[np.float64]

URDF_CAPABILITIES = FormatCapabilities("URDF")
LARGEST_FLOAT = sys.float_info.max
"""Stands for no limit at all, where URDF wants a number."""

_NEWER = ("acceleration", "deceleration", "jerk")
_KNOWN = frozenset(("effort", "damping", "friction", "k_position", "k_velocity", *_NEWER))
_SPACE = (("x", (1.0, 0.0, 0.0)), ("y", (0.0, 1.0, 0.0)), ("z", (0.0, 0.0, 1.0)))


def to_urdf(
    model: ModelView,
    path: Path,
    leave_out: Iterable[str] = (),
    tolerance: float | None = None,
    strict: bool = False,
) -> WrittenFile:
    """Return the text of a file, and what it says other than the model, or not at all.

    Parameters
    ----------
    model
        The model.
    path
        Where the file will lie; its name becomes that of the robot, and meshes are named from there.
    leave_out
        Names of constraints that are not to be said, and of articulations whose speeds are not.
    tolerance
        How far frames may be off where motions are approximated [m], [rad]; None for no approximation.
    strict
        Whether constraints that it cannot say are refused, rather than left out with a remark.

    Raises
    ------
    FormatError
        Naming what URDF cannot say, and why; or if the result could not be read again.
    """
    recognition = LinkTreeBuilder(model, URDF_CAPABILITIES, leave_out, tolerance, strict)
    plan = recognition.plan()
    content = UrdfWriter(plan, path, recognition.refusals).document()
    _check_read_back(content, path)
    return WrittenFile(content, tuple(plan.remarks), plan.errors, recognition.refusals.left_out)


def _check_read_back(content: bytes, path: Path) -> None:
    """Read again what was written.

    Raises
    ------
    FormatError
        If there is something wrong with it.
    """
    model = Model()
    try:
        with collect_warnings(), model.edit() as edit, no_collection():
            robot = parse_urdf(content, path.name, str(path.absolute().parent))
            for operation in urdf_operations(robot):
                edit.apply(operation)
    except KineverseError as error:
        raise FormatError(f"What would be written cannot be read again: {error}") from error


class UrdfWriter:
    """Writes one plan."""

    def __init__(self, plan: RobotDescription, path: Path, refusals: UnsupportedFeatures) -> None:
        self._plan, self._path, self._refusals = plan, path, refusals
        self._links = TakenNames([WORLD, *(link.name for link in plan.links)])
        self._joints = TakenNames(
            [*(link.label for link in plan.links), *(joint.name for joint in plan.joints)]
        )
        self._bodies = UrdfBodyWriter(path.absolute().parent, plan.remarks)
        self._root = Tag("robot", {"name": path.name.removesuffix(path.suffix) or "model"})

    def document(self) -> bytes:
        """Return the text.

        Raises
        ------
        FormatError
            Naming what URDF cannot say.
        """
        links = self._plan.links
        if any(key in joint.dynamics for joint in self._plan.joints for key in _NEWER):
            self._root.give("version", "1.2")
        root = self._root_link()
        if root is None:
            self._bodies.write(self._root.add("link", name=WORLD), self._plan.world)
        for link in links:
            self._link(link, link is root)
        self._refusals.check(self._path.name)
        self._plan.remarks += self._refusals.remarks
        return format_xml(self._root, [*self._plan.remarks, *self._plan.error_lines])

    def _root_link(self) -> LinkDescription | None:
        """Return the link that is where the world is and carries all others, if there is one."""
        below = [link for link in self._plan.links if link.parent == WORLD]
        if len(below) != 1 or self._plan.world != NO_BODY:
            return None
        if below[0].joints or below[0].recorded or not np.array_equal(below[0].pose, np.eye(4)):
            return None
        return below[0]

    def _link(self, link: LinkDescription, is_root: bool) -> None:
        if rotation_deviation(link.pose) > ROTATION_TOLERANCE:
            self._refusals.add(
                link.name,
                f"is turned by a constant that is off by {rotation_deviation(link.pose):.2g} from any rotation",
            )
        if is_root:
            self._bodies.write(self._root.add("link", name=link.name), link.body)
            return
        parent, pose = link.parent, link.pose
        compound = self._compound(link)
        if compound is not None:
            name, kind, axis = compound
            self._bodies.write(self._root.add("link", name=link.name), link.body)
            self._joint(name, kind, parent, link.name, pose, axis)
            return
        at = np.zeros(3)
        for k, joint in enumerate(link.joints):
            if isinstance(joint, BallJointDescription):
                self._refusals.add(joint.name, "turns by a quaternion, which URDF has for free motion only")
                return
            point = np.array(joint.point) if joint.turns else at
            last = k == len(link.joints) - 1 and not point.any()
            child = link.name if last else self._links.take(f"{link.name}/{joint.name.rpartition('/')[2]}")
            element = self._root.add("link", name=child)
            if last:
                self._bodies.write(element, link.body)
            self._axis_joint(joint, parent, child, pose @ translation(point - at))
            parent, pose, at = child, np.eye(4), point
        if at.any() or not link.joints:
            name = link.label or self._joints.take(f"{link.name}/fixed")
            self._bodies.write(self._root.add("link", name=link.name), link.body)
            self._joint(name, "fixed", parent, link.name, pose @ translation(-at))

    def _compound(self, link: LinkDescription) -> tuple[str, str, tuple[float, ...] | None] | None:
        """Return name, kind and axis of a joint with several coordinates, if the link moves by one."""
        if len(link.joints) not in (3, 4):
            return None
        axes = [j for j in link.joints if isinstance(j, JointDescription)]
        if any(not j.leads or not _is_plain(j) for j in axes):
            return None
        names = [j.name for j in axes]
        ball = link.joints[-1]
        if isinstance(ball, BallJointDescription) and len(axes) == 3 and not any(ball.point):
            free = [(f"{ball.name}/{c}", False, axis) for c, axis in _SPACE]
            return (ball.name, "floating", None) if free == [_axis_key(j) for j in axes] else None
        if len(axes) != 3 or len(link.joints) != 3:
            return None
        name, n = names[2].removesuffix("/angle"), axes[2].axis
        turn = rotation_from_z(n)
        first, second = (tuple((turn[:3, k] + 0.0).tolist()) for k in (0, 1))
        flat = [(f"{name}/x", False, first), (f"{name}/y", False, second), (f"{name}/angle", True, n)]
        same = all(
            a[:2] == b[:2] and np.abs(np.subtract(a[2], b[2])).max() < ROTATION_TOLERANCE
            for a, b in zip(flat, map(_axis_key, axes), strict=True)
        )
        return (name, "planar", n) if same and not any(axes[2].point) else None

    def _axis_joint(self, joint: JointDescription, parent: str, child: str, pose: Matrix) -> None:
        kind = "prismatic" if not joint.turns else "continuous" if joint.bounds.open else "revolute"
        element = self._joint(joint.name, kind, parent, child, pose, joint.axis)
        self._limit(element, joint, kind)
        if joint.amount != IDENTITY_COEFFICIENTS or not joint.leads:
            offset, factor = (*joint.amount, 0.0)[:2]
            element.add(
                "mimic", joint=joint.symbol.path, multiplier=factor, offset=offset if offset else None
            )
        known = joint.dynamics
        if known.get("damping") or known.get("friction"):
            element.add("dynamics", damping=_number(known, "damping"), friction=_number(known, "friction"))
        soft = joint.bounds.soft
        if soft is not None and kind == "continuous":
            self._refusals.leave(f"{joint.name}/soft_limits", "are soft limits of a joint that has no others")
            soft = None
        if soft is not None or "k_velocity" in known:
            lower, upper = soft or (None, None)
            element.add(
                "safety_controller",
                soft_lower_limit=lower,
                soft_upper_limit=upper,
                k_position=_number(known, "k_position"),
                k_velocity=_number(known, "k_velocity") or 0.0,
            )
        for key in known:
            if key not in _KNOWN:
                self._plan.remarks.append(f"URDF has no {key}: that of '{joint.name}' is left out")

    def _limit(self, element: Tag, joint: JointDescription, kind: str) -> None:
        bounds, known = joint.bounds, joint.dynamics
        effort, fastest = _number(known, "effort"), bounds.fastest
        newer = {key: _number(known, key) for key in _NEWER}
        if kind == "continuous" and effort is None and fastest == math.inf and not any(newer.values()):
            return
        if not fastest > 0:
            self._refusals.add(joint.name, "may not move at all, by a limit of its speed that is 0")
        limit = element.add("limit")
        if kind != "continuous":
            limit.give("lower", max(bounds.lower, -LARGEST_FLOAT))
            limit.give("upper", min(bounds.upper, LARGEST_FLOAT))
        limit.give("effort", LARGEST_FLOAT if effort is None else min(effort, LARGEST_FLOAT))
        limit.give("velocity", min(fastest, LARGEST_FLOAT))
        for key, value in newer.items():
            limit.give(key, value)

    def _joint(
        self,
        name: str,
        kind: str,
        parent: str,
        child: str,
        pose: Matrix,
        axis: Iterable[float] | None = None,
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
    return joint.name, joint.turns, joint.axis


def _is_plain(joint: JointDescription) -> bool:
    """Whether nothing limits a joint: URDF has no limits of joints with several coordinates."""
    bounds = joint.bounds
    return bounds.open and bounds.soft is None and bounds.fastest == math.inf and not joint.dynamics


def _number(known: object, key: str) -> float | None:
    value = known.get(key) if isinstance(known, dict) else None
    return float(value) if isinstance(value, (int, float)) and not math.isnan(value) else None
