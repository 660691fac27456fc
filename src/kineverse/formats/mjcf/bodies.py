"""Bodies, joints and sites of a compiled MJCF."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from msgspec.structs import replace

from kineverse.formats import poses
from kineverse.formats.names import NameFaultHandler, UniqueNames, drop_empty_parts
from kineverse.formats.poses import IDENTITY, compose_poses, invert_pose, is_identity
from kineverse.formats.resource_paths import find_root_violation
from kineverse.formats.xml_reader import quote
from kineverse.model.body import (
    Body,
    Box,
    Capsule,
    Cylinder,
    Ellipsoid,
    Geometry,
    Inertia,
    Pose,
    Rgba,
    Shape,
    Sphere,
    Vector3,
)

from .compiled_document import CompiledMjcf
from .description import (
    COORDINATE_SUFFIXES,
    WORLD,
    MjcfDynamics,
    MjcfJoint,
    MjcfJointType,
    MjcfLink,
    MjcfSite,
)
from .elements import ElementRemark, MjcfElement
from .meshes import place_mesh
from .mujoco_api import mujoco

_JOINT_KINDS: tuple[MjcfJointType, ...] = ("free", "ball", "slide", "hinge")  # in the order of mjtJoint
_VISIBLE_GROUPS = range(3)  # geom groups that MuJoCo's viewers show by default

_DEFAULT_COLOR = [0.5, 0.5, 0.5, 1.0]
"""Colour of a geom without one, which has the colour of its material instead."""


class MjcfShapes:
    """Shapes and inertia of the bodies of a compiled model."""

    def __init__(self, compiled: CompiledMjcf, folder: str, root: str, remark: ElementRemark) -> None:
        self._model, self._compiled = compiled.model, compiled
        self._folder, self._root = folder, root
        self._nodes, self._remark = compiled.nodes(compiled.spec.geoms), remark

    def body(self, number: int) -> Body:
        """Return the shapes and the inertia of a body; no inertia if it is unknown or zero."""
        m = self._model
        visuals: list[Shape] = []
        collisions: list[Shape] = []
        first = int(m.body_geomadr[number])
        for geom in range(first, first + int(m.body_geomnum[number])):
            collides = bool(m.geom_contype[geom] or m.geom_conaffinity[geom])
            color = self._color(geom)
            is_visible = int(m.geom_group[geom]) in _VISIBLE_GROUPS and color[3] > 0.0
            shape = self._shape(geom, color) if collides or is_visible else None
            if shape is not None:
                if is_visible:
                    visuals.append(shape)
                if collides:
                    collisions.append(shape)
        return Body(tuple(visuals), tuple(collisions), self._inertia(number))

    def _inertia(self, number: int) -> Inertia | None:
        m = self._model
        mass = float(m.body_mass[number])
        a, b, c = m.body_inertia[number].tolist()
        if number in self._compiled.unknown_inertia or not (mass or a or b or c):
            return None
        return Inertia(mass, (a, 0.0, 0.0, b, 0.0, c), mujoco_pose(m.body_ipos[number], m.body_iquat[number]))

    def _shape(self, geom: int, color: Rgba) -> Shape | None:
        m, kinds = self._model, mujoco().mjtGeom
        name, kind = m.geom(geom).name, m.geom_type[geom]
        pose = mujoco_pose(m.geom_pos[geom], m.geom_quat[geom])
        if geom in self._compiled.left_out:
            self._remark_geom(geom, self._compiled.left_out[geom])
            return None
        if kind != kinds.mjGEOM_MESH:
            form = _primitive(kind, m.geom_size[geom].tolist())
            if form is None:
                self._remark_geom(geom, "is left out: a plane has no end, which no shape here has.")
                return None
            return Shape(form, pose, name, color)
        mesh = int(m.geom_dataid[geom])
        asset = self._compiled.assets.get(m.mesh(mesh).name)
        if asset is None or not asset.uri:
            self._remark_geom(geom, "is left out: its triangles are in no file.")
            return None
        mesh_T_centre = mujoco_pose(m.mesh_pos[mesh], m.mesh_quat[mesh])
        placed = place_mesh(asset, compose_poses(pose, invert_pose(mesh_T_centre)), self._folder, self._root)
        if placed is None:
            self._remark_geom(
                geom, "is left out: its mesh is scaled along other axes than those of its file."
            )
            return None
        violation = find_root_violation(asset.uri, self._folder, self._root)
        if violation is not None:
            self._remark_geom(geom, f"names {violation}")
        form, origin = placed
        return Shape(form, origin, name, color)

    def _remark_geom(self, geom: int, text: str) -> None:
        self._remark(self._nodes[geom], text)

    def _color(self, geom: int) -> Rgba:
        m = self._model
        rgba, material = m.geom_rgba[geom].tolist(), int(m.geom_matid[geom])
        if material >= 0 and rgba == _DEFAULT_COLOR:
            rgba = m.mat_rgba[material].tolist()
        red, green, blue, alpha = (round(value, 7) for value in rgba)  # single precision
        return red, green, blue, alpha


def _primitive(kind: int, size: list[float]) -> Geometry | None:
    kinds = mujoco().mjtGeom
    x, y, z = size
    if kind == kinds.mjGEOM_BOX:
        return Box((2.0 * x, 2.0 * y, 2.0 * z))
    if kind == kinds.mjGEOM_SPHERE:
        return Sphere(x)
    if kind == kinds.mjGEOM_CAPSULE:
        return Capsule(x, 2.0 * y)
    if kind == kinds.mjGEOM_CYLINDER:
        return Cylinder(x, 2.0 * y)
    return Ellipsoid((x, y, z)) if kind == kinds.mjGEOM_ELLIPSOID else None


def mujoco_pose(position: Any, wxyz: Any) -> Pose:
    """Return the pose of a position and a quaternion (w, x, y, z), in MuJoCo's order."""
    x, y, z = map(float, position)
    w, a, b, c = map(float, wxyz)
    return poses.pose_from_quaternion((x, y, z), (a, b, c, w))


FREE_JOINT = "free"  # last part of the name of a mocap body's free joint, after the name of the body


class MjcfBodies:
    """Bodies, joints and sites of a compiled model, with unique names."""

    def __init__(
        self,
        compiled: CompiledMjcf,
        shapes: MjcfShapes,
        source: str,
        remark: ElementRemark,
        on_recoverable_error: NameFaultHandler,
    ) -> None:
        self._model, self._source, self._shapes = compiled.model, source, shapes
        self._efforts, self._home = compiled.efforts, compiled.home
        self._custom, self._bound = compiled.prepared.custom, float(compiled.spec.compiler.boundmass)
        model, spec = compiled.model, compiled.spec
        if self._home is not None and len(self._home) != model.nq:
            remark(None, 'the key "home" does not fit the joints that are read, and is left out.')
            self._home = None
        self._body_nodes = compiled.nodes(spec.bodies)
        # MuJoCo has no line number of a <freejoint>.
        self._joint_nodes = {
            number: node or self._body_nodes[int(model.jnt_bodyid[number])]
            for number, node in compiled.nodes(spec.joints).items()
        }
        self._site_nodes = compiled.nodes(spec.sites)
        self._unique_frames = UniqueNames(on_recoverable_error, WORLD)
        self._unique_joints = UniqueNames(on_recoverable_error)
        self.body_names = self._name_bodies()
        self.joint_names = self._name_joints()
        joints: dict[int, list[MjcfJoint]] = {}
        for number in range(model.njnt):
            joints.setdefault(int(model.jnt_bodyid[number]), []).append(self._joint(number))
        for number in range(model.nbody):
            if model.body_mocapid[number] >= 0:
                joints[number] = [self._mocap_joint(number)]
        self.links = tuple(self._link(number, tuple(joints.get(number, ()))) for number in range(model.nbody))
        self.site_names = self._name_sites()
        self.sites = tuple(self._site(k) for k in range(model.nsite) if not self.is_closure_site(k))

    def is_closure_site(self, site: int) -> bool:
        """Return True if a site only marks the end of a loop closure at the origin of its body."""
        m = self._model
        pose = mujoco_pose(m.site_pos[site], m.site_quat[site])
        return drop_empty_parts(m.site(site).name) in self._custom.ends and is_identity(pose)

    def _where(self, node: MjcfElement | None) -> str:
        return self._source if node is None else node.where

    def _name_bodies(self) -> list[str]:
        """Return the names of all bodies; those without name are numbered below their parent."""
        m = self._model
        names = [WORLD, *[""] * (m.nbody - 1)]
        nameless: dict[int, int] = {}
        for number in range(1, m.nbody):
            if m.body(number).name:
                names[number] = self._unique_frames.take(
                    m.body(number).name, self._where(self._body_nodes[number])
                )
        for number in range(1, m.nbody):
            if not names[number]:
                parent = int(m.body_parentid[number])
                count = nameless[parent] = nameless.get(parent, -1) + 1
                name = f"body{count}" if parent == 0 else f"{names[parent]}/body{count}"
                names[number] = self._unique_frames.invent(name, self._where(self._body_nodes[number]))
        return names

    def _name_joints(self) -> list[str]:
        """Return the names of all joints; those without name are named after their body."""
        m = self._model
        names = [""] * m.njnt
        for number in range(m.njnt):
            if m.joint(number).name:
                names[number] = self._unique_joints.take(
                    m.joint(number).name, self._where(self._joint_nodes[number])
                )
        nameless: dict[int, list[int]] = {}
        for number in range(m.njnt):
            if not names[number]:
                nameless.setdefault(int(m.jnt_bodyid[number]), []).append(number)
        for body, numbers in nameless.items():
            for count, number in enumerate(numbers):
                name = self.body_names[body] + ("" if len(numbers) == 1 else f"/joint{count}")
                names[number] = self._unique_joints.invent(name, self._where(self._joint_nodes[number]))
        for number in range(m.njnt):
            name, where = names[number], self._where(self._joint_nodes[number])
            coordinates = [f"{name}/{suffix}" for suffix in COORDINATE_SUFFIXES[self._kind(number)]]
            clash = [coordinate for coordinate in coordinates if coordinate in self._unique_joints]
            if clash:
                problem = f"its coordinate would be called {quote(clash[0])} here, as a joint is. Rename one"
                names[number] = self._unique_joints.replace(f"{name}_joint", where, problem)
        return names

    def _name_sites(self) -> list[str]:
        """Return the names of all sites; those without name are numbered below their body."""
        m = self._model
        names = [""] * m.nsite
        nameless: dict[int, int] = {}
        for number in range(m.nsite):
            body, where = int(m.site_bodyid[number]), self._where(self._site_nodes[number])
            if self.is_closure_site(number):
                names[number] = self.body_names[body]
            elif m.site(number).name:
                name = drop_empty_parts(m.site(number).name)
                names[number] = self._unique_frames.invent(name, where, f"{name}_site")
            else:
                count = nameless[body] = nameless.get(body, -1) + 1
                names[number] = self._unique_frames.invent(f"{self.body_names[body]}/site{count}", where)
        return names

    def _link(self, number: int, joints: tuple[MjcfJoint, ...]) -> MjcfLink:
        m, name = self._model, self.body_names[number]
        body = self._shapes.body(number)
        if name in self._custom.massless and m.body_mass[number] <= self._bound:
            body = replace(body, inertia=None)
        return MjcfLink(
            name,
            self.body_names[int(m.body_parentid[number])],
            mujoco_pose(m.body_pos[number], m.body_quat[number]) if number else IDENTITY,
            joints,
            body,
            self._where(self._body_nodes[number]),
        )

    def _site(self, number: int) -> MjcfSite:
        m = self._model
        return MjcfSite(
            self.site_names[number],
            self.body_names[int(m.site_bodyid[number])],
            mujoco_pose(m.site_pos[number], m.site_quat[number]),
            self._where(self._site_nodes[number]),
        )

    def _mocap_joint(self, number: int) -> MjcfJoint:
        where = self._where(self._body_nodes[number])
        name = self._unique_joints.invent(f"{self.body_names[number]}/{FREE_JOINT}", where)
        return MjcfJoint(name, "free", self.body_names[number], home=(0.0,) * 6 + (1.0,), where=where)

    def _kind(self, number: int) -> MjcfJointType:
        return _JOINT_KINDS[int(self._model.jnt_type[number])]

    def _joint(self, number: int) -> MjcfJoint:
        m, kind = self._model, self._kind(number)
        name, where = self.joint_names[number], self._where(self._joint_nodes[number])
        lower = upper = None
        if m.jnt_limited[number] and kind != "free":
            lower, upper = (v if abs(v) < np.inf else None for v in m.jnt_range[number].tolist())
        address = int(m.jnt_qposadr[number])
        return MjcfJoint(
            name,
            kind,
            self._unique_frames.invent(name, where, f"{name}_joint"),
            _vector(m.jnt_axis[number]),
            _vector(m.jnt_pos[number]) if kind in ("hinge", "ball") else (0.0, 0.0, 0.0),
            float(m.qpos0[address]) if kind in ("hinge", "slide") else 0.0,
            lower,
            upper,
            self._custom.speeds.get(name),
            self._home_position(number, kind, address),
            self._dynamics(number, kind),
            where,
        )

    def _home_position(self, number: int, kind: MjcfJointType, address: int) -> tuple[float, ...]:
        m, engine = self._model, mujoco()
        qpos = m.qpos0 if self._home is None else self._home
        if kind in ("hinge", "slide"):
            return (float(qpos[address]),)
        if kind == "ball":
            w, x, y, z = self._unit_quaternion(qpos[address : address + 4]).tolist()
            return x, y, z, w
        # The model's coordinates are relative to the pose of the body in the file, MuJoCo's to the world.
        rest, pose = m.qpos0[address : address + 7], qpos[address : address + 7]
        inverse, rotation, offset = np.zeros(4), np.zeros(4), np.zeros(3)
        engine.mju_negQuat(inverse, rest[3:])
        engine.mju_mulQuat(rotation, inverse, self._unit_quaternion(pose[3:]))
        engine.mju_rotVecQuat(offset, pose[:3] - rest[:3], inverse)
        w, x, y, z = rotation.tolist()
        return *offset.tolist(), x, y, z, w

    def _unit_quaternion(self, wxyz: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Return a normalized quaternion; one of length zero is the identity, as in MuJoCo."""
        unit = np.array(wxyz, dtype=float)
        mujoco().mju_normalize4(unit)
        return unit

    def _dynamics(self, number: int, kind: MjcfJointType) -> MjcfDynamics:
        m = self._model
        dof = int(m.jnt_dofadr[number])
        strength = self._efforts.get(m.joint(number).name) if kind in ("hinge", "slide") else None
        if m.jnt_actfrclimited[number]:
            largest = float(np.abs(m.jnt_actfrcrange[number]).max())
            strength = largest if strength is None else min(largest, strength)
        stiffness = float(m.jnt_stiffness[number])
        has_spring = stiffness and kind in ("hinge", "slide")
        values = {
            "effort": strength,
            "damping": float(m.dof_damping[dof]) or None,
            "friction": float(m.dof_frictionloss[dof]) or None,
            "armature": float(m.dof_armature[dof]) or None,
            "spring_stiffness": stiffness or None,
            "spring_reference": float(m.qpos_spring[int(m.jnt_qposadr[number])]) if has_spring else None,
        }
        return tuple((key, value) for key, value in values.items() if value is not None)


def _vector(numbers: Any) -> Vector3:
    x, y, z = map(float, numbers)
    return x, y, z
