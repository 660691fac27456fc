"""Closed loops of observed linkages: detection, independent coordinates, and closure equations."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import combinations
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from kineverse.estimation.identification.families import FamilyMotion, GroupMotion
from kineverse.estimation.identification.joint_operations import family_coordinates, rigid_pose
from kineverse.estimation.identification.result import Fit
from kineverse.lie import Array, inverse, skew
from kineverse.loops import CloseLoop
from kineverse.loops.equations import AXES
from kineverse.model.basic_operations import AddFrame
from kineverse.model.frame import Frame
from kineverse.model.operation import Operation

if TYPE_CHECKING:
    from .kinematic_graph import PartPair

Times = npt.NDArray[np.int_]

_RANK_TOLERANCE = 0.05  # smallest singular value that counts as a degree of freedom, relative to the largest
_CONSTRAINED = 10.0  # ratio of squared errors by which a joint constrains the joints of its chain
_EXACT = 1e-6  # error without noise [m], [rad]

_X, _Y, _Z, _RX, _RY, _RZ = range(6)
CONSTRAINED_COMPONENTS: Mapping[str, tuple[int, ...]] = {
    "rigid": (_X, _Y, _Z, _RX, _RY, _RZ),
    "prismatic": (_X, _Y, _RX, _RY, _RZ),
    "revolute": (_X, _Y, _Z, _RX, _RY),
    "cylindrical": (_X, _Y, _RX, _RY),
    "spherical": (_X, _Y, _Z),
    "planar": (_Z, _RX, _RY),
}
"""Components of the pin in the seat that each joint constrains: x, y, z and the rotations about them."""


class Chain(NamedTuple):
    """Chain of joints, at the times at which all of its parts were observed."""

    poses: Array  # of the last part in the first, (N, 4, 4)
    twists: Array  # of the last part per unit of each joint value, (N, 6, n)
    times: Times


def build_chain(joints: Sequence[PartPair], start: str, random: np.random.Generator | None = None) -> Chain:
    """Return the chain of joints from the part ``start`` on, with values in observed or random order."""
    times = reduce(np.intersect1d, (joint.times for joint in joints))
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    # Twists are about the origin of the first part, until all joints are passed.
    twists = []
    for joint in joints:
        q = joint.result.best.joint_values[np.searchsorted(joint.times, times)]
        linear = joint.result.best.motion.linearise(q if random is None else random.permuted(q, axis=0))
        forward = joint.parent == start
        step = linear.pose if forward else inverse(linear.pose)
        # A joint that is traversed backwards has the opposite twist, in the axes of its child.
        parent = poses if forward else poses @ step
        v, w = (parent[:, :3, :3] @ part for part in (linear.by_joints[:, :3], linear.by_joints[:, 3:]))
        place = (parent @ linear.pose)[:, :3, 3]
        twists.append(np.concatenate([v + skew(place) @ w, w], axis=1))
        poses, start = poses @ step, joint.child if forward else joint.parent
    every = np.concatenate(twists, axis=2)
    every[:, :3] -= skew(poses[:, :3, 3]) @ every[:, 3:]
    return Chain(poses, every, times)


def closes_loop(pair: PartPair, joints: Sequence[PartPair]) -> bool:
    """Return True if a pair constrains the chain of joints from its parent to its child.

    The observed values of the joints then agree with the pair, and the same values in random order do not.
    """
    fit = pair.result.best
    constrained = CONSTRAINED_COMPONENTS.get("cylindrical" if fit.family == "screw" else fit.family)
    if pair.result.is_ambiguous or not pair.is_consistent or constrained is None:
        return False
    observed, shuffled = (build_chain(joints, pair.parent, r) for r in (None, np.random.default_rng(0)))
    if len(observed.times) < 2:
        return False
    errors = []
    for chain in (observed, shuffled):
        pin = inverse(fit.motion.left) @ chain.poses @ inverse(fit.motion.right)
        turned = 0.5 * (pin - np.swapaxes(pin, 1, 2))
        components = np.stack([*pin[:, :3, 3].T, turned[:, 2, 1], turned[:, 0, 2], turned[:, 1, 0]])
        errors.append(np.mean(components[list(constrained)] ** 2, axis=1) + _EXACT**2)
    return bool(np.mean(errors[1] / errors[0]) > _CONSTRAINED)


class ObservedLoop(NamedTuple):
    """Joint outside the tree, and the chain of tree joints from its parent to its child."""

    joint: PartPair
    chain: Sequence[PartPair]

    @property
    def strength(self) -> float:
        """Range of the joint in standard deviations, less for small rotations, which are like any motion."""
        fit = self.joint.result.best
        moved = np.ptp(fit.joint_values, axis=0)
        spread = np.maximum(fit.deviations.mean(axis=0), 1e-12)
        bent = np.where(np.array(fit.motion.kinds, dtype=bool), np.minimum(moved, 1.0), 1.0)
        return float((moved * bent / spread).min(initial=math.inf))


@dataclass(frozen=True)
class LoopClosure:
    """Closure of a loop: a pin coincides with a seat in some components by dependent coordinates."""

    name: str  # prefix of the names of frames and articulations
    seat_in: str  # name of the part with the seat, and pose of the seat in it, (4, 4)
    seat: Array
    pin_in: str
    pin: Array
    mask: tuple[str, ...]  # mask, dependent and home are those of kineverse.CloseLoop
    dependent: tuple[str, ...]
    home: tuple[tuple[str, float], ...]

    def operations(self, name: Callable[[str], str]) -> Iterator[Operation]:
        """Yield the operations that close the loop, with names of parts mapped to the model."""
        title = name(self.name)
        yield AddFrame(f"{title}/seat", Frame.from_transform(name(self.seat_in), rigid_pose(self.seat)))
        yield AddFrame(f"{title}/pin", Frame.from_transform(name(self.pin_in), rigid_pose(self.pin)))
        yield CloseLoop(
            name=f"{title}/loop",
            frame=f"{title}/pin",
            to=f"{title}/seat",
            mask=self.mask,
            dependent=tuple(name(x) for x in self.dependent),
            home=tuple((name(x), value) for x, value in self.home),
        )


@dataclass(frozen=True, eq=False)
class Ring:
    """Seat and pin of a loop, with twists of the pin in the axes of the seat per unit of each coordinate."""

    seat: Array
    pin: Array
    family: str
    names: tuple[str, ...]  # of the n coordinates of the chain
    times: Times
    twists: Array  # (N, 6, n)

    def equations(self, twists: Array | None = None) -> Array:
        """Return constrained twists, with translations divided by the lever, (N, m, n)."""
        twists = self.twists if twists is None else twists
        v, w = (float(np.sum(part**2)) for part in (twists[:, :3], twists[:, 3:]))
        lever = math.sqrt(v / w) if v and w else 1.0  # makes metres and radians comparable
        scaled = np.concatenate([twists[:, :3] / lever, twists[:, 3:]], axis=1)
        return scaled[:, CONSTRAINED_COMPONENTS[self.family]]


@dataclass(frozen=True, eq=False)
class ClosureEquations:
    """Equations of a closed loop: linear combinations of the speeds of its coordinates are zero."""

    ring: Ring
    rows: list[int]  # of the constrained components
    names: list[str]  # of the coordinates that were independent before
    dependent: list[str]
    home: np.int_  # time at which the dependent coordinates are determined best
    times: Times


def close_loops(
    loops: Iterable[ObservedLoop], joints: Sequence[PartPair]
) -> Iterator[tuple[ObservedLoop, LoopClosure | None]]:
    """Yield the loops that remove mobility, the shortest first, with their closures, or None."""
    # Loops are selected by strength and then closed by length.
    selected: list[tuple[ObservedLoop, Ring]] = []
    closed: list[ClosureEquations] = []
    for loop in sorted(loops, key=lambda loop: -loop.strength):
        ring = _build_ring(loop)
        if ring is None:
            yield loop, None
        elif (plan := _plan(ring, closed)) is not None:
            closed.append(plan)
            selected.append((loop, ring))
    observed = {}
    for joint in joints:
        for k, x in enumerate(_coordinates(joint.result.best, joint.child) or ()):
            observed[x] = dict(zip(joint.times, joint.result.best.joint_values[:, k].tolist(), strict=True))
    closed = []
    for loop, ring in sorted(selected, key=lambda pair: len(pair[0].chain)):
        leading = {x for each in closed for x in each.names} - {x for each in closed for x in each.dependent}
        plan = _plan(ring, closed, leading)
        if plan is None:
            yield loop, None
            continue
        closed.append(plan)
        joint = loop.joint
        closure = LoopClosure(
            f"{joint.child}/{joint.parent}",
            joint.parent,
            ring.seat,
            joint.child,
            ring.pin,
            mask=tuple(AXES[CONSTRAINED_COMPONENTS[ring.family][k]] for k in plan.rows),
            dependent=tuple(plan.dependent),
            home=tuple((x, observed[x][plan.home]) for x in plan.names),
        )
        yield loop, closure


def _plan(
    ring: Ring, closed: Sequence[ClosureEquations], leading: Collection[str] = ()
) -> ClosureEquations | None:
    """Return the equations of a loop; None if it removes no mobility or has no possible dependent."""
    names, times, twists = resolve(ring, closed)
    equations = ring.equations(twists)
    largest = np.median(np.linalg.svd(ring.equations(), compute_uv=False)[:, 0])
    values = np.linalg.svd(equations, compute_uv=False)
    # An observed loop has at least one degree of freedom.
    count = min(int(np.median(np.sum(values > _RANK_TOLERANCE * largest, axis=1))), len(names) - 1)
    eligible = [k for k, x in enumerate(names) if x not in leading]
    if not 0 < count <= len(eligible):
        return None
    rows, columns = _choose_equations(equations, count, eligible)
    home = times[np.argmax(_smallest_singular_values(equations[:, rows][:, :, columns]))]
    return ClosureEquations(ring, rows, names, [names[k] for k in columns], home, times)


def resolve(ring: Ring, closed: Sequence[ClosureEquations]) -> tuple[list[str], Times, Array]:
    """Return the independent coordinates of a loop, the times, and twists per unit of these coordinates.

    With A q' = 0 for the closed loops, the dependent speeds are q_D' = -A_D⁻¹ A_I q_I'.
    """
    linked: list[ClosureEquations] = []
    reached = {*ring.names}
    while more := [each for each in closed if each not in linked and reached & {*each.ring.names}]:
        linked += more
        reached.update(x for each in more for x in each.ring.names)
    times = reduce(np.intersect1d, (each.times for each in linked), ring.times)
    names = list(dict.fromkeys(x for one in (ring, *(each.ring for each in linked)) for x in one.names))

    def spread(one: Ring, values: Array) -> Array:
        result = np.zeros((len(times), values.shape[1], len(names)))
        result[:, :, [names.index(x) for x in one.names]] = values[np.searchsorted(one.times, times)]
        return result

    twists = spread(ring, ring.twists)
    follows = np.array([any(x in each.dependent for each in linked) for x in names])
    moves = np.isin(names, ring.names) & ~follows
    if linked:
        rows = [spread(each.ring, each.ring.equations()[:, each.rows]) for each in linked]
        a = np.concatenate(rows, axis=1)
        slopes = -np.linalg.solve(a[:, :, follows], a[:, :, ~follows])
        of_ring = np.isin(np.array(names)[follows], ring.names)
        moves[~follows] |= np.abs(slopes[:, of_ring]).max(axis=(0, 1), initial=0.0) > _EXACT
        twists[:, :, ~follows] += twists[:, :, follows] @ slopes
    return [x for x, kept in zip(names, moves, strict=True) if kept], times, twists[:, :, moves]


def _coordinates(fit: Fit, name: str) -> tuple[str, ...] | None:
    """Return the coordinates of the joint values of a fit; None if they are not the joint values."""
    if isinstance(fit.motion, FamilyMotion):
        return family_coordinates(fit.motion, name)
    if fit.family == "cylindrical":
        return f"{name}/slide", f"{name}/turn"
    if fit.family in ("prismatic", "revolute", "screw"):
        return (name,)
    return () if fit.family == "rigid" else None


def _build_ring(loop: ObservedLoop) -> Ring | None:
    """Return the ring of a loop; None if it cannot be closed."""
    fit = loop.joint.result.best
    names: list[str] = []
    for other in loop.chain:
        between = _coordinates(other.result.best, other.child)
        if between is None:
            return None
        names += between
    if fit.family not in CONSTRAINED_COMPONENTS or not isinstance(fit.motion, GroupMotion):
        return None
    chain = build_chain(loop.chain, loop.joint.parent)
    seat, pin = fit.motion.left, inverse(fit.motion.right)
    linear = chain.twists[:, :3] - skew(chain.poses[:, :3, :3] @ pin[:3, 3]) @ chain.twists[:, 3:]
    twists = [seat[:3, :3].T @ part for part in (linear, chain.twists[:, 3:])]
    return Ring(seat, pin, fit.family, tuple(names), chain.times, np.concatenate(twists, axis=1))


def _choose_equations(equations: Array, count: int, eligible: Sequence[int]) -> tuple[list[int], list[int]]:
    """Return the rows and the dependent columns that are determined best in the worst configuration."""
    each = combinations(range(equations.shape[1]), count)
    rows = max(each, key=lambda some: _smallest_singular_values(equations[:, some]).min())
    chosen = equations[:, rows]
    each = combinations(eligible, count)
    columns = max(each, key=lambda some: _smallest_singular_values(chosen[:, :, some]).min())
    return list(rows), list(columns)


def _smallest_singular_values(matrices: Array) -> Array:
    return np.asarray(np.linalg.svd(matrices, compute_uv=False)[:, -1])
