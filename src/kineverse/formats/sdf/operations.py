"""SDF descriptions as model operations.

Links and frames become frames, joints degrees of freedom of the same name, below the prefix. A joint whose
frame is not that of its child link gets an intermediate frame of its own name.
"""

from __future__ import annotations

import math
from collections.abc import Container, Iterator, Mapping
from dataclasses import replace
from typing import Any

from kineverse import articulations
from kineverse.errors import FormatError
from kineverse.formats.description import path_between
from kineverse.formats.names import NameMap
from kineverse.formats.poses import (
    IDENTITY,
    compose_poses,
    invert_pose,
    is_identity,
    pose_from_quaternion,
)
from kineverse.formats.urdf.operations import AXIS_JOINTS
from kineverse.formats.xml_reader import quote
from kineverse.loops.close_loop import CloseLoop
from kineverse.loops.equations import AXES
from kineverse.model.basic_operations import AddFrame, SetBody, SetHome
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
    links = {link.name: link for link in scene.links}
    for root in scene.roots:
        name = model_name(root.link)
        if root.free:
            yield from _free_motion(links[root.link], name, model_name)
        else:
            yield AddFrame(name, Frame(MODEL_WORLD, (links[root.link].pose,)))
        if root.link in bodies:
            yield SetBody(name, bodies[root.link])
    for joint in scene.joints:
        yield from _tree_joint(joint, model_name)
        if joint.child in bodies:
            yield SetBody(model_name(joint.child), bodies[joint.child])
    for frame in scene.frames:
        yield AddFrame(model_name(frame.name), Frame(model_name(frame.parent), (frame.pose,)))
    above = {joint.child: joint for joint in scene.joints}
    closing: dict[str, list[SdfJoint]] = {}
    for joint in scene.loops:
        name = f"{joint.name}/loop" if joint.loop is None else joint.loop.name
        closing.setdefault(name, []).append(joint)
    dependent: set[str] = set()
    for joints in closing.values():
        # Ends that close one loop together have the same rows; others are loops of their own.
        together = [joint for joint in joints if (joint.kind == "ball") == (joints[0].kind == "ball")]
        alone = [replace(joint, loop=None) for joint in joints if joint not in together]
        for group in (together, *([joint] for joint in alone)):
            home = _home(group, above, dependent)
            placed = tuple((symbol_name(model_name(name), 0), value) for name, value in home.items())
            yield from _loop(group, model_name, placed)
            dependent |= set(group[0].loop.dependent or ()) if group[0].loop else set()
    for joint in scene.joints:
        if joint.home and joint.name not in dependent and not any(axis.mimic for axis in joint.axes):
            yield SetHome(model_name(joint.name), joint.home)


def _tree_joint(joint: SdfJoint, model_name: NameMap) -> Iterator[Operation]:
    """Yield the operations of a joint, with an intermediate frame if its frame is not that of its child."""
    if is_identity(joint.pose_in_child):
        yield from _motions(joint, model_name, model_name(joint.child))
        return
    between, link = model_name(joint.frame or joint.name), model_name(joint.child)
    yield from _motions(joint, model_name, between)
    yield AddFrame(link, Frame(between, (invert_pose(joint.pose_in_child),)))


def _free_motion(link: SdfLink, name: str, model_name: NameMap) -> Iterator[Operation]:
    """Yield the free motion of a link, from the pose in the file or from where its home leads to that."""
    free, origin = model_name(link.free) if link.free else f"{name}/free", link.pose
    if link.home:
        xyz, quaternion = link.home[:3], link.home[3:]
        origin = compose_poses(origin, invert_pose(pose_from_quaternion(xyz, quaternion)))
    yield articulations.Floating(name=free, parent=MODEL_WORLD, child=name, origin=origin)
    if link.home:
        yield SetHome(free, link.home)


def _home(
    closing: list[SdfJoint], above: Mapping[str, SdfJoint], dependent: Container[str]
) -> dict[str, float]:
    """Return the coordinates in a loop that are not 0 where the file closes it, but for dependent ones."""
    parents = {link: joint.parent for link, joint in above.items()}
    names = (link for joint in closing for link in path_between(joint.parent, joint.child, parents))
    home: dict[str, float] = {}
    for joint in (above[link] for link in dict.fromkeys(names)):
        if joint.kind == "ball":
            values = joint.zero or joint.home or (0.0, 0.0, 0.0, 1.0)
            pairs = zip(("qx", "qy", "qz", "qw"), values, strict=True)
            home |= {f"{joint.name}/{key}": value for key, value in pairs if value}
        elif len(joint.axes) == 1 and joint.zero and joint.axes[0].mimic is None:
            home[joint.name] = joint.zero[0]
    return {name: value for name, value in home.items() if name not in dependent}


def _loop(
    closing: list[SdfJoint], model_name: NameMap, home: tuple[tuple[str, float], ...]
) -> Iterator[Operation]:
    """Yield the operations of joints to frames of their own, and of the loop that closes there.

    A joint that states its loop closes it together with others.
    """
    pairs = []
    for joint in closing:
        name = model_name(joint.frame or joint.name)
        if joint.kind in ("ball", "fixed"):
            yield AddFrame(name, Frame(model_name(joint.parent), (joint.pose_in_parent,)))
        else:
            yield from _motions(joint, model_name, name)
        yield AddFrame(f"{name}/closed", Frame(model_name(joint.child), (joint.pose_in_child,)))
        pairs.append((f"{name}/closed", name))
    first = closing[0]
    stated = first.loop.dependent if first.loop else None
    (frame, to), *more = pairs
    yield CloseLoop(
        name=model_name(first.loop.name) if first.loop else f"{model_name(first.name)}/loop",
        frame=frame,
        to=to,
        more=tuple(more),
        mask=AXES[:3] if first.kind == "ball" else AXES,
        dependent=None if stated is None else tuple(symbol_name(model_name(one), 0) for one in stated),
        home=home,
    )


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
        if name in taken:
            raise FormatError(
                f"{part.source}, line {part.line}: {what} would be called {quote(name)} here, as "
                f"{taken[name]} is. Rename one of them."
            )
        taken[name] = f"{what} of line {part.line}"

    for link in scene.links:
        take(frames, link.name, "the link", link)
    for frame in scene.frames:
        take(frames, frame.name, "the frame", frame)
    free = {root.link for root in scene.roots if root.free}
    for link in scene.links:
        if link.name in free:
            take(articulations, link.free or f"{link.name}/free", "the free motion of the link", link)
    for joint in (*scene.joints, *scene.loops):
        take(articulations, joint.name, "the joint", joint)
        for axis in joint.axes if len(joint.axes) == 2 else ():
            take(articulations, joint.name + axis.suffix, f"the {axis.suffix[1:]} axis", joint)
        if joint in scene.loops or not is_identity(joint.pose_in_child):
            take(frames, joint.frame or joint.name, "the frame of the joint", joint)
