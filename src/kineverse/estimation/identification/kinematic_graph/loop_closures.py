"""Observed loops: closure tests, mobility, dependent coordinates, and closure equations."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, product
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from kineverse.estimation.identification.families import FamilyMotion, GroupMotion
from kineverse.estimation.identification.joint_operations import family_coordinates, rigid_pose
from kineverse.estimation.identification.result import Fit
from kineverse.estimation.linear_algebra import invert_matrices
from kineverse.lie import Array, inverse, skew, transform
from kineverse.loops import CloseLoop
from kineverse.loops.equations import AXES
from kineverse.model.basic_operations import AddFrame
from kineverse.model.frame import Frame
from kineverse.model.operation import Operation

from .pairwise import PartPair

Times = npt.NDArray[np.int_]


class Twists(NamedTuple):
    """Twists of a frame per unit of each of n coordinates, (N, 6, n), at N times."""

    names: tuple[str, ...]
    times: Times
    twists: Array


class _Slopes(NamedTuple):
    """Derivatives of a dependent coordinate by each of its independent ones, (N,), at N times."""

    times: Times
    slopes: Mapping[str, Array]


class DependentCoordinates:
    """Dependent coordinates of closed loops, with their derivatives by the independent ones."""

    def __init__(self) -> None:
        self._known: dict[str, _Slopes] = {}

    @property
    def leading(self) -> set[str]:
        """Independent coordinates on which others depend."""
        return {u for known in self._known.values() for u in known.slopes}

    def resolve(self, motion: Twists) -> Twists:
        """Return twists per unit of the independent coordinates."""
        times = motion.times
        for x in motion.names:
            if x in self._known:
                times = np.intersect1d(times, self._known[x].times)
        rows = np.searchsorted(motion.times, times)
        columns: dict[str, Array] = {}
        for k, x in enumerate(motion.names):
            for u, slope in self._slopes(x, times).items():
                columns[u] = columns.get(u, 0.0) + motion.twists[rows, :, k] * slope[:, None]
        return Twists(tuple(columns), times, np.stack([*columns.values()], axis=2))

    def add(self, motion: Twists, columns: Sequence[int], slopes: Array) -> None:
        """Make some columns dependent on the others, with slopes (N, dependent, independent)."""
        leads = [x for k, x in enumerate(motion.names) if k not in columns]
        new = {
            motion.names[k]: _Slopes(motion.times, {x: slopes[:, i, j] for j, x in enumerate(leads)})
            for i, k in enumerate(columns)
        }
        before, self._known = self._known, new
        for x, (times, by_others) in before.items():
            common = times
            for u in by_others:
                if u in new:
                    common = np.intersect1d(common, new[u].times)
            rows = np.searchsorted(times, common)
            total: dict[str, Array] = {}
            for u, by_u in by_others.items():
                for v, slope in self._slopes(u, common).items():
                    total[v] = total.get(v, 0.0) + by_u[rows] * slope
            self._known[x] = _Slopes(common, total)

    def _slopes(self, name: str, times: Times) -> Mapping[str, Array]:
        """Return the derivatives of a coordinate by independent ones; an independent one has slope 1."""
        if name not in self._known:
            return {name: np.ones(len(times))}
        known = self._known[name]
        rows = np.searchsorted(known.times, times)
        return {u: slope[rows] for u, slope in known.slopes.items()}


RANK_TOLERANCE = 0.05  # smallest singular value that counts as a degree of freedom, relative to the largest
_DEGREES = {1: 5, 2: 3}  # degree of polynomials or Fourier series of one and of two joint values; 2 for more
_UNEXPLAINED = 0.1  # largest unexplained share of the variance of a dependent joint value
_WRAPPING = math.pi  # range from which on an angle is treated as periodic [rad]
# Largest random change of joint values for configurations that were not observed [m] or [rad].
_PERTURBATION = 0.3


@dataclass(frozen=True)
class Chain:
    """Chain of joints, at the times at which all of its parts were observed."""

    poses: Array  # of the last part in the first, (N, 4, 4)
    twists: Array  # of the last part per unit of each joint value, (N, 6, m)
    values: Array  # joint values and their standard deviations, (N, m)
    deviations: Array
    is_angle: tuple[bool, ...]  # mask of the joint values that are angles, (m,)
    times: Times

    @property
    def mobility(self) -> int:
        """Number of degrees of freedom of the last part relative to the first."""
        if not self.twists.shape[2]:
            return 0
        scaled = self.twists.copy()
        scaled[:, :3] /= math.sqrt(float(np.mean(np.sum(self.poses[:, :3, 3] ** 2, axis=1)))) or 1.0
        values = np.linalg.svd(scaled, compute_uv=False)
        return int(np.median(np.sum(values > RANK_TOLERANCE * values[:, :1], axis=1)))


def build_chain(joints: Sequence[PartPair], start: str, random: np.random.Generator | None = None) -> Chain:
    """Return the chain of successive joints from the part ``start`` on, observed or with random values."""
    times = joints[0].times
    for one in joints[1:]:
        times = np.intersect1d(times, one.times)
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    # Twists are about the origin of the first part, until all joints are passed.
    parts: list[tuple[Array, Array, Array]] = []
    for one in joints:
        fit = one.result.best
        rows = np.searchsorted(one.times, times)
        q = fit.joint_values[rows]
        if random is not None:
            # For configurations that were not observed.
            q = random.permuted(q, axis=0)
            if isinstance(fit.motion, GroupMotion):
                q = q + random.uniform(-_PERTURBATION, _PERTURBATION, q.shape)
        linear = fit.motion.linearise(q)
        forward = one.parent == start
        step = linear.pose if forward else inverse(linear.pose)
        # A joint that is traversed backwards has the opposite twist, in the axes of its child.
        parent = poses if forward else poses @ step
        turned = parent[:, :3, :3]
        v, w = turned @ linear.by_joints[:, :3], turned @ linear.by_joints[:, 3:]
        place = (parent @ linear.pose)[:, :3, 3]
        parts.append((np.concatenate([v + skew(place) @ w, w], axis=1), q, fit.deviations[rows]))
        poses = poses @ step
        start = one.child if forward else one.parent
    twists, values, deviations = (np.concatenate(each, axis=-1) for each in zip(*parts, strict=True))
    twists[:, :3] -= skew(poses[:, :3, 3]) @ twists[:, 3:]
    angles = tuple(angle for one in joints for angle in find_angles(one.result.best))
    return Chain(poses, twists, values, deviations, angles, times)


def closes_loop(pair: PartPair, joints: Sequence[PartPair]) -> bool:
    """Return True if a pair is constrained beyond the chain of joints from its parent to its child."""
    if pair.result.is_ambiguous or not pair.is_consistent:
        return False
    chain = build_chain(joints, pair.parent)
    fit = pair.result.best
    count = fit.motion.joints
    if len(chain.times) < 2 or chain.mobility <= count:
        return False
    rows = np.searchsorted(pair.times, chain.times)
    values = np.concatenate([chain.values, fit.joint_values[rows]], axis=1)
    deviations = np.concatenate([chain.deviations, fit.deviations[rows]], axis=1)
    is_wide = np.ptp(values, axis=0) > _WRAPPING
    is_periodic = np.logical_and([*chain.is_angle, *find_angles(fit)], is_wide).tolist()
    samples = [_JointSamples(*each) for each in zip(values.T, deviations.T, is_periodic, strict=True)]
    return any(_determine(samples, chosen) for chosen in combinations(range(len(samples)), count))


class _JointSamples(NamedTuple):
    """Values of a joint and their standard deviations; periodic for an angle of a wide range."""

    values: Array
    deviations: Array
    is_periodic: bool

    def terms(self, degree: int) -> list[Array]:
        """Return the terms of a degree in a polynomial, or in a Fourier series if periodic."""
        if not degree:
            return [np.ones(len(self.values))]
        if self.is_periodic:
            return [np.cos(degree * self.values), np.sin(degree * self.values)]
        moved = self.values - self.values.mean()
        return [(moved / (moved.std() or 1.0)) ** degree]


def find_angles(fit: Fit) -> list[bool]:
    """Return the mask of the joint values that are angles."""
    return [isinstance(fit.motion, GroupMotion) and bool(kind) for kind in fit.motion.kinds]


def _determine(samples: Sequence[_JointSamples], chosen: Sequence[int]) -> bool:
    """Return True if chosen joint values determine all others, by polynomials or Fourier series."""
    degree = _DEGREES.get(len(chosen), 2)
    degrees = [d for d in product(range(degree + 1), repeat=len(chosen)) if sum(d) <= degree]
    each = [[samples[k].terms(d) for k, d in zip(chosen, some, strict=True)] for some in degrees]
    features = np.column_stack([np.prod(factors, axis=0) for some in each for factors in product(*some)])
    if len(features) < 2 * features.shape[1]:
        return False
    for k in set(range(len(samples))) - {*chosen}:
        for term in samples[k].terms(1):
            moved = term - term.mean()
            left = moved - features @ np.linalg.lstsq(features, moved, rcond=None)[0]
            variance = 1.0 if samples[k].is_periodic else samples[k].values.var() or 1.0
            noise = np.mean(samples[k].deviations ** 2) / variance
            if np.mean(left**2) >= _UNEXPLAINED * np.mean(moved**2) + 4.0 * noise:
                return False
    return True


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

_ABOUT_Z = ("prismatic", "revolute", "cylindrical", "planar")  # families whose seat may be rotated about z
# Tolerance for the axes in standard deviations, and the largest tolerance of the rank.
_WELL_KNOWN, _SMALL = 4.0, 0.15


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
        bent = np.where(find_angles(fit), np.minimum(moved, 1.0), 1.0)
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


@dataclass(frozen=True)
class _Ends:
    """Poses of the seat and the pin of a loop."""

    seat: Array
    pin: Array
    motion: Twists  # of the pin in the axes of the seat
    constrained: tuple[int, ...]  # components that coincide


def close_loops(
    loops: Iterable[ObservedLoop], joints: Sequence[PartPair]
) -> Iterator[tuple[ObservedLoop, LoopClosure | None]]:
    """Yield the loops that remove mobility, the shortest first, with their closures, or None."""
    # Loops are selected by strength and then closed by length.
    selected, dependents = [], DependentCoordinates()
    for loop in sorted(loops, key=lambda loop: -loop.strength):
        ends = _ends(loop)
        if ends is None:
            yield loop, None
        elif _can_move(loop) and (plan := _plan(loop, ends, dependents)) is not None:
            dependents.add(plan.motion, plan.columns, plan.slopes)
            selected.append((loop, ends))
    observed = {}
    for joint in joints:
        for k, x in enumerate(_coordinates(joint.result.best, joint.child) or ()):
            observed[x] = joint.times, joint.result.best.joint_values[:, k]
    dependents = DependentCoordinates()
    for loop, ends in sorted(selected, key=lambda pair: len(pair[0].chain)):
        plan = _plan(loop, ends, dependents, dependents.leading)
        if plan is None:
            yield loop, None
            continue
        dependents.add(plan.motion, plan.columns, plan.slopes)
        joint, names = loop.joint, plan.motion.names
        turn = transform(plan.axes, np.zeros(3))
        closure = LoopClosure(
            f"{joint.child}/{joint.parent}",
            joint.parent,
            ends.seat @ turn,
            joint.child,
            ends.pin @ turn,
            mask=tuple(AXES[ends.constrained[k]] for k in plan.rows),
            dependent=tuple(names[k] for k in plan.columns),
            home=_find_home(observed, names, plan.columns, plan.motion.times),
        )
        yield loop, closure


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
    """Return the ends of a loop in observed or random configurations; None if it cannot be closed."""
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
    # Twists of the pin, in the axes of the seat.
    linear = ring.twists[:, :3] - skew(ring.poses[:, :3, :3] @ pin[:3, 3]) @ ring.twists[:, 3:]
    back = seat[:3, :3].T
    twists = np.concatenate([back @ linear, back @ ring.twists[:, 3:]], axis=1)
    return _Ends(seat, pin, Twists(tuple(names), ring.times, twists), CONSTRAINED_COMPONENTS[fit.family])


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
    return np.concatenate([seat_R_new.T @ twists[:, :3] / lever, seat_R_new.T @ twists[:, 3:]], axis=1)


def _tolerance(loop: ObservedLoop) -> float:
    """Return the relative singular value below which a motion is explained by uncertain axes."""
    fits = [joint.result.best for joint in (loop.joint, *loop.chain)]
    axes = [fit.deviation(c) for fit in fits for c in fit.coordinates if c.startswith("axis.")]
    return min(max(RANK_TOLERANCE, _WELL_KNOWN * max(axes, default=0.0)), _SMALL)


def _rank(equations: Array, tolerance: float, whole: Array | None = None) -> int:
    values = np.linalg.svd(equations, compute_uv=False)
    scale = values if whole is None else np.linalg.svd(whole, compute_uv=False)
    return int(np.median(np.sum(values > tolerance * np.median(scale[:, 0]), axis=1)))


def _choose_equations(equations: Array, count: int, eligible: Sequence[int]) -> tuple[list[int], list[int]]:
    """Return the rows and the dependent columns with the best conditioning in the worst configuration."""

    def conditioning(square: Array) -> float:
        return float(np.linalg.svd(square, compute_uv=False)[:, -1].min())

    each = combinations(range(equations.shape[1]), count)
    rows = max(each, key=lambda some: conditioning(equations[:, some]))
    chosen = equations[:, rows]
    columns = max(combinations(eligible, count), key=lambda some: conditioning(chosen[:, :, some]))
    return list(rows), list(columns)


def _find_home(
    observed: Mapping[str, tuple[Times, Array]], names: Sequence[str], columns: Sequence[int], times: Times
) -> tuple[tuple[str, float], ...]:
    """Return the observed configuration in which independent coordinates are nearest to mid-range."""

    def at(x: str, time: Times | np.int_) -> Array:
        when, values = observed[x]
        return np.asarray(values[np.searchsorted(when, time)])

    off = np.zeros(len(times))
    for k in set(range(len(names))) - {*columns}:
        values = observed[names[k]][1]
        middle, range_ = 0.5 * (values.min() + values.max()), np.ptp(values) or 1.0
        off += ((at(names[k], times) - middle) / range_) ** 2
    best = times[np.argmin(off)]
    return tuple((x, float(at(x, best))) for x in names)
