"""The other joint value that an observation may mean.

Where positions are known much better than orientations, an observation says above all how far the child is
from the parent. On its way along a line or around an axis it is as far twice: on either side of the nearest
or the farthest place. Steps do not lead from one to the other, and a start that is off by the errors of
orientations has taken some for the wrong ones. So both are tried for each observation by itself, and the more
probable one is where the next steps begin.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from kineverse.estimation.rotations import exponential, logarithm, skew

from .groups import WZ, GroupMotion
from .matrices import inverted, times
from .motion import Member
from .observations import Observations
from .rigid import Array
from .solving import Belief, Solution, solve

STEPS, TURNS = 6, 4
# By how much, as a logarithm, the other one has to be more probable.
BETTER = 1e-3


class Single(NamedTuple):
    """What single observations say if the motion is known.

    Attributes
    ----------
    values
        The most probable joint value of each, (N, 1).
    orientation
        The most probable orientation of the parent, (N, 3, 3).
    log_density
        Of each observation, with both integrated out, (N,); without a constant.
    """

    values: Array
    orientation: Array
    log_density: Array


def straightened(seen: Observations, solution: Solution[Member]) -> Solution[Member]:
    """Return the solution with observations on their more probable side, if positions are that precise."""
    motion = solution.motion
    if not isinstance(motion, GroupMotion) or motion.joints != 1 or not motion.size or not seen.softness:
        return solution
    for _ in range(TURNS):
        start = _exchanged(seen, solution, motion)
        if start is None:
            break
        values, parent = start
        better = solve(seen, motion, values, parent, solution.belief)
        if not (better.cost < solution.cost and isinstance(better.motion, GroupMotion)):
            break
        solution, motion = better, better.motion
    return solution


def _exchanged(
    seen: Observations, solution: Solution[Member], motion: GroupMotion
) -> tuple[Array, Array] | None:
    """Return joint values and the parent's poses with the other ones where they are more probable."""
    belief, parent = solution.belief, solution.parent
    here = singly(seen, motion, solution.values, parent, belief)
    there = singly(seen, motion, others(motion, solution.values, belief), parent, belief)
    better = there.log_density > here.log_density + BETTER
    if not better.any():
        return None
    values, parent = solution.values.copy(), parent.copy()
    values[better] = there.values[better]
    parent[better, :3, :3] = there.orientation[better]
    return values, parent


def singly(seen: Observations, motion: GroupMotion, values: Array, parent: Array, belief: Belief) -> Single:
    """Return what each observation says near joint values (N, 1), whatever the others say.

    Unknown are the joint value and the parent's orientation; its position is eliminated, and what is left is
    the way between both parts.
    """
    whitening, log_volume = _whitening(seen)
    way, rows = seen.child[:, :3, 3] - seen.parent[:, :3, 3], seen.rows
    turned = _aligned(parent[:, :3, :3], motion.at(values).pose[:, :3, 3], way)
    best = Single(values, turned, np.full(len(seen), -math.inf))
    for _ in range(STEPS):
        linear = motion.at(values)
        lever = times(turned, linear.pose[:, :3, 3])
        back = np.swapaxes(turned, 1, 2)
        of_parent = logarithm(seen.parent[:, :3, :3] @ back)
        errors, by_turn = [way - lever, of_parent], [skew(lever), -_beside(of_parent)]
        by_joint = [-times(turned, linear.by_joints[:, :3, 0]), np.zeros_like(lever)]
        if rows == 6:
            child = seen.child[:, :3, :3] @ np.swapaxes(linear.pose[:, :3, :3], 1, 2)
            of_child = logarithm(child @ back)
            errors.append(of_child)
            by_turn.append(-_beside(of_child))
            by_joint.append(-times(_beside(of_child) @ turned, linear.by_joints[:, 3:, 0]))
        error = times(whitening, np.concatenate(errors, axis=1))
        by = whitening @ np.concatenate(
            [np.concatenate(by_turn, axis=1), np.concatenate(by_joint, axis=1)[:, :, None]], axis=2
        )
        off = values[:, 0] - belief.mean[0]
        information = np.swapaxes(by, 1, 2) @ by
        information[:, 3, 3] += belief.precision[0]
        slope = -np.einsum("nri,nr->ni", by, error)
        slope[:, 3] -= belief.precision[0] * off
        log = -0.5 * (np.sum(error**2, axis=1) + belief.precision[0] * off**2) - log_volume
        log -= 0.5 * np.linalg.slogdet(information)[1] - 0.5 * math.log(belief.precision[0])
        more = log > best.log_density
        best = Single(
            np.where(more[:, None], values, best.values),
            np.where(more[:, None, None], turned, best.orientation),
            np.where(more, log, best.log_density),
        )
        step = times(inverted(information), slope)
        turned = exponential(step[:, :3]) @ turned
        values = motion.bounded(values, step[:, 3:])
    return best


def others(motion: GroupMotion, values: Array, belief: Belief) -> Array:
    """Return the other joint values (N, 1) at which the child is as far from the parent."""
    l_p_parent = -motion.left[:3, :3].T @ motion.left[:3, 3]
    if motion.freedom.joints[0] < WZ:
        # Of the line through the child along z, the place nearest to the parent.
        return np.asarray(2.0 * (l_p_parent[2] - motion.right[2, 3]) - values)
    x, y, _ = motion.right[:3, 3]
    towards = math.atan2(l_p_parent[1], l_p_parent[0]) - math.atan2(y, x)
    other = 2.0 * towards - values
    return np.asarray(other - math.tau * np.round((other - belief.mean) / math.tau))


def _whitening(seen: Observations) -> tuple[Array, Array]:
    """Return what makes errors of the way and of both orientations white, and the logarithm of its volume."""
    rows, of_parent = seen.rows, seen.parent_covariance
    assert of_parent is not None  # else positions are not told by orientations
    count, size = len(seen), 3 + rows
    covariance = np.zeros((count, size, size))
    covariance[:, :6, :6] = of_parent
    covariance[:, :3, 3:6] *= -1.0
    covariance[:, 3:6, :3] *= -1.0
    covariance[:, :3, :3] += seen.child_covariance[:, :3, :3]
    if rows == 6:
        covariance[:, 6:, 6:] = seen.child_covariance[:, 3:, 3:]
        covariance[:, :3, 6:] = seen.child_covariance[:, :3, 3:]
        covariance[:, 6:, :3] = seen.child_covariance[:, 3:, :3]
    lower = np.linalg.cholesky(covariance)
    return np.linalg.inv(lower), np.log(np.einsum("nii->ni", lower)).sum(axis=1)


def _aligned(rotations: Array, lever: Array, way: Array) -> Array:
    """Return rotations with the least turn before them that makes levers point along the way."""
    pointing = times(rotations, lever)
    normal = np.cross(pointing, way)
    sine = np.linalg.norm(normal, axis=1)
    angle = np.arctan2(sine, np.sum(pointing * way, axis=1))
    return np.asarray(exponential(normal * (angle / np.where(sine > 0.0, sine, 1.0))[:, None]) @ rotations)


def _beside(turns: Array) -> Array:
    """Return how logarithms of rotations change with turns behind them, to first order."""
    return np.eye(3) + 0.5 * skew(turns)
