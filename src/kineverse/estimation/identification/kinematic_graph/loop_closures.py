"""Closure equations of observed loops.

A tree of joints and one additional joint, L · g(a) · R, form a loop. The additional joint has an end in each
of its parts, the seat parent · L and the pin child · R⁻¹. The two coincide except for the motion g. A planar
linkage needs only two of the equations for that. Because the axes have noise, more equations could not be
fulfilled. So the equations with the largest dependence on the coordinates are chosen, and as dependent
coordinates those that they determine best, in the worst of the observed configurations. A loop that removes
no mobility left by the other loops is dropped, because a short motion is similar to that of many joints.
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
"""Components of the pin in the seat that each joint constrains: x, y, z and the rotations about them."""

# Families whose seat may be rotated about z.
_ABOUT_Z = ("prismatic", "revolute", "cylindrical", "planar")
# Tolerance for the axes in standard deviations, and the largest tolerance of the rank.
_WELL_KNOWN, _SMALL = 4.0, 0.15


class ObservedLoop(NamedTuple):
    """Joint outside the tree, and the chain of tree joints from its parent to its child."""

    joint: ObservedJoint
    chain: Sequence[ObservedJoint]

    @property
    def strength(self) -> float:
        """Range of the joint in standard deviations, reduced for small rotations.

        Any short motion resembles a rotation about a distant axis.
        """
        fit = self.joint.result.best
        moved = np.ptp(fit.joint_values, axis=0)
        known = np.maximum(fit.deviations.mean(axis=0), 1e-12)
        bent = np.where(find_angles(fit), np.minimum(moved, 1.0), 1.0)
        return float((moved * bent / known).min(initial=math.inf))


@dataclass(frozen=True)
class LoopClosure:
    """Closure of a loop: a pin coincides with a seat in some components by dependent coordinates."""

    name: str  # prefix of the names of frames and articulations
    seat_in: str  # name of the part with the seat, and pose of the seat in it, (4, 4)
    seat: Array
    pin_in: str  # name of the part with the pin, and pose of the pin in it, (4, 4)
    pin: Array
    mask: tuple[str, ...]  # as for kineverse.CloseLoop
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


@dataclass(frozen=True)
class _Ends:
    """Seat and pin of a loop, see :class:`LoopClosure`."""

    seat: Array
    pin: Array
    motion: Twists  # twists of the pin in the axes of the seat
    constrained: tuple[int, ...]  # components that coincide


def close_loops(
    loops: Iterable[ObservedLoop], joints: Sequence[ObservedJoint]
) -> Iterator[tuple[ObservedLoop, LoopClosure | None]]:
    """Yield the loops that remove mobility, the shortest first, with their closures.

    The closure is None if a coordinate cannot be dependent, as that of a ball, and for joints that couple
    components, such as screws.
    """
    # Loops are selected by strength and then closed by length.
    selected = []
    dependents = DependentCoordinates()
    for loop in sorted(loops, key=lambda loop: -loop.strength):
        ends = _ends(loop)
        if ends is None:
            yield loop, None
        elif _can_move(loop) and (plan := _plan(loop, ends, dependents)) is not None:
            dependents.add(plan.motion, plan.columns, plan.slopes)
            selected.append((loop, ends))
    observed = {
        x: (joint.times, joint.result.best.joint_values[:, k])
        for joint in joints
        for k, x in enumerate(_coordinates(joint.result.best, joint.child) or ())
    }
    dependents = DependentCoordinates()
    for loop, ends in sorted(selected, key=lambda pair: len(pair[0].chain)):
        plan = _plan(loop, ends, dependents, dependents.leading)
        if plan is None:
            yield loop, None
            continue
        dependents.add(plan.motion, plan.columns, plan.slopes)
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
                home=_find_home(observed, names, plan.columns, plan.motion.times),
            ),
        )


class _Plan(NamedTuple):
    """Plan of a closure: axes of the seat, rows that are zero, dependent columns and their slopes."""

    motion: Twists
    axes: Array
    rows: list[int]
    columns: list[int]
    slopes: Array


def _plan(
    loop: ObservedLoop, ends: _Ends, dependents: DependentCoordinates, leading: Iterable[str] = ()
) -> _Plan | None:
    """Return the plan of a closure; None if the loop removes no mobility or has no possible dependent."""
    fit = loop.joint.result.best
    motion = dependents.resolve(ends.motion)
    axes = _align_axes(motion.twists, fit.family in _ABOUT_Z)
    equations = _equations(motion.twists, axes)[:, ends.constrained]
    whole = _equations(ends.motion.twists, axes)[:, ends.constrained]
    eligible = [k for k, x in enumerate(motion.names) if x not in leading]
    # An observed loop has at least one degree of freedom.
    count = min(_rank(equations, _tolerance(loop), whole), len(motion.names) - 1)
    if not 0 < count <= len(eligible):
        return None
    rows, columns = _choose_equations(equations, count, eligible)
    leads = [k for k in range(len(motion.names)) if k not in columns]
    chosen = equations[:, rows]
    return _Plan(motion, axes, rows, columns, -invert_matrices(chosen[:, :, columns]) @ chosen[:, :, leads])


def _can_move(loop: ObservedLoop) -> bool:
    """Return True if a loop has finite mobility, unlike three hinges in a line."""
    elsewhere = _ends(loop, np.random.default_rng(0))
    assert elsewhere is not None  # as for the observed configurations
    equations = _equations(elsewhere.motion.twists, np.eye(3))[:, elsewhere.constrained]
    return _rank(equations, _tolerance(loop)) < len(elsewhere.motion.names)


def _title(loop: ObservedLoop) -> str:
    return f"{loop.joint.child}/{loop.joint.parent}"


def _coordinates(fit: Fit, name: str) -> tuple[str, ...] | None:
    """Return the coordinates of the joint values of a fit; None if they are not the joint values."""
    if isinstance(fit.motion, FamilyMotion):
        return family_coordinates(fit.motion, name)
    if fit.family == "cylindrical":
        return f"{name}/slide", f"{name}/turn"
    if fit.family in ("prismatic", "revolute", "screw"):
        return (name,)
    return () if fit.family == "rigid" else None


def _ends(loop: ObservedLoop, random: np.random.Generator | None = None) -> _Ends | None:
    """Return the ends of a loop in the observed configurations, or in random ones.

    The result is None if the loop cannot be closed.
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
    twists = _transform_twists(ring.twists, ring.poses[:, :3, :3] @ pin[:3, 3], axes)
    return _Ends(seat, pin, Twists(tuple(names), ring.times, twists), CONSTRAINED_COMPONENTS[fit.family])


def _transform_twists(twists: Array, offset: Array, parent_R_axes: Array) -> Array:
    """Return twists (N, 6, n) of a point at an offset, in other axes."""
    linear = twists[:, :3] - skew(offset) @ twists[:, 3:]
    axes_R_parent = np.swapaxes(parent_R_axes, 1, 2)
    moved: Array = np.concatenate([axes_R_parent @ linear, axes_R_parent @ twists[:, 3:]], axis=1)
    return moved


def _align_axes(twists: Array, about_z: bool) -> Array:
    """Return axes of the seat that are aligned with the plane of a planar linkage."""
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
    """Return the lever that makes radians and metres comparable [m]."""
    v, w = (float(np.sum(part**2)) for part in (twists[:, :3], twists[:, 3:]))
    return math.sqrt(v / w) if v and w else 1.0


def _equations(twists: Array, seat_R_new: Array) -> Array:
    """Return twists in new axes, with translations divided by the lever, (N, 6, n)."""
    lever = _lever(twists)
    parts = [seat_R_new.T @ twists[:, :3] / lever, seat_R_new.T @ twists[:, 3:]]
    return np.concatenate(parts, axis=1)


def _tolerance(loop: ObservedLoop) -> float:
    """Return the relative singular value below which a motion is explained by uncertain axes."""
    fits = [joint.result.best for joint in (loop.joint, *loop.chain)]
    axes = [fit.deviation(c) for fit in fits for c in fit.coordinates if c.startswith("axis.")]
    return min(max(RANK_TOLERANCE, _WELL_KNOWN * max(axes, default=0.0)), _SMALL)


def _rank(equations: Array, tolerance: float, whole: Array | None = None) -> int:
    """Return the median rank of the equations, relative to the largest singular value of ``whole``."""
    values = np.linalg.svd(equations, compute_uv=False)
    most = values if whole is None else np.linalg.svd(whole, compute_uv=False)
    return int(np.median(np.sum(values > tolerance * np.median(most[:, 0]), axis=1)))


def _choose_equations(equations: Array, count: int, eligible: Sequence[int]) -> tuple[list[int], list[int]]:
    """Return the rows and the dependent columns with the best conditioning in the worst configuration."""

    def conditioning(square: Array) -> float:
        return float(np.linalg.svd(square, compute_uv=False)[:, -1].min())

    rows = max(
        combinations(range(equations.shape[1]), count), key=lambda some: conditioning(equations[:, some])
    )
    chosen = equations[:, rows]
    columns = max(combinations(eligible, count), key=lambda some: conditioning(chosen[:, :, some]))
    return list(rows), list(columns)


def _find_home(
    observed: Mapping[str, tuple[Times, Array]], names: Sequence[str], columns: Sequence[int], times: Times
) -> tuple[tuple[str, float], ...]:
    """Return the observed configuration in which independent coordinates are nearest to mid-range."""

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
