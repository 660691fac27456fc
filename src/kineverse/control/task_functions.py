"""Task functions: expressions that are zero where a relation of frames holds, for goals and holds."""

from __future__ import annotations

import casadi as ca
import numpy as np

from kineverse.expressions.expression import Expression, ExpressionLike, as_expression, binary
from kineverse.expressions.functions import arctan2, sqrt, where
from kineverse.spatial import as_transform, inverse, log_so3, unit_vector


def same_position(a_T: ExpressionLike, b_T: ExpressionLike) -> Expression:
    """Return the position of b minus that of a in the common frame, shape (3,) [m]."""
    return as_transform(b_T)[:3, 3] - as_transform(a_T)[:3, 3]


def same_orientation(a_T: ExpressionLike, b_T: ExpressionLike) -> Expression:
    """Return the rotation vector of b in a, shape (3,) [rad]; see :func:`.log_so3`."""
    return log_so3(as_transform(a_T)[:3, :3].T @ as_transform(b_T)[:3, :3])


def same_pose(a_T: ExpressionLike, b_T: ExpressionLike) -> Expression:
    """Return the pose of b in a as 6 numbers: position [m], then rotation vector [rad].

    All are zero where both poses are equal.

    Parameters
    ----------
    a_T, b_T
        Poses in a common frame, 4×4 expressions or arrays.
    """
    a_T_b = inverse(a_T) @ as_transform(b_T)
    return as_expression(np.concatenate([a_T_b[:3, 3], log_so3(a_T_b[:3, :3])]))


def look_at(
    camera_T: ExpressionLike, point: ExpressionLike, axis: ExpressionLike = (1.0, 0.0, 0.0)
) -> Expression:
    """Return the rotation vector that turns the viewing axis of a camera towards a point.

    It is in the camera's frame, shape (3,); its length is the angle between axis and ray [rad]. The rotation
    about the ray stays free. Straight behind the camera the direction of the turn is undefined.

    Parameters
    ----------
    camera_T
        Pose of the camera, 4×4.
    point
        Point in the frame of the pose, shape (3,) [m], away from the camera.
    axis
        Viewing axis in the camera's frame, shape (3,).
    """
    pose = as_transform(camera_T)
    forward = unit_vector(axis, "The viewing axis")
    ray = pose[:3, :3].T @ (as_expression(point) - pose[:3, 3])
    turn = as_expression(np.cross(forward, ray))
    cosine = forward @ ray
    sine2 = turn @ turn
    # atan(t)/t is 1 at t = 0; the branch avoids 0/0 and keeps the derivative there.
    aligned = _is_greater(cosine, 0.0) * _is_greater(1e-12 * cosine * cosine, sine2)
    sine = sqrt(where(aligned, 1.0, sine2))
    return turn * where(aligned, 1 / where(aligned, cosine, 1.0), arctan2(sine, cosine) / sine)


def _is_greater(a: ExpressionLike, b: ExpressionLike) -> Expression:
    """Return 1 where a > b, else 0; for selections, without gradient and trend."""
    return binary(ca.OP_LT, b, a)
