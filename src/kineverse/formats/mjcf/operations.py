"""MJCF descriptions as model operations: bodies, sites, loops, tendons and the home position.

Bodies and sites become frames, joints degrees of freedom of the same name, below the prefix. A joint that is
not the last of its body, or whose anchor is not at the origin of the body, has a frame of its own in between.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from typing import Any

from kineverse.articulations import Ball, Continuous, Floating, Prismatic, Revolute
from kineverse.articulations import Joint as JointOperation
from kineverse.expressions.expression import array
from kineverse.expressions.gradient import total_derivative
from kineverse.formats.poses import IDENTITY, compose_poses
from kineverse.formats.tree import path_between
from kineverse.loops.close_loop import CloseLoop
from kineverse.loops.equations import AXES
from kineverse.model.body import Pose, Vector3, is_empty_body
from kineverse.model.constraint import Constraint
from kineverse.model.frame import WORLD as MODEL_WORLD
from kineverse.model.frame import Frame
from kineverse.model.operation import Operation
from kineverse.model.operations import AddFrame, Constrain, SetBody, SetHome
from kineverse.model.registry import FileContent
from kineverse.spatial import axis_angle
from kineverse.symbols import position, symbol_name

from .description import COORDINATE_SUFFIXES, WORLD, MjcfClosure, MjcfCoupling, MjcfJoint, MjcfLink, MjcfScene
from .held_bodies import attach_held_bodies
from .joint_equalities import FollowerJoints
from .reader import parse_mjcf
from .tendons import Tendon, TendonCoupling

_LoopNameMap = Callable[[str], str]


def loop_operations(scene: MjcfScene, named: _LoopNameMap, followers: FollowerJoints) -> Iterator[Operation]:
    """Yield the operations that close the loops of a scene, in the order of the file."""
    parents = {link.name: link.parent for link in scene.links if link.name != WORLD}
    parents |= {site.name: site.parent for site in scene.sites}
    joints = {link.name: link.joints for link in scene.links}
    by_name = {joint.name: joint for link in scene.links for joint in link.joints}
    tied: set[str] = set()
    for closure in scene.closures:
        if closure.dependent is not None:
            inside_it = [by_name[name] for name in (*closure.free, *closure.dependent)]
            yield from _close_loop(closure, named, [v for joint in inside_it for v in _at_home(joint, named)])
            tied |= {joint.name for joint in inside_it}
            continue
        inside: dict[str, MjcfJoint] = {}
        for link in path_between(closure.first, closure.second, parents):
            for joint in joints.get(link, ()):
                name: str | None = joint.name
                while name is not None and name in followers:
                    name = followers.leaders[name]
                if name is not None:
                    inside[name] = by_name[name]
        # What an earlier loop determines is none of this one's coordinates.
        rest = [v for name, joint in inside.items() if name not in tied for v in _nonzero_rest(joint, named)]
        tied |= inside.keys()
        yield from _close_loop(closure, named, rest)


def _close_loop(
    closure: MjcfClosure, named: _LoopNameMap, home: Iterable[tuple[str, float]]
) -> Iterator[Operation]:
    name, follow = named(closure.name), closure.dependent
    pairs: list[list[str]] = []
    for k, part in enumerate((closure, *closure.more)):
        pairs.append([])
        for suffix, frame, pose in (
            ("first", part.first, part.in_first),
            ("second", part.second, part.in_second),
        ):
            end = named(frame)
            if pose is not IDENTITY:
                end = f"{name}/{k}/{suffix}" if k else f"{name}/{suffix}"
                yield AddFrame(end, Frame(named(frame), (pose,)))
            pairs[-1].append(end)
    (frame, to), *more = pairs
    # If nothing is said, the coordinates on the way to the first end come first, and so stay free.
    yield CloseLoop(
        name=name,
        frame=frame,
        to=to,
        more=tuple((one, other) for one, other in more),
        mask=AXES[:3] if closure.kind == "connect" else AXES,
        dependent=None if follow is None else tuple(symbol_name(named(joint), 0) for joint in follow),
        home=tuple(home),
    )


def _at_home(joint: MjcfJoint, named: _LoopNameMap) -> Iterator[tuple[str, float]]:
    """Yield the coordinates of a joint at home, where a loop that was written here is closed."""
    suffixes = COORDINATE_SUFFIXES[joint.kind] or ("",)
    for suffix, value in zip(suffixes, joint.home, strict=False):  # what something holds has no home
        yield symbol_name(f"{named(joint.name)}/{suffix}".rstrip("/"), 0), value


def _nonzero_rest(joint: MjcfJoint, named: _LoopNameMap) -> Iterator[tuple[str, float]]:
    """Yield the coordinates of a joint that are not zero at rest, where its equalities hold."""
    if joint.kind in ("ball", "free"):
        yield symbol_name(f"{named(joint.name)}/qw", 0), 1.0
    elif joint.reference:
        yield symbol_name(named(joint.name), 0), joint.reference


MjcfNameMap = Callable[[str], str]


def mjcf_file_operations(file: FileContent) -> Iterator[tuple[str, Operation]]:
    """Yield the operations of an MJCF file, each with its tag."""
    scene = parse_mjcf(file.content, file.path.name, str(file.path.absolute().parent), file.root, file.strict)
    for operation in mjcf_operations(scene, file.prefix):
        yield operation.default_tag(), operation


def mjcf_operations(scene: MjcfScene, prefix: str | None = None) -> Iterator[Operation]:
    """Yield the operations that build what a file describes.

    Parameters
    ----------
    scene
        The description.
    prefix
        Put in front of the names of frames and degrees of freedom, with a slash. The world of the file is
        the frame ``prefix/world`` then.
    """

    def named(name: str) -> str:
        return f"{prefix}/{name}" if prefix else name

    scene = attach_held_bodies(scene)
    followers = FollowerJoints(scene.couplings, named)
    if prefix:
        yield AddFrame(named(WORLD), Frame(MODEL_WORLD, (IDENTITY,)))
    for link in scene.links:
        if link.name != WORLD:
            yield from _link(link, named, followers)
        if not is_empty_body(link.body):
            yield SetBody(named(link.name), link.body)
    for site in scene.sites:
        yield AddFrame(named(site.name), Frame(named(site.parent), (site.pose,)))
    yield from followers.constraints()
    if scene.has_home:
        followers.warn_homes((joint for link in scene.links for joint in link.joints), scene.source)
    yield from loop_operations(scene, named, followers)
    for tendon in scene.tendons:
        yield Tendon(
            name=named(tendon.name),
            terms=tuple((named(joint), factor) for joint, factor in tendon.terms),
            paths=tuple((divisor, tuple(map(named, sites))) for divisor, sites in tendon.paths),
            lower=tendon.lower,
            upper=tendon.upper,
            dynamics=tendon.dynamics,
        )
    for coupling in scene.tendon_couplings:
        yield _tendon_coupling(coupling, named)
    for link in scene.links:
        for joint in link.joints:
            if joint.name not in followers and (any(joint.home[:6]) or _is_outside(joint, scene.has_home)):
                yield SetHome(named(joint.name), joint.home)


def _link(link: MjcfLink, named: MjcfNameMap, followers: FollowerJoints) -> Iterator[Operation]:
    """Yield the joints of a body one after the other, each from where the one before has moved it."""
    child, parent, place = named(link.name), named(link.parent), link.pose
    for joint in link.joints:
        last = joint is link.joints[-1] and not any(joint.anchor)
        origin = compose_poses(place, _offset(joint.anchor))
        if joint.reference:
            origin = compose_poses(origin, _motion_back(joint))
        moved = child if last else named(joint.frame)
        yield _joint(joint, parent, moved, origin, named, followers)
        if joint.kind == "ball" and joint.upper is not None:
            yield _largest_angle(named(joint.name), joint.upper)
        if joint.speed is not None and _velocity(joint) is None:
            q = followers.position(joint.name)
            limit = Constraint.of(joint.speed[0], total_derivative(q), joint.speed[1])
            yield Constrain(f"{named(joint.name)}/velocity", limit)
        x, y, z = joint.anchor
        place, parent = _offset((-x, -y, -z)), moved
    if parent != child:
        yield AddFrame(child, Frame(parent, (place,)))


def _is_outside(joint: MjcfJoint, said: bool) -> bool:
    """Return whether a file says that a joint is at home where it cannot be."""
    if not said or joint.kind not in ("hinge", "slide") or not joint.home:
        return False
    lower, upper = joint.lower, joint.upper
    return (lower is not None and joint.home[0] < lower) or (upper is not None and upper < joint.home[0])


def _joint(
    joint: MjcfJoint, parent: str, child: str, origin: Pose, named: MjcfNameMap, followers: FollowerJoints
) -> JointOperation:
    common: dict[str, Any] = {
        "name": named(joint.name),
        "parent": parent,
        "child": child,
        "origin": origin,
        "dynamics": joint.dynamics,
    }
    if joint.kind == "free":
        return Floating(**common)
    if joint.kind == "ball":
        return Ball(**common)
    limited = joint.lower is not None or joint.upper is not None
    kind = Prismatic if joint.kind == "slide" else Revolute if limited else Continuous
    return kind(
        **common,
        axis=joint.axis,
        lower=joint.lower,
        upper=joint.upper,
        velocity=_velocity(joint),
        position=followers.position(joint.name) if joint.name in followers else None,
    )


def _velocity(joint: MjcfJoint) -> float | None:
    """Return the limit of a speed that is the same in both directions."""
    if joint.speed is None or joint.speed[0] != -joint.speed[1]:
        return None
    return joint.speed[1]


def _largest_angle(name: str, angle: float) -> Constrain:
    """Return the limit of how far a ball turns, about any axis: 1 - cos(angle), which is smooth at rest."""
    x, y, z, w = (position(f"{name}/q{c}") for c in "xyzw")
    q, v = array([x, y, z, w]), array([x, y, z])
    turned = 2 * (v @ v) / (q @ q)
    return Constrain(
        f"{name}/angle", Constraint.of(-math.inf, turned, 2 * math.sin(min(angle, math.pi) / 2) ** 2)
    )


def _offset(point: Vector3) -> Pose:
    if not any(point):
        return IDENTITY
    x, y, z = point
    return Pose((1.0, 0.0, 0.0, x, 0.0, 1.0, 0.0, y, 0.0, 0.0, 1.0, z))


def _motion_back(joint: MjcfJoint) -> Pose:
    """Return how a joint moves from its reference to 0."""
    if joint.kind == "hinge":
        return Pose.of(axis_angle(joint.axis, -joint.reference))
    x, y, z = (-joint.reference * a for a in joint.axis)
    return _offset((x, y, z))


def _tendon_coupling(coupling: MjcfCoupling, named: MjcfNameMap) -> TendonCoupling:
    leader = None if coupling.leader is None else named(coupling.leader)
    return TendonCoupling(
        name=named(coupling.name),
        tendon=named(coupling.follower),
        leader=leader,
        coefficients=coupling.coefficients,
        rest=coupling.rest,
        leader_rest=coupling.leader_rest,
    )
