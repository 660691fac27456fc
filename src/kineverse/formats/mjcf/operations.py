"""MJCF descriptions as model operations: bodies, sites, loops, tendons and the home position.

Bodies and sites become frames, joints degrees of freedom of the same name, below the prefix. A joint that is
not the last of its body, or whose anchor is not at the origin of the body, gets an intermediate frame.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import Any

from kineverse.articulations import Ball, Continuous, Floating, Prismatic, Revolute
from kineverse.articulations import Joint as JointOperation
from kineverse.expressions.expression import array
from kineverse.expressions.gradient import total_derivative
from kineverse.formats.description import path_between
from kineverse.formats.names import NameMap
from kineverse.formats.poses import IDENTITY, compose_poses, pose_from_rpy
from kineverse.loops.close_loop import CloseLoop
from kineverse.loops.equations import AXES
from kineverse.model.basic_operations import AddFrame, Constrain, SetBody, SetHome
from kineverse.model.body import Pose, Vector3, is_empty_body
from kineverse.model.constraint import Constraint
from kineverse.model.frame import WORLD as MODEL_WORLD
from kineverse.model.frame import Frame
from kineverse.model.operation import Operation
from kineverse.model.registry import FileContent
from kineverse.spatial import axis_angle
from kineverse.symbols import position, symbol_name

from .description import COORDINATE_SUFFIXES, WORLD, MjcfClosure, MjcfJoint, MjcfLink, MjcfScene
from .equalities import FollowerJoints, Tendon, TendonCoupling
from .held_bodies import attach_held_bodies
from .reader import parse_mjcf


def loop_operations(scene: MjcfScene, model_name: NameMap, followers: FollowerJoints) -> Iterator[Operation]:
    """Yield the operations that close the loops of a scene, in the order of the file."""
    parents = {link.name: link.parent for link in scene.links if link.name != WORLD}
    parents |= {site.name: site.parent for site in scene.sites}
    joints = {link.name: link.joints for link in scene.links}
    by_name = {joint.name: joint for link in scene.links for joint in link.joints}
    tied: set[str] = set()
    for closure in scene.closures:
        if closure.dependent is not None:
            stated = [by_name[name] for name in (*closure.free, *closure.dependent)]
            home = [value for joint in stated for value in _home_position(joint, model_name)]
            yield from _close_loop(closure, model_name, home)
            tied |= {joint.name for joint in stated}
            continue
        in_loop: dict[str, MjcfJoint] = {}
        for link in path_between(closure.first, closure.second, parents):
            for joint in joints.get(link, ()):
                name: str | None = joint.name
                while name is not None and name in followers:
                    name = followers.leaders[name]
                if name is not None:
                    in_loop[name] = by_name[name]
        # Coordinates of an earlier loop are dependent, so this loop has none of them.
        free = [joint for name, joint in in_loop.items() if name not in tied]
        home = [value for joint in free for value in _nonzero_rest(joint, model_name)]
        tied |= in_loop.keys()
        yield from _close_loop(closure, model_name, home)


def _close_loop(
    closure: MjcfClosure, model_name: NameMap, home: Iterable[tuple[str, float]]
) -> Iterator[Operation]:
    name, dependent = model_name(closure.name), closure.dependent
    pairs: list[list[str]] = []
    for k, part in enumerate((closure, *closure.more)):
        pairs.append([])
        for suffix, frame, pose in (
            ("first", part.first, part.in_first),
            ("second", part.second, part.in_second),
        ):
            end = model_name(frame)
            if pose is not IDENTITY:
                end = f"{name}/{k}/{suffix}" if k else f"{name}/{suffix}"
                yield AddFrame(end, Frame(model_name(frame), (pose,)))
            pairs[-1].append(end)
    (frame, to), *more = pairs
    # Without stated joints, the coordinates on the path to the first end come first and stay independent.
    yield CloseLoop(
        name=name,
        frame=frame,
        to=to,
        more=tuple((one, other) for one, other in more),
        mask=AXES[:3] if closure.kind == "connect" else AXES,
        dependent=None if dependent is None else tuple(symbol_name(model_name(j), 0) for j in dependent),
        home=tuple(home),
    )


def _home_position(joint: MjcfJoint, model_name: NameMap) -> Iterator[tuple[str, float]]:
    """Yield the coordinates of a joint at its home position, in which a loop of a written file is closed."""
    suffixes = COORDINATE_SUFFIXES[joint.kind] or ("",)
    for suffix, value in zip(suffixes, joint.home, strict=False):  # held bodies have no home position
        yield symbol_name(f"{model_name(joint.name)}/{suffix}".rstrip("/"), 0), value


def _nonzero_rest(joint: MjcfJoint, model_name: NameMap) -> Iterator[tuple[str, float]]:
    if joint.kind in ("ball", "free"):
        yield symbol_name(f"{model_name(joint.name)}/qw", 0), 1.0
    elif joint.reference:
        yield symbol_name(model_name(joint.name), 0), joint.reference


def mjcf_file_operations(file: FileContent) -> Iterator[tuple[str, Operation]]:
    """Yield the operations of an MJCF file, each with its tag."""
    scene = parse_mjcf(file.content, file.path.name, str(file.path.absolute().parent), file.root, file.strict)
    for operation in mjcf_operations(scene, file.prefix):
        yield operation.default_tag(), operation


def mjcf_operations(scene: MjcfScene, prefix: str | None = None) -> Iterator[Operation]:
    """Yield the operations that build the model of a file."""

    def model_name(name: str) -> str:
        return f"{prefix}/{name}" if prefix else name

    scene = attach_held_bodies(scene)
    followers = FollowerJoints(scene.couplings, model_name)
    if prefix:
        yield AddFrame(model_name(WORLD), Frame(MODEL_WORLD, (IDENTITY,)))
    for link in scene.links:
        if link.name != WORLD:
            yield from _link(link, model_name, followers)
        if not is_empty_body(link.body):
            yield SetBody(model_name(link.name), link.body)
    for site in scene.sites:
        yield AddFrame(model_name(site.name), Frame(model_name(site.parent), (site.pose,)))
    yield from followers.constraints()
    if scene.has_home:
        followers.warn_moved_homes((joint for link in scene.links for joint in link.joints), scene.source)
    yield from loop_operations(scene, model_name, followers)
    for tendon in scene.tendons:
        yield Tendon(
            name=model_name(tendon.name),
            terms=tuple((model_name(joint), factor) for joint, factor in tendon.terms),
            paths=tuple((divisor, tuple(map(model_name, sites))) for divisor, sites in tendon.paths),
            lower=tendon.lower,
            upper=tendon.upper,
            dynamics=tendon.dynamics,
        )
    for coupling in scene.tendon_couplings:
        yield TendonCoupling(
            name=model_name(coupling.name),
            tendon=model_name(coupling.follower),
            leader=None if coupling.leader is None else model_name(coupling.leader),
            coefficients=coupling.coefficients,
            rest=coupling.rest,
            leader_rest=coupling.leader_rest,
        )
    for joint in (joint for link in scene.links for joint in link.joints):
        is_needed = any(joint.home[:6]) or _is_home_outside(joint, scene.has_home)
        if is_needed and joint.name not in followers:
            yield SetHome(model_name(joint.name), joint.home)


def _link(link: MjcfLink, model_name: NameMap, followers: FollowerJoints) -> Iterator[Operation]:
    child, parent, parent_T_body = model_name(link.name), model_name(link.parent), link.pose
    for joint in link.joints:
        last = joint is link.joints[-1] and not any(joint.anchor)
        origin = compose_poses(parent_T_body, _translation(joint.anchor))
        if joint.reference:
            origin = compose_poses(origin, _motion_from_reference(joint))
        moved = child if last else model_name(joint.frame)
        yield _joint(joint, parent, moved, origin, model_name, followers)
        if joint.kind == "ball" and joint.upper is not None:
            yield _angle_limit(model_name(joint.name), joint.upper)
        if joint.speed is not None and _velocity(joint) is None:
            q = followers.position(joint.name)
            limit = Constraint.from_expressions(joint.speed[0], total_derivative(q), joint.speed[1])
            yield Constrain(f"{model_name(joint.name)}/velocity", limit)
        x, y, z = joint.anchor
        parent_T_body, parent = _translation((-x, -y, -z)), moved
    if parent != child:
        yield AddFrame(child, Frame(parent, (parent_T_body,)))


def _is_home_outside(joint: MjcfJoint, has_home: bool) -> bool:
    if not has_home or joint.kind not in ("hinge", "slide") or not joint.home:
        return False
    lower, upper = joint.lower, joint.upper
    return (lower is not None and joint.home[0] < lower) or (upper is not None and upper < joint.home[0])


def _joint(
    joint: MjcfJoint, parent: str, child: str, origin: Pose, model_name: NameMap, followers: FollowerJoints
) -> JointOperation:
    common: dict[str, Any] = {
        "name": model_name(joint.name),
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
    """Return the velocity limit of a joint; None unless it is the same in both directions."""
    if joint.speed is None or joint.speed[0] != -joint.speed[1]:
        return None
    return joint.speed[1]


def _angle_limit(name: str, angle: float) -> Constrain:
    """Return the limit of a ball joint's angle, as one on 1 - cos(angle), which is smooth at zero."""
    x, y, z, w = (position(f"{name}/q{c}") for c in "xyzw")
    q, v = array([x, y, z, w]), array([x, y, z])
    one_minus_cos = 2 * (v @ v) / (q @ q)
    return Constrain(
        f"{name}/angle",
        Constraint.from_expressions(-math.inf, one_minus_cos, 2 * math.sin(min(angle, math.pi) / 2) ** 2),
    )


def _translation(point: Vector3) -> Pose:
    return pose_from_rpy(point, (0.0, 0.0, 0.0)) if any(point) else IDENTITY


def _motion_from_reference(joint: MjcfJoint) -> Pose:
    if joint.kind == "hinge":
        return Pose.from_matrix(axis_angle(joint.axis, -joint.reference))
    x, y, z = (-joint.reference * a for a in joint.axis)
    return _translation((x, y, z))
