"""A joint that was learned, as a model: the joint, what was seen, and something that moves to look at."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from kineverse.errors import ValueRejectedError
from kineverse.estimation.identification.operations import joint_operation
from kineverse.formats.set_body import SetBody
from kineverse.gallery import shapes
from kineverse.model.body import Body
from kineverse.model.frame import WORLD
from kineverse.model.model import Model
from kineverse.model.operation import Operation
from kineverse.spatial import translation

if TYPE_CHECKING:
    from kineverse.estimation import Fit
    from kineverse.estimation.recording import Pair

Array = npt.NDArray[np.float64]

MOST_DOTS = 60
"""At most so many of the poses that were seen are in the model."""


def document_of(pair: Pair, fit: Fit) -> Model:
    """Return a model with the joint and, to be looked at, its axis, the part on it, and where it was seen.

    Where only positions were seen, the part's axes are those of its parent at joint value 0.

    Raises
    ------
    ValueRejectedError
        For a part that moves freely: there is no joint.
    """
    if fit.family == "free" and fit.motion.rows == 3:
        raise ValueRejectedError(
            f"'{pair.child}' moves freely: there is no joint to write. Without --document."
        )
    model = Model()
    seen = pair.relative[:, :3, 3] if pair.relative.ndim == 3 else pair.relative
    size = max(float(np.ptp(seen, axis=0).max()), 0.01)
    with model.edit() as edit:
        if pair.parent != WORLD:
            edit.add_frame(pair.parent, WORLD, translation(0, 0, 0))
        edit.apply(operation_of(fit, pair.parent, pair.child), tag=pair.child)
        edit.apply(SetBody(pair.parent, Body(_standing(fit, seen, size))))
        edit.apply(SetBody(pair.child, Body(_moving(fit, seen, size))))
    return model


def operation_of(fit: Fit, parent: str, child: str) -> Operation:
    """Return the joint as an operation, also where only positions were seen, see :func:`document_of`."""
    if fit.motion.rows == 6:
        return fit.operation(name=child, parent=parent, child=child)
    right = fit.motion.right.copy()
    right[:3, :3] = fit.motion.left[:3, :3].T
    limits = [(float(low), float(high)) for low, high in fit.range]
    return joint_operation(replace(fit.motion, right=right), limits, child, parent, child)


def _standing(fit: Fit, seen: Array, size: float) -> shapes.Shapes:
    """Return the axis, and dots where the part was seen, in the parent's frame."""
    chosen = np.unique(np.linspace(0, len(seen) - 1, MOST_DOTS).round().astype(int))
    made: shapes.Shapes = ()
    for point in seen[chosen]:
        made += shapes.sphere(0.008 * size, point, shapes.ORANGE)
    if "axis" in fit.parameters:
        axis = np.asarray(fit.parameters["axis"])
        middle = _foot(fit, seen.mean(axis=0))
        made += shapes.rod(middle - 0.5 * size * axis, middle + 0.5 * size * axis, 0.012 * size, shapes.RED)
    return made


def _moving(fit: Fit, seen: Array, size: float) -> shapes.Shapes:
    """Return the part, and an arm to the axis if it turns about one, in the part's frame."""
    made = shapes.box(np.full(3, 0.06 * size), color=shapes.BLUE)
    if "point" in fit.parameters:
        reference = np.asarray(fit.parameters["reference"])
        rotation = reference[:3, :3] if fit.motion.rows == 6 else np.eye(3)
        arm = rotation.T @ (_foot(fit, reference[:3, 3]) - reference[:3, 3])
        if np.linalg.norm(arm) > 0.01 * size:
            made += shapes.rod(np.zeros(3), arm, 0.012 * size, shapes.BLUE)
    return made


def _foot(fit: Fit, place: Array) -> Array:
    """Return the point on the axis nearest to a place; the place itself for what has no point."""
    if "point" not in fit.parameters:
        return place
    axis, point = np.asarray(fit.parameters["axis"]), np.asarray(fit.parameters["point"])
    foot: Array = point + (axis @ (place - point)) * axis
    return foot
