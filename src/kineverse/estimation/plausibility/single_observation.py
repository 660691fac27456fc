"""Gauss-Newton solution for one observation of a known joint.

The equations are those of :mod:`kineverse.estimation.identification.optimise` for one observation and no
parameters. Without the axes of many observations and without damping, a solution takes a tenth of the time.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from kineverse.estimation.identification.motion_model import LinearisedPoses
from kineverse.estimation.identification.observations import Observations
from kineverse.estimation.identification.optimise import CLOSE, JointValuePrior, Solution
from kineverse.lie import Array, exp_so3, log_so3

if TYPE_CHECKING:
    from .known_motion import KnownJoint, KnownMotion

_STEPS = 12
_STEP = 0.5
# Square of a residual beyond which the true pose of the parent stays at the observed one.
_GROSS = 1e3


def solve_observation(
    served: KnownJoint, motion: KnownMotion, observations: Observations, start: Array
) -> Solution[KnownMotion] | None:
    """Return the solution for one observation of a joint; None if the steps do not converge.

    Parameters
    ----------
    served
        Joint whose joint values are its coordinates.
    motion
        The motion that the solution names.
    observations
        The observation of both poses, (1, ...).
    start
        Initial joint values, (k,).
    """
    parent, child = observations.parent[0], observations.child[0]
    of_parent = None if observations.parent_covariance is None else observations.parent_covariance[0]
    of_child = observations.child_covariance[0]
    prior = JointValuePrior.vague(served.joints)
    low, high = served.inner_limits()
    values, true = np.clip(start, low, high), parent
    turned = np.zeros((6, 6))
    for _ in range(_STEPS):
        pose, by_joints = served.evaluate(values)
        rotation = true[:3, :3].T
        turned[:3, :3] = turned[3:, 3:] = rotation
        error = np.empty(6)
        error[:3] = rotation @ (child[:3, 3] - true[:3, 3]) - pose[:3, 3]
        error[3:] = _log(rotation @ child[:3, :3] @ pose[:3, :3].T)
        covariance = turned @ of_child @ turned.T
        if of_parent is not None:
            own = np.empty(6)
            own[:3] = rotation @ (parent[:3, 3] - true[:3, 3])
            own[3:] = _log(rotation @ parent[:3, :3])
            lever = _lever(pose)
            lifted = turned @ of_parent @ turned.T @ lever.T
            covariance += lever @ lifted
            error -= lever @ own
        try:
            weights = np.linalg.inv(covariance)
        except np.linalg.LinAlgError:
            return None
        gain, left, there = 0.0, error, values
        if served.joints:
            weighted = by_joints.T @ weights
            curvature = weighted @ by_joints + np.diag(prior.precision)
            slope = weighted @ error - prior.precision * values
            change = np.linalg.solve(curvature, slope)
            there = np.clip(
                values + np.where(served.is_angle, np.clip(change, -_STEP, _STEP), change), low, high
            )
            change = there - values
            # At a limit the step is shorter than the one that the slope asks for.
            gain += float(change @ curvature @ change)
            left = error - by_joints @ change
        square = float(error @ weights @ error)
        # Which parent would explain a gross error best matters to nobody, and is many steps away.
        follows = square < _GROSS
        if of_parent is not None and follows:
            blame = own + lifted @ (weights @ left)
            gain += float(np.sum(blame**2 / np.diag(of_parent)))
        if gain < CLOSE:
            linear = LinearisedPoses(pose[None], np.zeros((1, 6, 0)), by_joints[None])
            return Solution(
                motion,
                values[None],
                square,
                error[None],
                covariance[None],
                linear,
                true[None],
                prior,
                True,
            )
        values = there
        if of_parent is not None and follows:
            step = np.eye(4)
            step[:3, :3], step[:3, 3] = exp_so3(blame[3:]), blame[:3]
            true = true @ step
        if not (np.isfinite(values).all() and np.isfinite(true).all()):
            return None
    return None


def _log(rotation: Array) -> Array:
    """Return the rotation vector of one rotation, as :func:`kineverse.lie.log_so3`."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rotation.tolist()
    cosine = 0.5 * (xx + yy + zz - 1.0)
    if cosine < -0.99:
        return log_so3(rotation)
    x, y, z = 0.5 * (zy - yz), 0.5 * (xz - zx), 0.5 * (yx - xy)
    sine = math.sqrt(x * x + y * y + z * z)
    factor = 1.0 if sine < 1e-9 else math.atan2(sine, cosine) / sine
    return np.array([factor * x, factor * y, factor * z])


def _lever(pose: Array) -> Array:
    """Return the displacement of the child by an error of the parent, (6, 6)."""
    x, y, z = pose[:3, 3].tolist()
    result = np.eye(6)
    result[0, 4], result[0, 5] = z, -y
    result[1, 3], result[1, 5] = -z, x
    result[2, 3], result[2, 4] = y, -x
    return result
