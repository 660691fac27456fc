"""Projection of further observations onto a motion with fixed parameters."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import numpy.typing as npt

from kineverse.estimation.linear_algebra import invert_matrices
from kineverse.estimation.robust import Outliers
from kineverse.lie import Stack

from .motion_model import LinearisedPoses, MotionModel, ParameterPrior
from .observations import Observations
from .optimise import Solution, levenberg_marquardt
from .outlier_rejection import UNEVEN, is_inlier
from .result import Fit
from .unwrapping import find_revolving_joint


@dataclass(frozen=True)
class FixedMotion:
    """A member of a family whose parameters are known by now."""

    motion: MotionModel

    size = 0

    @property
    def joints(self) -> int:
        """The number of joint values."""
        return self.motion.joints

    def at(self, values: Stack) -> LinearisedPoses:
        """Return the poses at joint values (N, k)."""
        linear = self.motion.at(values)
        return linear._replace(by_parameters=np.zeros((*linear.by_joints.shape[:2], 0)))

    def moved(self, step: Stack) -> Self:
        """Return itself: there are no parameters."""
        return self

    def bounded(self, values: Stack, step: Stack) -> Stack:
        """Return joint values after a step."""
        return self.motion.bounded(values, step)

    def prior(self) -> ParameterPrior:
        """Return that nothing is believed beforehand."""
        return ParameterPrior(np.zeros(0), np.zeros((0, 0)))


def project_observations(
    motion: MotionModel, values: Stack, seen: Observations, expected: Stack | None = None
) -> Solution[FixedMotion]:
    """Return the most likely joint values of a motion at observations that it need not be made of.

    They begin at the nearest of some values, (N, k); what turns about an axis, at that of its turns which is
    nearest to what is expected, if something is.
    """
    poses = motion.at(values).pose
    apart = np.sum((seen.relative[:, None] - poses[None])[:, :, :3] ** 2, axis=(2, 3))
    begin = values[np.argmin(apart, axis=1)]
    joint = find_revolving_joint(motion)
    if expected is not None and joint is not None:
        begin[:, joint] += math.tau * np.round((expected - begin[:, joint]) / math.tau)
    return levenberg_marquardt(seen, FixedMotion(motion), begin)


def squared_errors(solution: Solution[FixedMotion]) -> Stack:
    """Return χ² of each observation, (N,)."""
    weighted = np.linalg.solve(solution.covariance, solution.residuals[:, :, None])[:, :, 0]
    squares: Stack = np.sum(solution.residuals * weighted, axis=1)
    return squares


def complete_fit(
    fit: Fit,
    seen: Observations,
    used: npt.NDArray[np.int_],
    scale: float = 1.0,
    outliers: Outliers | None = None,
    stated: bool = True,
    ordered: bool = False,
) -> Fit:
    """Return a fit of some observations with the joint values of all, and which of the others are wrong.

    Parameters
    ----------
    fit
        Of the observations ``used``.
    seen
        All observations.
    used
        The numbers of those of the fit.
    scale
        By how much the standard deviations of their noise are larger.
    outliers
        How often the others are wrong; all of them are if None.
    stated
        Whether the size of the noise is known.
    ordered
        Whether turns were counted.
    """
    others: npt.NDArray[np.int_] = np.setdiff1d(np.arange(len(seen)), used)
    if not len(others):
        return fit
    expected, joint = None, find_revolving_joint(fit.motion)
    if ordered and joint is not None:
        expected = np.interp(others, used[fit.right], fit.joint_values[fit.right, joint])
    solution = project_observations(fit.motion, fit.joint_values, seen.at(others), expected)
    by_joints = solution.linear.by_joints
    information = np.swapaxes(by_joints, 1, 2) @ invert_matrices(solution.covariance) @ by_joints
    # Half a turn is as little as can be known of a turn that moves nothing.
    information += math.pi**-2 * np.eye(fit.motion.joints)
    deviations = scale * np.sqrt(np.einsum("nii->ni", invert_matrices(information)))
    wrong = others
    if outliers is not None:
        covariance = scale**2 * solution.covariance
        wrong = others[~classify_inliers(solution.residuals, covariance, outliers, stated)]

    def together(of_used: Stack, of_others: Stack) -> Stack:
        result = np.empty((len(seen), of_used.shape[1]))
        result[used], result[others] = of_used, of_others
        return result

    return replace(
        fit,
        joint_values=together(fit.joint_values, solution.values),
        deviations=together(fit.deviations, deviations),
        residuals=together(fit.residuals, solution.residuals),
        outliers=tuple(np.union1d(used[list(fit.outliers)], wrong).tolist()),
    )


def classify_inliers(
    residuals: Stack, covariance: Stack, outliers: Outliers, stated: bool
) -> npt.NDArray[np.bool_]:
    """Return which residuals (N, m) with covariances (N, m, m), stated or not, are those of what is right."""
    if not stated:
        covariance = UNEVEN**2 * covariance
    squares = np.einsum("ni,nij,nj->n", residuals, invert_matrices(covariance), residuals)
    log_scale = 0.5 * np.linalg.slogdet(math.tau * covariance)[1]
    return is_inlier(squares, log_scale, outliers, residuals.shape[1])
