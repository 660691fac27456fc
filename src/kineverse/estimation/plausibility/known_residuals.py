"""Residuals of observations under the served model.

The whitened residual of a relative pose has six components with unit deviation. The joint values absorb the
components along the joint directions. The other 6 - k, ρ, do not depend on them: if the joint is as served,
they are independent standard normal numbers. Joint values beyond their limits are further evidence against
it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from kineverse.estimation.identification.motion_model import LinearisedPoses
from kineverse.estimation.identification.observations import Observations
from kineverse.estimation.identification.optimise import Solution
from kineverse.estimation.linear_algebra import invert_matrices, log_determinants
from kineverse.lie import Array, pose_difference, skew

from .known_motion import KnownJoint
from .single_observation import complete_basis, displacement_jacobian, solve_observation

SIZES = (0.01, 0.05, 0.3)
"""Standard deviations of a displacement, for each component of a twist [m], [rad]."""

# Prior information of joint values: a deviation of 100 [m] or [rad].
_PRECISION = 1e-4


@dataclass(frozen=True)
class KnownResiduals:
    """Residuals of N observations under a served joint."""

    coordinates: Array  # most likely coordinates inside the limits, (N, n)
    values: Array  # most likely joint values without limits, by linearisation, (N, k)
    covariances: Array  # covariances of values, (N, k, k)
    orthogonal: Array  # ρ, the whitened residual orthogonal to the joint directions, (N, 6 - k)
    whitened: Array  # same residual in the axes of the whitened pose, (N, 6)
    displacement_jacobian: Array
    bound_excess: Array
    pose_residuals: Array  # (N, 6)
    log_scale: Array  # (N,)
    limit_excess: Array  # (N, c)
    disagreement: Array  # difference from the estimates of the same coordinates by others, likewise, (N, e)
    other_values: Array  # these estimates, (N, e). consistency sets the last three

    def __len__(self) -> int:
        return len(self.orthogonal)

    @property
    def one_sided(self) -> Array:
        """All one-sided test quantities, in standard deviations, (N, 2 k + c + 2 e)."""
        return np.concatenate(
            [self.bound_excess, self.limit_excess, self.disagreement, -self.disagreement], axis=1
        )

    def select(self, rows: slice | npt.NDArray[np.int_]) -> Self:
        """Return the residuals of some of the observations."""
        return type(self)(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))

    def scaled(self, factor: float) -> Self:
        """Return the residuals for covariances of the poses that are larger by a factor."""
        root = math.sqrt(factor)
        smaller = (
            "orthogonal", "whitened", "displacement_jacobian", "bound_excess", "limit_excess", "disagreement",
        )  # fmt: skip
        return replace(
            self,
            covariances=factor * self.covariances,
            log_scale=self.log_scale + 0.5 * self.orthogonal.shape[1] * math.log(factor),
            **{name: getattr(self, name) / root for name in smaller},
        )


def compute_residuals(served: KnownJoint, observations: Observations) -> KnownResiduals:
    """Compute the residuals of observations under a served joint."""
    if len(observations) == 1 and served.is_plain and observations.rows == 6:
        single = _compute_one(served, observations)
        if single is not None:
            return single
    coordinates, solution = served.solve(observations)
    whitening, error, directions = _whiten(solution)
    transposed = np.swapaxes(directions, 1, 2)
    joints = served.joints
    covariances = invert_matrices(transposed @ directions + _PRECISION * np.eye(joints))
    # At a limit, one Gauss-Newton step leads to the optimum without limits.
    step = (covariances @ transposed @ error[:, :, None])[:, :, 0]
    values = solution.values + step
    if not served.is_plain:
        values = _displacements(solution.linear)
    basis = np.linalg.qr(directions, mode="complete")[0]
    across = np.swapaxes(basis[:, :, joints:], 1, 2)
    deviations = np.sqrt(np.einsum("nii->ni", covariances))
    excess = np.concatenate([served.lower - values, values - served.upper], axis=1)
    pose = solution.linear.pose
    orthogonal = (across @ error[:, :, None])[:, :, 0]
    return KnownResiduals(
        coordinates,
        values,
        covariances,
        orthogonal,
        (basis[:, :, joints:] @ orthogonal[:, :, None])[:, :, 0],
        across @ whitening @ _displacement_jacobian(pose, served.middle),
        excess / np.tile(deviations, (1, 2)),
        solution.residuals,
        0.5 * (log_determinants(math.tau * solution.covariance) - log_determinants(math.tau * covariances)),
        *(np.zeros((len(observations), 0)) for _ in range(3)),
    )


def _compute_one(served: KnownJoint, observations: Observations) -> KnownResiduals | None:
    """Compute the residuals of one observation; None if its joint values are not found."""
    start = served.initial_coordinates(observations)[0] if served.joints else np.zeros(0)
    solution = solve_observation(served, observations, start, _PRECISION)
    if solution is None:
        return None
    values, pose, by_joints, residual, covariance = solution
    joints = served.joints
    triangle = np.linalg.cholesky(covariance)
    whitening = np.linalg.inv(triangle)
    error, directions = whitening @ residual, whitening @ by_joints
    log_scale = float(np.log(np.diagonal(triangle)).sum()) + 0.5 * (6 - joints) * math.log(math.tau)
    covariances: Array = np.zeros((joints, joints))
    if joints:
        covariances = invert_matrices(directions.T @ directions + _PRECISION * np.eye(joints))
        log_scale -= 0.5 * float(np.linalg.slogdet(covariances)[1])
    unbounded = values + covariances @ (directions.T @ error)
    across = complete_basis(directions)
    orthogonal = across.T @ error
    deviations = np.sqrt(np.diagonal(covariances))
    excess = np.concatenate(
        [(served.lower - unbounded) / deviations, (unbounded - served.upper) / deviations]
    )
    none = np.zeros((1, 0))
    return KnownResiduals(
        values[None],
        unbounded[None],
        covariances[None],
        orthogonal[None],
        (across @ orthogonal)[None],
        (across.T @ whitening @ displacement_jacobian(pose, served.middle))[None],
        excess[None],
        residual[None],
        np.array([log_scale]),
        none,
        none,
        none,
    )


def orthogonal_residuals(solution: Solution[Any]) -> Array:
    """Return the whitened residuals without their components along the joint directions, (N, 6)."""
    _, error, directions = _whiten(solution)
    basis = np.linalg.qr(directions)[0]
    along: Array = basis @ (np.swapaxes(basis, 1, 2) @ error[:, :, None])
    return error - along[:, :, 0]


def _whiten(solution: Solution[Any]) -> tuple[Array, Array, Array]:
    """Return W with W S Wᵀ = I, (N, 6, 6), whitened residuals (N, 6) and joint directions (N, 6, k)."""
    whitening = np.linalg.inv(np.linalg.cholesky(solution.covariance))
    error = (whitening @ solution.residuals[:, :, None])[:, :, 0]
    return whitening, error, whitening @ solution.linear.by_joints


def _displacements(linear: LinearisedPoses) -> Array:
    """Return the joint values from the first pose to each, to first order."""
    values: Array = pose_difference(linear.pose, linear.pose[0]) @ np.linalg.pinv(linear.by_joints[0]).T
    return values


def _displacement_jacobian(pose: Array, middle: Array) -> Array:
    """Return the child's twist per unit twist of the joint in the parent, and of the child on the joint."""
    result = np.zeros((len(pose), 6, 12))
    result[:, :3, :3] = result[:, 3:, 3:6] = np.eye(3)
    result[:, :3, 3:6] = -skew(pose[:, :3, 3] - middle)
    result[:, :3, 6:9] = result[:, 3:, 9:] = pose[:, :3, :3]
    return result
