"""Forward kinematics and geometric Jacobians along chains of frames.

A frame's pose is kept as an *anchor*, the product up to its last moving factor, and a constant offset behind it.
Constants are multiplied as numbers before they meet an expression, so rigidly attached frames cost nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
import numpy.typing as npt

from ..errors import ModelError
from ..expressions.expression import NO_NODES, Expression, make
from ..expressions.layout import SX
from ..expressions.node import Node
from ..symbols import Symbol
from .body import Pose
from .frame import WORLD, Frame

FrameLookup = Callable[[str], Frame]


@dataclass(frozen=True, slots=True)
class Placement:
    """Where a frame is in the root of a chain: anchor_R, anchor_p (None for the identity), then a constant."""

    rotation: SX | None
    position: SX | None
    nodes: frozenset[Node]
    offset: npt.NDArray[np.float64]
    # The chain this was composed from, to see whether it still holds.
    frame: Frame | None = None
    parent: Placement | None = None

    def then(self, frame: Frame) -> Placement:
        """Return the placement of a child frame."""
        rotation, position, nodes, offset = self.rotation, self.position, self.nodes, self.offset
        for factor in frame.factors:
            if isinstance(factor, Pose):
                offset = offset @ factor.matrix
                continue
            rotation, position = compose(rotation, position, offset, factor)
            nodes = nodes | factor._nodes if factor._nodes else nodes
            offset = IDENTITY
        return Placement(rotation, position, nodes, offset, frame, self)

    def matrix(self) -> Expression:
        """Return the 4×4 transform."""
        if self.rotation is None or self.position is None:
            return make(ca.SX(ca.DM(self.offset)), (4, 4), NO_NODES)
        rotation, position = apply_offset(self.rotation, self.position, self.offset)
        return homogeneous(rotation, position, self.nodes)


IDENTITY = np.eye(4)
IDENTITY.flags.writeable = False
ROOT = Placement(None, None, NO_NODES, IDENTITY)
_BOTTOM = ca.SX(ca.DM([[0, 0, 0, 1]]))


def homogeneous(rotation: SX, position: SX, nodes: frozenset[Node]) -> Expression:
    """Return the 4×4 expression of a rotation and a position."""
    return make(ca.densify(ca.vertcat(ca.horzcat(rotation, position), _BOTTOM)), (4, 4), nodes)


def compose(rotation: SX | None, position: SX | None, offset: npt.NDArray[np.float64], factor: Expression) -> tuple[SX, SX]:
    """Return rotation and position of anchor @ offset @ factor."""
    sx = factor._sx
    factor_rotation, factor_position = sx[:3, :3], sx[:3, 3]
    if offset is not IDENTITY:
        c, t = _sparse(offset[:3, :3]), _sparse(offset[:3, 3])
        factor_position = ca.mtimes(c, factor_position) + t
        factor_rotation = ca.mtimes(c, factor_rotation)
    if rotation is None:
        return factor_rotation, factor_position
    return ca.mtimes(rotation, factor_rotation), ca.mtimes(rotation, factor_position) + position


def apply_offset(rotation: SX, position: SX, offset: npt.NDArray[np.float64]) -> tuple[SX, SX]:
    """Return rotation and position of anchor @ offset."""
    if offset is IDENTITY:
        return rotation, position
    return (
        ca.mtimes(rotation, _sparse(offset[:3, :3])),
        ca.mtimes(rotation, _sparse(offset[:3, 3])) + position,
    )


def _sparse(numbers: npt.NDArray[np.float64]) -> SX:
    return ca.SX(ca.sparsify(ca.DM(numbers)))


def ancestors(name: str, lookup: FrameLookup) -> list[str]:
    """Return the frame and its ancestors, up to but without the world.

    Raises
    ------
    ModelError
        If the chain runs in a circle.
    """
    chain: list[str] = []
    seen: set[str] = set()
    while name != WORLD:
        if name in seen:
            raise ModelError(f"Cyclic frames: {' -> '.join([*chain[chain.index(name) :], name])}.")
        seen.add(name)
        chain.append(name)
        name = lookup(name).parent
    return chain


def branches(frame: str, relative_to: str, lookup: FrameLookup) -> tuple[list[str], list[str]]:
    """Return the chains from the last common ancestor down to ``relative_to`` and down to ``frame``."""
    down, base = ancestors(frame, lookup)[::-1], ancestors(relative_to, lookup)[::-1]
    common = 0
    while common < min(len(down), len(base)) and down[common] == base[common]:
        common += 1
    return base[common:], down[common:]


def place(chain: Sequence[str], lookup: FrameLookup, start: Placement = ROOT) -> Placement:
    """Compose a chain of frames."""
    placement = start
    for name in chain:
        placement = placement.then(lookup(name))
    return placement


def relative(frame: str, relative_to: str, lookup: FrameLookup) -> Expression:
    """Return relative_to_T_frame in plain coordinates."""
    from ..spatial import inverse

    base, down = branches(frame, relative_to, lookup)
    tip = place(down, lookup).matrix()
    if not base:
        return tip
    root = inverse(place(base, lookup).matrix())
    return root @ tip if down else root


def jacobian_columns(
    frame: str, relative_to: str, lookup: FrameLookup, heuristic: bool
) -> tuple[SX, SX, dict[Symbol, tuple[SX, SX, frozenset[Node]]]]:
    """Return rotation and position of the frame, and per speed (linear, angular, nodes), in ``relative_to``.

    Linear parts are the velocity of the frame's origin. Every moving factor contributes the twist it makes in
    front of itself, carried to the tip by a cross product; so the cost is linear in the length of the chain.
    """
    base, down = branches(frame, relative_to, lookup)
    base_twists, base_placement = _twists(base, lookup, heuristic)
    tip_twists, tip_placement = _twists(down, lookup, heuristic)
    base_rotation, base_position = _dense(base_placement)
    tip_rotation, tip_position = _dense(tip_placement)
    columns: dict[Symbol, tuple[SX, SX, frozenset[Node]]] = {}
    # In the common ancestor: the tip moves with its own factors, and against those of the other branch.
    for sign, twists in ((1, tip_twists), (-1, base_twists)):
        for key, origin, linear, angular, nodes in twists:
            v = linear + ca.cross(angular, tip_position - origin)
            if sign < 0:
                v, angular = -v, -angular
            if key in columns:
                old_v, old_w, old_nodes = columns[key]
                v, angular, nodes = old_v + v, old_w + angular, old_nodes | nodes
            columns[key] = v, angular, nodes
    if not base:
        return tip_rotation, tip_position, columns
    turn = base_rotation.T
    turned = {k: (ca.mtimes(turn, v), ca.mtimes(turn, w), n) for k, (v, w, n) in columns.items()}
    rotation = ca.mtimes(turn, tip_rotation)
    return rotation, ca.mtimes(turn, tip_position - base_position), turned


Twist = tuple[Symbol, SX, SX, SX, frozenset[Node]]


def _twists(chain: Sequence[str], lookup: FrameLookup, heuristic: bool) -> tuple[list[Twist], Placement]:
    """Return (speed, origin, linear at origin, angular, nodes) of every moving factor, and the placement."""
    twists: list[Twist] = []
    rotation, position, nodes, offset = None, None, NO_NODES, IDENTITY
    for name in chain:
        for factor in lookup(name).factors:
            if isinstance(factor, Pose):
                offset = offset @ factor.matrix
                continue
            if rotation is None or position is None:
                at_rotation, at_position = _sparse(offset[:3, :3]), ca.densify(_sparse(offset[:3, 3]))
            else:
                at_rotation, at_position = apply_offset(rotation, position, offset)
            factor_rotation = factor._sx[:3, :3]
            for key, entry in factor.gradient(heuristic).items():
                omega_cross = ca.mtimes(entry._sx[:3, :3], factor_rotation.T)
                omega = ca.vertcat(omega_cross[2, 1], omega_cross[0, 2], omega_cross[1, 0])
                linear = entry._sx[:3, 3] - ca.cross(omega, factor._sx[:3, 3])
                twists.append(
                    (key, at_position, ca.mtimes(at_rotation, linear), ca.mtimes(at_rotation, omega), entry._nodes | nodes)
                )
            rotation, position = compose(rotation, position, offset, factor)
            nodes = nodes | factor._nodes if factor._nodes else nodes
            offset = IDENTITY
    return twists, Placement(rotation, position, nodes, offset)


def _dense(placement: Placement) -> tuple[SX, SX]:
    if placement.rotation is None or placement.position is None:
        return ca.SX(ca.DM(placement.offset[:3, :3])), ca.SX(ca.DM(placement.offset[:3, 3]))
    return apply_offset(placement.rotation, placement.position, placement.offset)
