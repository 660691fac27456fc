"""Forward kinematics, geometric Jacobians along chains of frames, and units of coordinates.

The pose of a frame is stored as an *anchor*, the product up to the last moving factor, and a constant offset.
Constants are multiplied numerically before they enter an expression, so rigidly attached frames add no cost.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np
import numpy.typing as npt
from msgspec import Struct

from kineverse.errors import ModelError, NoSolutionError
from kineverse.expressions.expression import NO_NODES, Expression, from_casadi
from kineverse.expressions.layout import SX
from kineverse.expressions.node import Node
from kineverse.lie import Array
from kineverse.spatial import OneAxisTransform, inverse
from kineverse.symbols import Symbol

from .body import Pose
from .frame import WORLD, Frame

if TYPE_CHECKING:
    from .model_view import ModelView

FrameLookup = Callable[[str], Frame]


class ChainStep(Struct, frozen=True):
    """Moving factor of a chain, with the rotation and position of the chain before it."""

    rotation: SX
    position: SX
    nodes: frozenset[Node]
    factor: Expression


class Placement(Struct, frozen=True):
    """Pose of a frame in the root of a chain.

    Rotation and position of the anchor (None for the identity), and the constant offset.
    """

    rotation: SX | None
    position: SX | None
    nodes: frozenset[Node]
    offset: npt.NDArray[np.float64]
    steps: tuple[ChainStep, ...] = ()
    parent: Placement | None = None

    def then(self, frame: Frame) -> Placement:
        """Return the placement of a child frame."""
        rotation, position, nodes, offset = self.rotation, self.position, self.nodes, self.offset
        steps = []
        for factor in frame.factors:
            if isinstance(factor, Pose):
                offset = offset @ factor.matrix
                continue
            rotation, position = _with_offset(rotation, position, offset)
            steps.append(ChainStep(rotation, position, nodes, factor))
            nodes = nodes | factor.nodes if factor.nodes else nodes
            if isinstance(factor, OneAxisTransform):
                if factor.is_rotation:
                    rotation = ca.mtimes(rotation, factor.rotation)
                else:
                    position = ca.mtimes(rotation, factor.offset) + position
            else:
                sx = factor.sx
                position = ca.mtimes(rotation, sx[:3, 3]) + position
                rotation = ca.mtimes(rotation, sx[:3, :3])
            offset = IDENTITY
        return Placement(rotation, position, nodes, offset, tuple(steps), self)

    def parts(self) -> tuple[SX, SX]:
        """Return rotation and position."""
        return _with_offset(self.rotation, self.position, self.offset)

    def matrix(self) -> Expression:
        """Return the 4×4 transform."""
        if self.rotation is None:
            return from_casadi(ca.SX(ca.DM(self.offset)), (4, 4), NO_NODES)
        rotation, position = self.parts()
        return from_casadi(
            ca.densify(ca.vertcat(ca.horzcat(rotation, position), _BOTTOM)), (4, 4), self.nodes
        )

    def all_steps(self) -> list[ChainStep]:
        """Return the moving factors of the chain, from the root outwards."""
        steps: list[ChainStep] = []
        placement: Placement | None = self
        while placement is not None:
            steps += reversed(placement.steps)
            placement = placement.parent
        return steps[::-1]


IDENTITY = np.eye(4)
IDENTITY.flags.writeable = False
ROOT = Placement(None, None, NO_NODES, IDENTITY)
_BOTTOM = ca.SX(ca.DM([[0, 0, 0, 1]]))
_EYE3 = np.eye(3)


def _with_offset(rotation: SX | None, position: SX | None, offset: npt.NDArray[np.float64]) -> tuple[SX, SX]:
    """Return rotation and position of anchor @ offset; identities are skipped."""
    if rotation is None or position is None:
        return _sparse(offset[:3, :3]), ca.SX(ca.DM(offset[:3, 3]))
    if offset is IDENTITY:
        return rotation, position
    if offset[:3, 3].any():
        position = ca.mtimes(rotation, _sparse(offset[:3, 3])) + position
    if not np.array_equal(offset[:3, :3], _EYE3):
        rotation = ca.mtimes(rotation, _sparse(offset[:3, :3]))
    return rotation, position


def _sparse(numbers: npt.NDArray[np.float64]) -> SX:
    return ca.SX(ca.sparsify(ca.DM(numbers)))


def ancestors(name: str, lookup: FrameLookup) -> list[str]:
    """Return the frame and its ancestors, without the world."""
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


def compose_chain(chain: Sequence[str], lookup: FrameLookup) -> Placement:
    """Return the placement of the last frame of a chain, which frames cache as that in the world."""
    return _place(chain, lookup, "relative_placement")


def place_in_world(name: str, lookup: FrameLookup) -> Placement:
    """Return the placement of a frame in the world; frames cache the placements of all ancestors."""
    return _place(ancestors(name, lookup)[::-1], lookup, "placement")


def _place(chain: Sequence[str], lookup: FrameLookup, cache: str) -> Placement:
    placement = ROOT
    for name in chain:
        frame = lookup(name)
        known: Placement | None = getattr(frame, cache)
        # A cached placement is valid while it refers to the same parent placement.
        if known is None or known.parent is not placement:
            known = placement.then(frame)
            object.__setattr__(frame, cache, known)
        placement = known
    return placement


def relative_pose(frame: str, relative_to: str, lookup: FrameLookup) -> Expression:
    """Return relative_to_T_frame in plain coordinates."""
    base, down = branches(frame, relative_to, lookup)
    tip = compose_chain(down, lookup).matrix()
    if not base:
        return tip
    root = inverse(compose_chain(base, lookup).matrix())
    return root @ tip if down else root


class Twist(Struct):
    """Twist of a frame per unit of one speed: velocity of the origin and angular velocity."""

    linear: SX
    angular: SX
    nodes: frozenset[Node]


def compute_twists(base: Placement, tip: Placement, heuristic: bool) -> tuple[SX, SX, dict[Symbol, Twist]]:
    """Return rotation and position of the tip in the base, and its twist per speed, in axes of the base.

    Both placements are relative to a common ancestor. Every moving factor contributes its own twist,
    transformed to the tip by a cross product. So the cost is linear in the length of the chain.
    """
    rotation, position = tip.parts()
    found: dict[Symbol, Twist] = {}
    # Relative to the base, the tip moves with its own factors and opposite to the factors of the base.
    for sign, placement in ((1, tip), (-1, base)):
        for step in placement.all_steps():
            _add_step(found, step, position, sign, heuristic)
    if base is ROOT:
        return rotation, position, found
    base_rotation, base_position = base.parts()
    turn = base_rotation.T
    for twist in found.values():
        twist.linear, twist.angular = ca.mtimes(turn, twist.linear), ca.mtimes(turn, twist.angular)
        twist.nodes = twist.nodes | base.nodes
    return ca.mtimes(turn, rotation), ca.mtimes(turn, position - base_position), found


def _add_step(found: dict[Symbol, Twist], step: ChainStep, tip: SX, sign: int, heuristic: bool) -> None:
    moves = _axis_twists if isinstance(step.factor, OneAxisTransform) else _twists
    for key, velocity, omega, entry_nodes in moves(step, tip, heuristic):
        if sign < 0:
            velocity, omega = -velocity, -omega
        nodes = entry_nodes | step.nodes
        if key in found:
            known = found[key]
            known.linear, known.angular = known.linear + velocity, known.angular + omega
            known.nodes = known.nodes | nodes
        else:
            found[key] = Twist(velocity, omega, nodes)


def _axis_twists(
    step: ChainStep, tip: SX, heuristic: bool
) -> Iterator[tuple[Symbol, SX, SX, frozenset[Node]]]:
    """Yield speed, linear and angular velocity, and nodes of a motion about or along an axis."""
    motion = step.factor
    assert isinstance(motion, OneAxisTransform)
    if sum(d != 0 for d in motion.direction) == 1:
        index = next(i for i, d in enumerate(motion.direction) if d)
        unit = step.rotation[:, index]
        direction = unit if motion.direction[index] == 1 else -unit
    else:
        direction = ca.mtimes(step.rotation, ca.SX(ca.DM(motion.direction)))
    for key, entry in motion.amount.gradient(heuristic).items():
        along = direction * entry.sx
        if motion.is_rotation:
            yield key, ca.cross(along, tip - step.position), along, entry.nodes
        else:
            yield key, along, ca.SX(3, 1), entry.nodes


def _twists(step: ChainStep, tip: SX, heuristic: bool) -> Iterator[tuple[Symbol, SX, SX, frozenset[Node]]]:
    """Yield speed, linear and angular velocity, and nodes of any rigid motion."""
    factor = step.factor
    entries = factor.gradient(heuristic)
    if not entries:
        return
    factor_rotation, factor_position = factor.sx[:3, :3].T, factor.sx[:3, 3]
    arm = tip - step.position
    for key, entry in entries.items():
        spin = ca.mtimes(ca.sparsify(entry.sx[:3, :3]), factor_rotation)
        linear = ca.sparsify(entry.sx[:3, 3])
        velocity, omega = ca.SX(3, 1), ca.SX(3, 1)
        if spin.nnz():
            local = ca.sparsify(ca.vertcat(spin[2, 1], spin[0, 2], spin[1, 0]))
            omega = ca.mtimes(step.rotation, local)
            velocity = ca.cross(omega, arm)
            if factor_position.nnz():
                linear = linear - ca.cross(local, factor_position)
        if linear.nnz():
            velocity = velocity + ca.mtimes(step.rotation, linear)
        yield key, velocity, omega, entry.nodes


DIFFERENCE_STEP = 1e-4  # step of the finite differences; their error is its square [unit of the coordinate]

UNIT_TOLERANCE = 1e-5

PROBE_DISTANCES = (0.0, 1.0, -1.0, 0.1, -0.1)
"""Distances of the probed states from the given values; the later ones are used if earlier ones fail."""


def infer_units(model: ModelView, values: Mapping[str, float], names: Iterable[str]) -> dict[str, str]:
    """Return ``"rad"``, ``"m"`` or ``""`` for each of the named symbols."""
    from kineverse.compilation import compile  # for start-up time

    wanted = list(names)
    # In terms of free coordinates: the angles of a closed loop follow its crank.
    moving = [t for frame in model.frames.values() if (t := model.rates.carry(frame.transform)).symbols]
    if not moving:
        return dict.fromkeys(wanted, "")
    function = compile(moving, tier="interpreter")  # a few calls do not pay for C
    inputs = [str(symbol) for symbol in function.inputs]
    base = np.array([values[name] for name in inputs])

    def rates(place: Array, index: int) -> tuple[Array, Array]:
        offset = np.zeros(len(inputs))
        offset[index] = DIFFERENCE_STEP
        with np.errstate(invalid="ignore"):  # Frames without a finite pose have no rates.
            return _rates(np.array(function(place - offset)), np.array(function(place + offset)))

    found = dict.fromkeys(wanted, "")
    # A second state excludes coordinates that move by one radian a unit only by chance.
    off = 0.1 + 0.01 * np.arange(len(base))
    for name in wanted:
        if name not in inputs:
            continue
        seen = []
        for distance in PROBE_DISTANCES:
            # Loops do not close everywhere; two states are enough.
            with suppress(NoSolutionError):
                seen.append(rates(base + distance * off, inputs.index(name)))
            if len(seen) == 2:
                break
        if len(seen) < 2:
            continue
        turning = np.all([np.abs(turn - 1.0) < UNIT_TOLERANCE for turn, _ in seen], axis=0)
        shifting = np.all(
            [(turn < UNIT_TOLERANCE) & (np.abs(s - 1.0) < UNIT_TOLERANCE) for turn, s in seen], axis=0
        )
        found[name] = "rad" if turning.any() else "m" if shifting.any() else ""
    return found


def _rates(before: Array, after: Array) -> tuple[Array, Array]:
    """Return the (N,) rates of rotation [rad] and translation [m] a unit, from poses two steps apart."""
    # The antisymmetric part of R_before' R_after has the norm √2 |sin| of the angle between them.
    change = np.einsum("nji,njk->nik", before[:, :3, :3], after[:, :3, :3])
    sine = np.linalg.norm(change - np.swapaxes(change, 1, 2), axis=(1, 2)) / np.sqrt(8.0)
    shift = np.linalg.norm(after[:, :3, 3] - before[:, :3, 3], axis=1)
    return np.asarray(sine / (2.0 * DIFFERENCE_STEP)), np.asarray(shift / (2.0 * DIFFERENCE_STEP))
