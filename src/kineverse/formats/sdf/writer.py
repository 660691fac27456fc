"""Models as SDF text.

Every moving frame becomes a link, and every coordinate a joint of its name. A frame without a body that
nothing moves becomes a ``<frame>``. A joint turns about any line of its link; a link that moves by several
coordinates has intermediate links. A joint that moves by a multiple of a coordinate mimics the joint of that
coordinate. A joint between two frames closes a loop.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from kineverse.errors import list_some
from kineverse.formats.description import (
    BallJointDescription,
    JointBounds,
    JointDescription,
    LinkDescription,
    LoopJoint,
    Matrix,
    RobotDescription,
    WrittenFile,
    dynamics_number,
)
from kineverse.formats.export.capabilities import FormatCapabilities, UnsupportedFeatures
from kineverse.formats.export.link_tree import LinkTreeBuilder, check_rotation
from kineverse.formats.loader import check_readable
from kineverse.formats.loop_closures import CLOSED
from kineverse.formats.names import TakenNames
from kineverse.formats.poses import ROTATION_TOLERANCE, pose_from_quaternion
from kineverse.formats.xml_writer import Tag, format_numbers, format_xml
from kineverse.lie import translation
from kineverse.model.body import NO_BODY, Vector3
from kineverse.model.frame import WORLD
from kineverse.model.model_view import ModelView
from kineverse.symbols import parse_symbol_name

from .body_writer import SdfBodyWriter, add_sdf_pose
from .custom_attributes import (
    FREE,
    HOME,
    LOOP,
    NAME,
    NAMESPACE,
    PREFIX,
    ZERO,
    SdfLoop,
    allowed_name,
    joint_motion,
)

SDF_CAPABILITIES = FormatCapabilities("SDF", loop_joints=True)

_VERSION, _CONE_VERSION = "1.11", "1.12"
"""Version of written files: the first one with ``<mimic>``, or with cones."""

_DYNAMICS = {
    "damping": ("damping",),
    "friction": ("friction",),
    "spring_reference": ("spring_reference", "rest"),
    "spring_stiffness": ("spring_stiffness", "stiffness"),
}
_KNOWN = frozenset(("effort", *(key for keys in _DYNAMICS.values() for key in keys)))
_QUATERNION = ("qx", "qy", "qz", "qw")
_UNTURNED = (0.0, 0.0, 0.0, 1.0)
_PERPENDICULAR = 1e-9  # largest cosine of the axes of a universal joint; drake takes 1e-9 as well
_Z = (0.0, 0.0, 1.0)


def to_sdf(
    model: ModelView,
    path: Path,
    leave_out: Iterable[str] = (),
    tolerance: float | None = None,
    strict: bool = False,
) -> WrittenFile:
    """Convert a model to SDF."""
    builder = LinkTreeBuilder(model, SDF_CAPABILITIES, leave_out, tolerance, strict)
    description = builder.build()
    home = builder.home_positions()
    looped = set(_check_closed(model, description.loops, home, builder.unsupported))
    content = SdfWriter(description, path, builder.unsupported, home, looped).document()
    check_readable(content, path)
    return WrittenFile(content, tuple(description.remarks), description.errors, builder.unsupported.left_out)


def _check_closed(
    model: ModelView, loops: Iterable[LoopJoint], home: Mapping[str, float], unsupported: UnsupportedFeatures
) -> Iterator[str]:
    """Yield the coordinates of loops; refuse a loop that is open at home, where SDF would close it."""
    for loop in loops:
        yield from (parse_symbol_name(name)[0] for name in (*loop.free, *loop.dependent))
        for frame, to in loop.ends:
            pose = model.fk(frame, to)
            yield from (symbol.path for symbol in pose.symbols if symbol.path in home)
            gap = pose({symbol: home.get(symbol.path, symbol.value) for symbol in pose.symbols}) - np.eye(4)
            rows = gap[:3, 3] if loop.kind == "connect" else gap
            if np.abs(rows).max() > CLOSED:
                unsupported.refuse(
                    loop.name, "is open at home, and SDF closes a loop at the poses of the file"
                )


class SdfWriter:
    """Writer of one robot description as SDF.

    ``home`` is the home position of every coordinate, by its path, and ``looped`` are those in loops.
    """

    def __init__(
        self,
        description: RobotDescription,
        path: Path,
        unsupported: UnsupportedFeatures,
        home: Mapping[str, float],
        looped: Collection[str],
    ) -> None:
        self._looped = looped
        self._description, self._path, self._unsupported, self._home = description, path, unsupported, home
        self._bodies = SdfBodyWriter(path.absolute().parent, description.remarks)
        name = allowed_name(path.name.removesuffix(path.suffix) or "model")
        self._model = Tag("model", {"name": name})
        self._names = TakenNames([WORLD])
        self._frames = {WORLD: WORLD}
        self._renamed: dict[str, str] = {}
        for link in description.links:
            self._frames[link.name] = self._names.take(allowed_name(link.name), f"{allowed_name(link.name)}_")
            if self._frames[link.name] != link.name:
                self._renamed[link.name] = self._frames[link.name]
        self._axes: dict[str, tuple[str, str]] = {}
        self._joints = {id(link): self._plan(link) for link in description.links}

    def document(self) -> bytes:
        """Return the text of the file."""
        self._world_body()
        for link in self._description.links:
            self._link(link)
        for loop in self._description.loops:
            self._loop(loop)
        self._unsupported.check(self._path.name)
        if self._renamed:
            shown = list_some((f"'{old}' is '{new}'" for old, new in self._renamed.items()), 4)
            self._description.remarks.append(
                f"SDF allows no two things of one name, and reserves some names: {shown}. "
                "Kineverse reads the old names"
            )
        self._bodies.finish()
        self._description.remarks += self._unsupported.remarks
        version = _CONE_VERSION if self._bodies.has_cones else _VERSION
        root = Tag("sdf", {"version": version, f"xmlns:{PREFIX}": NAMESPACE}, [self._model])
        return format_xml(root, [*self._description.remarks, *self._description.error_lines])

    def _plan(self, link: LinkDescription) -> list[_SdfJoint]:
        """Return the joints of a link, and assign the names of their coordinates."""
        if self._free_name(link):
            return []
        planned = list(_merge_joints(link, self._looped))
        for joint in planned:
            joint.name = self._take_joint(joint.coordinate)
            if joint.is_independent:
                for suffix, axis in joint.suffixes.items():
                    self._axes[joint.coordinate + suffix] = joint.name, axis
        return planned

    def _frame(self, name: str) -> str:
        """Return the name of a frame in the file; one that is refused keeps its own."""
        return self._frames.get(name, name)

    def _take_joint(self, wanted: str, is_renaming_told: bool = True) -> str:
        name = allowed_name(wanted)
        taken = self._names.take(name, f"{name}_joint")
        if taken != wanted and is_renaming_told:
            self._renamed[wanted] = taken
        return taken

    def _world_body(self) -> None:
        """Add a link that has the shapes of the world, or that is there as SDF knows no model without."""
        body = self._description.world_body
        if body == NO_BODY and self._description.links:
            return
        name = self._names.take("world_body")
        if body != NO_BODY:
            self._description.remarks.append(f"the shapes of the world are those of a link '{name}'")
        element = self._model.add("link", name=name)
        self._bodies.write(element, body, name)
        self._joint("fixed", self._names.take(f"{name}_fixed"), WORLD, name)

    def _link(self, link: LinkDescription) -> None:
        check_rotation(link, self._unsupported)
        if link.dynamics:
            self._description.remarks.append(
                f"'{link.name}' is moved by several joints in SDF: "
                f"the {' and '.join(link.dynamics)} of all is left out"
            )
        planned, parent, pose = self._joints[id(link)], link.parent, link.pose
        free = self._free_name(link)
        if free:
            self._free_link(link, free)
            return
        if not planned:
            self._fixed(link)
            return
        here = self._frame(parent)
        for k, joint in enumerate(planned):
            is_last = k == len(planned) - 1
            name = self._frames[link.name] if is_last else self._names.take(f"{joint.name}_link")
            zero = joint.zero(self._home, self._looped)
            placed = pose @ _motion_in_link(joint, zero) if zero else pose
            element = self._add_link(link.name if is_last else name, name, placed, here)
            self._bodies.write(element, link.body if is_last else NO_BODY, link.name if is_last else name)
            self._moving_joint(joint, zero, here, name)
            here, pose = name, np.eye(4)

    def _add_link(self, frame: str, name: str, pose: Matrix, parent: str) -> Tag:
        element = self._model.add("link", name=name)
        if name != frame:
            element.attributes[NAME] = frame
        add_sdf_pose(element, pose, None if parent == WORLD else parent)
        return element

    def _fixed(self, link: LinkDescription) -> None:
        name, parent = self._frames[link.name], self._frame(link.parent)
        if link.body == NO_BODY and link.parent != WORLD:
            element = self._model.add("frame", name=name, attached_to=parent)
            if name != link.name:
                element.attributes[NAME] = link.name
            add_sdf_pose(element, link.pose)
            return
        element = self._add_link(link.name, name, link.pose, parent)
        self._bodies.write(element, link.body, link.name)
        wanted = link.fixed_joint_name or f"{link.name}/fixed"
        joint = self._joint("fixed", self._take_joint(wanted, False), parent, name)
        if joint.attributes["name"] != wanted:
            joint.attributes[NAME] = wanted

    def _free_name(self, link: LinkDescription) -> str:
        """Return the name of the free motion of a link in the world; empty if it has no such motion."""
        free = link.free_motion if link.parent == WORLD else ""
        if not free or self._description.has_followers(link):
            return ""
        slides = [joint for joint in link.joints if isinstance(joint, JointDescription)]
        is_plain = all(j.bounds == JointBounds() and j.name not in self._looped for j in slides)
        return free if is_plain else ""

    def _free_link(self, link: LinkDescription, free: str) -> None:
        values = [self._home.get(f"{free}/{c}", 0.0) for c in ("x", "y", "z", *_QUATERNION)]
        motion = pose_from_quaternion(tuple(values[:3]), tuple(values[3:])).matrix
        element = self._add_link(link.name, self._frames[link.name], link.pose @ motion, WORLD)
        element.attributes[FREE] = free
        if tuple(values) != (0.0, 0.0, 0.0, *_UNTURNED):
            element.attributes[HOME] = format_numbers(values)
        self._bodies.write(element, link.body, link.name)

    def _joint(self, kind: str, name: str, parent: str, child: str) -> Tag:
        element = self._model.add("joint", name=name, type=kind)
        element.add_text("parent", parent)
        element.add_text("child", child)
        return element

    def _moving_joint(self, joint: _SdfJoint, zero: Sequence[float], parent: str, child: str) -> None:
        element = self._joint(joint.kind, joint.name, parent, child)
        if joint.name != joint.coordinate:
            element.attributes[NAME] = joint.coordinate
        if zero:
            element.attributes[ZERO] = format_numbers(zero)
        home = joint.home(self._home)
        if home:
            element.attributes[HOME] = format_numbers(home)
        if any(joint.point):
            add_sdf_pose(element, translation(np.array(joint.point)))
        shift = zero[0] if len(zero) == 1 else 0.0
        for tag, axis in zip(("axis", "axis2"), joint.axes, strict=False):
            self._axis(element.add(tag), axis, shift)
        if joint.kind == "screw":
            element.add_text("screw_thread_pitch", joint.pitch)
        if joint.kind == "ball":
            self._say_missing(joint.coordinate, joint.dynamics, ())

    def _axis(self, element: Tag, joint: JointDescription, shift: float) -> None:
        element.add_text("xyz", joint.axis)
        bounds, effort = joint.bounds, dynamics_number(joint.dynamics, "effort")
        if not bounds.max_velocity > 0:
            self._unsupported.refuse(joint.name, "may not move at all, by a limit of its speed that is 0")
        if bounds.soft is not None:
            self._unsupported.leave_out(f"{joint.name}/soft_limits", "are soft limits")
        limits = {
            "lower": bounds.lower - shift,
            "upper": bounds.upper - shift,
            "effort": math.inf if effort is None else effort,
            "velocity": bounds.max_velocity,
        }
        limit = Tag("limit")
        for key, value in limits.items():
            if math.isfinite(value):
                limit.add_text(key, value)
        dynamics = Tag("dynamics")
        for key, names in _DYNAMICS.items():
            values = (dynamics_number(joint.dynamics, name) for name in names)
            value = next((value for value in values if value), 0.0)
            if value:
                dynamics.add_text(key, value - shift if key == "spring_reference" else value)
        element.inside += [part for part in (limit, dynamics) if part.inside]
        if not joint.is_independent:
            self._mimic(element, joint, shift)
        self._say_missing(joint.name, joint.dynamics, _KNOWN)

    def _mimic(self, element: Tag, joint: JointDescription, shift: float) -> None:
        known = self._axes.get(joint.symbol.path)
        if known is None:
            return  # what it follows is refused
        offset, factor = (*joint.coefficients, 0.0)[:2]
        leader, axis = known
        mimic = element.add("mimic", joint=leader, axis=None if axis == "axis" else axis)
        mimic.add_text("multiplier", factor)
        mimic.add_text("offset", offset - shift)
        leader_shift = self._home[joint.symbol.path] if joint.symbol.path in self._looped else 0.0
        mimic.add_text("reference", 0.0 - leader_shift)

    def _say_missing(self, name: str, dynamics: Mapping[str, Any], known: Iterable[str]) -> None:
        for key, value in dynamics.items():
            if value and key not in known:
                self._description.remarks.append(f"SDF has no {key} here: that of '{name}' is left out")

    def _loop(self, loop: LoopJoint) -> None:
        """Add a joint for each pair of frames that a loop keeps together: a ball, or a fixed one."""
        dependent = None if loop.constraints else tuple(parse_symbol_name(name)[0] for name in loop.dependent)
        record = SdfLoop(loop.name, () if loop.constraints else dependent)
        for k, (frame, to) in enumerate(loop.ends):
            wanted = loop.name.removesuffix("/loop") + (f"/{k}" if k else "")
            kind = "ball" if loop.kind == "connect" else "fixed"
            ends = self._frame(to), self._frame(frame)
            if ends[1] == WORLD:
                ends = ends[1], ends[0]
            element = self._joint(kind, self._take_joint(wanted, False), *ends)
            element.attributes[LOOP] = record.as_text()


class _SdfJoint:
    """Joint of SDF, which is one or several joints of a link, with the name of its coordinates."""

    def __init__(
        self,
        kind: str,
        coordinate: str,
        axes: Sequence[JointDescription] = (),
        point: Vector3 = (0.0, 0.0, 0.0),
        pitch: float = 0.0,
        dynamics: Mapping[str, Any] | None = None,
    ) -> None:
        self.kind, self.coordinate, self.axes, self.point = kind, coordinate, axes, point
        self.pitch, self.dynamics = pitch, dynamics or {}
        self.name = ""  # name in the file

    @property
    def is_independent(self) -> bool:
        """True if its positions are coordinates."""
        return all(axis.is_independent for axis in self.axes)

    @property
    def suffixes(self) -> Mapping[str, str]:
        """Element of the axis of each coordinate, by the part of its name after that of the joint."""
        if self.kind == "universal":
            return {"/first": "axis", "/second": "axis2"}
        return {} if self.kind == "ball" else {"": "axis"}

    def zero(self, home: Mapping[str, float], looped: Iterable[str]) -> tuple[float, ...]:
        """Return the values of its coordinates at the poses of the file: those at home, in a loop."""
        if self.kind == "ball":
            names = [f"{self.coordinate}/{c}" for c in _QUATERNION]
            values = tuple(home.get(name, default) for name, default in zip(names, _UNTURNED, strict=True))
            return values if any(name in looped for name in names) and values != _UNTURNED else ()
        if self.kind == "universal" or self.axes[0].symbol.path not in looped:
            return ()
        value = _position(self.axes[0], home)
        return (value,) if value else ()

    def home(self, home: Mapping[str, float]) -> tuple[float, ...]:
        """Return the home of its coordinates; empty if a reader takes the same by default."""
        if self.kind == "ball":
            values = tuple(home.get(f"{self.coordinate}/{c}", 0.0) for c in _QUATERNION)
            return values if values != _UNTURNED else ()
        if not self.is_independent:
            return ()
        values = tuple(home.get(axis.symbol.path, 0.0) for axis in self.axes)
        default = tuple(axis.bounds.home for axis in self.axes)
        return values if values != default else ()


def _position(joint: JointDescription, home: Mapping[str, float]) -> float:
    return float(np.polynomial.polynomial.polyval(home.get(joint.symbol.path, 0.0), joint.coefficients))


def _merge_joints(link: LinkDescription, looped: Iterable[str]) -> Iterator[_SdfJoint]:
    """Yield the joints of a link in SDF: those of a screw and of a universal joint are one."""
    joints = list(link.joints)
    if len(joints) == 2 and all(isinstance(joint, JointDescription) for joint in joints):
        first, second = (joint for joint in joints if isinstance(joint, JointDescription))
        for turn, slide in ((first, second), (second, first)):
            pitch = _screw_pitch(turn, slide)
            if pitch:
                yield _SdfJoint("screw", turn.name, (turn,), turn.point, pitch)
                return
        name = first.name.removesuffix("/first")
        closed = {first.symbol.path, second.symbol.path}.isdisjoint(looped)
        if closed and _is_universal(first, second, name):
            yield _SdfJoint("universal", name, (first, second), first.point)
            return
    for joint in joints:
        if isinstance(joint, BallJointDescription):
            yield _SdfJoint("ball", joint.name, (), joint.point, dynamics=joint.dynamics)
        else:
            kind = "prismatic"
            if joint.is_rotation:
                kind = "continuous" if joint.bounds.is_unbounded else "revolute"
            yield _SdfJoint(kind, joint.name, (joint,), joint.point if joint.is_rotation else (0.0, 0.0, 0.0))


def _screw_pitch(turn: JointDescription, slide: JointDescription) -> float:
    """Return the pitch of the screw that two motions make [m per revolution]; 0 if they make none."""
    if not turn.is_rotation or slide.is_rotation or not turn.is_independent or slide.symbol != turn.symbol:
        return 0.0
    if (
        slide.bounds != JointBounds()
        or slide.dynamics
        or len(slide.coefficients) != 2
        or slide.coefficients[0]
    ):
        return 0.0
    for sign in (1.0, -1.0):
        if np.abs(np.subtract(turn.axis, np.multiply(slide.axis, sign))).max() <= ROTATION_TOLERANCE:
            return sign * slide.coefficients[1] * math.tau
    return 0.0


def _is_universal(first: JointDescription, second: JointDescription, name: str) -> bool:
    cosine = abs(math.fsum(a * b for a, b in zip(first.axis, second.axis, strict=True)))
    return (
        (first.name, second.name) == (f"{name}/first", f"{name}/second")
        and first.is_rotation
        and second.is_rotation
        and first.is_independent
        and second.is_independent
        and first.point == second.point
        and cosine <= _PERPENDICULAR
    )


def _motion_in_link(joint: _SdfJoint, zero: Sequence[float]) -> Matrix:
    """Return the motion of a joint from zero to the poses of the file, in the axes of its link."""
    axis, turns = (joint.axes[0].axis, joint.axes[0].is_rotation) if joint.axes else (_Z, True)
    point = translation(np.array(joint.point))
    motion: Matrix = point @ joint_motion(axis, turns, zero, joint.pitch).matrix @ np.linalg.inv(point)
    return motion
