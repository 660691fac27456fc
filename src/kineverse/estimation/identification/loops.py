"""Whether a pair of parts closes a loop: it moves in fewer ways than the joints between both let it.

The joints between both say where one is in the other, and far more precisely than a look at the pair alone,
as each joint value is known by itself. So these poses have to fit what was identified for the pair, too.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from .identify import identify
from .pairs import UNLIKELY, Pair, covariance_of
from .rigid import Array, inverse, skew
from .tracks import Track, between

# How small a way to move may be beside the largest, to be one.
_RANK = 0.05
# Of a joint's parameters, which are off by the noise of as many observations as there are for each of them.
_PARAMETERS = 12.0


@dataclass(frozen=True)
class Chain:
    """Where the end of a chain of joints is in its beginning, at the times at which all parts were seen.

    Attributes
    ----------
    poses
        (N, 4, 4).
    twists
        Of the end about its origin, in the axes of the beginning, per unit of each joint value, (N, 6, m).
    deviations
        Of the joint values, (N, m).
    times
        The numbers of the observations.
    """

    poses: Array
    twists: Array
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
        deviations.append(fit.deviations[rows])
        poses = poses @ step
        start = one.child if forward else one.parent
    columns = np.concatenate(twists, axis=2)
    columns[:, :3] -= skew(poses[:, :3, 3]) @ columns[:, 3:]
    return Chain(poses, columns, np.concatenate(deviations, axis=1), times)


def closes_loop(known: Pair, joints: Sequence[Pair], seen: Mapping[str, Track]) -> bool:
    """Whether a pair is held by more than the joints between both, from its parent to its child."""
    if known.found.cannot_tell or not known.explained:
        return False
    between_both = chain(joints, known.parent)
    if len(between_both.times) < 2 or between_both.ways <= known.found.best.motion.joints:
        return False
    observed = between(seen[known.parent], seen[known.child], known.times)
    noise = covariance_of(observed, known.found.best).mean(axis=0) * _PARAMETERS / len(known.times)
    scaled = between_both.twists * between_both.deviations[:, None, :]
    spread = scaled @ np.swapaxes(scaled, 1, 2) + noise
    family = known.found.best.family
    fit = identify(None, between_both.poses, covariance_b=spread, families=[family]).best
    squares = np.sum(fit.residuals * np.linalg.solve(spread, fit.residuals[:, :, None])[:, :, 0])
    expected = fit.residuals.size
    return bool(squares < expected + UNLIKELY * math.sqrt(2.0 * expected))
