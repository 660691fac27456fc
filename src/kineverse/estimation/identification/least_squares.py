"""Levenberg-Marquardt with Schur complement over parameters, joint values and parent poses.

With the true poses Â_k of the parent as unknowns too, the errors of an observation, in the axes of Â_k, are

    e_A = (Â⁻¹A),      e_B = (Â⁻¹B) against H(θ, a)

To first order, after a step (ε, δθ, δa) they are e_A - ε and e_B - M ε - J_θ δθ - J_a δa, where M transports
ε over the lever between the parts. Elimination of ε leaves e_B - M e_A with covariance S = Σ_B + M Σ_A Mᵀ.
Elimination of δa by its Schur complement leaves a system in θ alone. Â_k is updated after every step, so the
linearisation is at the estimate. The result maximises the full likelihood with all true poses as unknowns.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Generic, NamedTuple, TypeVar

import numpy as np

from kineverse.errors import InvalidValueError
from kineverse.estimation.linear_algebra import (
    invert_matrices,
    multiply_vectors,
    squared_errors,
    sum_log_determinants,
)
from kineverse.lie import Array, exp_so3, log_so3, skew, transform

from .motion_functions import FamilyMember, GeneratedMotion, MotionModel, ParameterPrior
from .native import LinearisedPoses
from .observations import Observations

if TYPE_CHECKING:
    from .marginal_likelihood import IntegratedValues

M = TypeVar("M", bound=MotionModel)
M_co = TypeVar("M_co", bound=MotionModel, covariant=True)

STEPS = 40
# Predicted decrease of the cost at convergence: a hundredth of a standard deviation. Convergence is linear,
# so two successive decreases also predict the next one.
CLOSE = 1e-4
ROUGH = 1e-2  # the same for a first solution: a tenth of a standard deviation


@dataclass(frozen=True)
class JointValuePrior:
    """Prior of the joint values: independent Gaussians."""

    mean: Array  # mean and precision of each joint value, (k,)
    precision: Array
    marginal: bool = False  # True if the joint values are integrated out

    @staticmethod
    def vague(joints: int) -> JointValuePrior:
        """Return a prior so weak that it only keeps unobservable joint values finite."""
        return JointValuePrior(np.zeros(joints), np.full(joints, 1e-4))


class InitialGuess(NamedTuple):
    """Initial member of a family and joint values (N, k)."""

    motion: FamilyMember
    values: Array


@dataclass(frozen=True)
class Solution(Generic[M_co]):
    """Maximum of the likelihood and the quadratic approximation around it."""

    motion: M_co
    values: Array  # joint values, (N, k)
    cost: float  # twice the negative logarithm of likelihood and prior, without constants
    residuals: Array  # residuals e_B - M e_A of the child's pose in the parent, in the parent's axes, (N, m)
    covariance: Array  # their covariance S, (N, m, m)
    linear: LinearisedPoses
    parent: Array  # most likely true poses of the parent, (N, 4, 4)
    joint_prior: JointValuePrior
    converged: bool  # True if the steps became small; else the solution is the best one so far
    # The evidence, if it was computed along with the solution. A copy that differs has none.
    integrated: IntegratedValues | None = field(default=None, init=False)


@dataclass(frozen=True)
class _Point(Generic[M_co]):
    """Linearisation at a point in the space of all unknowns."""

    motion: M_co
    values: Array
    parent: Array
    linear: LinearisedPoses
    prior: ParameterPrior
    parent_errors: Array
    residuals: Array
    lever: Array
    parent_covariance: Array | None
    weights: Array
    covariance: Array
    cost: float


def levenberg_marquardt(
    observations: Observations,
    motion: M,
    values: Array,
    parent: Array | None = None,
    joint_prior: JointValuePrior | None = None,
    steps: int = STEPS,
    close: float = CLOSE,
) -> Solution[M]:
    """Return the maximum of the likelihood, from a start."""
    joint_prior = joint_prior or JointValuePrior.vague(motion.joints)
    parent = observations.parent if parent is None else parent
    point = _linearise(observations, motion, values, parent, joint_prior)
    damping, converged, before = 0.0, False, 0.0
    for _ in range(steps):
        reduced = _step(observations, point, damping, joint_prior)
        if reduced is None:
            damping = max(10.0 * damping, 1e-6)
            if damping > 1e8:
                break
            continue
        trial, gain = reduced
        if trial.cost <= point.cost + 1e-12 * abs(point.cost):
            converged = gain < close or gain * gain < close * before
            point, damping, before = trial, 0.1 * damping if damping > 1e-6 else 0.0, gain
        else:
            converged, damping = gain < close, max(10.0 * damping, 1e-4)
        if converged or damping > 1e8:
            break
    at_end = point.residuals, point.covariance, point.linear, point.parent
    return Solution(point.motion, point.values, point.cost, *at_end, joint_prior, converged)


def _linearise(
    observations: Observations, motion: M, values: Array, parent: Array, joint_prior: JointValuePrior
) -> _Point[M]:
    linear = motion.linearise(values)
    prior = motion.prior()
    rows = observations.rows
    p_R_w = np.swapaxes(parent[:, :3, :3], 1, 2)
    by_child = linear.pose[:, :3, :3]
    offset = (p_R_w @ (observations.child[:, :3, 3] - parent[:, :3, 3])[:, :, None])[:, :, 0]
    error = offset - linear.pose[:, :3, 3]
    if rows == 6:
        turned = log_so3(p_R_w @ observations.child[:, :3, :3] @ np.swapaxes(by_child, 1, 2))
        error = np.concatenate([error, turned], axis=1)
    covariance = _rotate_covariances(observations.child_covariance, p_R_w)
    cost = float(squared_errors(error, covariance).sum())
    parent_errors, of_parent = np.zeros((len(observations), 6)), None
    lever = _lever(linear.pose[:, :3, 3], rows)
    residuals = error
    if observations.parent_covariance is not None:
        moved = (p_R_w @ (observations.parent[:, :3, 3] - parent[:, :3, 3])[:, :, None])[:, :, 0]
        parent_errors = np.concatenate([moved, log_so3(p_R_w @ observations.parent[:, :3, :3])], axis=1)
        of_parent = _rotate_covariances(observations.parent_covariance, p_R_w)
        cost += float(squared_errors(parent_errors, of_parent).sum())
        residuals = error - multiply_vectors(lever, parent_errors)
        covariance = covariance + lever @ of_parent @ np.swapaxes(lever, 1, 2)
    weights = invert_matrices(covariance)
    cost += float(prior.residuals @ prior.residuals)
    cost += float(np.sum(joint_prior.precision * (values - joint_prior.mean) ** 2))
    if joint_prior.marginal:
        cost += _log_determinants(covariance, linear, joint_prior)
    at_point = parent_errors, residuals, lever, of_parent, weights, covariance, cost
    return _Point(motion, values, parent, linear, prior, *at_point)


def _step(
    observations: Observations, point: _Point[M], damping: float, joint_prior: JointValuePrior
) -> tuple[_Point[M], float] | None:
    """Return the point after a step and the predicted decrease of the cost; None if the step fails."""
    by_parameters, by_joints = point.linear.by_parameters, point.linear.by_joints
    projected = point.weights
    moving = by_joints.shape[2] > 0
    if moving:
        pulled = joint_prior.precision * (joint_prior.mean - point.values)
        weighted = np.swapaxes(by_joints, 1, 2) @ point.weights
        curvature = weighted @ by_joints
        diagonal = np.einsum("nii->ni", curvature)
        diagonal += joint_prior.precision + damping * diagonal
        slope = multiply_vectors(weighted, point.residuals) + pulled
        inverse = invert_matrices(curvature)
        projected = point.weights - np.swapaxes(weighted, 1, 2) @ inverse @ weighted
    rotated = np.swapaxes(by_parameters, 1, 2) @ projected
    prior = point.prior
    normal = np.einsum("nir,nrj->ij", rotated, by_parameters) + prior.by_parameters.T @ prior.by_parameters
    right = np.einsum("nir,nr->i", rotated, point.residuals) - prior.by_parameters.T @ prior.residuals
    if moving:
        # The gradient of the prior of joint values, transformed to the parameters.
        pull = multiply_vectors(inverse, pulled)
        right -= np.einsum("nrj,nrk,nk->j", by_parameters, np.swapaxes(weighted, 1, 2), pull)
        if joint_prior.marginal and len(right):
            right -= 0.5 * _log_determinant_gradient(point, inverse @ weighted, joint_prior)
    normal[np.diag_indices_from(normal)] *= 1.0 + damping
    try:
        step = np.linalg.solve(normal, right) if len(right) else right
    except np.linalg.LinAlgError:
        return None
    gain = float(step @ right)
    left = (by_parameters @ step) if len(step) else np.zeros_like(point.residuals)
    values = point.values
    if moving:
        back = slope - multiply_vectors(weighted, left)
        change = multiply_vectors(inverse, back)
        gain += float(np.sum(slope * multiply_vectors(inverse, slope)))
        left = left + multiply_vectors(by_joints, change)
        values = point.motion.retract_joints(values, change)
    parent = point.parent
    if point.parent_covariance is not None:
        rest = point.weights @ (point.residuals - left)[:, :, None]
        blame = point.parent_covariance @ np.swapaxes(point.lever, 1, 2) @ rest
        error = point.parent_errors + blame[:, :, 0]
        parent = parent @ transform(exp_so3(error[:, 3:]), error[:, :3])
        gain += float(np.sum(error**2 / np.einsum("nii->ni", point.parent_covariance)))
    if not (np.isfinite(step).all() and np.isfinite(values).all() and np.isfinite(parent).all()):
        return None
    try:
        trial = _linearise(observations, point.motion.retract(step), values, parent, joint_prior)
    except (np.linalg.LinAlgError, InvalidValueError):  # the lever is too long for S in double precision
        return None
    return (trial, gain) if np.isfinite(trial.cost) else None


def _log_determinants(covariance: Array, linear: LinearisedPoses, joint_prior: JointValuePrior) -> float:
    """Return the sum of log |S + J_a P⁻¹ J_aᵀ|."""
    moved = (linear.by_joints / joint_prior.precision) @ np.swapaxes(linear.by_joints, 1, 2)
    return sum_log_determinants(covariance + moved)


def _log_determinant_gradient(point: _Point[M], gains: Array, joint_prior: JointValuePrior) -> Array:
    """Return the derivatives of Σ log |T| by the parameters, T = S + J_a P⁻¹ J_aᵀ, at optimal joint values.

    With Π = T⁻¹ and the gains G = P⁻¹ J_aᵀ Π, d log |T| = tr(Π dS) + 2 tr(G dJ_a). S depends on the lever of
    the parent alone.
    """
    by_joints, rows = point.linear.by_joints, point.residuals.shape[1]
    moved = (by_joints / joint_prior.precision) @ np.swapaxes(by_joints, 1, 2)
    lever = np.zeros((len(gains), 3))
    if point.parent_covariance is not None:
        inverse = invert_matrices(point.covariance + moved)
        q = (point.parent_covariance @ np.swapaxes(point.lever, 1, 2) @ inverse)[:, 3:, :3]
        lever = np.stack([q[:, 2, 1] - q[:, 1, 2], q[:, 0, 2] - q[:, 2, 0], q[:, 1, 0] - q[:, 0, 1]], axis=1)
    assert isinstance(point.motion, GeneratedMotion)  # ranges of other motions are not estimated
    by_step, by_values = point.motion.slope(point.values, gains[:, :, :rows], lever)
    # The joint values follow the parameters.
    followed = np.einsum("nk,nkr,nri->i", by_values, gains, point.linear.by_parameters)
    return np.asarray(2.0 * (by_step.sum(axis=0) - followed))


def _lever(offset: Array, rows: int) -> Array:
    """Return M, the displacement of the child by an error of the parent, (N, m, 6)."""
    result = np.zeros((len(offset), rows, 6))
    result[:, :, :rows] = np.eye(rows)
    result[:, :3, 3:] = -skew(offset)
    return result


def _rotate_covariances(covariance: Array, rotation: Array) -> Array:
    turned = np.empty_like(covariance) if covariance.flags.writeable else np.empty(covariance.shape)
    back = np.swapaxes(rotation, 1, 2)
    for i in range(0, covariance.shape[1], 3):
        for j in range(0, covariance.shape[2], 3):
            turned[:, i : i + 3, j : j + 3] = rotation @ covariance[:, i : i + 3, j : j + 3] @ back
    return turned
