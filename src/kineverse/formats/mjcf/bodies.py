"""Bodies, joints and sites of a compiled MJCF."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from kineverse.formats.names import NameFaultHandler, UniqueNames, drop_empty_parts
from kineverse.formats.poses import IDENTITY, is_identity
from kineverse.formats.xml_reader import quote
from kineverse.model.body import Vector3

from .compile import CompiledMjcf, ElementNote
from .description import (
    COORDINATE_SUFFIXES,
    WORLD,
    MjcfDynamics,
    MjcfJoint,
    MjcfJointType,
    MjcfLink,
    MjcfSite,
)
from .elements import MjcfElement
from .mujoco_api import mujoco
from .shapes import MjcfShapes, mujoco_pose

FREE_JOINT = "free"
"""What the name of the free motion of a mocap body has behind that of the body."""


class MjcfBodies:
    """The bodies of a model, with their names.

    Attributes
    ----------
    links, sites
        What was read.
    body_names, joint_names, site_names
        By the numbers that they have in the model.
    """

    def __init__(
        self,
        compiled: CompiledMjcf,
        shapes: MjcfShapes,
        source: str,
        note: ElementNote,
        mend: NameFaultHandler,
    ) -> None:
        self._model, self._source, self._shapes = compiled.model, source, shapes
        self._efforts, self._home = compiled.efforts, compiled.home
        self._custom, self._bound = compiled.prepared.custom, float(compiled.spec.compiler.boundmass)
        model, spec = compiled.model, compiled.spec
        if self._home is not None and len(self._home) != model.nq:
            note(None, 'the key "home" does not fit the joints that are read, and is left out.')
            self._home = None
        self._body_nodes = compiled.nodes(spec.bodies)
        # Of a <freejoint>, MuJoCo does not know the line.
        self._joint_nodes = {
            number: node or self._body_nodes[int(model.jnt_bodyid[number])]
            for number, node in compiled.nodes(spec.joints).items()
        }
        self._site_nodes = compiled.nodes(spec.sites)
        self._frames = UniqueNames(mend, WORLD)
        self._movers = UniqueNames(mend)
        self.body_names = self._named_bodies()
        self.joint_names = self._named_joints()
        joints: dict[int, list[MjcfJoint]] = {}
        for number in range(model.njnt):
            joints.setdefault(int(model.jnt_bodyid[number]), []).append(self._joint(number))
        for number in range(model.nbody):
            if model.body_mocapid[number] >= 0:
                joints[number] = [self._handle(number)]
        self.links = tuple(self._link(number, tuple(joints.get(number, ()))) for number in range(model.nbody))
        self.site_names = self._named_sites()
        self.sites = tuple(self._site(k) for k in range(model.nsite) if not self.is_closure_site(k))

    def is_closure_site(self, site: int) -> bool:
        """Whether a site is only there to say where its body is tied, which is at its origin."""
        m = self._model
        pose = mujoco_pose(m.site_pos[site], m.site_quat[site])
        return drop_empty_parts(m.site(site).name) in self._custom.ends and is_identity(pose)

    def _where(self, node: MjcfElement | None) -> str:
        return self._source if node is None else node.where

    def _named_bodies(self) -> list[str]:
        m = self._model
        names = [WORLD, *[""] * (m.nbody - 1)]
        nameless: dict[int, int] = {}
        for number in range(1, m.nbody):
            if m.body(number).name:
                names[number] = self._frames.take(m.body(number).name, self._where(self._body_nodes[number]))
        for number in range(1, m.nbody):
            if not names[number]:
                parent = int(m.body_parentid[number])
                count = nameless[parent] = nameless.get(parent, -1) + 1
                name = f"body{count}" if parent == 0 else f"{names[parent]}/body{count}"
                names[number] = self._frames.invent(name, self._where(self._body_nodes[number]))
        return names

    def _named_joints(self) -> list[str]:
        m = self._model
        names = [""] * m.njnt
        for number in range(m.njnt):
            if m.joint(number).name:
                names[number] = self._movers.take(
                    m.joint(number).name, self._where(self._joint_nodes[number])
                )
        nameless: dict[int, list[int]] = {}
        for number in range(m.njnt):
            if not names[number]:
                nameless.setdefault(int(m.jnt_bodyid[number]), []).append(number)
        for body, numbers in nameless.items():
            for count, number in enumerate(numbers):
                name = self.body_names[body] + ("" if len(numbers) == 1 else f"/joint{count}")
                names[number] = self._movers.invent(name, self._where(self._joint_nodes[number]))
        kinds = {int(mujoco().mjtJoint.mjJNT_BALL): "ball", int(mujoco().mjtJoint.mjJNT_FREE): "free"}
        for number in range(m.njnt):
            kind: MjcfJointType = kinds.get(int(m.jnt_type[number]), "hinge")  # type: ignore[assignment]  # as above
            name, where = names[number], self._where(self._joint_nodes[number])
            clash = [
                f"{name}/{suffix}"
                for suffix in COORDINATE_SUFFIXES[kind]
                if f"{name}/{suffix}" in self._movers
            ]
            if clash:
                problem = f"its coordinate would be called {quote(clash[0])} here, as a joint is. Rename one"
                names[number] = self._movers.replace(f"{name}_joint", where, problem)
        return names

    def _named_sites(self) -> list[str]:
        m = self._model
        names = [""] * m.nsite
        nameless: dict[int, int] = {}
        for number in range(m.nsite):
            body, where = int(m.site_bodyid[number]), self._where(self._site_nodes[number])
            if self.is_closure_site(number):
                names[number] = self.body_names[body]
            elif m.site(number).name:
                name = drop_empty_parts(m.site(number).name)
                names[number] = self._frames.invent(name, where, f"{name}_site")
            else:
                count = nameless[body] = nameless.get(body, -1) + 1
                names[number] = self._frames.invent(f"{self.body_names[body]}/site{count}", where)
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

    def _handle(self, number: int) -> MjcfJoint:
        """Return the free motion of a mocap body, which users and programs move as they like."""
        where = self._where(self._body_nodes[number])
        name = self._movers.invent(f"{self.body_names[number]}/{FREE_JOINT}", where)
        return MjcfJoint(name, "free", self.body_names[number], home=(0.0,) * 6 + (1.0,), where=where)

    def _joint(self, number: int) -> MjcfJoint:
        m, kinds = self._model, mujoco().mjtJoint
        kind: MjcfJointType = {
            int(kinds.mjJNT_HINGE): "hinge",
            int(kinds.mjJNT_SLIDE): "slide",
            int(kinds.mjJNT_BALL): "ball",
        }.get(int(m.jnt_type[number]), "free")  # type: ignore[assignment]  # mypy widens literals in a dict
        name, where = self.joint_names[number], self._where(self._joint_nodes[number])
        lower = upper = None
        if m.jnt_limited[number] and kind != "free":
            lower, upper = (v if abs(v) < np.inf else None for v in m.jnt_range[number].tolist())
        address = int(m.jnt_qposadr[number])
        return MjcfJoint(
            name,
            kind,
            self._frames.invent(name, where, f"{name}_joint"),
            _vector(m.jnt_axis[number]),
            _vector(m.jnt_pos[number]) if kind in ("hinge", "ball") else (0.0, 0.0, 0.0),
            float(m.qpos0[address]) if kind in ("hinge", "slide") else 0.0,
            lower,
            upper,
            self._custom.speeds.get(name),
            self._values(number, kind, address),
            self._dynamics(number, kind),
            where,
        )

    def _values(self, number: int, kind: MjcfJointType, address: int) -> tuple[float, ...]:
        """Return the coordinates of a joint at home."""
        m, engine = self._model, mujoco()
        given = m.qpos0 if self._home is None else self._home
        if kind in ("hinge", "slide"):
            return (float(given[address]),)
        if kind == "ball":
            w, x, y, z = self._turn(given[address : address + 4]).tolist()
            return x, y, z, w
        # The joint's own coordinates begin where the body is in the file, MuJoCo's at the origin.
        rest, pose = m.qpos0[address : address + 7], given[address : address + 7]
        back, turn, offset = np.zeros(4), np.zeros(4), np.zeros(3)
        engine.mju_negQuat(back, rest[3:])
        engine.mju_mulQuat(turn, back, self._turn(pose[3:]))
        engine.mju_rotVecQuat(offset, pose[:3] - rest[:3], back)
        w, x, y, z = turn.tolist()
        return *offset.tolist(), x, y, z, w

    def _turn(self, wxyz: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Return a quaternion of length one, as MuJoCo makes it: one without length turns nothing."""
        unit = np.array(wxyz, dtype=float)
        mujoco().mju_normalize4(unit)
        return unit

    def _dynamics(self, number: int, kind: MjcfJointType) -> MjcfDynamics:
        m = self._model
        dof = int(m.jnt_dofadr[number])
        strength = self._efforts.get(m.joint(number).name) if kind in ("hinge", "slide") else None
        if m.jnt_actfrclimited[number]:
            own = float(np.abs(m.jnt_actfrcrange[number]).max())
            strength = own if strength is None else min(own, strength)
        stiffness = float(m.jnt_stiffness[number])
        springs = stiffness and kind in ("hinge", "slide")
        values = {
            "effort": strength,
            "damping": float(m.dof_damping[dof]) or None,
            "friction": float(m.dof_frictionloss[dof]) or None,
            "armature": float(m.dof_armature[dof]) or None,
            "spring_stiffness": stiffness or None,
            "spring_reference": float(m.qpos_spring[int(m.jnt_qposadr[number])]) if springs else None,
        }
        return tuple((key, value) for key, value in values.items() if value is not None)


def _vector(numbers: Any) -> Vector3:
    x, y, z = map(float, numbers)
    return x, y, z
