"""A robot description as the sequence of operations that builds it (2022 paper, III-B)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from ...articulations import Continuous, Fixed, Floating, Planar, Prismatic, Revolute
from ...expressions.expression import Expression
from ...model.body import Body
from ...model.frame import WORLD, Frame
from ...model.operation import Effects, Operation
from ...model.reader import Reader
from ...symbols import Symbol, position
from .description import Joint, Robot, Safety


@dataclass(frozen=True)
class AttachBody(Operation):
    """Gives a frame something to see, to touch and to weigh."""

    name: str
    body: Body

    def apply(self, model: Reader) -> Effects:
        """Write the body."""
        return Effects(bodies={self.name: self.body})

    def default_tag(self) -> str:
        """Return ``body`` and the frame."""
        return f"body {self.name}"


@dataclass(frozen=True)
class Root(Operation):
    """Puts the root link of a description into the world."""

    name: str
    parent: str = WORLD

    def apply(self, model: Reader) -> Effects:
        """Write the frame."""
        return Effects(frames={self.name: Frame(self.parent, ())})

    def default_tag(self) -> str:
        """Return ``root`` and the frame."""
        return f"root {self.name}"


@dataclass(frozen=True)
class SoftLimits(Operation):
    """Keeps a joint's speed between lines that pass through zero at its soft limits.

    ``-k (q - soft_lower) <= q̇ <= -k (q - soft_upper)``: slower towards a soft limit, led back from beyond.
    """

    name: str
    position: Symbol
    safety: Safety

    def apply(self, model: Reader) -> Effects:
        """Write the constraint ``name/safety``."""
        q, k = self.position, self.safety.k_position
        lower, upper = -k * (q - self.safety.soft_lower), -k * (q - self.safety.soft_upper)
        return Effects(constraints={f"{self.name}/safety": (lower, q.derivative(), upper)})

    def default_tag(self) -> str:
        """Return ``safety`` and the joint."""
        return f"safety {self.name}"


def robot_operations(robot: Robot, prefix: str | None = None, parent: str = WORLD) -> Iterator[Operation]:
    """Yield the operations that build a robot: its root, joints from there outwards, bodies as they appear.

    Parameters
    ----------
    robot
        The description.
    prefix
        Put in front of all names, with a slash; without one a root link ``world`` is the world itself.
    parent
        The frame the root link is put into.
    """

    def named(name: str) -> str:
        return f"{prefix}/{name}" if prefix else name

    bodies = {link.name: link.body for link in robot.links if link.body != Body()}
    if named(robot.root) != WORLD:
        yield Root(named(robot.root), parent)
    if robot.root in bodies:
        yield AttachBody(named(robot.root), bodies[robot.root])
    for joint in robot.joints:
        yield _joint(joint, named)
        if joint.safety is not None and joint.safety.k_position > 0 and joint.mimic is None and joint.kind != "fixed":
            yield SoftLimits(named(joint.name), position(named(joint.name)), joint.safety)
        if joint.child in bodies:
            yield AttachBody(named(joint.child), bodies[joint.child])


def _joint(joint: Joint, named: Any) -> Operation:
    dynamics = [
        (key, value)
        for key, value in (
            ("effort", joint.limits.effort),
            ("damping", joint.dynamics.damping or None),
            ("friction", joint.dynamics.friction or None),
        )
        if value is not None
    ]
    common: dict[str, Any] = {
        "name": named(joint.name),
        "parent": named(joint.parent),
        "child": named(joint.child),
        "origin": joint.origin,
        "dynamics": tuple(dynamics),
    }
    if joint.kind == "fixed":
        return Fixed(**common)
    if joint.kind == "floating":
        return Floating(**common)
    axis = joint.axis or (1.0, 0.0, 0.0)
    if joint.kind == "planar":
        return Planar(**common, axis=axis)
    limits = {"lower": joint.limits.lower, "upper": joint.limits.upper, "velocity": joint.limits.velocity}
    follows: Expression | None = None
    if joint.mimic is not None:
        follows = joint.mimic.multiplier * position(named(joint.mimic.joint)) + joint.mimic.offset
    kinds = {"revolute": Revolute, "continuous": Continuous, "prismatic": Prismatic}
    return kinds[joint.kind](**common, axis=axis, **limits, position=follows)
