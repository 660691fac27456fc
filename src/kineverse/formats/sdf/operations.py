"""SDF descriptions as model operations.

Links and frames become frames, joints degrees of freedom of the same name, below the prefix. A joint whose
frame is not that of its child link gets an intermediate frame of its own name.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

from kineverse import articulations
from kineverse.errors import FormatError
from kineverse.formats.description import path_between
from kineverse.formats.names import NameMap
from kineverse.formats.poses import IDENTITY, invert_pose, is_identity
from kineverse.formats.urdf.operations import AXIS_JOINTS
from kineverse.formats.xml_reader import quote
from kineverse.loops.close_loop import CloseLoop
from kineverse.loops.equations import AXES
from kineverse.model.basic_operations import AddFrame, SetBody
from kineverse.model.body import is_empty_body
from kineverse.model.frame import WORLD as MODEL_WORLD
from kineverse.model.frame import Frame
from kineverse.model.operation import Operation
from kineverse.model.registry import FileContent
from kineverse.symbols import position, symbol_name

from .description import WORLD, SdfAxis, SdfFrame, SdfJoint, SdfLink, SdfScene
from .reader import parse_sdf

_PERPENDICULAR = 1e-6


def sdf_file_operations(file: FileContent) -> Iterator[tuple[str, Operation]]:
    """Yield the operations of an SDF file, each with its tag."""
    scene = parse_sdf(file.content, file.path.name, str(file.path.absolute().parent), file.root, file.strict)
    for operation in sdf_operations(scene, file.prefix):
        yield operation.default_tag(), operation


def sdf_operations(scene: SdfScene, prefix: str | None = None) -> Iterator[Operation]:
    """Yield the operations that build the models of a file, from the roots outwards."""

    def model_name(name: str) -> str:
        if name == WORLD:
            return MODEL_WORLD
        return f"{prefix}/{name}" if prefix else name

    _check_names(scene)
    bodies = {link.name: link.body for link in scene.links if not is_empty_body(link.body)}
    poses = {link.name: link.pose for link in scene.links}
    for root in scene.roots:
        name = model_name(root.link)
        if root.free:
            free = f"{name}/free"
            yield articulations.Floating(name=free, parent=MODEL_WORLD, child=name, origin=poses[root.link])
        else:
            yield AddFrame(name, Frame(MODEL_WORLD, (poses[root.link],)))
        if root.link in bodies:
            yield SetBody(name, bodies[root.link])
    for joint in scene.joints:
        yield from _tree_joint(joint, model_name)
        if joint.child in bodies:
            yield SetBody(model_name(joint.child), bodies[joint.child])
    for frame in scene.frames:
        yield AddFrame(model_name(frame.name), Frame(model_name(frame.parent), (frame.pose,)))
    above = {joint.child: joint for joint in scene.joints}
    for joint in scene.loops:
        yield from _loop(joint, model_name, _home(joint, above, model_name))


def _tree_joint(joint: SdfJoint, model_name: NameMap) -> Iterator[Operation]:
    """Yield the operations of a joint, with an intermediate frame if its frame is not that of its child."""
    if is_identity(joint.pose_in_child):
        yield from _motions(joint, model_name, model_name(joint.child))
        return
    between, link = model_name(joint.name), model_name(joint.child)
    yield from _motions(joint, model_name, between)
    yield AddFrame(link, Frame(between, (invert_pose(joint.pose_in_child),)))


def _home(
    loop: SdfJoint, above: Mapping[str, SdfJoint], model_name: NameMap
) -> tuple[tuple[str, float], ...]:
    """Return the home position of the quaternions in a loop; its other coordinates are 0."""
    parents = {link: joint.parent for link, joint in above.items()}
    joints = [above[link] for link in path_between(loop.parent, loop.child, parents)]
    return tuple(
        (symbol_name(f"{model_name(joint.name)}/qw", 0), 1.0) for joint in joints if joint.kind == "ball"
    )


def _loop(joint: SdfJoint, model_name: NameMap, home: tuple[tuple[str, float], ...]) -> Iterator[Operation]:
    """Yield the operations of a joint to a frame of its own, and of the loop that closes it at the link."""
    name = model_name(joint.name)
    closed, loop = f"{name}/closed", f"{name}/loop"
    ball = joint.kind == "ball"
    if ball or joint.kind == "fixed":
        yield AddFrame(name, Frame(model_name(joint.parent), (joint.pose_in_parent,)))
    else:
        yield from _motions(joint, model_name, name)
    yield AddFrame(closed, Frame(model_name(joint.child), (joint.pose_in_child,)))
    yield CloseLoop(name=loop, frame=closed, to=name, mask=AXES[:3] if ball else AXES, home=home)


def _motions(joint: SdfJoint, model_name: NameMap, child: str) -> Iterator[Operation]:
    name = model_name(joint.name)
    common: dict[str, Any] = {
        "name": name,
        "parent": model_name(joint.parent),
        "child": child,
        "origin": IDENTITY if is_identity(joint.pose_in_parent) else joint.pose_in_parent,
    }
    if joint.kind == "fixed":
        yield articulations.Fixed(**common)
    elif joint.kind == "ball":
        yield articulations.Ball(**common, dynamics=_dynamics(joint, ""))
    elif joint.kind == "gearbox":
        (axis,) = joint.axes
        assert joint.gear is not None
        driver, given = position(model_name(joint.gear.leader)), _axis(axis, model_name)
        del given["position"]  # it follows from that of the driver
        ratio, offset = joint.gear.multiplier, joint.gear.offset
        yield articulations.Gearbox(**common, **given, driver=driver, ratio=ratio, offset=offset)
    elif joint.kind in ("universal", "revolute2"):
        yield from _two_axes(joint, common, model_name)
    else:
        (axis,) = joint.axes
        given = _axis(axis, model_name)
        if joint.kind == "screw":
            yield articulations.Screw(**common, **given, pitch=joint.pitch)
        else:
            yield AXIS_JOINTS[joint.kind](**common, **given)


def _two_axes(joint: SdfJoint, common: dict[str, Any], model_name: NameMap) -> Iterator[Operation]:
    """Yield a universal joint, or two hinges in series if it is reversed, coupled, or not perpendicular."""
    first, second = joint.axes
    cosine = math.fsum(a * b for a, b in zip(first.xyz, second.xyz, strict=True))
    independent = first.mimic is None and second.mimic is None
    if joint.kind == "universal" and independent and not joint.is_reversed and abs(cosine) <= _PERPENDICULAR:
        yield articulations.Universal(
            **common,
            first=first.xyz,
            second=second.xyz,
            first_limits=articulations.Limits(first.lower, first.upper, first.velocity),
            second_limits=articulations.Limits(second.lower, second.upper, second.velocity),
            dynamics=(*_dynamics(joint, "first/", 0), *_dynamics(joint, "second/", 1)),
        )
        return
    name = common["name"]
    between = name + first.suffix
    yield articulations.Revolute(
        **(common | {"name": name + first.suffix, "child": between}), **_axis(first, model_name)
    )
    own = {"name": name + second.suffix, "parent": between, "child": common["child"], "origin": IDENTITY}
    yield articulations.Revolute(**own, **_axis(second, model_name))


def _axis(axis: SdfAxis, model_name: NameMap) -> dict[str, Any]:
    return {
        "axis": axis.xyz,
        "lower": axis.lower,
        "upper": axis.upper,
        "velocity": axis.velocity,
        "position": None
        if axis.mimic is None
        else axis.mimic.multiplier * position(model_name(axis.mimic.leader)) + axis.mimic.offset,
        "dynamics": axis.dynamics,
    }


def _dynamics(joint: SdfJoint, prefix: str, index: int = 0) -> tuple[tuple[str, float], ...]:
    axes = joint.axes[index : index + 1]
    return tuple((prefix + key, value) for axis in axes for key, value in axis.dynamics)


def _check_names(scene: SdfScene) -> None:
    frames: dict[str, str] = {MODEL_WORLD: "the world"}
    articulations: dict[str, str] = {}

    def take(taken: dict[str, str], name: str, what: str, part: SdfLink | SdfFrame | SdfJoint) -> None:
        other = taken.setdefault(name, f"{what} of line {part.line}")
        if other != f"{what} of line {part.line}" or not name:
            raise FormatError(
                f"{part.source}, line {part.line}: {what} would be called {quote(name)} here, as {other} is. "
                "Rename one of them."
            )

    for link in scene.links:
        take(frames, link.name, "the link", link)
    for frame in scene.frames:
        take(frames, frame.name, "the frame", frame)
    free = {root.link for root in scene.roots if root.free}
    for link in scene.links:
        if link.name in free:
            take(articulations, f"{link.name}/free", "the free motion of the link", link)
    for joint in (*scene.joints, *scene.loops):
        take(articulations, joint.name, "the joint", joint)
        for axis in joint.axes if len(joint.axes) == 2 else ():
            take(articulations, joint.name + axis.suffix, f"the {axis.suffix[1:]} axis", joint)
        if joint in scene.loops or not is_identity(joint.pose_in_child):
            take(frames, joint.name, "the frame of the joint", joint)
