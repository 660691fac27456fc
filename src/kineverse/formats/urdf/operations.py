"""URDF descriptions as model operations.

Links become frames and joints degrees of freedom of the same name, below the prefix. The tags of the
operations name the elements: ``joint pr2/l_elbow_flex_joint``, ``body pr2/l_elbow_flex_link``, ``soft limits
...``.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Container, Iterable, Iterator
from dataclasses import replace
from typing import Any

from msgspec import structs

from kineverse import articulations
from kineverse.articulations import Continuous, Fixed, OneDofJoint, Planar, Prismatic, Revolute
from kineverse.articulations import Joint as JointOperation
from kineverse.errors import FormatError
from kineverse.formats.names import NumberedNames, drop_empty_parts
from kineverse.formats.reader_warnings import Fault, warn
from kineverse.formats.xml_reader import quote
from kineverse.model.basic_operations import AddFrame, SetBody, SetData, SoftLimits
from kineverse.model.body import Pose, is_empty_body
from kineverse.model.frame import WORLD, Frame
from kineverse.model.operation import Operation
from kineverse.model.registry import FileContent
from kineverse.shipped.robots import joint_spring, mobile_base
from kineverse.symbols import position

from .description import UrdfJoint, UrdfLink, UrdfRobot
from .kept_elements import DATUM
from .reader import parse_urdf

AXIS_JOINTS: dict[str, type[OneDofJoint]] = {
    "revolute": Revolute,
    "continuous": Continuous,
    "prismatic": Prismatic,
}
_FREE_JOINTS: dict[str, type[JointOperation]] = {
    "fixed": Fixed,
    "floating": articulations.Floating,
    "spherical": articulations.Ball,
}
_SUFFIXES = {
    "planar": ("x", "y", "angle"),
    "spherical": ("qx", "qy", "qz", "qw", "wx", "wy", "wz"),
    "floating": ("x", "y", "z", "qx", "qy", "qz", "qw", "wx", "wy", "wz"),
}
_ROOT = Pose()
_CONTROL = re.compile(r"[\0-\x1f]")


def urdf_file_operations(file: FileContent) -> Iterator[tuple[str, Operation]]:
    """Yield the operations of a URDF file, each with its tag.

    A shipped robot has its mobile base first, and joints of shipped models have their springs.
    """
    robot = parse_urdf(file.content, file.path.name, str(file.path.absolute().parent), file.root, file.strict)
    base = mobile_base(file.shipped, file.prefix) if file.shipped else None
    if base is not None:
        yield base.default_tag(), base
    parent = WORLD if base is None else base.child
    joints = f"{file.prefix}/" if file.prefix else ""
    for operation in urdf_operations(robot, file.prefix, parent, file.strict):
        if file.shipped and isinstance(operation, JointOperation):
            spring = joint_spring(file.shipped, operation.name.removeprefix(joints))
            operation = replace(operation, dynamics=(*operation.dynamics, *spring))
        yield operation.default_tag(), operation


def urdf_operations(
    robot: UrdfRobot, prefix: str | None = None, parent: str = WORLD, strict: bool = False
) -> Iterator[Operation]:
    """Yield the operations that build a robot, from its root outwards."""
    links, joints = assign_names(robot, prefix, strict)

    def frame_name(name: str) -> str:
        return f"{prefix}/{links[name]}" if prefix else links[name]

    def joint_name(name: str) -> str:
        return f"{prefix}/{joints[name]}" if prefix else joints[name]

    root = frame_name(robot.root)
    bodies = {link.name: link.body for link in robot.links if not is_empty_body(link.body)}
    if root != WORLD:
        yield AddFrame(root, Frame(parent, (_ROOT,)))
    elif parent != WORLD:
        raise FormatError(
            f"{robot.source}: its root link is the world, so it cannot be attached to {quote(parent)}. "
            "Load it with a prefix."
        )
    if robot.root in bodies:
        yield SetBody(root, bodies[robot.root])
    for other in robot.more_roots:
        yield AddFrame(frame_name(other), Frame(parent, (_ROOT,)))
        if other in bodies:
            yield SetBody(frame_name(other), bodies[other])
    for joint in robot.joints:
        yield from _joint_operations(joint, frame_name, joint_name)
        if joint.child in bodies:
            yield SetBody(frame_name(joint.child), bodies[joint.child])
    # The world is in many models, so its first child names what is kept of a robot that begins there.
    anchors = [robot.root] if root != WORLD else [joint.child for joint in robot.joints]
    if robot.kept is not None and anchors:
        changed = {k: v for k, v in {**links, **joints}.items() if v != drop_empty_parts(k)}
        kept = structs.replace(robot.kept, anchor=links[anchors[0]], renamed=tuple(changed.items()))
        yield SetData(f"{frame_name(anchors[0])}/{DATUM}", kept.as_datum())


def _joint_operations(
    joint: UrdfJoint, frame_name: Callable[[str], str], joint_name: Callable[[str], str]
) -> Iterator[Operation]:
    name = joint_name(joint.name)
    common: dict[str, Any] = {
        "name": name,
        "parent": frame_name(joint.parent),
        "child": frame_name(joint.child),
        "origin": joint.origin,
        "dynamics": _dynamics(joint),
    }
    if joint.kind in _FREE_JOINTS:
        yield _FREE_JOINTS[joint.kind](**common)
        return
    limits, safety, mimic = joint.limits, joint.safety, joint.mimic
    common |= {"axis": joint.axis, "lower": limits.lower, "upper": limits.upper, "velocity": limits.velocity}
    if joint.kind == "planar":
        yield Planar(**common)
        return
    follows = None if mimic is None else mimic.multiplier * position(joint_name(mimic.leader)) + mimic.offset
    yield AXIS_JOINTS[joint.kind](**common, position=follows)
    if safety is not None and safety.has_limits:
        q = position(name) if follows is None else follows
        yield SoftLimits(name, q, safety.soft_lower, safety.soft_upper)


def _dynamics(joint: UrdfJoint) -> tuple[tuple[str, float], ...]:
    values = {
        "effort": joint.limits.effort,
        "acceleration": joint.limits.acceleration,
        "deceleration": joint.limits.deceleration,
        "jerk": joint.limits.jerk,
        "damping": joint.dynamics.damping or None,
        "friction": joint.dynamics.friction or None,
        "k_position": None if joint.safety is None else joint.safety.k_position,
        "k_velocity": None if joint.safety is None else joint.safety.k_velocity,
    }
    return tuple((name, value) for name, value in values.items() if value is not None)


def assign_names(robot: UrdfRobot, prefix: str | None, strict: bool) -> tuple[dict[str, str], dict[str, str]]:
    """Return the names of links and joints in the model; invalid and repeated names are replaced."""
    numbers = NumberedNames()

    def rename(
        what: str, thing: UrdfLink | UrdfJoint, problem: str, wanted: str, taken: Container[str]
    ) -> str:
        place = f"<{what} name={quote(thing.name)}>"
        if strict:
            raise FormatError(f"{robot.source}, line {thing.line}, {place}: {problem}. Rename it.")
        name = numbers.first_free(wanted, taken)
        warn([Fault(f"{robot.source}, line {thing.line}, {place}: {problem}; it is called {quote(name)}.")])
        return name

    parts: tuple[tuple[str, Iterable[UrdfLink | UrdfJoint]], ...] = (
        ("link", robot.links),
        ("joint", robot.joints),
    )
    found: list[dict[str, str]] = []
    for what, things in parts:
        # Descriptions older than tf2 call links "/base_link".
        plain = {thing.name: drop_empty_parts(thing.name) for thing in things}
        known: dict[str, UrdfLink | UrdfJoint] = {}
        every = set(plain.values())
        for thing in things:
            name = plain[thing.name]
            if not name or _CONTROL.search(name):
                problem = "the name has nothing but slashes, or a control character"
                name = _CONTROL.sub("_", name) or what
                name = rename(what, thing, problem, name, every)
            elif name in known:
                problem = f"only slashes tell it from the one on line {known[name].line}"
                name = rename(what, thing, problem, f"{name}_{what}", every)
            elif what == "link" and name == WORLD and not prefix and thing.name != robot.root:
                problem = "it is not the root, but has the name of the root of all frames. Give a prefix"
                name = rename(what, thing, problem, f"{name}_{what}", every)
            known[name] = thing
            every.add(name)
            plain[thing.name] = name
        found.append(plain)
    links, joints = found
    taken = set(joints.values())
    for joint in robot.joints:
        name = joints[joint.name]
        clash = [f"{name}/{s}" for s in _SUFFIXES.get(joint.kind, ()) if f"{name}/{s}" in taken]
        if clash:
            problem = f"its coordinate {quote(clash[0])} has the name of another joint"
            split = [other.split("/") for other in taken]
            everywhere = {"/".join(parts[: k + 1]) for parts in split for k in range(len(parts))}
            joints[joint.name] = rename("joint", joint, problem, f"{name}_joint", everywhere)
            taken.add(joints[joint.name])
    return links, joints
