"""Joint values of a fit: prior of their range, mirrored solutions, sliding point, revolutions.

In parent_T_child = L · translation(v) · Exp(w) · R, the translation c of R selects the point of the child
that v translates. The likelihood does not depend on c, but the prior of v does. So this sliding point has a
Gaussian prior around the origin of the child, and the evidence integrates over it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from kineverse.estimation.linear_algebra import invert_matrices, multiply_vectors, sum_log_determinants
from kineverse.lie import Array, exp_so3, inverse, log_so3, skew

from .families import REACH, WX, WY, WZ, GroupMotion
from .least_squares import InitialGuess, JointValuePrior, Solution, levenberg_marquardt
from .motion_model import FamilyMember, MotionModel
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


SLIDING_TURNS = 3
SLIDING_TOLERANCE = 1e-6  # step of the point at convergence [m]


def optimise_sliding_point(solution: Solution[FamilyMember]) -> Solution[FamilyMember]:
    """Return the same motion with the most likely sliding point."""
    motion = solution.motion
    if not isinstance(motion, GroupMotion) or not motion.slides:
        return solution
    slides, joints = motion.slides, motion.joints
    for _ in range(SLIDING_TURNS):
        per_observation = solve_per_observation(solution)
        ranges = fit_joint_ranges(solution.motion, per_observation)
        weights = invert_matrices(per_observation.covariances + np.diag(ranges.deviations**2))
        # Derivatives of the joint values by their mean and by c.
        by = np.zeros((len(per_observation.values), joints, joints + slides))
        by[:, range(joints), range(joints)] = 1.0
        by[:, :slides, joints:] = _rotations(motion, solution.values)[:, :slides, :slides]
        weighted = np.swapaxes(by, 1, 2) @ weights
        normal = (weighted @ by).sum(axis=0)
        normal[range(joints, joints + slides), range(joints, joints + slides)] += REACH**-2
        right = multiply_vectors(weighted, per_observation.values).sum(axis=0)
        right[joints:] -= motion.right[:slides, 3] / REACH**2
        change = np.linalg.solve(normal, right)[joints:]
        displacement = np.concatenate([change, np.zeros(3 - slides)])
        values, moved = solution.values.copy(), motion.right.copy()
        values[:, :slides] -= (_rotations(motion, values) @ displacement)[:, :slides]
        moved[:3, 3] += displacement
        motion = replace(motion, right=moved)
        solution = replace(solution, motion=motion, values=values, linear=motion.linearise(values))
        if np.abs(change).max() <= SLIDING_TOLERANCE:
            break
    return solution


def sliding_point_twists(motion: FamilyMember, values: Array) -> Array:
    """Return twists of the child per unit of each component of c, (N, m, 2 or 3), or (N, m, 0)."""
    if not isinstance(motion, GroupMotion) or not motion.slides:
        return np.zeros((len(values), motion.rows, 0))
    result = np.zeros((len(values), 6, motion.slides))
    result[:, :3] = (motion.left[:3, :3] @ _rotations(motion, values))[:, :, : motion.slides]
    return result


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
    if not isinstance(motion, GroupMotion) or not motion.slides:
        return ChildOriginMotion(motion, covariance, values, covariances)
    slides, freedom = motion.slides, motion.parametrisation
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
    motion = replace(motion, left=left, right=right)
    covariances = by @ covariances @ np.swapaxes(by, 1, 2)
    return ChildOriginMotion(motion, moved @ covariance @ moved.T, values, covariances)


def _rotations(motion: GroupMotion, values: Array) -> Array:
    twist = np.zeros((len(values), 6))
    twist[:, list(motion.parametrisation.joints)] = values
    return exp_so3(twist[:, WX:])


MIRROR_STEPS, MIRROR_TURNS = 6, 4
BETTER = 1e-3  # least gain in log density for an exchange


class SingleObservation(NamedTuple):
    """Joint value and parent orientation of each observation by itself, for a fixed motion."""

    values: Array  # most probable joint values, (N, 1)
    orientation: Array  # most probable orientations of the parent, (N, 3, 3)
    log_density: Array  # log density of each observation with both integrated out, up to a constant, (N,)


def choose_mirrored_values(
    observations: Observations, solution: Solution[FamilyMember]
) -> Solution[FamilyMember]:
    """Choose the more probable of two mirrored joint values for each observation with precise positions."""
    motion = solution.motion
    if (
        not isinstance(motion, GroupMotion)
        or motion.joints != 1
        or not (motion.size and observations.softness)
    ):
        return solution
    for _ in range(MIRROR_TURNS):
        prior, values, parent = solution.joint_prior, solution.values.copy(), solution.parent.copy()
        current = evaluate_each_observation(observations, motion, values, parent, prior)
        others = mirrored_values(motion, values, prior)
        mirrored = evaluate_each_observation(observations, motion, others, parent, prior)
        is_better = mirrored.log_density > current.log_density + BETTER
        if not is_better.any():
            break
        values[is_better] = mirrored.values[is_better]
        parent[is_better, :3, :3] = mirrored.orientation[is_better]
        trial = levenberg_marquardt(observations, motion, values, parent, prior)
        if trial.cost >= solution.cost:
            break
        solution, motion = trial, trial.motion
    return solution


def evaluate_each_observation(
    observations: Observations,
    motion: GroupMotion,
    values: Array,
    parent: Array,
    joint_prior: JointValuePrior,
) -> SingleObservation:
    """Return the local optimum and the density of each observation near joint values (N, 1).

    The unknowns are the joint value and the parent's orientation. The parent's position is eliminated, so the
    measured position is the displacement between the two parts.
    """
    whitening, log_volume = _whitening(observations)
    displacement, rows = observations.child[:, :3, 3] - observations.parent[:, :3, 3], observations.rows
    orientation = _aligned(parent[:, :3, :3], motion.linearise(values).pose[:, :3, 3], displacement)
    best = SingleObservation(values, orientation, np.full(len(observations), -math.inf))
    for _ in range(MIRROR_STEPS):
        linear = motion.linearise(values)
        lever = multiply_vectors(orientation, linear.pose[:, :3, 3])
        back = np.swapaxes(orientation, 1, 2)
        of_parent = log_so3(observations.parent[:, :3, :3] @ back)
        errors = [displacement - lever, of_parent]
        by_rotation = [skew(lever), -_inverse_left_jacobian(of_parent)]
        by_joint = [-orientation @ linear.by_joints[:, :3], np.zeros((len(lever), 3, 1))]
        if rows == 6:
            child = observations.child[:, :3, :3] @ np.swapaxes(linear.pose[:, :3, :3], 1, 2)
            of_child = log_so3(child @ back)
            inverse_jacobian = _inverse_left_jacobian(of_child)
            errors.append(of_child)
            by_rotation.append(-inverse_jacobian)
            by_joint.append(-inverse_jacobian @ orientation @ linear.by_joints[:, 3:])
        error = multiply_vectors(whitening, np.concatenate(errors, axis=1))
        slopes = [np.concatenate(parts, axis=1) for parts in (by_rotation, by_joint)]
        by = whitening @ np.concatenate(slopes, axis=2)
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
            np.where(more[:, None, None], orientation, best.orientation),
            np.where(more, log, best.log_density),
        )
        step = multiply_vectors(invert_matrices(information), slope)
        orientation = exp_so3(step[:, :3]) @ orientation
        values = motion.retract_joints(values, step[:, 3:])
    return best


def mirrored_values(motion: GroupMotion, values: Array, joint_prior: JointValuePrior) -> Array:
    """Return the other joint values (N, 1) at which the child has the same distance from the parent."""
    l_p_parent = -motion.left[:3, :3].T @ motion.left[:3, 3]
    if motion.parametrisation.joints[0] < WZ:
        # The foot of the perpendicular from the parent on the child's line along z.
        return np.asarray(2.0 * (l_p_parent[2] - motion.right[2, 3]) - values)
    x, y, _ = motion.right[:3, 3]
    towards = math.atan2(l_p_parent[1], l_p_parent[0]) - math.atan2(y, x)
    other = 2.0 * towards - values
    return np.asarray(other - math.tau * np.round((other - joint_prior.mean) / math.tau))


def _whitening(observations: Observations) -> tuple[Array, Array]:
    rows, of_parent = observations.rows, observations.parent_covariance
    assert of_parent is not None  # only then does the ambiguity arise
    count, size = len(observations), 3 + rows
    covariance = np.zeros((count, size, size))
    covariance[:, :6, :6] = of_parent
    covariance[:, :3, 3:6] *= -1.0
    covariance[:, 3:6, :3] *= -1.0
    covariance[:, :3, :3] += observations.child_covariance[:, :3, :3]
    if rows == 6:
        covariance[:, 6:, 6:] = observations.child_covariance[:, 3:, 3:]
        covariance[:, :3, 6:] = observations.child_covariance[:, :3, 3:]
        covariance[:, 6:, :3] = observations.child_covariance[:, 3:, :3]
    lower = np.linalg.cholesky(covariance)
    return np.linalg.inv(lower), np.log(np.einsum("nii->ni", lower)).sum(axis=1)


def _aligned(rotations: Array, lever: Array, displacement: Array) -> Array:
    """Return rotations, corrected by the smallest one that aligns the levers with the displacement."""
    pointing = multiply_vectors(rotations, lever)
    normal = np.cross(pointing, displacement)
    sine = np.linalg.norm(normal, axis=1)
    angle = np.arctan2(sine, np.sum(pointing * displacement, axis=1))
    return np.asarray(exp_so3(normal * (angle / np.where(sine > 0.0, sine, 1.0))[:, None]) @ rotations)


def _inverse_left_jacobian(turns: Array) -> Array:
    """Return the inverse left Jacobian of rotation vectors, to first order."""
    return np.eye(3) + 0.5 * skew(turns)


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
    known = solve_per_observation(solution)
    values = known.values
    middle = math.atan2(float(np.sin(values).mean()), float(np.cos(values).mean()))
    logs = []
    for each in (known, replace(known, values=values - math.tau * np.round((values - middle) / math.tau))):
        ranges = fit_joint_ranges(solution.motion, each)
        precision = float(np.sum(1.0 / (ranges.deviations[0] ** 2 + known.covariances[:, 0, 0])))
        # The evidence integrates over the mean, which is less certain with more revolutions.
        logs.append(ranges.log_density - 0.5 * math.log(precision))
    return max(0.0, logs[1] - logs[0])


def is_screw(motion: FamilyMember) -> bool:
    """Return True for a screw."""
    return isinstance(motion, GroupMotion) and motion.group.pitch
