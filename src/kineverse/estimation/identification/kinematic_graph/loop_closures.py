"""Closure equations of observed loops.

A tree of joints and one joint more, L · g(a) · R, make a loop. The latter has ends in both of its parts, the
seat parent · L and the pin child · R⁻¹, which are together but for what g moves. A linkage in a plane needs
only two equations of all that say so, and as axes are known with noise, nothing would fulfil more. So those
are taken that depend most on the coordinates, and those coordinates follow that they tell best, judged by the
worst of all configurations that were seen. A loop that takes nothing away which others have left is none: a
short motion is like that of many joints.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np

from kineverse.estimation.identification.custom_family import FamilyMotion
from kineverse.estimation.identification.families import GroupMotion
from kineverse.estimation.identification.found_operations import family_coordinates, rigid_pose
from kineverse.estimation.identification.result import Fit
from kineverse.estimation.linear_algebra import invert_matrices
from kineverse.lie import Array, inverse, skew, transform
from kineverse.loops import CloseLoop
from kineverse.loops.equations import AXES
from kineverse.model.frame import Frame
from kineverse.model.operation import Operation
from kineverse.model.operations import AddFrame

from .loop_mobility import (
    RANK_TOLERANCE,
    DependentCoordinates,
    ObservedJoint,
    Times,
    Twists,
    build_chain,
    find_angles,
)

_X, _Y, _Z, _RX, _RY, _RZ = range(6)
CONSTRAINED_COMPONENTS: Mapping[str, tuple[int, ...]] = {
    "rigid": (_X, _Y, _Z, _RX, _RY, _RZ),
    "prismatic": (_X, _Y, _RX, _RY, _RZ),
    "revolute": (_X, _Y, _Z, _RX, _RY),
    "cylindrical": (_X, _Y, _RX, _RY),
    "spherical": (_X, _Y, _Z),
    "planar": (_Z, _RX, _RY),
}
"""Which components of its pin in its seat each joint holds, out of x, y, z and turns about them."""

# Their axes may be turned about z.
_ABOUT_Z = ("prismatic", "revolute", "cylindrical", "planar")
# How many standard deviations axes may be off, and what is a way to part however badly they are known.
_WELL_KNOWN, _SMALL = 4.0, 0.15


class ObservedLoop(NamedTuple):
    """A joint, and the joints of a tree from its parent to its child."""

    joint: ObservedJoint
    chain: Sequence[ObservedJoint]

    @property
    def strength(self) -> float:
        """How far the joint moved, in units of how well that is known, less where it hardly turned.

        Any short motion is like that of a hinge somewhere.
        """
        fit = self.joint.result.best
        moved = np.ptp(fit.joint_values, axis=0)
        known = np.maximum(fit.deviations.mean(axis=0), 1e-12)
        bent = np.where(find_angles(fit), np.minimum(moved, 1.0), 1.0)
        return float((moved * bent / known).min(initial=math.inf))


@dataclass(frozen=True)
class LoopClosure:
    """How a loop is closed: a pin coincides with a seat in some components, and coordinates follow.

    Attributes
    ----------
    name
        What frames and articulations begin with.
    seat_in, seat
        The part that has the seat, and its pose there, (4, 4).
    pin_in, pin
        The same of the pin.
    mask, dependent, home
        See :class:`kineverse.CloseLoop`.
    """

    name: str
    seat_in: str
    seat: Array
    pin_in: str
    pin: Array
    mask: tuple[str, ...]
    dependent: tuple[str, ...]
    home: tuple[tuple[str, float], ...]

    def operations(self, name: Callable[[str], str]) -> Iterator[Operation]:
        """Yield what closes the loop, with names of parts as they are in the model."""
        title = name(self.name)
        yield AddFrame(f"{title}/seat", Frame.of(name(self.seat_in), rigid_pose(self.seat)))
        yield AddFrame(f"{title}/pin", Frame.of(name(self.pin_in), rigid_pose(self.pin)))
        yield CloseLoop(
            name=f"{title}/loop",
            frame=f"{title}/pin",
            to=f"{title}/seat",
            mask=self.mask,
            dependent=tuple(name(x) for x in self.dependent),
            home=tuple((name(x), value) for x, value in self.home),
        )


@dataclass(frozen=True)
class _Ends:
    """A seat and a pin, see :class:`LoopClosure`.

    Attributes
    ----------
    motion
        Of the pin in the axes of the seat.
    held
        The components that coincide.
    """

    seat: Array
    pin: Array
    motion: Twists
    constrained: tuple[int, ...]


def close_loops(
    loops: Iterable[ObservedLoop], joints: Sequence[ObservedJoint]
) -> Iterator[tuple[ObservedLoop, LoopClosure | None]]:
    """Yield the loops that take away what others leave, the smallest first, and how they are closed.

    That is None where coordinates between both parts cannot follow others, as those of a ball, and for joints
    that do more than to leave components free, as screws.

    Parameters
    ----------
    loops
        What may be one.
    joints
        All joints of the tree.
    """
    # Which of them are loops is told in another order than that in which they are closed.
    kept = []
    followers = DependentCoordinates()
    for loop in sorted(loops, key=lambda loop: -loop.strength):
        ends = _ends(loop)
        if ends is None:
            yield loop, None
        elif _can_move(loop) and (plan := _plan(loop, ends, followers)) is not None:
            followers.add(plan.motion, plan.columns, plan.slopes)
            kept.append((loop, ends))
    observed = {
        x: (joint.times, joint.result.best.joint_values[:, k])
        for joint in joints
        for k, x in enumerate(_coordinates(joint.result.best, joint.child) or ())
    }
    followers = DependentCoordinates()
    for loop, ends in sorted(kept, key=lambda pair: len(pair[0].chain)):
        plan = _plan(loop, ends, followers, followers.leading)
        if plan is None:
            yield loop, None
            continue
        followers.add(plan.motion, plan.columns, plan.slopes)
        joint, names = loop.joint, plan.motion.names
        turn = transform(plan.axes, np.zeros(3))
        yield (
            loop,
            LoopClosure(
                _title(loop),
                joint.parent,
                ends.seat @ turn,
                joint.child,
                ends.pin @ turn,
                mask=tuple(AXES[ends.constrained[k]] for k in plan.rows),
                dependent=tuple(names[k] for k in plan.columns),
                home=_home(observed, names, plan.columns, plan.motion.times),
            ),
        )


class _Plan(NamedTuple):
    """Which rows are zero, in which axes of the seat, and which columns follow, by which slopes."""

    motion: Twists
    axes: Array
    rows: list[int]
    columns: list[int]
    slopes: Array


def _plan(
    loop: ObservedLoop, ends: _Ends, followers: DependentCoordinates, leading: Iterable[str] = ()
) -> _Plan | None:
    """Return how a loop is closed; None if nothing is left of it to close, or nothing that could follow."""
    fit = loop.joint.result.best
    motion = followers.resolve(ends.motion)
    axes = _axes(motion.twists, fit.family in _ABOUT_Z)
    equations = _equations(motion.twists, axes)[:, ends.constrained]
    whole = _equations(ends.motion.twists, axes)[:, ends.constrained]
    able = [k for k, x in enumerate(motion.names) if x not in leading]
    # Something moves, or no loop would have been seen.
    count = min(_rank(equations, _tolerance(loop), whole), len(motion.names) - 1)
    if not 0 < count <= len(able):
        return None
    rows, columns = _chosen(equations, count, able)
    leads = [k for k in range(len(motion.names)) if k not in columns]
    chosen = equations[:, rows]
    return _Plan(motion, axes, rows, columns, -invert_matrices(chosen[:, :, columns]) @ chosen[:, :, leads])


def _can_move(loop: ObservedLoop) -> bool:
    """Whether a loop can move for more than a moment, unlike three hinges in a line."""
    elsewhere = _ends(loop, np.random.default_rng(0))
    assert elsewhere is not None  # as where it was seen
    equations = _equations(elsewhere.motion.twists, np.eye(3))[:, elsewhere.constrained]
    return _rank(equations, _tolerance(loop)) < len(elsewhere.motion.names)


def _title(loop: ObservedLoop) -> str:
    return f"{loop.joint.child}/{loop.joint.parent}"


def _coordinates(fit: Fit, name: str) -> tuple[str, ...] | None:
    """Return the coordinates that are a joint's values, in their order; None if it has others."""
    if isinstance(fit.motion, FamilyMotion):
        return family_coordinates(fit.motion, name)
    if fit.family == "cylindrical":
        return f"{name}/slide", f"{name}/turn"
    if fit.family in ("prismatic", "revolute", "screw"):
        return (name,)
    return () if fit.family == "rigid" else None


def _ends(loop: ObservedLoop, random: np.random.Generator | None = None) -> _Ends | None:
    """Return the ends of a loop, where they were seen or elsewhere.

    None if it cannot be closed.
    """
    joint, fit = loop.joint, loop.joint.result.best
    names: list[str] = []
    for other in loop.chain:
        between = _coordinates(other.result.best, other.child)
        if between is None:
            return None
        names += between
    if not isinstance(fit.motion, GroupMotion) or fit.family not in CONSTRAINED_COMPONENTS:
        return None
    ring = build_chain(loop.chain, joint.parent, random)
    seat, pin = fit.motion.left, inverse(fit.motion.right)
    axes = np.broadcast_to(seat[:3, :3], (len(ring.times), 3, 3))
    twists = _moved(ring.twists, ring.poses[:, :3, :3] @ pin[:3, 3], axes)
    return _Ends(seat, pin, Twists(tuple(names), ring.times, twists), CONSTRAINED_COMPONENTS[fit.family])


def _moved(twists: Array, offset: Array, parent_R_axes: Array) -> Array:
    """Return twists (N, 6, n) of a point at some offset, in other axes."""
    linear = twists[:, :3] - skew(offset) @ twists[:, 3:]
    axes_R_parent = np.swapaxes(parent_R_axes, 1, 2)
    moved: Array = np.concatenate([axes_R_parent @ linear, axes_R_parent @ twists[:, 3:]], axis=1)
    return moved


def _axes(twists: Array, about_z: bool) -> Array:
    """Return axes along which linkages in a plane move or do not: their plane contains or leaves out one."""
    v, w = (np.concatenate([*part.transpose(0, 2, 1)]) for part in (twists[:, :3], twists[:, 3:]))
    if about_z:
        # In a plane, ω and z x v are along its normal.
        normal = np.concatenate([_lever(twists) * w[:, :2], v[:, 1::-1] * (-1.0, 1.0)])
        x = np.linalg.eigh(normal.T @ normal)[1][:, 1]
        return np.array([[x[0], -x[1], 0.0], [x[1], x[0], 0.0], [0.0, 0.0, 1.0]])
    axes: Array = np.linalg.eigh(v.T @ v)[1]
    axes[:, 2] *= np.linalg.det(axes)
    return axes


def _lever(twists: Array) -> float:
    """Return how many metres make a radian."""
    v, w = (float(np.sum(part**2)) for part in (twists[:, :3], twists[:, 3:]))
    return math.sqrt(v / w) if v and w else 1.0


def _equations(twists: Array, seat_R_new: Array) -> Array:
    """Return twists in new axes, with radians and metres alike, (N, 6, n)."""
    lever = _lever(twists)
    parts = [seat_R_new.T @ twists[:, :3] / lever, seat_R_new.T @ twists[:, 3:]]
    return np.concatenate(parts, axis=1)


def _tolerance(loop: ObservedLoop) -> float:
    """Return up to which part of the largest a way to part may be due to axes that are not well known."""
    fits = [joint.result.best for joint in (loop.joint, *loop.chain)]
    axes = [fit.deviation(c) for fit in fits for c in fit.coordinates if c.startswith("axis.")]
    return min(max(RANK_TOLERANCE, _WELL_KNOWN * max(axes, default=0.0)), _SMALL)


def _rank(equations: Array, tolerance: float, whole: Array | None = None) -> int:
    """Return in how many ways the ends can part; they are small beside those if nothing else held them."""
    values = np.linalg.svd(equations, compute_uv=False)
    most = values if whole is None else np.linalg.svd(whole, compute_uv=False)
    return int(np.median(np.sum(values > tolerance * np.median(most[:, 0]), axis=1)))


def _chosen(equations: Array, count: int, able: Sequence[int]) -> tuple[list[int], list[int]]:
    """Return the rows, and the columns that follow, by which a loop is told best where it is told worst."""

    def told(square: Array) -> float:
        return float(np.linalg.svd(square, compute_uv=False)[:, -1].min())

    rows = max(combinations(range(equations.shape[1]), count), key=lambda some: told(equations[:, some]))
    chosen = equations[:, rows]
    columns = max(combinations(able, count), key=lambda some: told(chosen[:, :, some]))
    return list(rows), list(columns)


def _home(
    observed: Mapping[str, tuple[Times, Array]], names: Sequence[str], columns: Sequence[int], times: Times
) -> tuple[tuple[str, float], ...]:
    """Return the coordinates when those that do not follow were in the middle of what was seen of them."""

    def at(x: str, time: Times | np.int_) -> Array:
        when, values = observed[x]
        there: Array = values[np.searchsorted(when, time)]
        return there

    off = np.zeros(len(times))
    for k in set(range(len(names))) - {*columns}:
        values = observed[names[k]][1]
        middle, range_ = 0.5 * (values.min() + values.max()), np.ptp(values) or 1.0
        off += ((at(names[k], times) - middle) / range_) ** 2
    best = times[np.argmin(off)]
    return tuple((x, float(at(x, best))) for x in names)
