"""Extended Kalman filter of a base in the plane, from its odometry and the poses of known landmarks."""

from __future__ import annotations

import numpy as np

from kineverse.estimation.robust import CHI_SQUARED_6
from kineverse.lie import Array, inverse, pose_difference, rotation_z, transform


class BaseFilter:
    """Filter of the position and the heading of a base.

    The error is a twist (vx, vy, ω) in the axes of the base: the pose is the estimate times exp(error). A
    motion M turns it to Ad(M⁻¹) error (Solà et al., A micro Lie theory, 2018).
    """

    def __init__(self, odometry: float, turn: float, has_outliers: bool) -> None:
        self._variance = np.array([odometry, odometry, turn]) ** 2
        self._has_outliers = has_outliers
        self.reset(np.zeros(3))

    def reset(self, pose: Array) -> None:
        """Begin at a known pose (3,), which is also what the odometry reads."""
        self.pose, self._read = pose.copy(), pose.copy()
        self.covariance = np.zeros((3, 3))

    @property
    def deviations(self) -> Array:
        """Standard deviations of x, y and heading (3,)."""
        turned = np.eye(3)
        turned[:2, :2] = rotation_z(self.pose[2])[:2, :2]
        return np.asarray(np.sqrt(np.diag(turned @ self.covariance @ turned.T)))

    def move(self, read: Array) -> None:
        """Follow the odometry to its next reading (3,)."""
        step = read - self._read
        if not step.any():
            return
        step[:2] = rotation_z(-self._read[2])[:2, :2] @ step[:2]
        self._read = read.copy()
        self.pose[:2] += rotation_z(self.pose[2])[:2, :2] @ step[:2]
        self.pose[2] += step[2]
        adjoint = np.eye(3)
        adjoint[:2, 2] = -step[1], step[0]
        adjoint[:2] = rotation_z(-step[2])[:2, :2] @ adjoint[:2]
        way = float(np.linalg.norm(step[:2]) + abs(step[2]))
        self.covariance = adjoint @ self.covariance @ adjoint.T + way * np.diag(self._variance)

    def correct(self, seen: Array, known: Array, deviations: Array) -> None:
        """Correct the estimate by landmarks."""
        expected = inverse(place(self.pose)) @ known
        errors = pose_difference(seen, expected)
        slopes = -motion_of(expected)
        variances = np.repeat(deviations, 3, axis=1) ** 2
        if self._has_outliers:
            spread = slopes @ self.covariance @ np.swapaxes(slopes, 1, 2) + variances[:, :, None] * np.eye(6)
            squares = (errors * np.linalg.solve(spread, errors[:, :, None])[:, :, 0]).sum(axis=1)
            kept = squares < CHI_SQUARED_6
            errors, slopes, variances = errors[kept], slopes[kept], variances[kept]
        weighted = slopes / variances[:, :, None]
        information = np.einsum("kia,kib->ab", weighted, slopes)
        self.covariance = np.linalg.solve(np.eye(3) + self.covariance @ information, self.covariance)
        self.covariance = (self.covariance + self.covariance.T) / 2
        step = self.covariance @ np.einsum("kia,ki->a", weighted, errors)
        self.pose[:2] += rotation_z(self.pose[2])[:2, :2] @ step[:2]
        self.pose[2] += step[2]


def place(pose: Array) -> Array:
    """Return the transform (4, 4) of x, y and a heading (3,)."""
    return np.asarray(transform(rotation_z(pose[2]), np.array([pose[0], pose[1], 0.0])))


def motion_of(poses: Array) -> Array:
    """Return the motion (m, 6, 3) of frames (m, 4, 4) that a twist (vx, vy, ω) of their parent carries."""
    slopes = np.zeros((len(poses), 6, 3))
    slopes[:, 0, 0] = slopes[:, 1, 1] = slopes[:, 5, 2] = 1.0
    slopes[:, 0, 2], slopes[:, 1, 2] = -poses[:, 1, 3], poses[:, 0, 3]
    return slopes
