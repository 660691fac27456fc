"""Second solution of a joint value, and the gauge of the sliding point.

What slides in a plane and turns besides, or moves freely, has joint values (v, w) with

    parent_T_child = L · translation(v) · Exp(w) · R

and R's translation c says of which point v are the slides. The likelihood does not know c, but what is
believed of slides beforehand does: those of a hinge have no width where c is on its axis. Nobody knows such a
point; it is within reach of the child's origin. So it is chosen as the observations have it, and integrated
out of the evidence: what becomes of a family does not depend on where the origin of the child is.

Where positions are known much better than orientations, an observation says above all how far the child is
from the parent. On its way along a line or around an axis it is as far twice: on either side of the nearest
or the farthest place. Steps do not lead from one to the other, and a start that is off by the errors of
orientations has taken some for the wrong ones. So both are tried for each observation by itself, and the more
probable one is where the next steps begin.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from kineverse.estimation.linear_algebra import invert_matrices, multiply_vectors
from kineverse.lie import Array, exp_so3, log_so3, skew

from .families import REACH, WX, WZ, GroupMotion
from .motion_model import FamilyMember
from .observations import Observations
from .optimise import JointValuePrior, Solution, levenberg_marquardt
from .range_prior import fit_joint_ranges, solve_per_observation

SLIDING_TURNS = 3
# What the point moves by when it has settled [m].
SLIDING_TOLERANCE = 1e-6


def optimise_sliding_point(solution: Solution[FamilyMember]) -> Solution[FamilyMember]:
    """Return the same motion with slides of the point that makes them most probable."""
    motion = solution.motion
    if not isinstance(motion, GroupMotion) or not motion.slides:
        return solution
    slides, joints = motion.slides, motion.joints
    for _ in range(SLIDING_TURNS):
        seen = solve_per_observation(solution)
        width = fit_joint_ranges(solution.motion, seen)
        weights = invert_matrices(seen.covariances + np.diag(width.deviations**2))
        # What the mean and c would make of joint values.
        by = np.zeros((len(seen.values), joints, joints + slides))
        by[:, range(joints), range(joints)] = 1.0
        by[:, :slides, joints:] = _turns(motion, solution.values)[:, :slides, :slides]
        weighted = np.swapaxes(by, 1, 2) @ weights
        normal = (weighted @ by).sum(axis=0)
        normal[range(joints, joints + slides), range(joints, joints + slides)] += REACH**-2
        right = multiply_vectors(weighted, seen.values).sum(axis=0)
        right[joints:] -= motion.right[:slides, 3] / REACH**2
        change = np.linalg.solve(normal, right)[joints:]
        solution = _changed(solution, motion, change)
        assert isinstance(solution.motion, GroupMotion)  # a changed one is none else
        motion = solution.motion
        if np.abs(change).max() <= SLIDING_TOLERANCE:
            break
    return solution


def sliding_point_twists(motion: FamilyMember, values: Array) -> Array:
    """Return twists of the child per unit of each component of c, (N, m, 2 or 3), or (N, m, 0)."""
    if not isinstance(motion, GroupMotion) or not motion.slides:
        return np.zeros((len(values), motion.rows, 0))
    result = np.zeros((len(values), 6, motion.slides))
    result[:, :3] = (motion.left[:3, :3] @ _turns(motion, values))[:, :, : motion.slides]
    return result


class ChildOriginMotion(NamedTuple):
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

    motion: FamilyMember
    covariance: Array
    values: Array
    covariances: Array


def slide_child_origin(
    motion: FamilyMember, covariance: Array, values: Array, covariances: Array
) -> ChildOriginMotion:
    """Return a motion by the slides of the child's origin, around 0."""
    if not isinstance(motion, GroupMotion) or not motion.slides:
        return ChildOriginMotion(motion, covariance, values, covariances)
    slides, freedom = motion.slides, motion.parametrisation
    turned = motion.left[:3, :3].T @ motion.linearise(values).by_joints[:, :3]
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
    return ChildOriginMotion(
        replace(motion, left=left, right=right),
        moved @ covariance @ moved.T,
        values,
        by @ covariances @ np.swapaxes(by, 1, 2),
    )


def _changed(solution: Solution[FamilyMember], motion: GroupMotion, change: Array) -> Solution[FamilyMember]:
    way = np.zeros(3)
    way[: len(change)] = change
    values, right = solution.values.copy(), motion.right.copy()
    values[:, : len(change)] -= (_turns(motion, values) @ way)[:, : len(change)]
    right[:3, 3] += way
    motion = replace(motion, right=right)
    return replace(solution, motion=motion, values=values, linear=motion.linearise(values))


def _turns(motion: GroupMotion, values: Array) -> Array:
    """Return Exp(w), (N, 3, 3)."""
    twist = np.zeros((len(values), 6))
    twist[:, list(motion.parametrisation.joints)] = values
    return exp_so3(twist[:, WX:])


MIRROR_STEPS, MIRROR_TURNS = 6, 4
# By how much, as a logarithm, the other one has to be more probable.
BETTER = 1e-3


class SingleObservation(NamedTuple):
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


def choose_mirrored_values(seen: Observations, solution: Solution[FamilyMember]) -> Solution[FamilyMember]:
    """Return the solution with observations on their more probable side, if positions are that precise."""
    motion = solution.motion
    if not isinstance(motion, GroupMotion) or motion.joints != 1 or not motion.size or not seen.softness:
        return solution
    for _ in range(MIRROR_TURNS):
        start = _exchanged(seen, solution, motion)
        if start is None:
            break
        values, parent = start
        better = levenberg_marquardt(seen, motion, values, parent, solution.joint_prior)
        if not (better.cost < solution.cost and isinstance(better.motion, GroupMotion)):
            break
        solution, motion = better, better.motion
    return solution


def _exchanged(
    seen: Observations, solution: Solution[FamilyMember], motion: GroupMotion
) -> tuple[Array, Array] | None:
    """Return joint values and the parent's poses with the other ones where they are more probable."""
    joint_prior, parent = solution.joint_prior, solution.parent
    here = evaluate_each_observation(seen, motion, solution.values, parent, joint_prior)
    there = evaluate_each_observation(
        seen, motion, mirrored_values(motion, solution.values, joint_prior), parent, joint_prior
    )
    better = there.log_density > here.log_density + BETTER
    if not better.any():
        return None
    values, parent = solution.values.copy(), parent.copy()
    values[better] = there.values[better]
    parent[better, :3, :3] = there.orientation[better]
    return values, parent


def evaluate_each_observation(
    seen: Observations, motion: GroupMotion, values: Array, parent: Array, joint_prior: JointValuePrior
) -> SingleObservation:
    """Return what each observation says near joint values (N, 1), whatever the others say.

    Unknown are the joint value and the parent's orientation; its position is eliminated, and what is left is
    the way between both parts.
    """
    whitening, log_volume = _whitening(seen)
    way, rows = seen.child[:, :3, 3] - seen.parent[:, :3, 3], seen.rows
    turned = _aligned(parent[:, :3, :3], motion.linearise(values).pose[:, :3, 3], way)
    best = SingleObservation(values, turned, np.full(len(seen), -math.inf))
    for _ in range(MIRROR_STEPS):
        linear = motion.linearise(values)
        lever = multiply_vectors(turned, linear.pose[:, :3, 3])
        back = np.swapaxes(turned, 1, 2)
        of_parent = log_so3(seen.parent[:, :3, :3] @ back)
        errors, by_turn = [way - lever, of_parent], [skew(lever), -_inverse_left_jacobian(of_parent)]
        by_joint = [-multiply_vectors(turned, linear.by_joints[:, :3, 0]), np.zeros_like(lever)]
        if rows == 6:
            child = seen.child[:, :3, :3] @ np.swapaxes(linear.pose[:, :3, :3], 1, 2)
            of_child = log_so3(child @ back)
            errors.append(of_child)
            by_turn.append(-_inverse_left_jacobian(of_child))
            by_joint.append(
                -multiply_vectors(_inverse_left_jacobian(of_child) @ turned, linear.by_joints[:, 3:, 0])
            )
        error = multiply_vectors(whitening, np.concatenate(errors, axis=1))
        by = whitening @ np.concatenate(
            [np.concatenate(by_turn, axis=1), np.concatenate(by_joint, axis=1)[:, :, None]], axis=2
        )
        off = values[:, 0] - joint_prior.mean[0]
        information = np.swapaxes(by, 1, 2) @ by
        information[:, 3, 3] += joint_prior.precision[0]
        slope = -np.einsum("nri,nr->ni", by, error)
        slope[:, 3] -= joint_prior.precision[0] * off
        log = -0.5 * (np.sum(error**2, axis=1) + joint_prior.precision[0] * off**2) - log_volume
        log -= 0.5 * np.linalg.slogdet(information)[1] - 0.5 * math.log(joint_prior.precision[0])
        more = log > best.log_density
        best = SingleObservation(
            np.where(more[:, None], values, best.values),
            np.where(more[:, None, None], turned, best.orientation),
            np.where(more, log, best.log_density),
        )
        step = multiply_vectors(invert_matrices(information), slope)
        turned = exp_so3(step[:, :3]) @ turned
        values = motion.retract_joints(values, step[:, 3:])
    return best


def mirrored_values(motion: GroupMotion, values: Array, joint_prior: JointValuePrior) -> Array:
    """Return the other joint values (N, 1) at which the child is as far from the parent."""
    l_p_parent = -motion.left[:3, :3].T @ motion.left[:3, 3]
    if motion.parametrisation.joints[0] < WZ:
        # Of the line through the child along z, the place nearest to the parent.
        return np.asarray(2.0 * (l_p_parent[2] - motion.right[2, 3]) - values)
    x, y, _ = motion.right[:3, 3]
    towards = math.atan2(l_p_parent[1], l_p_parent[0]) - math.atan2(y, x)
    other = 2.0 * towards - values
    return np.asarray(other - math.tau * np.round((other - joint_prior.mean) / math.tau))


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
    pointing = multiply_vectors(rotations, lever)
    normal = np.cross(pointing, way)
    sine = np.linalg.norm(normal, axis=1)
    angle = np.arctan2(sine, np.sum(pointing * way, axis=1))
    return np.asarray(exp_so3(normal * (angle / np.where(sine > 0.0, sine, 1.0))[:, None]) @ rotations)


def _inverse_left_jacobian(turns: Array) -> Array:
    """Return how logarithms of rotations change with turns behind them, to first order."""
    return np.eye(3) + 0.5 * skew(turns)
