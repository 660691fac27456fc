"""SDF descriptions as model operations.

Links and frames become frames, joints degrees of freedom of the same name, below the prefix. A joint whose
frame is not that of the link below it has a frame of its own in between, with its name.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from kineverse.articulations import (
    Ball,
    Continuous,
    Fixed,
    Floating,
    Gearbox,
    Limits,
    OneDofJoint,
    Prismatic,
    Revolute,
    Screw,
    Universal,
)
from kineverse.errors import FormatError
from kineverse.expressions.expression import Expression
from kineverse.formats.mimic import MimicRelation
from kineverse.formats.poses import IDENTITY, invert_pose, is_identity
from kineverse.formats.tree import path_between
from kineverse.formats.xml_reader import quote
from kineverse.loops.close_loop import CloseLoop
from kineverse.loops.equations import AXES
from kineverse.model.body import is_empty_body
from kineverse.model.frame import WORLD as MODEL_WORLD
from kineverse.model.frame import Frame as Placed
from kineverse.model.operation import Operation
from kineverse.model.operations import AddFrame, SetBody
from kineverse.model.registry import FileContent
from kineverse.symbols import position, symbol_name

from .description import WORLD, SdfAxis, SdfJoint, SdfScene
from .reader import parse_sdf

_AXIS_JOINTS: dict[str, type[OneDofJoint]] = {
    "revolute": Revolute,
    "continuous": Continuous,
    "prismatic": Prismatic,
}
_PERPENDICULAR = 1e-6

SdfNameMap = Callable[[str], str]


def sdf_file_operations(file: FileContent) -> Iterator[tuple[str, Operation]]:
    """Yield the operations of an SDF file, each with its tag."""
    scene = parse_sdf(file.content, file.path.name, str(file.path.absolute().parent), file.root, file.strict)
    for operation in sdf_operations(scene, file.prefix):
        yield operation.default_tag(), operation


def sdf_operations(scene: SdfScene, prefix: str | None = None) -> Iterator[Operation]:
    """Yield the operations that build the models of a file, from the roots outwards.

    Parameters
    ----------
    scene
        The description.
    prefix
        Put in front of the names of frames and degrees of freedom, with a slash.

    Raises
    ------
    FormatError
        If two things would have the same name.
    """

    def named(name: str) -> str:
        if name == WORLD:
            return MODEL_WORLD
        return f"{prefix}/{name}" if prefix else name

    _check_names(scene)
    bodies = {link.name: link.body for link in scene.links if not is_empty_body(link.body)}
    poses = {link.name: link.pose for link in scene.links}
    for root in scene.roots:
        name = named(root.link)
        if root.free:
            free = f"{name}/free"
            yield Floating(name=free, parent=MODEL_WORLD, child=name, origin=poses[root.link])
        else:
            yield AddFrame(name, Placed(MODEL_WORLD, (poses[root.link],)))
        if root.link in bodies:
            yield SetBody(name, bodies[root.link])
    for joint in scene.joints:
        yield from _tree_joint(joint, named)
        if joint.child in bodies:
            yield SetBody(named(joint.child), bodies[joint.child])
    for frame in scene.frames:
        yield AddFrame(named(frame.name), Placed(named(frame.parent), (frame.pose,)))
    above = {joint.child: joint for joint in scene.joints}
    for joint in scene.loops:
        yield from _loop(joint, named, _home(joint, above, named))


def _tree_joint(joint: SdfJoint, named: SdfNameMap) -> Iterator[Operation]:
    if is_identity(joint.in_child):
        yield from _motions(joint, named, named(joint.child))
        return
    between, link = named(joint.name), named(joint.child)
    yield from _motions(joint, named, between)
    yield AddFrame(link, Placed(between, (invert_pose(joint.in_child),)))


def _home(loop: SdfJoint, above: Mapping[str, SdfJoint], named: SdfNameMap) -> tuple[tuple[str, float], ...]:
    """Return where quaternions are that a loop goes by; all other coordinates are 0 there."""
    parents = {link: joint.parent for link, joint in above.items()}
    inside = [above[link] for link in path_between(loop.parent, loop.child, parents)]
    return tuple((symbol_name(f"{named(joint.name)}/qw", 0), 1.0) for joint in inside if joint.kind == "ball")


def _loop(joint: SdfJoint, named: SdfNameMap, home: tuple[tuple[str, float], ...]) -> Iterator[Operation]:
    """Yield a joint that ends in a frame of its own, and the loop that ties it to the link."""
    name = named(joint.name)
    closed, loop = f"{name}/closed", f"{name}/loop"
    ball = joint.kind == "ball"
    if ball or joint.kind == "fixed":
        yield AddFrame(name, Placed(named(joint.parent), (joint.in_parent,)))
    else:
        yield from _motions(joint, named, name)
    yield AddFrame(closed, Placed(named(joint.child), (joint.in_child,)))
    yield CloseLoop(name=loop, frame=closed, to=name, mask=AXES[:3] if ball else AXES, home=home)


def _motions(joint: SdfJoint, named: SdfNameMap, child: str) -> Iterator[Operation]:
    """Yield what a joint moves by, from its place in the parent to a frame."""
    name = named(joint.name)
    common: dict[str, Any] = {
        "name": name,
        "parent": named(joint.parent),
        "child": child,
        "origin": IDENTITY if is_identity(joint.in_parent) else joint.in_parent,
    }
    if joint.kind == "fixed":
        yield Fixed(**common)
    elif joint.kind == "ball":
        yield Ball(**common, dynamics=_dynamics(joint, ""))
    elif joint.kind == "gearbox":
        (axis,) = joint.axes
        assert joint.gear is not None
        driver = position(named(joint.gear.leader))
        yield Gearbox(
            **common,
            axis=axis.xyz,
            driver=driver,
            ratio=joint.gear.multiplier,
            offset=joint.gear.offset,
            lower=axis.lower,
            upper=axis.upper,
            velocity=axis.velocity,
            dynamics=axis.dynamics,
        )
    elif joint.kind in ("universal", "revolute2"):
        yield from _two_axes(joint, common, named)
    else:
        (axis,) = joint.axes
        given = _axis(axis, named)
        if joint.kind == "screw":
            yield Screw(**common, **given, pitch=joint.pitch)
        else:
            yield _AXIS_JOINTS[joint.kind](**common, **given)


def _two_axes(joint: SdfJoint, common: dict[str, Any], named: SdfNameMap) -> Iterator[Operation]:
    """Yield a universal joint, or two hinges in a row where the axes are not such that it is one."""
    first, second = joint.axes
    cosine = math.fsum(a * b for a, b in zip(first.xyz, second.xyz, strict=True))
    alone = first.following is None and second.following is None
    if joint.kind == "universal" and alone and not joint.turned and abs(cosine) <= _PERPENDICULAR:
        yield Universal(
            **common,
            first=first.xyz,
            second=second.xyz,
            first_limits=Limits(first.lower, first.upper, first.velocity),
            second_limits=Limits(second.lower, second.upper, second.velocity),
            dynamics=(*_dynamics(joint, "first/", 0), *_dynamics(joint, "second/", 1)),
        )
        return
    name = common["name"]
    between = name + first.suffix
    yield Revolute(**(common | {"name": name + first.suffix, "child": between}), **_axis(first, named))
    own = {"name": name + second.suffix, "parent": between, "child": common["child"], "origin": IDENTITY}
    yield Revolute(**own, **_axis(second, named))


def _axis(axis: SdfAxis, named: SdfNameMap) -> dict[str, Any]:
    return {
        "axis": axis.xyz,
        "lower": axis.lower,
        "upper": axis.upper,
        "velocity": axis.velocity,
        "position": None if axis.following is None else _mimic_position(axis.following, named),
        "dynamics": axis.dynamics,
    }


def _mimic_position(following: MimicRelation[str], named: SdfNameMap) -> Expression:
    return following.multiplier * position(named(following.leader)) + following.offset


def _dynamics(joint: SdfJoint, prefix: str, index: int = 0) -> tuple[tuple[str, float], ...]:
    axes = joint.axes[index : index + 1]
    return tuple((prefix + key, value) for axis in axes for key, value in axis.dynamics)


def _check_names(scene: SdfScene) -> None:
    """Raise where two things of the description would have the same name in the model."""
    frames: dict[str, str] = {MODEL_WORLD: "the world"}
    articulations: dict[str, str] = {}

    def take(taken: dict[str, str], name: str, what: str, line: int, source: str) -> None:
        other = taken.setdefault(name, f"{what} of line {line}")
        if other != f"{what} of line {line}" or not name:
            raise FormatError(
                f"{source}, line {line}: {what} would be called {quote(name)} here, as {other} is. "
                "Rename one of them."
            )

    for link in scene.links:
        take(frames, link.name, "the link", link.line, link.source)
    for frame in scene.frames:
        take(frames, frame.name, "the frame", frame.line, frame.source)
    free = {root.link for root in scene.roots if root.free}
    for link in scene.links:
        if link.name in free:
            take(articulations, f"{link.name}/free", "the free motion of the link", link.line, link.source)
    both = [(joint, False) for joint in scene.joints] + [(joint, True) for joint in scene.loops]
    for joint, closes in both:
        take(articulations, joint.name, "the joint", joint.line, joint.source)
        two = len(joint.axes) == 2
        for axis in joint.axes if two else ():
            take(
                articulations,
                joint.name + axis.suffix,
                f"the {axis.suffix[1:]} axis",
                joint.line,
                joint.source,
            )
        if closes or not is_identity(joint.in_child):
            take(frames, joint.name, "the frame of the joint", joint.line, joint.source)
