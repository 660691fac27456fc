"""Engines that compute the poses of a file on their own: pinocchio for URDF, MuJoCo for MJCF, drake for SDF.

An engine reads the file with its own parser. Here, only coordinates are set: by the names that the file gives
them, and followers by the rule of the format where the engine leaves them free.
"""

from __future__ import annotations

import importlib
import logging
import math
from abc import ABC, abstractmethod
from collections.abc import Container, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, ClassVar
from xml.etree import ElementTree

import numpy as np
import numpy.typing as npt

from kineverse._extras import install_command
from kineverse.errors import FormatError, MissingDependencyError
from kineverse.formats.files import read_file
from kineverse.formats.poses import pose_from_quaternion
from kineverse.formats.sdf.custom_attributes import FREE, HOME, LOOP, NAME, NAMESPACE, ZERO
from kineverse.lie import rotation_angle
from kineverse.model.registry import FrameDeviation

Array = npt.NDArray[np.float64]

_QUATERNION = ("qx", "qy", "qz", "qw")
_FREE = ("x", "y", "z", *_QUATERNION)


class PoseEngine(ABC):
    """Engine that has read one file.

    ``frames`` are the names in the model of all frames that it computes, ``skipped`` of those that it cannot,
    and ``remarks`` say why.
    """

    name: ClassVar[str]
    package: ClassVar[str]  # name of its package in Python
    distribution: ClassVar[str]  # name under which it is installed
    equal: ClassVar[float] = 1e-9  # largest difference of a pose [m], [rad] that is rounding

    def __init__(self, path: Path) -> None:
        self.path, self.content = path, read_file(path)
        self.frames: Sequence[str] = ()
        self.skipped: Container[str] = ()
        self.remarks: list[str] = []

    @classmethod
    def require(cls) -> Any:
        """Import the package of the engine, which is optional; raise if it is missing."""
        try:
            return importlib.import_module(cls.package)
        except ImportError as error:
            raise MissingDependencyError(
                f"{cls.name}, which reads such a file, is not installed: {install_command('check')}"
            ) from error

    @classmethod
    def version(cls) -> str:
        """Return the version of the engine; empty if it is unknown."""
        try:
            return version(cls.distribution)
        except PackageNotFoundError:
            return ""

    @abstractmethod
    def poses(self, values: Mapping[str, float]) -> Array:
        """Return the poses of all frames in the world, (n, 4, 4), by the values of coordinates."""

    def closures(self) -> Mapping[str, FrameDeviation]:
        """Return the gap of each joint that closes a loop, at the poses of the file."""
        return {}

    def refuse(self, error: object) -> FormatError:
        """Return the error that the engine does not read the file."""
        lines = [line for line in str(error).strip().splitlines() if line.strip()]
        reason = lines[0] if lines else "it does not say why"
        return FormatError(f"{self.path.name}: {self.name} does not read it: {reason}")


class PinocchioEngine(PoseEngine):
    """URDF in pinocchio, where joints that mimic move freely; here they follow by multiplier and offset."""

    name, package, distribution = "pinocchio", "pinocchio", "pin"
    _COMPOUND: ClassVar = {"planar": ("x", "y", "angle"), "floating": _FREE}

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._pin = self.require()
        try:
            text = self.content.decode()
            self._model = self._pin.buildModelFromXML(text)
            root = ElementTree.fromstring(text)
        except (ValueError, RuntimeError, ElementTree.ParseError) as error:
            raise self.refuse(error) from None
        self._data = self._model.createData()
        self._joints = {joint.get("name", ""): joint for joint in root.findall("joint")}
        self.skipped = skipped = set(self._links_below_tilted_planes())
        body = self._pin.FrameType.BODY
        known = {f.name: k for k, f in enumerate(self._model.frames) if f.type == body}
        self._indices = {name: k for name, k in known.items() if name not in skipped}
        self.frames = list(self._indices)

    def _links_below_tilted_planes(self) -> Iterator[str]:
        """Yield the links that a planar joint moves whose plane pinocchio does not know."""
        children: dict[str, list[str]] = {}
        starts = []
        for name, joint in self._joints.items():
            parent, child, axis = joint.find("parent"), joint.find("child"), joint.find("axis")
            if parent is None or child is None:
                continue
            children.setdefault(parent.get("link", ""), []).append(child.get("link", ""))
            numbers = [float(x) for x in ("1 0 0" if axis is None else axis.get("xyz", "1 0 0")).split()]
            if joint.get("type") == "planar" and numbers != [0.0, 0.0, 1.0]:
                starts.append(child.get("link", ""))
                self.remarks.append(
                    f"pinocchio has planes of x and y only: what '{name}' moves is not compared"
                )
        while starts:
            link = starts.pop()
            yield link
            starts += children.get(link, [])

    def poses(self, values: Mapping[str, float]) -> Array:
        """Return the poses of all links."""
        q: list[float] = []
        for name in self._model.names[1:]:
            q += self._numbers(name, values)
        self._pin.framesForwardKinematics(self._model, self._data, np.array(q))
        placed = [self._data.oMf[k].homogeneous for k in self._indices.values()]
        return np.array(placed).reshape(-1, 4, 4)

    def _numbers(self, name: str, values: Mapping[str, float]) -> list[float]:
        kind = self._joints[name].get("type", "")
        if kind in self._COMPOUND:
            own = [values[f"{name}/{c}"] for c in self._COMPOUND[kind]]
            if kind == "planar":
                return [*own[:2], math.cos(own[2]), math.sin(own[2])]
            length = math.hypot(*own[3:])
            return [*own[:3], *(x / length for x in own[3:])]
        value = self._value(name, values)
        return [math.cos(value), math.sin(value)] if kind == "continuous" else [value]

    def _value(self, name: str, values: Mapping[str, float]) -> float:
        mimic = self._joints[name].find("mimic")
        if mimic is None:
            return values[name]
        leader = self._value(mimic.get("joint", ""), values)
        return float(mimic.get("multiplier", 1)) * leader + float(mimic.get("offset", 0))


class MujocoEngine(PoseEngine):
    """MJCF in MuJoCo, whose equalities move nothing in its kinematics: joints follow by their polynomials."""

    name, package, distribution = "mujoco", "mujoco", "mujoco"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._mujoco = mujoco = self.require()
        try:
            self._model = mujoco.MjModel.from_xml_path(str(path))
        except (ValueError, RuntimeError, mujoco.FatalError) as error:
            raise self.refuse(error) from None
        self._data = mujoco.MjData(self._model)
        self.frames = [self._model.body(k).name for k in range(1, self._model.nbody)]

    def poses(self, values: Mapping[str, float]) -> Array:
        """Return the poses of all bodies."""
        model, mujoco = self._model, self._mujoco
        q = model.qpos0.copy()
        followers = dict(self._followers())
        for k in range(model.njnt):
            name, start = model.joint(k).name, model.jnt_qposadr[k]
            kind = mujoco.mjtJoint(int(model.jnt_type[k]))
            if kind in (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL):
                turn = [values[f"{name}/{c}"] for c in ("qw", "qx", "qy", "qz")]
                if kind == mujoco.mjtJoint.mjJNT_BALL:
                    q[start : start + 4] = turn
                    continue
                body = model.jnt_bodyid[k]
                place, whole = np.zeros(3), np.zeros(4)
                xyz = np.array([values[f"{name}/{c}"] for c in "xyz"])
                mujoco.mju_rotVecQuat(place, xyz, model.body_quat[body])
                mujoco.mju_mulQuat(whole, model.body_quat[body], np.array(turn))
                q[start : start + 3], q[start + 3 : start + 7] = model.body_pos[body] + place, whole
            elif k not in followers:
                q[start] = values[name]
        for k, (leader, coefficients) in followers.items():
            start = model.jnt_qposadr[k]
            moved = q[model.jnt_qposadr[leader]] - model.qpos0[model.jnt_qposadr[leader]]
            q[start] = model.qpos0[start] + np.polynomial.polynomial.polyval(moved, coefficients)
        self._data.qpos[:] = q
        mujoco.mj_kinematics(model, self._data)
        result = np.tile(np.eye(4), (model.nbody - 1, 1, 1))
        result[:, :3, :3] = self._data.xmat[1:].reshape(-1, 3, 3)
        result[:, :3, 3] = self._data.xpos[1:]
        return result

    def _followers(self) -> Iterator[tuple[int, tuple[int, Array]]]:
        """Yield the number of each joint that follows another, with that of the other and the polynomial."""
        model, mujoco = self._model, self._mujoco
        for k in range(model.neq):
            if model.eq_type[k] == mujoco.mjtEq.mjEQ_JOINT and model.eq_obj2id[k] >= 0:
                yield int(model.eq_obj1id[k]), (int(model.eq_obj2id[k]), model.eq_data[k, :5])


class DrakeEngine(PoseEngine):
    """SDF in drake, which reads it by libsdformat.

    Drake closes no loops, and lets joints that mimic move freely. Joints that close loops are not given to
    it: whether they close is computed from the poses of their ends. Followers are set by the rule of SDF.
    """

    name, package, distribution = "drake", "pydrake.multibody.plant", "drake"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        plants = self.require()
        from pydrake.multibody.parsing import Parser

        ElementTree.register_namespace("kineverse", NAMESPACE)
        try:
            root = ElementTree.fromstring(self.content)
        except ElementTree.ParseError as error:
            raise self.refuse(error) from None
        model = root.find("model")
        if model is None:
            raise FormatError(f"{path.name}: has no <model> that drake could be compared with.")
        self._loops = [joint for joint in model.findall("joint") if _given(joint, LOOP)]
        for joint in self._loops:
            model.remove(joint)
        self._plant = plants.MultibodyPlant(0.0)
        with _without_logging():
            try:
                (instance,) = Parser(self._plant).AddModelsFromString(
                    ElementTree.tostring(root, "unicode"), "sdf"
                )
                self._plant.Finalize()
            except (RuntimeError, ValueError) as error:
                raise self.refuse(error) from None
        self._context = self._plant.CreateDefaultContext()
        self._joints = {joint.get("name", ""): joint for joint in model.findall("joint")}
        names = [part for tag in ("link", "frame") for part in model.findall(tag)]
        find = self._plant.GetFrameByName
        self._by_name = {part.get("name", ""): find(part.get("name", ""), instance) for part in names}
        self._frames = {_given(part, NAME) or part.get("name", ""): part.get("name", "") for part in names}
        self.frames = list(self._frames)
        self._starts = {n: self._joint(n, instance).position_start() for n in self._joints}
        self._start = self._plant.GetPositions(self._context).copy()
        self._free = [link for link in model.findall("link") if _given(link, FREE)]
        self._free_poses = {link.get("name", ""): self._pose(link.get("name", "")) for link in self._free}

    def _joint(self, name: str, instance: Any) -> Any:
        return self._plant.GetJointByName(name, instance)

    def _pose(self, name: str) -> Array:
        pose: Array = self._by_name[name].CalcPoseInWorld(self._context).GetAsMatrix4()
        return pose

    def poses(self, values: Mapping[str, float]) -> Array:
        """Return the poses of all links and frames."""
        from pydrake.math import RigidTransform, RotationMatrix

        q = self._start.copy()
        for name in self._joints:
            own = self._positions(name, values)
            q[self._starts[name] : self._starts[name] + len(own)] = own
        self._plant.SetPositions(self._context, q)
        for link in self._free:
            name, free = link.get("name", ""), _given(link, FREE)
            home = _numbers(link, HOME) or [0.0] * 6 + [1.0]
            start = self._free_poses[name] @ np.linalg.inv(_free_motion(home))
            pose = start @ _free_motion([values[f"{free}/{c}"] for c in _FREE])
            body = self._by_name[name].body()
            turn: Any = pose[:3, :3]
            place: Any = pose[:3, 3]
            placed = RigidTransform(RotationMatrix.ProjectToRotationMatrix(turn), place)
            self._plant.SetFreeBodyPose(self._context, body, placed)
        return np.array([self._pose(name) for name in self._frames.values()]).reshape(-1, 4, 4)

    def _positions(self, name: str, values: Mapping[str, float]) -> list[float]:
        """Return the positions of a joint in drake."""
        joint = self._joints[name]
        kind, own = joint.get("type"), _given(joint, NAME) or name
        if kind == "fixed":
            return []
        if kind == "ball":
            from pydrake.math import RollPitchYaw, RotationMatrix

            turn: Any = _rotation([values[f"{own}/{c}"] for c in _QUATERNION])
            zero = _numbers(joint, ZERO)
            turn = _rotation(zero).T @ turn if zero else turn
            return list(RollPitchYaw(RotationMatrix.ProjectToRotationMatrix(turn)).vector())
        if kind == "universal":
            return [values[f"{own}/first"], values[f"{own}/second"]]
        return [self._position(name, "axis", values)]

    def _position(self, name: str, tag: str, values: Mapping[str, float]) -> float:
        """Return the position of an axis by the rule of SDF: multiplier (leader - reference) + offset."""
        joint = self._joints[name]
        mimic = joint.find(f"{tag}/mimic")
        if mimic is not None:
            leader = self._position(mimic.get("joint", ""), mimic.get("axis", "axis"), values)
            factor, offset, reference = (
                float(mimic.findtext(key, default))
                for key, default in (("multiplier", "1"), ("offset", "0"), ("reference", "0"))
            )
            return factor * (leader - reference) + offset
        own = _given(joint, NAME) or name
        if joint.get("type") == "universal":
            return values[f"{own}/{'first' if tag == 'axis' else 'second'}"]
        return values[own] - (_numbers(joint, ZERO) or [0.0])[0]

    def closures(self) -> Mapping[str, FrameDeviation]:
        """Return the gap of each joint that closes a loop, at the poses of the file."""
        self._plant.SetPositions(self._context, self._start)
        found = {}
        for joint in self._loops:
            ends = [joint.findtext(role, "") for role in ("parent", "child")]
            a, b = (np.eye(4) if end == "world" else self._pose(end) for end in ends)
            turned = rotation_angle(a[:3, :3].T @ b[:3, :3])
            angle = 0.0 if joint.get("type") == "ball" else float(turned)
            found[joint.get("name", "")] = FrameDeviation(
                float(np.linalg.norm(a[:3, 3] - b[:3, 3])), float(angle)
            )
        return found


def _given(element: ElementTree.Element, key: str) -> str:
    """Return a custom attribute of an element, whose prefix ElementTree replaces by its address."""
    return element.get(f"{{{NAMESPACE}}}{key.partition(':')[2]}", "")


def _numbers(element: ElementTree.Element, key: str) -> list[float]:
    return [float(word) for word in _given(element, key).split()]


def _rotation(xyzw: Sequence[float]) -> Array:
    return pose_from_quaternion((0.0, 0.0, 0.0), tuple(xyzw)).matrix[:3, :3]


def _free_motion(values: Sequence[float]) -> Array:
    return pose_from_quaternion(tuple(values[:3]), tuple(values[3:])).matrix


@contextmanager
def _without_logging() -> Iterator[None]:
    """Silence drake, which warns of what it does not simulate."""
    logger = logging.getLogger("drake")
    before = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(before)
