"""Residuals of observations under the served model.

The whitened residual of a relative pose has six components of deviation 1. Those along the joint directions
are taken up by the joint values; the other 6 - k, ρ, do not depend on them, and if the articulation is as
served they are independent standard normal numbers. Joint values that lie beyond their limits say the rest.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt

from kineverse.estimation.identification.motion_model import LinearisedPoses
from kineverse.estimation.identification.observations import Observations
from kineverse.estimation.linear_algebra import invert_matrices
from kineverse.lie import Stack, pose_difference, skew

from .known_motion import KnownJoint

SIZES = (0.01, 0.05, 0.3)
"""How far elsewhere something may sit, as standard deviations of each part of a twist [m], [rad]."""

# Joint values that nothing tells are believed within 100 [m] or [rad].
_PRECISION = 1e-4


@dataclass(frozen=True)
class KnownResiduals:
    """N observations beside a served articulation.

    Attributes
    ----------
    coordinates
        The most likely coordinates inside the limits, (N, n).
    values
        The most likely joint values without limits, by linearisation, (N, k). Where they are no coordinates,
        turns and slides from the first observation.
    covariances
        Of them, (N, k, k).
    normal
        ρ, (N, 6 - k).
    by_place
        How ρ changes if the articulation sits elsewhere in the parent and the child elsewhere on it: per unit
        of a twist of either, in their axes and about the child in the default state, (N, 6 - k, 12).
    beyond
        How far values are below the lower and above the upper limits, in standard deviations; -∞ without
        limits, (N, 2 k).
    residuals
        Of the relative pose in the parent's axes, with the best joint values inside the limits, (N, 6).
    log_scale
        ½ log |2πS| of each observation less ½ log |2πC| of its joint values: with ½ |ρ|², what is left when
        joint values are integrated out, (N,).
    tied
        How far values are beyond limits that depend on several coordinates, in standard deviations; NaN where
        that is not known, (N, c).
    apart
        How far values differ from what others say of the same coordinates, likewise, (N, e).
    others
        What these say, (N, e). See :mod:`.ties`, which fills the last three in.
    """

    coordinates: Stack
    values: Stack
    covariances: Stack
    normal: Stack
    by_place: Stack
    beyond: Stack
    residuals: Stack
    log_scale: Stack
    tied: Stack
    apart: Stack
    others: Stack

    def __len__(self) -> int:
        return len(self.normal)

    @property
    def against(self) -> Stack:
        """Everything that is beyond something, in standard deviations, (N, 2 k + c + 2 e)."""
        return np.concatenate([self.beyond, self.tied, self.apart, -self.apart], axis=1)

    def at(self, rows: slice | npt.NDArray[np.int_]) -> Self:
        """Return the misfit of some of the observations."""
        return type(self)(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))


def compute_residuals(served: KnownJoint, seen: Observations) -> KnownResiduals:
    """Return what of the observations is left unexplained."""
    coordinates, solution = served.solve(seen)
    whitening = np.linalg.inv(np.linalg.cholesky(solution.covariance))
    error = (whitening @ solution.residuals[:, :, None])[:, :, 0]
    directions = whitening @ solution.linear.by_joints
    transposed = np.swapaxes(directions, 1, 2)
    joints = served.joints
    covariances = invert_matrices(transposed @ directions + _PRECISION * np.eye(joints))
    # At a limit the best value without limits is a step away.
    step = (covariances @ transposed @ error[:, :, None])[:, :, 0]
    values = solution.values + step
    if not served.is_plain:
        values = _turns(solution.linear)
    basis = np.linalg.qr(directions, mode="complete")[0]
    across = np.swapaxes(basis[:, :, joints:], 1, 2)
    deviations = np.sqrt(np.einsum("nii->ni", covariances))
    beyond = np.concatenate([served.lower - values, values - served.upper], axis=1)
    pose = solution.linear.pose
    return KnownResiduals(
        coordinates,
        values,
        covariances,
        (across @ error[:, :, None])[:, :, 0],
        across @ whitening @ _moved(pose, served.middle),
        beyond / np.tile(deviations, (1, 2)),
        solution.residuals,
        0.5 * (_log_determinants(solution.covariance) - _log_determinants(covariances)),
        *(np.zeros((len(seen), 0)) for _ in range(3)),
    )


def _turns(linear: LinearisedPoses) -> Stack:
    """Return the joint values that lead from the first pose to each, to first order."""
    values: Stack = pose_difference(linear.pose, linear.pose[0]) @ np.linalg.pinv(linear.by_joints[0]).T
    return values


def _moved(pose: Stack, middle: Stack) -> Stack:
    """Return twists of the child per unit twist of the articulation in the parent, and of the child on it."""
    result = np.zeros((len(pose), 6, 12))
    result[:, :3, :3] = result[:, 3:, 3:6] = np.eye(3)
    result[:, :3, 3:6] = -skew(pose[:, :3, 3] - middle)
    result[:, :3, 6:9] = result[:, 3:, 9:] = pose[:, :3, :3]
    return result


def _log_determinants(matrices: Stack) -> Stack:
    logs: Stack = np.linalg.slogdet(2.0 * np.pi * matrices)[1]
    return logs
