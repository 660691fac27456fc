"""Mobility of loops, loop-closure tests and dependent coordinates.

In a loop the joint values are not independent. As many of them as the mobility of the loop determine all
others. A pair whose relative motion is only similar to a simple joint, such as a door and a distant drawer,
is no loop.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, product
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from kineverse.estimation.identification.families import GroupMotion
from kineverse.estimation.identification.result import Fit, IdentificationResult
from kineverse.lie import Array, inverse, skew

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
            for u, own in by_others.items():
                for v, slope in self._slopes(u, common).items():
                    total[v] = total.get(v, 0.0) + own[rows] * slope
            self._known[x] = _Slopes(common, total)

    def _slopes(self, name: str, times: Times) -> Mapping[str, Array]:
        """Return the derivatives of a coordinate by independent ones; an independent one has slope 1."""
        if name not in self._known:
            return {name: np.ones(len(times))}
        known = self._known[name]
        rows = np.searchsorted(known.times, times)
        return {u: slope[rows] for u, slope in known.slopes.items()}


RANK_TOLERANCE = 0.05
"""Smallest singular value that counts as a degree of freedom, relative to the largest."""

# Degree of polynomials or Fourier series of one and of two joint values; 2 for more.
_DEGREES = {1: 5, 2: 3}
# Largest unexplained share of the variance of a dependent joint value.
_UNEXPLAINED = 0.1
# Range from which on an angle is treated as periodic [rad].
_WRAPPING = math.pi
# Largest random change of joint values for configurations that were not observed [m] or [rad].
_PERTURBATION = 0.3


class ObservedJoint(Protocol):
    """Joint between two parts, with the indices of the observations of both."""

    @property
    def parent(self) -> str:
        """Name of the parent part."""
        ...

    @property
    def child(self) -> str:
        """Name of the child part."""
        ...

    @property
    def result(self) -> IdentificationResult:
        """Identification result of the pair."""
        ...

    @property
    def times(self) -> npt.NDArray[np.int_]:
        """Indices of the observations of both parts."""
        ...


@dataclass(frozen=True)
class Chain:
    """Chain of joints, at the times at which all of its parts were observed."""

    poses: Array  # poses of the last part in the first, (N, 4, 4)
    twists: Array  # (N, 6, m)
    values: Array  # joint values and their standard deviations, (N, m)
    deviations: Array
    is_angle: tuple[bool, ...]  # mask of the joint values that are angles, (m,)
    times: npt.NDArray[np.int_]  # indices of the observations

    @property
    def mobility(self) -> int:
        """Number of degrees of freedom of the last part relative to the first."""
        if not self.twists.shape[2]:
            return 0
        scaled = self.twists.copy()
        scaled[:, :3] /= math.sqrt(float(np.mean(np.sum(self.poses[:, :3, 3] ** 2, axis=1)))) or 1.0
        values = np.linalg.svd(scaled, compute_uv=False)
        return int(np.median(np.sum(values > RANK_TOLERANCE * values[:, :1], axis=1)))


def build_chain(
    joints: Sequence[ObservedJoint], start: str, random: np.random.Generator | None = None
) -> Chain:
    """Return the chain of successive joints from the part ``start`` on.

    With ``random``, the joint values are permuted and perturbed independently, for configurations that were
    not observed.
    """
    times = joints[0].times
    for one in joints[1:]:
        times = np.intersect1d(times, one.times)
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    # Twists about the origin of the first part, until all joints are passed.
    twists: list[Array] = []
    values: list[Array] = []
    deviations: list[Array] = []
    for one in joints:
        fit = one.result.best
        rows = np.searchsorted(one.times, times)
        values_taken = fit.joint_values[rows]
        if random is not None:
            values_taken = random.permuted(values_taken, axis=0)
            if isinstance(fit.motion, GroupMotion):
                values_taken = values_taken + random.uniform(
                    -_PERTURBATION, _PERTURBATION, values_taken.shape
                )
        linear = fit.motion.linearise(values_taken)
        forward = one.parent == start
        step = linear.pose if forward else inverse(linear.pose)
        # A joint that is traversed backwards has the opposite twist, in the axes of its child.
        parent = poses if forward else poses @ step
        turned = parent[:, :3, :3]
        v, w = turned @ linear.by_joints[:, :3], turned @ linear.by_joints[:, 3:]
        place = (parent @ linear.pose)[:, :3, 3]
        twists.append(np.concatenate([v + skew(place) @ w, w], axis=1))
        values.append(values_taken)
        deviations.append(fit.deviations[rows])
        poses = poses @ step
        start = one.child if forward else one.parent
    columns = np.concatenate(twists, axis=2)
    columns[:, :3] -= skew(poses[:, :3, 3]) @ columns[:, 3:]
    angles = tuple(angle for one in joints for angle in find_angles(one.result.best))
    joined, known = np.concatenate(values, axis=1), np.concatenate(deviations, axis=1)
    return Chain(poses, columns, joined, known, angles, times)


def closes_loop(known: PartPair, joints: Sequence[ObservedJoint]) -> bool:
    """Return True if a pair is constrained beyond the chain of joints from its parent to its child."""
    if known.result.is_ambiguous or not known.is_consistent:
        return False
    chain = build_chain(joints, known.parent)
    fit = known.result.best
    count = fit.motion.joints
    if len(chain.times) < 2 or chain.mobility <= count:
        return False
    own = np.searchsorted(known.times, chain.times)
    values = np.concatenate([chain.values, fit.joint_values[own]], axis=1)
    deviations = np.concatenate([chain.deviations, fit.deviations[own]], axis=1)
    angles = [*chain.is_angle, *find_angles(fit)]
    samples = [
        _JointSamples(values[:, k], deviations[:, k], angle and bool(np.ptp(values[:, k]) > _WRAPPING))
        for k, angle in enumerate(angles)
    ]
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
    own = isinstance(fit.motion, GroupMotion)
    return [own and bool(kind) for kind in fit.motion.kinds]


def _determine(samples: Sequence[_JointSamples], chosen: Sequence[int]) -> bool:
    """Return True if chosen joint values determine all others, by polynomials or Fourier series."""
    most = _DEGREES.get(len(chosen), 2)
    degrees = [d for d in product(range(most + 1), repeat=len(chosen)) if sum(d) <= most]
    each = [[samples[k].terms(d) for k, d in zip(chosen, some, strict=True)] for some in degrees]
    features = np.column_stack([np.prod(factors, axis=0) for some in each for factors in product(*some)])
    if len(features) < 2 * features.shape[1]:
        return False
    for k in set(range(len(samples))) - {*chosen}:
        for term in samples[k].terms(1):
            moved = term - term.mean()
            left = moved - features @ np.linalg.lstsq(features, moved, rcond=None)[0]
            noise = np.mean(samples[k].deviations ** 2) / (
                1.0 if samples[k].is_periodic else samples[k].values.var() or 1.0
            )
            if np.mean(left**2) >= _UNEXPLAINED * np.mean(moved**2) + 4.0 * noise:
                return False
    return True
