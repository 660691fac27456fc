"""Projection of further observations onto a motion with fixed parameters."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from kineverse.estimation.linear_algebra import invert_matrices
from kineverse.estimation.robust import Outliers
from kineverse.lie import Array

from .motion_model import FixedMotion, MotionModel
from .observations import Observations
from .optimise import Solution, levenberg_marquardt
from .outlier_rejection import UNEVEN, is_inlier
from .result import Fit
from .unwrapping import find_revolving_joint


def project_observations(
    motion: MotionModel, values: Array, observations: Observations, expected: Array | None = None
) -> Solution[FixedMotion]:
    """Return the most likely joint values of a fixed motion at observations."""
    poses = motion.linearise(values).pose
    distances = np.sum((observations.relative[:, None] - poses[None])[:, :, :3] ** 2, axis=(2, 3))
    starts = values[np.argmin(distances, axis=1)]
    joint = find_revolving_joint(motion)
    if expected is not None and joint is not None:
        starts[:, joint] += math.tau * np.round((expected - starts[:, joint]) / math.tau)
    return levenberg_marquardt(observations, FixedMotion(motion), starts)


def complete_fit(
    fit: Fit,
    observations: Observations,
    used: npt.NDArray[np.int_],
    outliers: Outliers | None = None,
    stated: bool = True,
    sequential: bool = False,
) -> Fit:
    """Return a fit of some observations, extended to all of them.

    The motion stays as it is. The other observations get joint values, deviations and residuals, and are
    classified as inliers or outliers.
    """
    others: npt.NDArray[np.int_] = np.setdiff1d(np.arange(len(observations)), used)
    if not len(others):
        return fit
    expected, joint = None, find_revolving_joint(fit.motion)
    if sequential and joint is not None:
        expected = np.interp(others, used[fit.inliers], fit.joint_values[fit.inliers, joint])
    solution = project_observations(fit.motion, fit.joint_values, observations.select(others), expected)
    by_joints = solution.linear.by_joints
    information = np.swapaxes(by_joints, 1, 2) @ invert_matrices(solution.covariance) @ by_joints
    # An angle without effect on the pose has a standard deviation of half a revolution at most.
    information += math.pi**-2 * np.eye(fit.motion.joints)
    deviations = np.sqrt(np.einsum("nii->ni", invert_matrices(information)))
    rejected = others
    if outliers is not None:
        rejected = others[~classify_inliers(solution.residuals, solution.covariance, outliers, stated)]

    def merge(of_used: Array, of_others: Array) -> Array:
        result = np.empty((len(observations), of_used.shape[1]))
        result[used], result[others] = of_used, of_others
        return result

    return replace(
        fit,
        joint_values=merge(fit.joint_values, solution.values),
        deviations=merge(fit.deviations, deviations),
        residuals=merge(fit.residuals, solution.residuals),
        outliers=tuple(np.union1d(used[list(fit.outliers)], rejected).tolist()),
    )


def classify_inliers(
    residuals: Array, covariance: Array, outliers: Outliers, stated: bool
) -> npt.NDArray[np.bool_]:
    """Return the mask of inliers for residuals (N, m) with covariances (N, m, m), stated or estimated."""
    if not stated:
        covariance = UNEVEN**2 * covariance
    squares = np.einsum("ni,nij,nj->n", residuals, invert_matrices(covariance), residuals)
    log_scale = 0.5 * np.linalg.slogdet(math.tau * covariance)[1]
    return is_inlier(squares, log_scale, outliers, residuals.shape[1])
