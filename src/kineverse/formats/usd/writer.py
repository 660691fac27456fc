"""Models as USD: a robot of UsdPhysics, and the document of the model.

A frame that moves, or has a body, becomes a rigid body below the default prim; any other frame is a plain
transform below the body that carries it. A coordinate becomes a joint of its name, and the axis of a joint is
z of the joint's frames. A link that moves by several coordinates has bodies in between, unless one generic
joint has the same motion in every engine: slides along perpendicular lines, and one turn about one of them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from kineverse.errors import FormatError
from kineverse.formats.description import (
    BallJointDescription,
    JointDescription,
    LinkDescription,
    LoopJoint,
    Matrix,
    RobotDescription,
    WrittenFile,
)
from kineverse.formats.document.writer import to_json
from kineverse.formats.export.capabilities import FormatCapabilities, UnsupportedFeatures
from kineverse.formats.export.link_tree import LinkTreeBuilder, check_rotation
from kineverse.formats.names import TakenNames
from kineverse.lie import axis_angle, quaternion, rotation_along_z, round_exact, transform, translation
from kineverse.model.body import NO_BODY, is_empty_body
from kineverse.model.frame import WORLD
from kineverse.model.model_view import ModelView

from .body_writer import PrimNames, UsdBodyWriter
from .embedded_document import DOCUMENT_PRIM, embed_document
from .kinematics import StagePoses
from .pxr_api import (
    COEFFICIENTS,
    COORDINATE,
    DEPENDENT,
    FREE,
    HOME,
    LARGEST_FLOAT,
    LEADER,
    LOOP,
    NAME,
    ROTATIONS,
    TRANSLATIONS,
    pxr,
    set_text,
    to_gf_matrix,
    to_gf_quaternion,
)
from .scene import read_scene

USD_CAPABILITIES = FormatCapabilities("UsdPhysics", loop_joints=True)

READ_BACK_TOLERANCE = 1e-4
"""Largest deviation of a pose that is read back [m], [rad]: some hundred times what single precision makes of
a chain of thirty joints, and far below what a wrong frame or sign makes of any."""

_Joint = JointDescription | BallJointDescription
_PASSIVE = ("friction", "armature")  # those of Newton's schema
_KNOWN = (
    "effort",
    "damping",
    "friction",
    "armature",
    "spring_stiffness",
    "spring_reference",
    "stiffness",
    "rest",
)
_ALIGNED = 1e-9  # largest deviation of the axes of a generic joint from those of a frame


def to_usd(
    model: ModelView,
    path: Path,
    leave_out: Iterable[str] = (),
    tolerance: float | None = None,
    strict: bool = False,
) -> WrittenFile:
    """Convert a model to USD, with its document inside.

    A motion that no joint of UsdPhysics has is refused with ``strict``. Otherwise the body is kinematic, at
    home where the model is: readers of the document lose nothing.
    """
    pxr()  # the error about what is missing comes first
    leave_out = (leave_out,) if isinstance(leave_out, str) else tuple(leave_out)
    document = to_json(model)
    builder = LinkTreeBuilder(model, USD_CAPABILITIES, leave_out, tolerance, strict)
    description = builder.build()
    if builder.unsupported and not strict:
        refused = builder.unsupported.refused
        builder = LinkTreeBuilder(
            model, USD_CAPABILITIES, leave_out, tolerance, strict, loose=True, carriers=True
        )
        description = builder.build()
        for link in description.links:
            if link.is_loose:
                builder.unsupported.leave_out_motion(
                    link.name, refused.get(link.name, "is carried by nothing")
                )
    home = builder.home_positions()
    writer = UsdWriter(description, path, builder.unsupported, home, leave_out)
    stage = writer.stage()
    _check_read_back(stage, writer.home_poses, home)
    embed_document(stage, document)
    if description.remarks:
        description.remarks.insert(
            0, "the document in the file has all of the model, other tools see less of it:"
        )
    known = tuple(description.remarks), description.errors, builder.unsupported.left_out
    return WrittenFile(_content(stage, path), *known)


def _content(stage: Any, path: Path) -> bytes:
    layer = stage.GetRootLayer()
    if path.suffix == ".usda":
        text: str = layer.ExportToString()
        return text.encode()
    with TemporaryDirectory() as folder:  # OpenUSD writes binary files by their names only
        file = Path(folder, f"stage{path.suffix}")
        layer.Export(str(file))
        return file.read_bytes()


def _check_read_back(stage: Any, expected: Mapping[str, Matrix], home: Mapping[str, float]) -> None:
    """Compare the poses at home of what USD reads with those that were meant."""
    poses = StagePoses(read_scene(stage, "what would be written"))
    found = poses.at(home)
    for name, pose in expected.items():
        if any(ord(character) < 32 for character in name):  # readers replace these
            continue
        error = float(np.abs(found[name] - pose).max()) if name in found else math.inf
        size = max(1.0, float(np.abs(pose[:3, 3]).max()))  # single precision is relative to the distance
        if not error <= READ_BACK_TOLERANCE * size:
            raise FormatError(
                f"What would be written places '{name}' elsewhere than the model, by {error:g} m."
            )


@dataclass(frozen=True)
class _Carrier:
    """Prim that carries a frame, and the pose of the frame in it; the world's is the default prim."""

    path: Any
    pose: Matrix

    def at(self, pose: Matrix) -> _Carrier:
        """Return the carrier of a frame that has a pose in this one."""
        return _Carrier(self.path, self.pose @ pose)


class UsdWriter:
    """Writer of one description.

    ``home`` is the home position of every coordinate, by its path. ``left_out`` are articulations whose
    followers may move freely.
    """

    def __init__(
        self,
        description: RobotDescription,
        path: Path,
        unsupported: UnsupportedFeatures,
        home: Mapping[str, float],
        left_out: Sequence[str] = (),
    ) -> None:
        self._description, self._unsupported, self._home = description, unsupported, home
        self._left_out = left_out
        self._file = path.name
        self._api = pxr()
        self._stage = self._api.Usd.Stage.CreateInMemory()
        self._names = PrimNames("joints", WORLD, DOCUMENT_PRIM)
        self._joint_names = PrimNames()
        self._link_names = TakenNames([WORLD, *(link.name for link in description.links)])
        self._bodies = UsdBodyWriter(self._stage, description.remarks)
        identifier = PrimNames().take(path.name.removesuffix(path.suffix) or "model")
        self._root = self._api.UsdGeom.Xform.Define(self._stage, f"/{identifier}").GetPrim()
        self._carriers = {WORLD: _Carrier(self._root.GetPath(), np.eye(4))}
        self._joint_paths: dict[str, Any] = {}
        self.home_poses: dict[str, Matrix] = {WORLD: np.eye(4)}
        joints = description.joints
        self._leaders = {j.symbol: j for j in joints if j.is_independent}
        self._led = {j.symbol.path for j in joints if not j.is_independent}

    def stage(self) -> Any:
        """Return the stage without the document."""
        api, stage = self._api, self._stage
        stage.SetDefaultPrim(self._root)
        api.Usd.ModelAPI(self._root).SetKind("component")
        api.UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        api.UsdGeom.SetStageUpAxis(stage, api.UsdGeom.Tokens.z)
        api.UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)
        joints = api.UsdGeom.Scope.Define(stage, self._root.GetPath().AppendChild("joints")).GetPrim()
        if not is_empty_body(self._description.world_body):
            world = api.UsdGeom.Xform.Define(stage, self._root.GetPath().AppendChild(WORLD)).GetPrim()
            self._bodies.write(world, self._description.world_body, WORLD, moves=False)
        for link in self._description.links:
            self._link(link)
        for joint in self._description.joints:
            self._mimic(joint)
        for loop in self._description.loops:
            self._loop(loop)
        if joints.GetChildren():
            api.UsdPhysics.ArticulationRootAPI.Apply(self._root)
        self._unsupported.check(self._file)
        self._description.remarks += self._unsupported.remarks
        for name, error in self._description.errors.items():
            if error.position or error.angle:
                self._description.remarks.append(f"approximated: '{name}' is off by {error} at most")
        del self.home_poses[WORLD]
        return stage

    def _link(self, link: LinkDescription) -> None:
        check_rotation(link, self._unsupported)
        parent = self._carriers[link.parent]
        pose = self.home_poses[link.parent] @ link.pose
        for joint in link.joints:
            pose = pose @ self._motion(joint)
        self.home_poses[link.name] = pose
        moves = bool(link.joints) or link.is_loose
        if not moves and link.body == NO_BODY and not link.is_articulation:
            self._plain_frame(link, parent)
            return
        prim = self._body_prim(link.name, pose)
        self._carriers[link.name] = _Carrier(prim.GetPath(), np.eye(4))
        self._bodies.write(prim, link.body, link.name, moves=True)
        if link.is_loose:
            self._api.UsdPhysics.RigidBodyAPI(prim).CreateKinematicEnabledAttr(True)
            return
        free = link.free_motion
        motion = [f"{free}/{c}" for c in ("x", "y", "z", "qx", "qy", "qz", "qw")]
        if free and parent.path == self._root.GetPath() and self._led.isdisjoint(motion):
            set_text(prim, FREE, free)
            home = [self._home[name] for name in motion]
            prim.CreateAttribute(HOME, self._api.Sdf.ValueTypeNames.DoubleArray, True).Set(home)
            return
        if not moves:
            child = self._carriers[link.name]
            self._joint("Fixed", link.fixed_joint_name, parent.at(link.pose), child)
            return
        if link.dynamics:
            self._description.remarks.append(
                f"the {' and '.join(link.dynamics)} of all joints of '{link.name}' together is left out"
            )
        self._joints(link, parent)

    def _plain_frame(self, link: LinkDescription, parent: _Carrier) -> None:
        identifier = self._names.take(link.name)  # unique in the stage, as tools search prims by name alone
        path = parent.path.AppendChild(identifier)
        xform = self._api.UsdGeom.Xform.Define(self._stage, path)
        self._carriers[link.name] = parent.at(link.pose)
        xform.AddTransformOp().Set(to_gf_matrix(self._carriers[link.name].pose))
        set_text(xform.GetPrim(), NAME, link.name)

    def _body_prim(self, name: str, pose: Matrix) -> Any:
        path = self._root.GetPath().AppendChild(self._names.take(name))
        xform = self._api.UsdGeom.Xform.Define(self._stage, path)
        xform.AddTransformOp().Set(to_gf_matrix(pose))
        self._api.UsdPhysics.RigidBodyAPI.Apply(xform.GetPrim())
        set_text(xform.GetPrim(), NAME, name)
        return xform.GetPrim()

    def _motion(self, joint: _Joint) -> Matrix:
        """Return the motion of a joint from 0 to home, in coordinates of its link."""
        if isinstance(joint, BallJointDescription):
            turn = quaternion(np.array([self._home[f"{joint.name}/q{c}"] for c in "xyzw"]))
        else:
            amount = np.polynomial.polynomial.polyval(self._home[joint.symbol.path], joint.coefficients)
            if not joint.is_rotation:
                return np.asarray(translation(amount * np.array(joint.axis)))
            turn = axis_angle(np.array(joint.axis), np.asarray(amount))
        point = np.array(joint.point)
        return np.asarray(transform(turn, point - turn @ point))

    # -- joints ----------------------------------------------------------------------------------------------

    def _joints(self, link: LinkDescription, parent: _Carrier) -> None:
        """Add the joints of a link, and bodies in between if one joint does not have its motion."""
        generic = self._generic_axes(link.joints)
        groups = [[joint] for joint in link.joints] if generic is None else [link.joints]
        carrier, world = parent.at(link.pose), self.home_poses[link.parent] @ link.pose
        for k, joints in enumerate(groups):
            for joint in joints:
                world = world @ self._motion(joint)
            if k == len(groups) - 1:
                child = self._carriers[link.name]
            else:
                name = self._link_names.take(f"{link.name}/{joints[-1].name.rpartition('/')[2]}")
                prim = self._body_prim(name, world)
                self._bodies.write(prim, NO_BODY, name, moves=True)
                child = _Carrier(prim.GetPath(), np.eye(4))
            if generic is not None:
                self._generic(joints, *generic, carrier, child)
            else:
                self._single(joints[0], carrier, child)
            carrier = child

    def _generic_axes(self, joints: Sequence[_Joint]) -> tuple[Matrix, dict[str, _Joint]] | None:
        """Return the rotation of a generic joint's frame, and its degrees of freedom with their joints.

        UsdPhysics states no order of turns, so there is one at most, or a ball, after the slides.
        """
        slides = [j for j in joints if isinstance(j, JointDescription) and not j.is_rotation]
        turns = list(joints[len(slides) :])
        if not slides or len(joints) == 1 or len(turns) > 1 or list(joints[: len(slides)]) != slides:
            return None
        if any(map(self._is_alone, joints)):
            return None
        axes = [np.array(joint.axis) for joint in slides]
        turn = turns[0] if turns else None
        if isinstance(turn, JointDescription) and _find_axis(axes, turn) is None:
            axes.append(np.array(turn.axis))
        if len(axes) > 3 or np.abs(np.array(axes) @ np.array(axes).T - np.eye(len(axes))).max() > _ALIGNED:
            return None
        if len(axes) == 1:
            axes += list(rotation_along_z(axes[0])[:, :2].T)
        elif len(axes) == 2:
            axes.append(np.cross(axes[0], axes[1]))
        elif np.linalg.det(np.array(axes)) < 0:  # a frame is right-handed
            axes[:2] = axes[1::-1]
        rotation = round_exact(np.array(axes).T)
        if isinstance(turn, BallJointDescription) and not np.array_equal(rotation, np.eye(3)):
            return None  # its coordinates are about the axes of the link
        freedoms: dict[str, _Joint] = {}
        for joint in joints:
            if isinstance(joint, BallJointDescription):
                freedoms[ROTATIONS[0]] = joint
                continue
            along = _find_axis(axes, joint)
            assert along is not None
            freedoms[(ROTATIONS if joint.is_rotation else TRANSLATIONS)[along]] = joint
        return rotation, freedoms

    def _is_alone(self, joint: _Joint) -> bool:
        """Return True if a joint has to have one degree of freedom: Newton's schemas are about all."""
        if isinstance(joint, BallJointDescription):
            return False
        is_coupled = not joint.is_independent or joint.symbol.path in self._led
        return (
            is_coupled
            or joint.bounds.max_velocity < math.inf
            or any(joint.dynamics.get(key) for key in _PASSIVE)
        )

    def _single(self, joint: _Joint, parent: _Carrier, child: _Carrier) -> None:
        if isinstance(joint, BallJointDescription):
            point = translation(np.array(joint.point))
            self._joint("Spherical", joint.name, parent.at(point), child.at(point))
            self._forget(joint.name, joint.dynamics)
            return
        frame, axis = _axis_frame(joint)
        kind = "Revolute" if joint.is_rotation else "Prismatic"
        made = self._joint(kind, joint.name, parent.at(frame), child.at(frame))
        self._joint_paths[joint.name] = made.GetPath()
        made.CreateAxisAttr(axis)
        lower, upper = self._range(joint)
        if lower >= -LARGEST_FLOAT:
            made.CreateLowerLimitAttr(lower)
        if upper <= LARGEST_FLOAT:
            made.CreateUpperLimitAttr(upper)
        self._drive(made.GetPrim(), "angular" if joint.is_rotation else "linear", joint)
        passive = {key: float(joint.dynamics[key]) for key in _PASSIVE if joint.dynamics.get(key)}
        speed = joint.bounds.max_velocity * (math.degrees(1.0) if joint.is_rotation else 1.0)
        if speed <= LARGEST_FLOAT:
            passive["velocityLimit"] = speed
        if passive:
            self._newton(made.GetPrim(), "NewtonJointAPI", **passive)

    def _generic(
        self,
        joints: Sequence[_Joint],
        rotation: Matrix,
        freedoms: Mapping[str, _Joint],
        parent: _Carrier,
        child: _Carrier,
    ) -> None:
        last = joints[-1]
        turns = isinstance(last, BallJointDescription) or last.is_rotation
        point = np.array(last.point) if turns else np.zeros(3)
        frame = transform(rotation, point)
        prim = self._joint("", _common_name(joints), parent.at(frame), child.at(frame)).GetPrim()
        for freedom in (*TRANSLATIONS, *ROTATIONS):
            joint = freedoms.get(freedom)
            if joint is not None:
                set_text(prim, COORDINATE.format(freedom), joint.name)
            if isinstance(joint, JointDescription):
                self._limit(prim, freedom, *self._range(joint))
                self._drive(prim, freedom, joint)
            elif joint is not None:
                self._forget(joint.name, joint.dynamics)
            elif not (freedom in ROTATIONS and isinstance(last, BallJointDescription)):
                self._limit(prim, freedom, 1.0, -1.0)  # low above high: locked

    def _joint(self, kind: str, name: str, *ends: _Carrier) -> Any:
        """Define a joint between two prims; the poses are those of its frame."""
        path = self._root.GetPath().AppendPath(f"joints/{self._joint_names.take(name)}")
        made = getattr(self._api.UsdPhysics, f"{kind}Joint").Define(self._stage, path)
        set_text(made.GetPrim(), NAME, name)
        for number, end in enumerate(ends):
            getattr(made, f"CreateBody{number}Rel")().SetTargets([end.path])
            getattr(made, f"CreateLocalPos{number}Attr")(tuple(end.pose[:3, 3].tolist()))
            getattr(made, f"CreateLocalRot{number}Attr")(to_gf_quaternion(end.pose))
        return made

    def _range(self, joint: JointDescription) -> tuple[float, float]:
        """Return the bounds of a joint [deg] or [m]; the soft limits are within."""
        lower, upper = joint.bounds.lower, joint.bounds.upper
        if joint.bounds.soft is not None:
            lower, upper = max(lower, joint.bounds.soft[0]), min(upper, joint.bounds.soft[1])
            self._description.remarks.append(f"the soft limits of '{joint.name}' are written as its limits")
        unit = math.degrees(1.0) if joint.is_rotation else 1.0
        return lower * unit, upper * unit

    def _limit(self, prim: Any, freedom: str, lower: float, upper: float) -> None:
        if lower < -LARGEST_FLOAT and upper > LARGEST_FLOAT:
            return
        limit = self._api.UsdPhysics.LimitAPI.Apply(prim, freedom)
        limit.CreateLowAttr(lower if lower >= -LARGEST_FLOAT else -math.inf)
        limit.CreateHighAttr(upper if upper <= LARGEST_FLOAT else math.inf)

    def _drive(self, prim: Any, freedom: str, joint: JointDescription) -> None:
        """Add what pulls at a degree of freedom as a drive towards the rest of its spring."""
        known = joint.dynamics
        numbers = {
            key: float(x) for key, x in known.items() if isinstance(x, (int, float)) and math.isfinite(x)
        }
        unit = math.degrees(1.0) if joint.is_rotation else 1.0
        stiffness = numbers.get("spring_stiffness") or numbers.get("stiffness") or 0.0
        rest = numbers.get("spring_reference") or numbers.get("rest") or 0.0
        effort, damping = numbers.get("effort", 0.0), numbers.get("damping", 0.0)
        if effort > 0 or damping or stiffness:
            drive = self._api.UsdPhysics.DriveAPI.Apply(prim, freedom)
            drive.CreateDampingAttr(damping / unit)
            drive.CreateStiffnessAttr(stiffness / unit)
            drive.CreateTargetPositionAttr(rest * unit)
            if 0 < effort < LARGEST_FLOAT:
                drive.CreateMaxForceAttr(effort)
        self._forget(joint.name, {key: x for key, x in known.items() if key not in _KNOWN})

    def _forget(self, name: str, known: Mapping[str, Any]) -> None:
        for key, value in known.items():
            if value:
                self._description.remarks.append(
                    f"UsdPhysics has no {key} here: that of '{name}' is left out"
                )

    def _newton(self, prim: Any, schema: str, **numbers: float) -> None:
        """Set numbers of one of Newton's schemas, which other tools pass over."""
        prim.AddAppliedSchema(schema)
        for key, value in numbers.items():
            prim.CreateAttribute(f"newton:{key}", self._api.Sdf.ValueTypeNames.Float, False).Set(value)

    def _mimic(self, joint: JointDescription) -> None:
        """Add the relation of a joint to the one that it follows, if both turn or both slide."""
        if joint.is_independent:
            return
        leader = self._leaders.get(joint.symbol)
        if leader is None or leader.name not in self._joint_paths:
            self._unsupported.leave_out_speeds(
                joint.name, f"follows '{joint.symbol}', of which no joint consists"
            )
            return
        offset, factor = (*joint.coefficients, 0.0)[:2]
        prim = self._stage.GetPrimAtPath(self._joint_paths[joint.name])
        if leader.is_rotation != joint.is_rotation:
            how = "turns with the slide of" if joint.is_rotation else "slides with the turn of"
            if not any(f"{joint.name}/".startswith(f"{name}/") for name in self._left_out):
                self._unsupported.leave_out_speeds(joint.name, f"{how} '{leader.name}'")
            types = self._api.Sdf.ValueTypeNames
            prim.CreateRelationship(LEADER, True).SetTargets([self._joint_paths[leader.name]])
            prim.CreateAttribute(COEFFICIENTS, types.Double2, True).Set((offset, factor))
            return
        unit = math.degrees(1.0) if joint.is_rotation else 1.0
        self._newton(prim, "NewtonMimicAPI", mimicCoef0=offset * unit, mimicCoef1=factor)
        prim.CreateRelationship("newton:mimicJoint", False).SetTargets([self._joint_paths[leader.name]])

    def _loop(self, loop: LoopJoint) -> None:
        kind = "Spherical" if loop.kind == "connect" else "Fixed"
        for k, (frame, to) in enumerate(loop.ends):
            name = f"{loop.name}/{k}" if k else loop.name
            made = self._joint(kind, name, self._carriers[to], self._carriers[frame])
            made.CreateExcludeFromArticulationAttr(True)
            prim, types = made.GetPrim(), self._api.Sdf.ValueTypeNames
            set_text(prim, LOOP, loop.name)
            prim.CreateAttribute(DEPENDENT, types.StringArray, True).Set(list(loop.dependent))


def _axis_frame(joint: JointDescription) -> tuple[Matrix, str]:
    """Return the pose of a joint's frame in its link, and which of the frame's axes is the joint's."""
    point = np.array(joint.point) if joint.is_rotation else np.zeros(3)
    for token, axis in zip("XYZ", np.eye(3).tolist(), strict=True):
        if list(joint.axis) == axis:
            return translation(point), token
    return transform(round_exact(rotation_along_z(np.array(joint.axis))), point), "Z"


def _find_axis(axes: Sequence[Matrix], joint: JointDescription) -> int | None:
    """Return the number of the axis along which that of a joint is; None if it is along none."""
    found = (k for k, axis in enumerate(axes) if np.abs(axis - np.array(joint.axis)).max() < _ALIGNED)
    return next(found, None)


def _common_name(joints: Sequence[_Joint]) -> str:
    """Return the name that the names of several joints begin with, else that of the last one."""
    first, *others = [joint.name.split("/") for joint in joints]
    count = 0
    while all(
        len(names) > count + 1 and names[: count + 1] == first[: count + 1] for names in (first, *others)
    ):
        count += 1
    return "/".join(first[:count]) or joints[-1].name
