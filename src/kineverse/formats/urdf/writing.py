"""A model as URDF text.

Every frame is a link and every coordinate a joint of its name. What moves by several coordinates, or about a
line that does not pass through its origin, hangs on links in between that carry nothing; what moves by a
multiple of a coordinate mimics it.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import numpy.typing as npt

from kineverse.articulations.free_joints import from_z
from kineverse.collection import no_collection
from kineverse.errors import FormatError, KineverseError
from kineverse.formats.export.markup import Tag, document
from kineverse.formats.export.names import Names
from kineverse.formats.export.plan import ITSELF, NO_BODY, BallJoint, Joint, Link, Plan, Written
from kineverse.formats.export.poses import RIGID, angles, deviation
from kineverse.formats.export.recognition import Recognition
from kineverse.formats.export.refusals import Refusals
from kineverse.formats.export.target import Target
from kineverse.formats.remarks import listening
from kineverse.formats.urdf.operations import robot_operations
from kineverse.formats.urdf.reader import parse_urdf
from kineverse.formats.urdf.writing_bodies import BodyWriter
from kineverse.model.frame import WORLD
from kineverse.model.view import ModelView

Matrix = npt.NDArray[np.float64]

URDF = Target("URDF")
OPEN = sys.float_info.max
"""Stands for no limit at all, where URDF wants a number."""

_NEWER = ("acceleration", "deceleration", "jerk")
_KNOWN = frozenset(("effort", "damping", "friction", "k_position", "k_velocity", *_NEWER))
_SPACE = (("x", (1.0, 0.0, 0.0)), ("y", (0.0, 1.0, 0.0)), ("z", (0.0, 0.0, 1.0)))


def urdf_of(
    model: ModelView,
    path: Path,
    leave_out: Iterable[str] = (),
    tolerance: float | None = None,
    strict: bool = False,
) -> Written:
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
    recognition = Recognition(model, URDF, leave_out, tolerance, strict)
    plan = recognition.plan()
    content = UrdfWriter(plan, path, recognition.refusals).document()
    _check(content, path)
    return Written(content, tuple(plan.remarks), plan.errors, recognition.refusals.left_out)


def _check(content: bytes, path: Path) -> None:
    """Read again what was written.

    Raises
    ------
    FormatError
        If there is something wrong with it.
    """
    from kineverse.model.model import Model

    model = Model()
    try:
        with listening(), model.edit() as edit, no_collection():
            robot = parse_urdf(content, path.name, str(path.absolute().parent))
            for operation in robot_operations(robot):
                edit.apply(operation)
    except KineverseError as error:
        raise FormatError(f"What would be written cannot be read again: {error}") from error


class UrdfWriter:
    """Writes one plan."""

    def __init__(self, plan: Plan, path: Path, refusals: Refusals) -> None:
        self._plan, self._path, self._refusals = plan, path, refusals
        self._links = Names([WORLD, *(link.name for link in plan.links)])
        self._joints = Names([*(link.label for link in plan.links), *(joint.name for joint in plan.joints)])
        self._bodies = BodyWriter(path.absolute().parent, plan.remarks)
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
        return document(self._root, [*self._plan.remarks, *self._plan.said_errors])

    def _root_link(self) -> Link | None:
        """Return the link that is where the world is and carries all others, if there is one."""
        below = [link for link in self._plan.links if link.parent == WORLD]
        if len(below) != 1 or self._plan.world != NO_BODY:
            return None
        if below[0].joints or below[0].recorded or not np.array_equal(below[0].pose, np.eye(4)):
            return None
        return below[0]

    def _link(self, link: Link, is_root: bool) -> None:
        if deviation(link.pose) > RIGID:
            self._refusals.add(
                link.name,
                f"is turned by a constant that is off by {deviation(link.pose):.2g} from any rotation",
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
            if isinstance(joint, BallJoint):
                self._refusals.add(joint.name, "turns by a quaternion, which URDF has for free motion only")
                return
            point = np.array(joint.point) if joint.turns else at
            last = k == len(link.joints) - 1 and not point.any()
            child = link.name if last else self._links.take(f"{link.name}/{joint.name.rpartition('/')[2]}")
            element = self._root.add("link", name=child)
            if last:
                self._bodies.write(element, link.body)
            self._axis_joint(joint, parent, child, pose @ _shift(point - at))
            parent, pose, at = child, np.eye(4), point
        if at.any() or not link.joints:
            name = link.label or self._joints.take(f"{link.name}/fixed")
            self._bodies.write(self._root.add("link", name=link.name), link.body)
            self._joint(name, "fixed", parent, link.name, pose @ _shift(-at))

    def _compound(self, link: Link) -> tuple[str, str, tuple[float, ...] | None] | None:
        """Return name, kind and axis of a joint with several coordinates, if the link moves by one."""
        if len(link.joints) not in (3, 4):
            return None
        axes = [j for j in link.joints if isinstance(j, Joint)]
        if any(not j.leads or not _is_plain(j) for j in axes):
            return None
        names = [j.name for j in axes]
        ball = link.joints[-1]
        if isinstance(ball, BallJoint) and len(axes) == 3 and not any(ball.point):
            free = [(f"{ball.name}/{c}", False, axis) for c, axis in _SPACE]
            return (ball.name, "floating", None) if free == [_key(j) for j in axes] else None
        if len(axes) != 3 or len(link.joints) != 3:
            return None
        name, n = names[2].removesuffix("/angle"), axes[2].axis
        turn = from_z(n)
        first, second = (tuple((turn[:3, k] + 0.0).tolist()) for k in (0, 1))
        flat = [(f"{name}/x", False, first), (f"{name}/y", False, second), (f"{name}/angle", True, n)]
        same = all(
            a[:2] == b[:2] and np.abs(np.subtract(a[2], b[2])).max() < RIGID
            for a, b in zip(flat, map(_key, axes), strict=True)
        )
        return (name, "planar", n) if same and not any(axes[2].point) else None

    def _axis_joint(self, joint: Joint, parent: str, child: str, pose: Matrix) -> None:
        kind = "prismatic" if not joint.turns else "continuous" if joint.bounds.open else "revolute"
        element = self._joint(joint.name, kind, parent, child, pose, joint.axis)
        self._limit(element, joint, kind)
        if joint.amount != ITSELF or not joint.leads:
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

    def _limit(self, element: Tag, joint: Joint, kind: str) -> None:
        bounds, known = joint.bounds, joint.dynamics
        effort, fastest = _number(known, "effort"), bounds.fastest
        newer = {key: _number(known, key) for key in _NEWER}
        if kind == "continuous" and effort is None and fastest == math.inf and not any(newer.values()):
            return
        if not fastest > 0:
            self._refusals.add(joint.name, "may not move at all, by a limit of its speed that is 0")
        limit = element.add("limit")
        if kind != "continuous":
            limit.give("lower", max(bounds.lower, -OPEN))
            limit.give("upper", min(bounds.upper, OPEN))
        limit.give("effort", OPEN if effort is None else min(effort, OPEN))
        limit.give("velocity", min(fastest, OPEN))
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
        xyz, rpy = pose[:3, 3].tolist(), angles(pose)
        if any(xyz) or any(rpy):
            element.add("origin", xyz=xyz, rpy=rpy if any(rpy) else None)
        element.add("parent", link=parent)
        element.add("child", link=child)
        if axis is not None:
            element.add("axis", xyz=axis)
        return element


def _shift(offset: Matrix) -> Matrix:
    pose = np.eye(4)
    pose[:3, 3] = offset
    return pose


def _key(joint: Joint) -> tuple[str, bool, tuple[float, ...]]:
    return joint.name, joint.turns, joint.axis


def _is_plain(joint: Joint) -> bool:
    """Whether nothing limits a joint: URDF has no limits of joints with several coordinates."""
    bounds = joint.bounds
    return bounds.open and bounds.soft is None and bounds.fastest == math.inf and not joint.dynamics


def _number(known: object, key: str) -> float | None:
    value = known.get(key) if isinstance(known, dict) else None
    return float(value) if isinstance(value, (int, float)) and not math.isnan(value) else None
