"""Models as MJCF text.

Every frame is a body and every coordinate a joint of its name. A body may have several joints, about lines
anywhere; what moves by a polynomial of a coordinate is an equality, and loops stay closed by equalities, too.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path

import numpy as np

from kineverse.errors import FormatError
from kineverse.formats import poses
from kineverse.formats.description import (
    NO_BODY,
    BallJointDescription,
    JointDescription,
    LinkDescription,
    RobotDescription,
    WrittenFile,
)
from kineverse.formats.export.capabilities import FormatCapabilities, UnsupportedFeatures
from kineverse.formats.export.link_tree import LinkTreeBuilder, check_rotation
from kineverse.formats.export.poses import unit_quaternion
from kineverse.formats.mjcf.body_writer import MjcfBodyWriter, add_pose
from kineverse.formats.mjcf.custom_elements import (
    ENDS,
    MASSLESS,
    add_loop,
    add_names,
    add_speeds,
    format_range,
)
from kineverse.formats.mjcf.mujoco_api import find_blamed_mesh, find_load_error
from kineverse.formats.names import TakenNames
from kineverse.formats.xml_writer import Tag, format_xml
from kineverse.model.frame import WORLD
from kineverse.model.model_view import ModelView

MJCF_CAPABILITIES = FormatCapabilities(
    "MJCF", sum_limits=True, one_way_speeds=True, loop_joints=True, polynomial_degree=4
)

_AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
_MOST_SPEEDS = 6
_ARMATURE = 1e-3
"""The inertia [kg m²], [kg] of joints that are so many that not all of them move something of their own."""
_QUATERNION = ("qx", "qy", "qz", "qw")
_DYNAMICS = {
    "damping": "damping",
    "friction": "frictionloss",
    "armature": "armature",
    "spring_stiffness": "stiffness",
    "spring_reference": "springref",
}


def to_mjcf(
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
        Where the file will lie; meshes are named from there.
    leave_out
        Names of constraints that are not to be said, and of articulations whose speeds are not.
    tolerance
        How far frames may be off where motions are approximated [m], [rad]; None for no approximation.
    strict
        Whether constraints that it cannot say are refused, rather than left out with a remark.

    Raises
    ------
    FormatError
        Naming what MJCF cannot say, and why; or if MuJoCo, where it is installed, does not open the result.
    """
    builder = LinkTreeBuilder(model, MJCF_CAPABILITIES, leave_out, tolerance, strict)
    description = builder.build()
    home = {s.path: v for s, v in builder.home_positions().items()}
    unsupported, remarks = builder.unsupported, description.remarks
    without: dict[str, str] = {}
    while True:
        description.remarks = remarks + [
            f"the mesh {file} is left out: MuJoCo refuses it, {why}" for file, why in without.items()
        ]
        writer = MjcfWriter(description, path, unsupported, home, without)
        root = writer.root()
        complaint = find_load_error(root, path.absolute().parent, writer.converted)
        if complaint is None:
            content = format_xml(root, [*description.remarks, *description.error_lines])
            return WrittenFile(
                content,
                tuple(description.remarks),
                description.errors,
                unsupported.left_out,
                writer.converted,
            )
        file = find_blamed_mesh(complaint, root)
        if file is None or file in without:
            raise FormatError(f"MuJoCo does not open what would be written: {complaint}.")
        without[file] = complaint


class MjcfWriter:
    """Writes one description.

    ``home`` has a value for every coordinate, by its path, which becomes the key of that name; ``without``
    are files of meshes that are left out.
    """

    def __init__(
        self,
        description: RobotDescription,
        path: Path,
        unsupported: UnsupportedFeatures,
        home: Mapping[str, float],
        without: Collection[str] = (),
    ) -> None:
        self._description, self._path, self._unsupported, self._home = description, path, unsupported, home
        self._bodies = MjcfBodyWriter(path, description.remarks, without)
        self._children: dict[str, list[LinkDescription]] = {}
        for link in description.links:
            self._children.setdefault(link.parent, []).append(link)
        self._names = TakenNames([WORLD, *(link.name for link in description.links)])
        self._qpos: list[float] = []
        self._elements: dict[str, Tag] = {}
        self._joint_names: set[str] = set()
        self._ends: dict[str, str] = {}
        self._ties: dict[str, list[str]] = {}

    @property
    def converted(self) -> Mapping[Path, bytes]:
        """Meshes that MuJoCo cannot read, in a format that it can, by where they will lie."""
        return self._bodies.files.converted

    def root(self) -> Tag:
        """Return the document.

        Raises
        ------
        FormatError
            Naming what MJCF cannot say.
        """
        root = Tag("mujoco", {"model": self._path.name.removesuffix(self._path.suffix) or "model"})
        compiler = root.add("compiler", angle="radian")
        world = Tag("worldbody")
        self._elements[WORLD] = world
        self._bodies.write(world, self._description.world_body, WORLD, moves=False)
        # Depth first, as MuJoCo numbers its joints.
        waiting = self._children.get(WORLD, [])[::-1]
        while waiting:
            link = waiting.pop()
            self._link(link)
            waiting += self._children.get(link.name, [])[::-1]
        self._unsupported.check(self._path.name)
        self._description.remarks += self._unsupported.remarks
        equality, tendon, key = self._equalities(), self._tendons(), Tag("keyframe")
        for name, value in self._bodies.settings().items():
            compiler.give(name, value)
        if any(self._qpos):
            key.add("key", name="home", qpos=self._qpos)
        parts = (self._said(), self._bodies.assets, world, tendon, equality, key)
        root.inside += [part for part in parts if part.inside or part is world]
        return root

    def _link(self, link: LinkDescription) -> None:
        check_rotation(link, self._unsupported)
        body = self._elements[link.parent]
        groups = _group_joints(link.joints)
        for k, joints in enumerate(groups):
            last = k == len(groups) - 1
            body = body.add("body", name=link.name if last else self._names.take(f"{link.name}/{k + 1}"))
            if not k:
                add_pose(body, link.pose)
            self._joints(body, link, joints)
            if not last:
                self._bodies.write(body, NO_BODY, body.attributes["name"], moves=True)
        self._elements[link.name] = body
        self._bodies.write(body, link.body, link.name, moves=bool(link.joints))

    def _joints(
        self, body: Tag, link: LinkDescription, joints: Iterable[JointDescription | BallJointDescription]
    ) -> None:
        free = self._free(link)
        if free is not None:
            body.add("freejoint", name=free)
            self._joint_names.add(free)
            self._rest_free(link, free)
        else:
            for joint in joints:
                self._joint_names.add(joint.name)
                if isinstance(joint, BallJointDescription):
                    body.add("joint", name=joint.name, type="ball", pos=_unless_zero(joint.point))
                    w, x, y, z = (self._home.get(f"{joint.name}/q{c}", 0.0) for c in "wxyz")
                    self._qpos += [w, x, y, z]
                else:
                    self._joint(body, joint)
                    if len(link.joints) > 2 and not joint.is_independent and "armature" not in joint.dynamics:
                        body.inside[-1].give("armature", _ARMATURE)
                    self._qpos.append(self._at_home(joint))

    def _free(self, link: LinkDescription) -> str | None:
        """Return the name of a joint that leaves a body free; only in the world there is one."""
        if link.parent != WORLD or len(link.joints) != 4:
            return None
        *slides, ball = link.joints
        if not isinstance(ball, BallJointDescription) or any(ball.point) or ball.dynamics:
            return None
        for joint, axis, c in zip(slides, _AXES, "xyz", strict=True):
            if (
                not isinstance(joint, JointDescription)
                or joint.is_rotation
                or not joint.is_independent
                or joint.axis != axis
            ):
                return None
            if joint.name != f"{ball.name}/{c}" or not joint.bounds.is_unbounded or joint.dynamics:
                return None
        return ball.name

    def _rest_free(self, link: LinkDescription, name: str) -> None:
        """Note where a free body is at home: MuJoCo counts from the world, not from where it is placed."""
        x, y, z, a, b, c, w = (
            self._home.get(f"{name}/{part}", 0.0) for part in ("x", "y", "z", *_QUATERNION)
        )
        turn = poses.pose_from_quaternion((x, y, z), (a, b, c, w)).matrix
        pose = link.pose @ turn
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
        known = joint.dynamics
        for key, attribute in _DYNAMICS.items():
            if isinstance(known.get(key), (int, float)) and known[key]:
                element.give(attribute, float(known[key]))
        effort = known.get("effort")
        if isinstance(effort, (int, float)) and 0 < effort < math.inf:
            element.give("actuatorfrcrange", (-float(effort), float(effort)))
        for key, value in known.items():
            if key not in _DYNAMICS and (key != "effort" or not value) and value:
                self._description.remarks.append(f"MJCF has no {key}: that of '{joint.name}' is left out")

    def _at_home(self, joint: JointDescription) -> float:
        x = self._home.get(joint.symbol.path, 0.0)
        return float(np.polynomial.polynomial.polyval(x, joint.coefficients))

    def _equalities(self) -> Tag:
        equality, names = Tag("equality"), TakenNames()
        for joint in self._description.joints:
            if not joint.is_independent:
                coefficients = [*joint.coefficients, 0.0, 0.0, 0.0, 0.0][:5]
                equality.add(
                    "joint",
                    name=names.take(joint.name),
                    joint1=joint.name,
                    joint2=joint.symbol.path,
                    polycoef=coefficients,
                )
        for frame in dict.fromkeys(
            end for loop in self._description.loops for pair in loop.ends for end in pair
        ):
            self._elements[frame].add("site", name=self._ends.setdefault(frame, f"{frame}/end"))
        for loop in self._description.loops:
            for k, (frame, to) in enumerate(loop.ends):
                name = names.take(f"{loop.name}/{k}" if k else loop.name)
                self._ties.setdefault(loop.name, []).append(name)
                # What the first end hangs on is free when somebody else closes the loop.
                equality.add(loop.kind, name=name, site1=self._ends[to], site2=self._ends[frame])
        return equality

    def _tendons(self) -> Tag:
        tendon = Tag("tendon")
        for item in self._description.sum_limits:
            fixed = tendon.add("fixed", name=item.name)
            fixed.attributes["range"] = _range(item.lower, item.upper)
            for symbol, factor in item.factors.items():
                fixed.add("joint", joint=symbol.path, coef=factor)
        return tendon

    def _said(self) -> Tag:
        """Return what only the reader here understands, and MuJoCo ignores."""
        custom = Tag("custom")
        if add_speeds(custom, self._description.joints):
            self._description.remarks.append(
                "MuJoCo knows no limits of speeds: they are custom numbers, <numeric>"
            )
        add_names(custom, MASSLESS, "body", self._bodies.massless)
        add_names(custom, ENDS, "site", self._ends.values())
        for loop in self._description.loops:
            add_loop(custom, loop, self._ties[loop.name], self._joint_names)
        return custom


def _group_joints(
    joints: Iterable[JointDescription | BallJointDescription],
) -> list[list[JointDescription | BallJointDescription]]:
    """Return joints in groups of six speeds at most, more than which no body of MuJoCo has."""
    groups: list[list[JointDescription | BallJointDescription]] = [[]]
    room = _MOST_SPEEDS
    for joint in joints:
        speeds = 3 if isinstance(joint, BallJointDescription) else 1
        if speeds > room:
            groups.append([])
            room = _MOST_SPEEDS
        groups[-1].append(joint)
        room -= speeds
    return groups


def _unless_zero(point: Iterable[float]) -> Iterable[float] | None:
    return point if any(point) else None


def _range(lower: float, upper: float) -> str:
    """Return the ends of a range, which MuJoCo wants to be apart."""
    if lower == upper:
        upper += 1e-15 * max(1.0, abs(lower))
    return format_range(lower, upper)
