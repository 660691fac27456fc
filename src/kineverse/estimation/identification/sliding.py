"""Which point of the child it is whose slides are a joint value.

What slides in a plane and turns besides, or moves freely, has joint values (v, w) with

    parent_T_child = L · translation(v) · Exp(w) · R

and R's translation c says of which point v are the slides. The likelihood does not know c, but what is
believed of slides beforehand does: those of a hinge have no width where c is on its axis. Nobody knows such a
point; it is within reach of the child's origin. So it is chosen as the observations have it, and integrated
out of the evidence: what becomes of a family does not depend on where the origin of the child is.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from kineverse.estimation.rotations import exponential, skew

from .groups import REACH, WX, GroupMotion
from .matrices import inverted, times
from .motion import Member
from .rigid import Array
from .solving import Solution
from .widths import alone, widths

TURNS = 3
# What the point moves by when it has settled [m].
CLOSE = 1e-6


def slid(solution: Solution[Member]) -> Solution[Member]:
    """Return the same motion with slides of the point that makes them most probable."""
    motion = solution.motion
    if not isinstance(motion, GroupMotion) or not motion.slides:
        return solution
    slides, joints = motion.slides, motion.joints
    for _ in range(TURNS):
        seen = alone(solution)
        width = widths(solution.motion, seen)
        weights = inverted(seen.covariances + np.diag(width.deviations**2))
        # What the mean and c would make of joint values.
        by = np.zeros((len(seen.values), joints, joints + slides))
        by[:, range(joints), range(joints)] = 1.0
        by[:, :slides, joints:] = _turns(motion, solution.values)[:, :slides, :slides]
        weighted = np.swapaxes(by, 1, 2) @ weights
        normal = (weighted @ by).sum(axis=0)
        normal[range(joints, joints + slides), range(joints, joints + slides)] += REACH**-2
        right = times(weighted, seen.values).sum(axis=0)
        right[joints:] -= motion.right[:slides, 3] / REACH**2
        change = np.linalg.solve(normal, right)[joints:]
        solution = _changed(solution, motion, change)
        assert isinstance(solution.motion, GroupMotion)  # a changed one is none else
        motion = solution.motion
        if np.abs(change).max() <= CLOSE:
            break
    return solution


def by_point(motion: Member, values: Array) -> Array:
    """Return twists of the child per unit of each component of c, (N, m, 2 or 3), or (N, m, 0)."""
    if not isinstance(motion, GroupMotion) or not motion.slides:
        return np.zeros((len(values), motion.rows, 0))
    result = np.zeros((len(values), 6, motion.slides))
    result[:, :3] = (motion.left[:3, :3] @ _turns(motion, values))[:, :, : motion.slides]
    return result


class OfChild(NamedTuple):
    """Slides of the child's own origin, for people.

    Attributes
    ----------
    motion
        With the child's origin in R's.
    covariance
        Of its parameters.
    values, covariances
        The joint values, (N, k) and (N, k, k).
    """

    motion: Member
    covariance: Array
    values: Array
    covariances: Array


def of_child(motion: Member, covariance: Array, values: Array, covariances: Array) -> OfChild:
    """Return a motion by the slides of the child's origin, around 0."""
    if not isinstance(motion, GroupMotion) or not motion.slides:
        return OfChild(motion, covariance, values, covariances)
    slides, freedom = motion.slides, motion.freedom
    turned = motion.left[:3, :3].T @ motion.at(values).by_joints[:, :3]
    by = np.tile(np.eye(motion.joints), (len(values), 1, 1))
    by[:, :slides, slides:] = turned[:, :slides, slides:]
    place = np.where(np.arange(3) < slides, motion.right[:3, 3], 0.0)
    values = values.copy()
    values[:, :slides] += (_turns(motion, values) @ place)[:, :slides]
    middle = np.zeros(3)
    middle[:slides] = values[:, :slides].mean(axis=0)
    values[:, :slides] -= middle[:slides]
    left, right = motion.left.copy(), motion.right.copy()
    left[:3, 3] += left[:3, :3] @ middle
    right[:3, 3] -= place
    # Turns of both frames are about their origins, and these are somewhere else now.
    moved = np.eye(motion.size)
    ends = len(freedom.left)
    for row, component in enumerate(freedom.right):
        for column, other in enumerate((*freedom.left, *freedom.right)):
            if component < WX <= other:
                lever = middle if column < ends else place
                moved[ends + row, column] = -skew(lever)[component, other - WX]
    return OfChild(
        replace(motion, left=left, right=right),
        moved @ covariance @ moved.T,
        values,
        by @ covariances @ np.swapaxes(by, 1, 2),
    )


def _changed(solution: Solution[Member], motion: GroupMotion, change: Array) -> Solution[Member]:
    way = np.zeros(3)
    way[: len(change)] = change
    values, right = solution.values.copy(), motion.right.copy()
    values[:, : len(change)] -= (_turns(motion, values) @ way)[:, : len(change)]
    right[:3, 3] += way
    motion = replace(motion, right=right)
    return replace(solution, motion=motion, values=values, linear=motion.at(values))


def _turns(motion: GroupMotion, values: Array) -> Array:
    """Return Exp(w), (N, 3, 3)."""
    twist = np.zeros((len(values), 6))
    twist[:, list(motion.freedom.joints)] = values
    return exponential(twist[:, WX:])
