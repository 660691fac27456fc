"""Where on a joint that is known by now other observations are."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import numpy.typing as npt

from kineverse.estimation.tracking.outliers import Outliers

from .fit import Fit
from .matrices import inverted
from .motion import Linear, Motion, Prior
from .observations import Observations
from .outlying import UNEVEN, is_right
from .rigid import Array
from .solving import Solution, solve
from .turning import turning_joint


@dataclass(frozen=True)
class Known:
    """A member of a family whose parameters are known by now."""

    motion: Motion

    size = 0

    @property
    def joints(self) -> int:
        """The number of joint values."""
        return self.motion.joints

    def at(self, values: Array) -> Linear:
        """Return the poses at joint values (N, k)."""
        linear = self.motion.at(values)
        return linear._replace(by_parameters=np.zeros((*linear.by_joints.shape[:2], 0)))

    def moved(self, step: Array) -> Self:
        """Return itself: there are no parameters."""
        return self

    def bounded(self, values: Array, step: Array) -> Array:
        """Return joint values after a step."""
        return self.motion.bounded(values, step)

    def prior(self) -> Prior:
        """Return that nothing is believed beforehand."""
        return Prior(np.zeros(0), np.zeros((0, 0)))


def beside(
    motion: Motion, values: Array, seen: Observations, expected: Array | None = None
) -> Solution[Known]:
    """Return the most likely joint values of a motion at observations that it need not be made of.

    They begin at the nearest of some values, (N, k); what turns about an axis, at that of its turns which is
    nearest to what is expected, if something is.
    """
    poses = motion.at(values).pose
    apart = np.sum((seen.relative[:, None] - poses[None])[:, :, :3] ** 2, axis=(2, 3))
    begin = values[np.argmin(apart, axis=1)]
    joint = turning_joint(motion)
    if expected is not None and joint is not None:
        begin[:, joint] += math.tau * np.round((expected - begin[:, joint]) / math.tau)
    return solve(seen, Known(motion), begin)


def squared_errors(solution: Solution[Known]) -> Array:
    """Return χ² of each observation, (N,)."""
    weighted = np.linalg.solve(solution.covariance, solution.residuals[:, :, None])[:, :, 0]
    squares: Array = np.sum(solution.residuals * weighted, axis=1)
    return squares


def completed(
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
    expected, joint = None, turning_joint(fit.motion)
    if ordered and joint is not None:
        expected = np.interp(others, used[fit.right], fit.joint_values[fit.right, joint])
    solution = beside(fit.motion, fit.joint_values, seen.at(others), expected)
    by_joints = solution.linear.by_joints
    information = np.swapaxes(by_joints, 1, 2) @ inverted(solution.covariance) @ by_joints
    # Half a turn is as little as can be known of a turn that moves nothing.
    information += math.pi**-2 * np.eye(fit.motion.joints)
    deviations = scale * np.sqrt(np.einsum("nii->ni", inverted(information)))
    wrong = others
    if outliers is not None:
        covariance = scale**2 * solution.covariance
        wrong = others[~are_right(solution.residuals, covariance, outliers, stated)]

    def together(of_used: Array, of_others: Array) -> Array:
        result = np.empty((len(seen), of_used.shape[1]))
        result[used], result[others] = of_used, of_others
        return result

    return replace(
        fit,
        joint_values=together(fit.joint_values, solution.values),
        deviations=together(fit.deviations, deviations),
        residuals=together(fit.residuals, solution.residuals),
        outlying=tuple(np.union1d(used[list(fit.outlying)], wrong).tolist()),
    )


def are_right(residuals: Array, covariance: Array, outliers: Outliers, stated: bool) -> npt.NDArray[np.bool_]:
    """Return which residuals (N, m) with covariances (N, m, m), stated or not, are those of what is right."""
    if not stated:
        covariance = UNEVEN**2 * covariance
    squares = np.einsum("ni,nij,nj->n", residuals, inverted(covariance), residuals)
    log_scale = 0.5 * np.linalg.slogdet(math.tau * covariance)[1]
    return is_right(squares, log_scale, outliers, residuals.shape[1])
