"""Mass and centre of mass of the bodies of a model.

The moment of mass h = Σ m p of a subtree goes from each frame to its parent,

    h_parent = Σ_children R h_child + m_child t,

so every moving factor transforms one vector. The graph is linear in the number of frames, and smaller than
that of their poses.
"""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca
import numpy as np

from kineverse.errors import ModelError, list_some
from kineverse.expressions.expression import NO_NODES, Expression, from_casadi
from kineverse.expressions.layout import SX
from kineverse.expressions.node import Node
from kineverse.lie import Array
from kineverse.spatial import OneAxisTransform

from .body import Body, Pose
from .frame import WORLD
from .kinematics import FrameLookup, ancestors


def find_masses(frame: str, bodies: Mapping[str, Body], lookup: FrameLookup) -> dict[str, list[str]]:
    """Return the bodies with mass at or below a frame, each with its ancestors and itself first."""
    result = {}
    for name, body in bodies.items():
        if body.inertia is not None and body.inertia.mass > 0:
            above = ancestors(name, lookup)
            if frame == WORLD or frame in above:
                result[name] = above
    return result


def center_of_mass(frame: str, bodies: Mapping[str, Body], lookup: FrameLookup) -> Expression:
    """Return the centre of mass of the bodies at or below a frame, (3,) [m] in the world.

    Coordinates are plain.
    """
    chains = find_masses(frame, bodies, lookup)
    if not chains:
        raise _no_mass(frame, bodies, lookup)
    moments: dict[str, _Moment] = {}
    for name in chains:
        inertia = bodies[name].inertia
        assert inertia is not None
        moments[name] = _Moment(inertia.mass, inertia.mass * inertia.origin.matrix[:3, 3])
    depths = {name: len(above) - i for above in chains.values() for i, name in enumerate(above)}
    for name in sorted(depths, key=depths.__getitem__, reverse=True):
        placed = lookup(name)
        moment = moments.pop(name)
        for factor in reversed(placed.factors):
            moment.transform(factor)
        moments.setdefault(placed.parent, _Moment(0.0, np.zeros(3))).add(moment)
    total = moments[WORLD]
    return from_casadi(ca.densify(total.sum() / total.mass), (3,), total.nodes)


class _Moment:
    """Mass [kg] and moment of mass [kg m] of a subtree: a constant part and a moving part."""

    def __init__(self, mass: float, constant: Array) -> None:
        self.mass = mass
        self.constant = constant
        self.moving: SX | None = None
        self.nodes: frozenset[Node] = NO_NODES

    def sum(self) -> SX:
        constant = ca.SX(ca.sparsify(ca.DM(self.constant)))
        return constant if self.moving is None else self.moving + constant

    def transform(self, factor: Pose | Expression) -> None:
        if isinstance(factor, Pose):
            matrix = factor.matrix
            self.constant = matrix[:3, :3] @ self.constant + self.mass * matrix[:3, 3]
            if self.moving is not None and not np.array_equal(matrix[:3, :3], np.eye(3)):
                self.moving = ca.mtimes(ca.SX(ca.sparsify(ca.DM(matrix[:3, :3]))), self.moving)
            return
        self.nodes = self.nodes | factor.nodes
        if isinstance(factor, OneAxisTransform) and not factor.is_rotation:
            offset = self.mass * factor.offset
            self.moving = offset if self.moving is None else self.moving + offset
            return
        if isinstance(factor, OneAxisTransform):
            self.moving = ca.mtimes(factor.rotation, self.sum())
        else:
            sx = factor.sx
            self.moving = ca.mtimes(sx[:3, :3], self.sum()) + self.mass * sx[:3, 3]
        self.constant = np.zeros(3)

    def add(self, other: _Moment) -> None:
        self.mass += other.mass
        self.constant = self.constant + other.constant
        self.nodes = self.nodes | other.nodes
        if other.moving is not None:
            self.moving = other.moving if self.moving is None else self.moving + other.moving


def _no_mass(frame: str, bodies: Mapping[str, Body], lookup: FrameLookup) -> ModelError:
    names = [name for name in bodies if frame == WORLD or frame in ancestors(name, lookup)]
    where = "in the model" if frame == WORLD else f"at or below '{frame}'"
    if not names:
        return ModelError(f"There is no body {where}, so there is no centre of mass.")
    shown = list_some(map(repr, names), 6)
    return ModelError(
        f"No body {where} has a mass, so there is no centre of mass: {shown}. A body gets one by its "
        "inertia: edit.add_frame(name, parent, transform, Body(inertia=Inertia(mass=..., tensor=...)))."
    )
