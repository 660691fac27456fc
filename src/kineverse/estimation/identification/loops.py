"""Whether a pair of parts closes a loop: it moves in fewer ways than the joints between both let it.

In a loop joint values are no longer independent: as many of them as the pair has ways to move determine all
others. A pair that only happens to move nearly like a simple joint, as a door and a drawer far away, is none.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, combinations_with_replacement

import numpy as np
import numpy.typing as npt

from kineverse.estimation.rotations import skew

from .pairs import Pair
from .rigid import Array, inverse

# How small a way to move may be beside the largest, to be one.
_RANK = 0.05
# The degree of polynomials of one and of two joint values; 2 for more.
_DEGREES = {1: 5, 2: 3}
# Which part of a joint value's variance may be left open where it is determined by others.
_OPEN = 0.1


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
    times
        The numbers of the observations.
    """

    poses: Array
    twists: Array
    values: Array
    deviations: Array
    times: npt.NDArray[np.int_]

    @property
    def ways(self) -> int:
        """In how many ways the end can move at once."""
        if not self.twists.shape[2]:
            return 0
        scaled = self.twists.copy()
        scaled[:, :3] /= math.sqrt(float(np.mean(np.sum(self.poses[:, :3, 3] ** 2, axis=1)))) or 1.0
        values = np.linalg.svd(scaled, compute_uv=False)
        return int(np.median(np.sum(values > _RANK * values[:, :1], axis=1)))


def chain(pairs: Sequence[Pair], start: str) -> Chain:
    """Return the chain of some joints, each beginning where the one before ended."""
    times = pairs[0].times
    for one in pairs[1:]:
        times = np.intersect1d(times, one.times)
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    # Twists about the origin of the beginning, until all are known.
    twists: list[Array] = []
    values: list[Array] = []
    deviations: list[Array] = []
    for one in pairs:
        fit = one.found.best
        rows = np.searchsorted(one.times, times)
        linear = fit.motion.at(fit.joint_values[rows])
        forward = one.parent == start
        step = linear.pose if forward else inverse(linear.pose)
        # A joint that is passed backwards moves by the opposite twist, said in its other part.
        parent = poses if forward else poses @ step
        turned = parent[:, :3, :3]
        v, w = turned @ linear.by_joints[:, :3], turned @ linear.by_joints[:, 3:]
        place = (parent @ linear.pose)[:, :3, 3]
        twists.append(np.concatenate([v + skew(place) @ w, w], axis=1))
        values.append(fit.joint_values[rows])
        deviations.append(fit.deviations[rows])
        poses = poses @ step
        start = one.child if forward else one.parent
    columns = np.concatenate(twists, axis=2)
    columns[:, :3] -= skew(poses[:, :3, 3]) @ columns[:, 3:]
    return Chain(poses, columns, np.concatenate(values, axis=1), np.concatenate(deviations, axis=1), times)


def closes_loop(known: Pair, joints: Sequence[Pair]) -> bool:
    """Whether a pair is held by more than the joints between both, from its parent to its child."""
    if known.found.cannot_tell or not known.explained:
        return False
    between_both = chain(joints, known.parent)
    fit = known.found.best
    count = fit.motion.joints
    if len(between_both.times) < 2 or between_both.ways <= count:
        return False
    own = np.searchsorted(known.times, between_both.times)
    values = np.concatenate([between_both.values, fit.joint_values[own]], axis=1)
    deviations = np.concatenate([between_both.deviations, fit.deviations[own]], axis=1)
    return any(
        _determine(values, deviations, list(chosen)) for chosen in combinations(range(values.shape[1]), count)
    )


def _determine(values: Array, deviations: Array, chosen: list[int]) -> bool:
    """Whether some joint values determine all others, as polynomials of them."""
    moved = values - values.mean(axis=0)
    scale = moved.std(axis=0)
    x = (moved / np.where(scale > 0.0, scale, 1.0))[:, chosen]
    terms = [np.ones(len(x))]
    for degree in range(1, _DEGREES.get(len(chosen), 2) + 1):
        factors = combinations_with_replacement(range(len(chosen)), degree)
        terms += [np.prod(x[:, some], axis=1) for some in factors]
    if len(values) < 2 * len(terms):
        return False
    rest = [j for j in range(values.shape[1]) if j not in chosen]
    features = np.column_stack(terms)
    left = moved[:, rest] - features @ np.linalg.lstsq(features, moved[:, rest], rcond=None)[0]
    noise = np.mean(deviations[:, rest] ** 2, axis=0)
    return bool(np.all(np.mean(left**2, axis=0) < _OPEN * scale[rest] ** 2 + 4.0 * noise))
