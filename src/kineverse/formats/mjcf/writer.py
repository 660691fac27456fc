"""Models as MJCF text.

Every frame becomes a body and every coordinate a joint of its name. A body may have several joints, about any
lines. A joint that moves by a polynomial of a coordinate follows it by an equality, and equalities close
loops.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from msgspec.structs import replace

from kineverse.errors import FormatError
from kineverse.formats import poses
from kineverse.formats.description import (
    BallJointDescription,
    JointDescription,
    LinkDescription,
    RobotDescription,
    WrittenFile,
)
from kineverse.formats.export.capabilities import FormatCapabilities, UnsupportedFeatures
from kineverse.formats.export.link_tree import LinkTreeBuilder, check_rotation
from kineverse.formats.names import TakenNames
from kineverse.formats.poses import unit_quaternion
from kineverse.formats.xml_writer import Tag, format_xml
from kineverse.model.body import NO_BODY
from kineverse.model.frame import WORLD
from kineverse.model.model_view import ModelView

from .body_writer import MjcfBodyWriter, add_pose
from .custom_elements import ENDS, MASSLESS, add_loop, add_names, add_speeds
from .mujoco_api import find_blamed_mesh, find_load_error

MJCF_CAPABILITIES = FormatCapabilities(
    "MJCF", sum_limits=True, one_way_speeds=True, loop_joints=True, polynomial_degree=4
)

_MAX_BODY_DOFS = 6
_ARMATURE = 1e-3  # armature [kg m²] or [kg] of dependent joints in such links; avoids singular inertia
_TIE_SOLREF, _TIE_SOLIMP = (0.004, 1.0), (0.99, 0.999, 0.001)
"""Equalities of dependent joints: with MuJoCo's default, a mimic joint gives way under load."""
_QUATERNION = ("qx", "qy", "qz", "qw")
_DYNAMICS = {
    "damping": "damping",
    "friction": "frictionloss",
    "armature": "armature",
    "spring_stiffness": "stiffness",
    "spring_reference": "springref",
    "stiffness": "stiffness",
    "rest": "springref",
}


def to_mjcf(
    model: ModelView,
    path: Path,
    leave_out: Iterable[str] = (),
    tolerance: float | None = None,
    strict: bool = False,
    visuals: bool = True,
) -> WrittenFile:
    """Convert a model to MJCF."""
    builder = LinkTreeBuilder(model, MJCF_CAPABILITIES, leave_out, tolerance, strict)
    description = builder.build()
    if not visuals:
        _drop_visuals(description)
    home = builder.home_positions()
    unsupported, remarks = builder.unsupported, description.remarks
    excluded: dict[str, str] = {}
    while True:
        description.remarks = remarks + [
            f"the mesh {file} is left out: MuJoCo refuses it, {reason}" for file, reason in excluded.items()
        ]
        writer = MjcfWriter(description, path, unsupported, home, excluded)
        root = writer.root()
        error = find_load_error(root, path.absolute().parent, writer.converted)
        if error is None:
            content = format_xml(root, [*description.remarks, *description.error_lines])
            known = tuple(description.remarks), description.errors, unsupported.left_out
            return WrittenFile(content, *known, writer.converted)
        file = find_blamed_mesh(error, root)
        if file is None or file in excluded:
            raise FormatError(f"MuJoCo does not open what would be written: {error}.")
        excluded[file] = error


def _drop_visuals(description: RobotDescription) -> None:
    """Remove the visual shapes of all bodies; where there are no others, they become those that collide."""
    body = description.world_body
    description.world_body = replace(body, visuals=(), collisions=body.collisions or body.visuals)
    for link in description.links:
        body = link.body
        link.body = replace(body, visuals=(), collisions=body.collisions or body.visuals)


class MjcfWriter:
    """Writer of one description.

    ``home`` is the home position of every coordinate, by its path, which becomes the key ``home``.
    ``excluded_files`` are references to mesh files that are left out.
    """

    def __init__(
        self,
        description: RobotDescription,
        path: Path,
        unsupported: UnsupportedFeatures,
        home: Mapping[str, float],
        excluded_files: Collection[str] = (),
    ) -> None:
        self._description, self._path, self._unsupported, self._home = description, path, unsupported, home
        self._body_writer = MjcfBodyWriter(path, description.remarks, excluded_files)
        self._children: dict[str, list[LinkDescription]] = {}
        for link in description.links:
            self._children.setdefault(link.parent, []).append(link)
        self._names = TakenNames([WORLD, *(link.name for link in description.links)])
        self._qpos: list[float] = []
        self._bodies_by_name: dict[str, Tag] = {}
        self._joint_names: set[str] = set()
        self._end_sites: dict[str, str] = {}
        self._loop_equalities: dict[str, list[str]] = {}

    @property
    def converted(self) -> Mapping[Path, bytes]:
        """Content of converted meshes, by path."""
        return self._body_writer.files.converted

    def root(self) -> Tag:
        """Return the root element of the document."""
        root = Tag("mujoco", {"model": self._path.name.removesuffix(self._path.suffix) or "model"})
        compiler = root.add("compiler", angle="radian")
        world = Tag("worldbody")
        self._bodies_by_name[WORLD] = world
        self._body_writer.write(world, self._description.world_body, WORLD, moves=False)
        # MuJoCo numbers joints depth first, which is the order of the values in the key.
        stack = self._children.get(WORLD, [])[::-1]
        while stack:
            link = stack.pop()
            self._link(link)
            stack += self._children.get(link.name, [])[::-1]
        self._unsupported.check(self._path.name)
        self._description.remarks += self._unsupported.remarks
        equality, tendon, key = self._equalities(), self._tendons(), Tag("keyframe")
        for name, value in self._body_writer.settings().items():
            compiler.give(name, value)
        if any(self._qpos):
            key.add("key", name="home", qpos=self._qpos)
        parts = (self._custom_elements(), self._body_writer.assets, world, tendon, equality, key)
        root.inside += [part for part in parts if part.inside or part is world]
        return root

    def _link(self, link: LinkDescription) -> None:
        """Add the body of a link, and intermediate bodies if it has more joints than a body may have."""
        check_rotation(link, self._unsupported)
        if link.dynamics and not self._freejoint_name(link):
            self._description.remarks.append(
                f"'{link.name}' is moved by several joints in MJCF: "
                f"the {' and '.join(link.dynamics)} of all is left out"
            )
        body = self._bodies_by_name[link.parent]
        groups = _group_joints(link.joints)
        for k, joints in enumerate(groups):
            last = k == len(groups) - 1
            body = body.add("body", name=link.name if last else self._names.take(f"{link.name}/{k + 1}"))
            if not k:
                add_pose(body, link.pose)
            self._joints(body, link, joints)
            if not last:
                self._body_writer.write(body, NO_BODY, body.attributes["name"], moves=True)
        self._bodies_by_name[link.name] = body
        self._body_writer.write(body, link.body, link.name, moves=bool(link.joints))

    def _joints(
        self, body: Tag, link: LinkDescription, joints: Iterable[JointDescription | BallJointDescription]
    ) -> None:
        free = self._freejoint_name(link)
        if free:
            if link.dynamics:
                self._dynamics(body.add("joint", name=free, type="free"), free, link.dynamics)
            else:
                body.add("freejoint", name=free)
            self._joint_names.add(free)
            self._append_free_home(link, free)
        else:
            for joint in joints:
                self._joint_names.add(joint.name)
                if isinstance(joint, BallJointDescription):
                    element = body.add("joint", name=joint.name, type="ball", pos=_unless_zero(joint.point))
                    self._dynamics(element, joint.name, joint.dynamics)
                    w, x, y, z = (self._home.get(f"{joint.name}/q{c}", 0.0) for c in "wxyz")
                    self._qpos += [w, x, y, z]
                else:
                    self._joint(body, joint)
                    if len(link.joints) > 2 and not joint.is_independent and "armature" not in joint.dynamics:
                        body.inside[-1].give("armature", _ARMATURE)
                    self._qpos.append(self._home_position(joint))

    def _freejoint_name(self, link: LinkDescription) -> str:
        free = link.free_motion if link.parent == WORLD else ""
        if not free or self._description.has_followers(link):
            return ""
        slides = [joint for joint in link.joints if isinstance(joint, JointDescription)]
        return free if all(joint.bounds.is_unbounded for joint in slides) else ""

    def _append_free_home(self, link: LinkDescription, name: str) -> None:
        """Add the home position of a free body to the key; MuJoCo measures it in the world."""
        x, y, z, a, b, c, w = (
            self._home.get(f"{name}/{part}", 0.0) for part in ("x", "y", "z", *_QUATERNION)
        )
        motion = poses.pose_from_quaternion((x, y, z), (a, b, c, w)).matrix
        pose = link.pose @ motion
        a, b, c, w = unit_quaternion(pose)
        self._qpos += [*pose[:3, 3].tolist(), w, a, b, c]

    def _joint(self, body: Tag, joint: JointDescription) -> None:
        kind = "hinge" if joint.is_rotation else "slide"
        element = body.add(
            "joint", name=joint.name, type=kind, pos=_unless_zero(joint.point), axis=joint.axis
        )
        lower, upper = joint.bounds.lower, joint.bounds.upper
        if joint.bounds.soft is not None:
            lower, upper = max(lower, joint.bounds.soft[0]), min(upper, joint.bounds.soft[1])
            self._description.remarks.append(f"the soft limits of '{joint.name}' are written as its limits")
        if (lower, upper) != (-math.inf, math.inf):
            element.attributes["range"] = _range(lower, upper)
        self._dynamics(element, joint.name, joint.dynamics)

    def _dynamics(self, element: Tag, name: str, known: Mapping[str, Any]) -> None:
        for key, attribute in _DYNAMICS.items():
            if isinstance(known.get(key), (int, float)) and known[key]:
                element.give(attribute, float(known[key]))
        effort = known.get("effort")
        has_effort = element.attributes["type"] in ("hinge", "slide")
        if has_effort and isinstance(effort, (int, float)) and 0 < effort < math.inf:
            element.give("actuatorfrcrange", (-float(effort), float(effort)))
        for key, value in known.items():
            if value and key not in _DYNAMICS and not (key == "effort" and has_effort):
                self._description.remarks.append(f"MJCF has no {key} here: that of '{name}' is left out")

    def _home_position(self, joint: JointDescription) -> float:
        x = self._home.get(joint.symbol.path, 0.0)
        return float(np.polynomial.polynomial.polyval(x, joint.coefficients))

    def _equalities(self) -> Tag:
        equality, names = Tag("equality"), TakenNames()
        for joint in self._description.joints:
            if not joint.is_independent:
                name, coefficients = names.take(joint.name), [*joint.coefficients, 0.0, 0.0, 0.0, 0.0][:5]
                tie = equality.add("joint", name=name, joint1=joint.name, joint2=joint.symbol.path)
                tie.give("polycoef", coefficients)
                tie.give("solref", _TIE_SOLREF)
                tie.give("solimp", _TIE_SOLIMP)
        ends = (end for loop in self._description.loops for pair in loop.ends for end in pair)
        for frame in dict.fromkeys(ends):
            self._bodies_by_name[frame].add("site", name=self._end_sites.setdefault(frame, f"{frame}/end"))
        for loop in self._description.loops:
            for k, (frame, to) in enumerate(loop.ends):
                name = names.take(f"{loop.name}/{k}" if k else loop.name)
                self._loop_equalities.setdefault(loop.name, []).append(name)
                # Readers keep the joints of the first site independent, here those of the second end.
                equality.add(loop.kind, name=name, site1=self._end_sites[to], site2=self._end_sites[frame])
        return equality

    def _tendons(self) -> Tag:
        tendon = Tag("tendon")
        for item in self._description.sum_limits:
            fixed = tendon.add("fixed", name=item.name)
            fixed.attributes["range"] = _range(item.lower, item.upper)
            for symbol, factor in item.factors.items():
                fixed.add("joint", joint=symbol.path, coef=factor)
        return tendon

    def _custom_elements(self) -> Tag:
        custom = Tag("custom")
        if add_speeds(custom, self._description.joints):
            self._description.remarks.append(
                "MuJoCo knows no limits of speeds: they are custom numbers, <numeric>"
            )
        add_names(custom, MASSLESS, "body", self._body_writer.massless)
        add_names(custom, ENDS, "site", self._end_sites.values())
        for loop in self._description.loops:
            add_loop(custom, loop, self._loop_equalities[loop.name], self._joint_names)
        return custom


def _group_joints(
    joints: Iterable[JointDescription | BallJointDescription],
) -> list[list[JointDescription | BallJointDescription]]:
    """Return joints in groups of at most six DoFs, the most of a body in MuJoCo."""
    groups: list[list[JointDescription | BallJointDescription]] = [[]]
    remaining = _MAX_BODY_DOFS
    for joint in joints:
        dofs = 3 if isinstance(joint, BallJointDescription) else 1
        if dofs > remaining:
            groups.append([])
            remaining = _MAX_BODY_DOFS
        groups[-1].append(joint)
        remaining -= dofs
    return groups


def _unless_zero(point: Iterable[float]) -> Iterable[float] | None:
    return point if any(point) else None


def _range(lower: float, upper: float) -> str:
    """Return a range as text; MuJoCo requires different ends."""
    if lower == upper:
        upper += 1e-15 * max(1.0, abs(lower))
    return f"{lower!r} {upper!r}"
