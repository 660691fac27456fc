"""A description as operations: bodies from the world outwards, then sites, loops, tendons, what is home.

Bodies and sites become frames, joints degrees of freedom of the same name, below the prefix. A joint that is
not the last of its body, or whose anchor is not at the origin of the body, has a frame of its own in between.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

from kineverse.articulations import Ball, Continuous, Floating, Prismatic, Revolute
from kineverse.articulations import Joint as JointOperation
from kineverse.expressions.expression import array
from kineverse.expressions.gradient import total_derivative
from kineverse.formats.poses import IDENTITY, product
from kineverse.formats.set_body import SetBody, is_empty
from kineverse.formats.set_home import SetHome
from kineverse.model.body import Pose, Vector3
from kineverse.model.constraint import Constraint
from kineverse.model.edit import AddFrame, Constrain
from kineverse.model.frame import WORLD as MODEL_WORLD
from kineverse.model.frame import Frame
from kineverse.model.operation import Operation
from kineverse.spatial import axis_angle
from kineverse.symbols import position

from .carrying import carried
from .description import WORLD, Coupling, Joint, Link, Scene
from .following import Followers
from .loops import loop_operations
from .tendons import Tendon, TendonCoupling

Named = Callable[[str], str]


def scene_operations(scene: Scene, prefix: str | None = None) -> Iterator[Operation]:
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

    scene = carried(scene)
    followers = Followers(scene.couplings, named)
    if prefix:
        yield AddFrame(named(WORLD), Frame(MODEL_WORLD, (IDENTITY,)))
    for link in scene.links:
        if link.name != WORLD:
            yield from _link(link, named, followers)
        if not is_empty(link.body):
            yield SetBody(named(link.name), link.body)
    for site in scene.sites:
        yield AddFrame(named(site.name), Frame(named(site.parent), (site.pose,)))
    yield from followers.constraints()
    if scene.has_home:
        followers.tell_homes((joint for link in scene.links for joint in link.joints), scene.source)
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


def _link(link: Link, named: Named, followers: Followers) -> Iterator[Operation]:
    """Yield the joints of a body one after the other, each from where the one before has moved it."""
    child, parent, place = named(link.name), named(link.parent), link.pose
    for joint in link.joints:
        last = joint is link.joints[-1] and not any(joint.anchor)
        origin = product(place, _offset(joint.anchor))
        if joint.reference:
            origin = product(origin, _motion_back(joint))
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


def _is_outside(joint: Joint, said: bool) -> bool:
    """Return whether a file says that a joint is at home where it cannot be."""
    if not said or joint.kind not in ("hinge", "slide") or not joint.home:
        return False
    lower, upper = joint.lower, joint.upper
    return (lower is not None and joint.home[0] < lower) or (upper is not None and upper < joint.home[0])


def _joint(
    joint: Joint, parent: str, child: str, origin: Pose, named: Named, followers: Followers
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


def _velocity(joint: Joint) -> float | None:
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


def _motion_back(joint: Joint) -> Pose:
    """Return how a joint moves from its reference to 0."""
    if joint.kind == "hinge":
        return Pose.of(axis_angle(joint.axis, -joint.reference))
    x, y, z = (-joint.reference * a for a in joint.axis)
    return _offset((x, y, z))


def _tendon_coupling(coupling: Coupling, named: Named) -> TendonCoupling:
    leader = None if coupling.leader is None else named(coupling.leader)
    return TendonCoupling(
        name=named(coupling.name),
        tendon=named(coupling.follower),
        leader=leader,
        coefficients=coupling.coefficients,
        rest=coupling.rest,
        leader_rest=coupling.leader_rest,
    )
