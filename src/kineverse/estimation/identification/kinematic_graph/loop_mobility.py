"""Mobility of loops, loop-closure tests and dependent coordinates.

In a loop joint values are no longer independent: as many of them as the pair has ways to move determine all
others. A pair that only happens to move nearly like a simple joint, as a door and a drawer far away, is none.
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
    """Twists of a frame per unit of each of n coordinates, (N, 6, n), at the times of N observations."""

    names: tuple[str, ...]
    times: Times
    twists: Array


class _Slopes(NamedTuple):
    """By how much a coordinate changes with each of those it follows, (N,), at N times."""

    times: Times
    slopes: Mapping[str, Array]


class DependentCoordinates:
    """Which coordinates follow which others."""

    def __init__(self) -> None:
        self._known: dict[str, _Slopes] = {}

    @property
    def leading(self) -> set[str]:
        """The coordinates that are followed."""
        return {u for known in self._known.values() for u in known.slopes}

    def resolve(self, motion: Twists) -> Twists:
        """Return twists per unit of coordinates that follow no others."""
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
        """Have some columns follow the others, by slopes (N, followers, leaders)."""
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
        """Return what a coordinate follows: itself, if no other."""
        if name not in self._known:
            return {name: np.ones(len(times))}
        known = self._known[name]
        rows = np.searchsorted(known.times, times)
        return {u: slope[rows] for u, slope in known.slopes.items()}


RANK_TOLERANCE = 0.05
"""How small a way to move may be beside the largest, to be one."""

# The degree of polynomials, or of Fourier series, of one and of two joint values; 2 for more.
_DEGREES = {1: 5, 2: 3}
# Which part of a joint value's variance may be left open where it is determined by others.
_UNEXPLAINED = 0.1
# From which range on an angle may go round, so that its values jump somewhere [rad].
_WRAPPING = math.pi
# How far joint values elsewhere are from those that were seen [m] or [rad].
_PERTURBATION = 0.3


class ObservedJoint(Protocol):
    """A joint between two parts, with the numbers of the observations in which both were seen."""

    @property
    def parent(self) -> str:
        """Where it begins."""
        ...

    @property
    def child(self) -> str:
        """Where it ends."""
        ...

    @property
    def result(self) -> IdentificationResult:
        """What was identified between them."""
        ...

    @property
    def times(self) -> npt.NDArray[np.int_]:
        """The numbers of the observations."""
        ...


@dataclass(frozen=True)
class Chain:
    """Where the end of a chain of joints is in its beginning, at the times at which all parts were seen.

    Attributes
    ----------
    poses
        (N, 4, 4).
    twists
        Of the end about its origin, in the axes of the beginning, per unit of each joint value, (N, 6, m).
    values, deviations
        The joint values and how well they are known, (N, m).
    turning
        Which of them are angles, (m,).
    times
        The numbers of the observations.
    """

    poses: Array
    twists: Array
    values: Array
    deviations: Array
    is_angle: tuple[bool, ...]
    times: npt.NDArray[np.int_]

    @property
    def mobility(self) -> int:
        """In how many ways the end can move at once."""
        if not self.twists.shape[2]:
            return 0
        scaled = self.twists.copy()
        scaled[:, :3] /= math.sqrt(float(np.mean(np.sum(self.poses[:, :3, 3] ** 2, axis=1)))) or 1.0
        values = np.linalg.svd(scaled, compute_uv=False)
        return int(np.median(np.sum(values > RANK_TOLERANCE * values[:, :1], axis=1)))


def build_chain(
    joints: Sequence[ObservedJoint], start: str, random: np.random.Generator | None = None
) -> Chain:
    """Return the chain of some joints, each beginning where the one before ended.

    With ``random`` it is not where it was seen, but somewhere else, with joint values that know nothing of
    each other.
    """
    times = joints[0].times
    for one in joints[1:]:
        times = np.intersect1d(times, one.times)
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    # Twists about the origin of the beginning, until all are known.
    twists: list[Array] = []
    values: list[Array] = []
    deviations: list[Array] = []
    for one in joints:
        fit = one.result.best
        rows = np.searchsorted(one.times, times)
        taken = fit.joint_values[rows]
        if random is not None:
            taken = random.permuted(taken, axis=0)
            if isinstance(fit.motion, GroupMotion):
                taken = taken + random.uniform(-_PERTURBATION, _PERTURBATION, taken.shape)
        linear = fit.motion.linearise(taken)
        forward = one.parent == start
        step = linear.pose if forward else inverse(linear.pose)
        # A joint that is passed backwards moves by the opposite twist, said in its other part.
        parent = poses if forward else poses @ step
        turned = parent[:, :3, :3]
        v, w = turned @ linear.by_joints[:, :3], turned @ linear.by_joints[:, 3:]
        place = (parent @ linear.pose)[:, :3, 3]
        twists.append(np.concatenate([v + skew(place) @ w, w], axis=1))
        values.append(taken)
        deviations.append(fit.deviations[rows])
        poses = poses @ step
        start = one.child if forward else one.parent
    columns = np.concatenate(twists, axis=2)
    columns[:, :3] -= skew(poses[:, :3, 3]) @ columns[:, 3:]
    angles = tuple(angle for one in joints for angle in find_angles(one.result.best))
    joined, known = np.concatenate(values, axis=1), np.concatenate(deviations, axis=1)
    return Chain(poses, columns, joined, known, angles, times)


def closes_loop(known: PartPair, joints: Sequence[ObservedJoint]) -> bool:
    """Whether a pair is held by more than the joints between both, from its parent to its child."""
    if known.result.is_ambiguous or not known.is_consistent:
        return False
    between_both = build_chain(joints, known.parent)
    fit = known.result.best
    count = fit.motion.joints
    if len(between_both.times) < 2 or between_both.mobility <= count:
        return False
    own = np.searchsorted(known.times, between_both.times)
    values = np.concatenate([between_both.values, fit.joint_values[own]], axis=1)
    deviations = np.concatenate([between_both.deviations, fit.deviations[own]], axis=1)
    angles = [*between_both.is_angle, *find_angles(fit)]
    samples = [
        _JointSamples(values[:, k], deviations[:, k], angle and bool(np.ptp(values[:, k]) > _WRAPPING))
        for k, angle in enumerate(angles)
    ]
    return any(_determine(samples, chosen) for chosen in combinations(range(len(samples)), count))


class _JointSamples(NamedTuple):
    """The values of a joint, how well they are known, and whether they go round."""

    values: Array
    deviations: Array
    round: bool

    def terms(self, degree: int) -> list[Array]:
        """Return what is of a degree in a polynomial of the values, or in a Fourier series."""
        if not degree:
            return [np.ones(len(self.values))]
        if self.round:
            return [np.cos(degree * self.values), np.sin(degree * self.values)]
        moved = self.values - self.values.mean()
        return [(moved / (moved.std() or 1.0)) ** degree]


def find_angles(fit: Fit) -> list[bool]:
    """Return which joint values are angles."""
    own = isinstance(fit.motion, GroupMotion)
    return [own and bool(kind) for kind in fit.motion.kinds]


def _determine(samples: Sequence[_JointSamples], chosen: Sequence[int]) -> bool:
    """Whether some joint values determine all others, as polynomials or Fourier series of them."""
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
                1.0 if samples[k].round else samples[k].values.var() or 1.0
            )
            if np.mean(left**2) >= _UNEXPLAINED * np.mean(moved**2) + 4.0 * noise:
                return False
    return True
