"""Marginal likelihood of a joint family by Laplace's approximation, and the ranges of its joint values.

With Gaussian joint values as wide as the motion (:class:`.JointRanges`), each observation contributes

    ∫ N(â_k; a, C_k) N(a; μ, s²) da = N(â_k; μ, s² + C_k)

so a motion that is short compared with the noise costs next to nothing. μ and the parameters are integrated
by Laplace's method. The mean pose has the same improper uniform prior in all families; the other parameters
have proper ones: directions are uniform on the sphere, levers are Gaussian.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from kineverse.estimation.linear_algebra import invert_matrices, multiply_vectors, sum_log_determinants
from kineverse.lie import Array, exp_so3, inverse, skew

from .families import REACH, WX, WY, WZ, GroupMotion, JointFamily
from .least_squares import InitialGuess, Solution
from .motion_functions import FamilyMember, MotionModel
from .observations import Observations

# Candidate widths [m], [rad].
GRID = np.geomspace(1e-5, 10.0, 61)
LITTLE = 1e-6
_STEP = math.log(float(GRID[1] / GRID[0]))


@dataclass(frozen=True)
class PerObservation:
    """Joint values of each observation by itself, without their prior."""

    values: Array  # joint values and their covariances, (N, k) and (N, k, k)
    covariances: Array
    log_likelihood: float


def solve_per_observation(solution: Solution[FamilyMember]) -> PerObservation:
    """Return the joint values by the observations alone, from the quadratic at the solution."""
    by_joints = solution.linear.by_joints
    weights = invert_matrices(solution.covariance)
    weighted = np.swapaxes(by_joints, 1, 2) @ weights
    # The small term keeps an angle without effect on the pose finite, and is too small to matter otherwise.
    covariances = invert_matrices(weighted @ by_joints + LITTLE * np.eye(by_joints.shape[2]))
    change = multiply_vectors(covariances, multiply_vectors(weighted, solution.residuals))
    left = solution.residuals - multiply_vectors(by_joints, change)
    log = -0.5 * float(np.sum(left * multiply_vectors(weights, left)))
    log += 0.5 * sum_log_determinants(math.tau * covariances)
    log -= 0.5 * sum_log_determinants(math.tau * solution.covariance)
    return PerObservation(solution.values + change, covariances, log)


@dataclass(frozen=True)
class JointRanges:
    """Width and mean of the range of joint values.

    Joint values are Gaussian with a mean μ and a width s, one width for all translations and one for all
    rotations. Let â_k be the maximum of the likelihood of observation k alone and C_k its covariance. Then
    â_k is distributed as N(μ, s² + C_k).
    """

    deviations: Array  # s and μ of each joint value, (k,)
    mean: Array
    log_density: float  # log ∫ Π N(â_k; μ, s² + C_k) p(s) ds at this μ, p(s) uniform in log s over the grid


def fit_joint_ranges(
    motion: FamilyMember, per_observation: PerObservation, weight: float = 1.0
) -> JointRanges:
    """Return the most likely widths and means, for a weight of each observation's log likelihood."""
    kinds = np.array(motion.kinds)
    deviations, occam = np.zeros(len(kinds)), 0.0
    variances = np.einsum("nii->ni", per_observation.covariances)
    for kind in sorted(set(motion.kinds)):
        block = kinds == kind
        deviations[block], part = _width(per_observation.values[:, block], variances[:, block], weight)
        occam += part
    total = per_observation.covariances + np.diag(deviations**2)
    weights = invert_matrices(total)
    weighted = multiply_vectors(weights, per_observation.values).sum(axis=0)
    mean: Array = np.linalg.solve(weights.sum(axis=0), weighted)
    off = per_observation.values - mean
    log = -0.5 * float(np.sum(off * multiply_vectors(weights, off)))
    log -= 0.5 * sum_log_determinants(math.tau * total)
    return JointRanges(deviations, mean, weight * log + occam)


def _width(values: Array, variances: Array, weight: float) -> tuple[float, float]:
    """Return the best s, and the log of the mean likelihood over all s relative to the best."""
    total = variances + GRID[:, None, None] ** 2
    weights = 1.0 / total
    mean = (weights * values).sum(axis=1) / weights.sum(axis=1)
    squares = (values - mean[:, None, :]) ** 2 * weights
    # The mean is integrated out. Else the width of a few values would be biased towards zero.
    logs = -0.5 * weight * (np.log(total) + squares).sum(axis=(1, 2))
    logs -= 0.5 * np.log(weights.sum(axis=1)).sum(axis=1)
    top = int(np.argmax(logs))
    best = math.log(float(GRID[top]))
    if 0 < top < len(logs) - 1:
        before, here, after = logs[top - 1 : top + 2]
        best += 0.5 * _STEP * float((after - before) / (2.0 * here - before - after))
    return math.exp(best), math.log(float(np.mean(np.exp(logs - logs[top]))))


def has_sliding_point(motion: FamilyMember) -> bool:
    """Return True if a motion translates a point of the child that is a parameter."""
    return isinstance(motion, GroupMotion) and bool(_sliding_components(motion))


def narrow_translations(solution: Solution[FamilyMember], alone: PerObservation) -> Solution[FamilyMember]:
    """Return the same motion with the sliding point at which the translations are most probable.

    From another point they vary as the rotations do, and the steps to this one are many.
    """
    motion, values = solution.motion, solution.values
    assert isinstance(motion, GroupMotion)
    slides = len(_sliding_components(motion))
    rotations = _rotations(motion, values)[:, :slides, :slides]
    varied = rotations - rotations.mean(axis=0)
    normal = np.einsum("nij,nik->jk", varied, varied) + 1e-9 * len(values) * np.eye(slides)
    right = np.einsum("nij,ni->j", varied, alone.values[:, :slides])
    off = alone.values[:, :slides] - rotations @ np.linalg.solve(normal, right)
    # The variance of an observation, of the translations or of the noise, against the prior of the point.
    ridge = max(float(off.var(axis=0).mean()), float(alone.covariances[:, 0, 0].mean())) / REACH**2
    moved = np.linalg.solve(normal + ridge * np.eye(slides), right - ridge * motion.right[:slides, 3])
    values, side = values.copy(), motion.right.copy()
    values[:, :slides] -= rotations @ moved
    side[:slides, 3] += moved
    motion = replace(motion, right=side)
    return replace(solution, motion=motion, values=values, linear=motion.linearise(values))


class ChildOriginMotion(NamedTuple):
    """Motion in terms of the translation of the child's origin, for display."""

    motion: FamilyMember  # with the sliding point at the origin of the child
    covariance: Array  # covariance of its parameters
    values: Array  # joint values and their covariances, (N, k) and (N, k, k)
    covariances: Array


def slide_child_origin(
    motion: FamilyMember, covariance: Array, values: Array, covariances: Array
) -> ChildOriginMotion:
    """Return a motion with the sliding point at the origin of the child and translations around 0."""
    if not isinstance(motion, GroupMotion) or not (sliding := _sliding_components(motion)):
        return ChildOriginMotion(motion, covariance, values, covariances)
    slides, freedom = len(sliding), motion.parametrisation
    orientation = motion.left[:3, :3].T @ motion.linearise(values).by_joints[:, :3]
    by = np.tile(np.eye(motion.joints), (len(values), 1, 1))
    by[:, :slides, slides:] = orientation[:, :slides, slides:]
    place = np.where(np.arange(3) < slides, motion.right[:3, 3], 0.0)
    values = values.copy()
    values[:, :slides] += (_rotations(motion, values) @ place)[:, :slides]
    middle = np.zeros(3)
    middle[:slides] = values[:, :slides].mean(axis=0)
    values[:, :slides] -= middle[:slides]
    left, right = motion.left.copy(), motion.right.copy()
    left[:3, 3] += left[:3, :3] @ middle
    right[:3, 3] -= place
    # Rotation parameters act about the origins of both frames, which have moved.
    moved = np.eye(motion.size)
    ends = len(freedom.left)
    for row, component in enumerate(freedom.right):
        for column, other in enumerate((*freedom.left, *freedom.right)):
            if component < WX <= other:
                moved[ends + row, column] = -skew(middle if column < ends else place)[component, other - WX]
    kept = [j for j in range(motion.size) if j - ends not in sliding]
    group = _about_child_origin(motion.group)
    covariances = by @ covariances @ np.swapaxes(by, 1, 2)
    covariance = (moved @ covariance @ moved.T)[np.ix_(kept, kept)]
    return ChildOriginMotion(
        replace(motion, group=group, left=left, right=right), covariance, values, covariances
    )


@functools.cache
def _about_child_origin(group: JointFamily) -> JointFamily:
    """Return a family without sliding point."""
    poses = group.poses
    kept = tuple(component for component in poses.right if component not in poses.joints)
    return replace(group, poses=replace(poses, right=kept, levers=0))


def _rotations(motion: GroupMotion, values: Array) -> Array:
    twist = np.zeros((len(values), 6))
    twist[:, list(motion.parametrisation.joints)] = values
    return exp_so3(twist[:, WX:])


def _sliding_components(motion: GroupMotion) -> tuple[int, ...]:
    """Return the indices of the sliding point among the components that move R."""
    freedom = motion.parametrisation
    return tuple(i for i, component in enumerate(freedom.right) if component in freedom.joints)


# A pose determines an angle only up to whole revolutions. In a sequence, the joint is assumed to rotate by
# less than half a revolution from one observation to the next. If the lead of a screw is small compared with
# the noise, only the count of revolutions reveals it.


def find_revolving_joint(motion: MotionModel) -> int | None:
    """Return the index of the joint value that is an angle about a fixed axis; None if there is none."""
    if not isinstance(motion, GroupMotion):
        return None
    joints = motion.parametrisation.joints
    return None if WX in joints or WY in joints or WZ not in joints else joints.index(WZ)


def unwrap_solution(solution: Solution[FamilyMember]) -> Solution[FamilyMember]:
    """Return the solution with angles unwrapped along the observations. A screw is unwrapped already."""
    joint = find_revolving_joint(solution.motion)
    if joint is None or is_screw(solution.motion):
        return solution
    values = solution.values.copy()
    values[:, joint] = np.unwrap(values[:, joint])
    mean = solution.joint_prior.mean.copy()
    mean[joint] = values[:, joint].mean()
    return replace(solution, values=values, joint_prior=replace(solution.joint_prior, mean=mean))


def unwrap_screw(observations: Observations, solution: Solution[FamilyMember]) -> InitialGuess | None:
    """Return a screw with the revolutions of the observations; None if this one has them already."""
    motion = solution.motion
    if not isinstance(motion, GroupMotion) or not is_screw(motion):
        return None
    angles = np.unwrap(solution.values[:, 0])
    if np.array_equal(angles, solution.values[:, 0]):
        return None
    pitch, offset = np.polyfit(angles, (inverse(motion.left) @ observations.relative)[:, 2, 3], 1)
    right = motion.right.copy()
    right[2, 3] = offset
    return InitialGuess(replace(motion, right=right, pitch=float(pitch)), angles[:, None])


def log_unwrapping_gain(solution: Solution[FamilyMember]) -> float:
    """Return the gain in log evidence of a screw whose revolutions are counted instead of unknown.

    The joint values of other families lie within one revolution. Without the correction each observation of
    a screw would pay for the choice among many revolutions.
    """
    if not is_screw(solution.motion):
        return 0.0
    middle = math.atan2(float(np.sin(solution.values).mean()), float(np.cos(solution.values).mean()))
    turns = np.round((solution.values - middle) / math.tau)
    if not turns.any():
        return 0.0
    known = solve_per_observation(solution)
    logs = []
    for each in (known, replace(known, values=known.values - math.tau * turns)):
        ranges = fit_joint_ranges(solution.motion, each)
        precision = float(np.sum(1.0 / (ranges.deviations[0] ** 2 + known.covariances[:, 0, 0])))
        # The evidence integrates over the mean, which is less certain with more revolutions.
        logs.append(ranges.log_density - 0.5 * math.log(precision))
    return max(0.0, logs[1] - logs[0])


def is_screw(motion: FamilyMember) -> bool:
    """Return True for a screw."""
    return isinstance(motion, GroupMotion) and motion.group.pitch


class Scored(NamedTuple):
    """Solution of a family and the logarithm of the evidence of the family."""

    solution: Solution[FamilyMember]
    log_evidence: float


@dataclass(frozen=True)
class Evidence:
    """Evidence of a family and the posterior of its unknowns."""

    log_evidence: float
    covariance: Array  # posterior covariance of the parameters, (n, n)
    joint_values: Array  # posterior joint values and their covariances, (N, k) and (N, k, k)
    joint_covariances: Array


class IntegratedValues(NamedTuple):
    """Evidence with the joint values integrated out, for M sizes of the noise; the rest is for the last."""

    logs: Array  # log evidences, (M,)
    deviations: Array  # widths and means of the ranges, (k,)
    mean: Array
    information: Array  # information matrix of the parameters and means, (n + k, n + k)
    alone: PerObservation
    values: Array  # posterior joint values and their covariances, (N, k) and (N, k, k)
    covariances: Array


def integrate_joint_values(solution: Solution[FamilyMember], weight: float = 1.0) -> IntegratedValues:
    """Integrate the joint values out, for a weight of each observation's log likelihood."""
    motion, size = solution.motion, solution.motion.size
    alone = solve_per_observation(solution)
    values, covariances = alone.values, alone.covariances
    ranges = JointRanges(np.zeros(0), np.zeros(0), 0.0)
    if motion.joints:
        ranges = fit_joint_ranges(motion, alone, weight)
        variance = np.diag(ranges.deviations**2)
        shrink = variance @ invert_matrices(covariances + variance)
        values = ranges.mean + multiply_vectors(shrink, values - ranges.mean)
        covariances = shrink @ covariances
    linear = motion.linearise(values)
    by_joints = linear.by_joints
    moved = (by_joints * ranges.deviations**2) @ np.swapaxes(by_joints, 1, 2)
    slopes = np.concatenate([linear.by_parameters, by_joints], axis=2)
    weighted = np.swapaxes(slopes, 1, 2) @ invert_matrices(solution.covariance + moved)
    log_prior, precision = motion.log_prior(ranges.mean)
    information = weight * (weighted @ slopes).sum(axis=0) + np.diag(precision)
    prior = motion.prior().by_parameters
    information[:size, :size] += prior.T @ prior
    log = weight * alone.log_likelihood + ranges.log_density + log_prior
    log += 0.5 * len(information) * math.log(math.tau) - 0.5 * float(np.linalg.slogdet(information)[1])
    rest = ranges.deviations, ranges.mean, information, alone, values, covariances
    return IntegratedValues(np.array([log]), *rest)


def evidence_of(motion: FamilyMember, integrated: IntegratedValues) -> Evidence:
    """Return the evidence and the posterior of the unknowns."""
    covariance = invert_matrices(integrated.information)[: motion.size, : motion.size]
    return Evidence(float(integrated.logs[-1]), covariance, integrated.values, integrated.covariances)


def laplace_evidence(solution: Solution[FamilyMember], weight: float = 1.0) -> Evidence:
    """Return the evidence by the quadratic approximation, for a weight of each observation's likelihood."""
    return evidence_of(solution.motion, integrate_joint_values(solution, weight))


def evidence_excess(solution: Solution[FamilyMember], alone: PerObservation | None = None) -> float:
    """Return the excess of the Laplace evidence over the value reached, if the steps did not converge.

    The quadratic approximation assumes a maximum. Without convergence it predicts a higher likelihood than
    was reached, and the difference of the logarithms is the correction.
    """
    joint_prior = solution.joint_prior
    if solution.converged or not joint_prior.marginal:
        return 0.0
    alone = alone or solve_per_observation(solution)
    total = alone.covariances + np.diag(1.0 / joint_prior.precision)
    off = alone.values - joint_prior.mean
    predicted = alone.log_likelihood - 0.5 * sum_log_determinants(math.tau * total)
    predicted -= 0.5 * float(np.sum(off * multiply_vectors(invert_matrices(total), off)))
    prior = solution.motion.prior().residuals
    reached = -0.5 * (solution.cost - float(prior @ prior) + solution.residuals.size * math.log(math.tau))
    return max(0.0, predicted - reached)
