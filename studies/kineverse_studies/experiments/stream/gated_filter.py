"""Textbook filter to compare with: constant velocity, an extended Kalman filter, a gate on each marker."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from kineverse.lie import Array, pose_difference

from .observations import ORIENTATION, POSITION, Stream

GATE = 22.46
"""χ² with six degrees of freedom that is exceeded once in a thousand."""

Markers = Callable[[float], Array]
"""Function that returns the poses of the markers (2, 4, 4) at an angle."""

_STEP = 1e-6


def run_gated_filter(stream: Stream, markers: Markers, acceleration: float) -> tuple[Array, Array]:
    """Return angles and their variances after each look (N,), (N,); it starts at the true angle."""
    noise = np.diag([POSITION**2] * 3 + [ORIENTATION**2] * 3)
    x, p, before = np.array([stream.angles[0], 0.0]), np.diag([0.01, 0.01]), float(stream.times[0])
    angles, variances = [], []
    for k, now in enumerate(stream.times.tolist()):
        dt = now - before
        before, move = now, np.array([[1.0, dt], [0.0, 1.0]])
        x = move @ x
        p = move @ p @ move.T + acceleration * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        for i in np.flatnonzero(stream.seen[k]).tolist():
            expected = markers(float(x[0]))[i]
            slope = pose_difference(markers(float(x[0]) + _STEP)[i], expected) / _STEP
            residual, jacobian = pose_difference(stream.poses[k, i], expected), np.zeros((6, 2))
            jacobian[:, 0] = slope
            spread = jacobian @ p @ jacobian.T + noise
            if float(residual @ np.linalg.solve(spread, residual)) > GATE:
                continue
            gain = p @ jacobian.T @ np.linalg.inv(spread)
            x, p = x + gain @ residual, (np.eye(2) - gain @ jacobian) @ p
        angles.append(float(x[0]))
        variances.append(float(p[0, 0]))
    return np.array(angles), np.array(variances)
