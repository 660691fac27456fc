"""Model of an identified joint, with shapes of its axis, the child and the observed positions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from kineverse.articulations.mechanisms.mechanism import BLUE, RED, box_shape, rod_shape, shift
from kineverse.errors import InvalidValueError
from kineverse.estimation.identification.curve import CURVE
from kineverse.estimation.identification.joint_operations import joint_operation
from kineverse.estimation.identification.result import Fit
from kineverse.lie import Array
from kineverse.model.basic_operations import SetBody
from kineverse.model.body import Body, Rgba, Shape, Sphere
from kineverse.model.frame import WORLD
from kineverse.model.model import Model
from kineverse.model.operation import Operation
from kineverse.spatial import translation

from .recording import RecordedPair, spaced_indices

_ORANGE: Rgba = (0.93, 0.56, 0.17, 1.0)

_DOTS = 60  # largest number of observed poses drawn in the model


def make_joint_model(pair: RecordedPair, fit: Fit) -> Model:
    """Return a model with the joint, and shapes of its axis, the child and the observed positions.

    If only positions are observed, the child's axes are those of its parent at joint value 0.

    Parameters
    ----------
    pair
        Observed poses.

    Raises
    ------
    InvalidValueError
        If only positions are observed and the part moves freely, as then there is no joint.
    """
    if fit.family == "free" and fit.motion.rows == 3:
        raise InvalidValueError(f"'{pair.child}' moves freely: there is no joint to write.")
    model = Model()
    positions = pair.relative[:, :3, 3] if pair.relative.ndim == 3 else pair.relative
    size = max(float(np.ptp(positions, axis=0).max()), 0.01)
    with model.edit() as edit:
        if pair.parent != WORLD:
            edit.add_frame(pair.parent, WORLD, translation(0, 0, 0))
        edit.apply(_make_operation(fit, pair.parent, pair.child), tag=pair.child)
        edit.apply(SetBody(pair.parent, Body(_parent_shapes(fit, positions, size))))
        edit.apply(SetBody(pair.child, Body(_child_shapes(fit, size))))
    return model


def _make_operation(fit: Fit, parent: str, child: str) -> Operation:
    """Return the joint as an operation; for positions alone see :func:`make_joint_model`."""
    if fit.motion.rows == 6 or fit.family == CURVE:
        return fit.operation(name=child, parent=parent, child=child, as_point=True)
    right = fit.motion.right.copy()
    right[:3, :3] = fit.motion.left[:3, :3].T
    limits = [(float(low), float(high)) for low, high in fit.range]
    return joint_operation(replace(fit.motion, right=right), limits, child, parent, child)


def _parent_shapes(fit: Fit, positions: Array, size: float) -> tuple[Shape, ...]:
    """Return the axis, and dots at observed positions, in the parent's frame."""
    dots = positions[spaced_indices(len(positions), _DOTS)]
    parts = [Shape(Sphere(0.008 * size), shift(*map(float, dot)), color=_ORANGE) for dot in dots]
    if "axis" in fit.parameters:
        half = 0.5 * size * np.asarray(fit.parameters["axis"])
        middle = _closest_point_on_axis(fit, positions.mean(axis=0))
        parts.append(_rod(middle - half, middle + half, size, RED))
    return tuple(parts)


def _child_shapes(fit: Fit, size: float) -> tuple[Shape, ...]:
    """Return a box for the child, and a rod from it to its axis if there is one, in the child's frame."""
    side = 0.06 * size
    parts = [box_shape((side, side, side), (0.0, 0.0, 0.0), BLUE)]
    if "point" in fit.parameters:
        reference = np.asarray(fit.parameters["reference"])
        rotation = reference[:3, :3] if fit.motion.rows == 6 else np.eye(3)
        arm = rotation.T @ (_closest_point_on_axis(fit, reference[:3, 3]) - reference[:3, 3])
        if np.linalg.norm(arm) > 0.01 * size:
            parts.append(_rod(np.zeros(3), arm, size, BLUE))
    return tuple(parts)


def _rod(start: Array, end: Array, size: float, color: Rgba) -> Shape:
    (a, b, c), (x, y, z) = start.tolist(), end.tolist()
    return rod_shape((a, b, c), (x, y, z), 0.012 * size, color)


def _closest_point_on_axis(fit: Fit, position: Array) -> Array:
    """Return the point of the axis closest to a position; the position itself if there is no axis."""
    if "point" not in fit.parameters:
        return position
    axis, point = np.asarray(fit.parameters["axis"]), np.asarray(fit.parameters["point"])
    return np.asarray(point + (axis @ (position - point)) * axis)
