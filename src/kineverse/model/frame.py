"""Frames: named coordinate systems, each placed in a parent frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
import numpy.typing as npt

from kineverse.errors import ShapeError, ValueRejectedError
from kineverse.expressions.expression import Expression, as_expression

from .body import Pose

WORLD = "world"

TransformLike: TypeAlias = "Expression | Pose | npt.ArrayLike"


@dataclass(frozen=True)
class Frame:
    """A frame and where it is in its parent.

    Attributes
    ----------
    parent
        Name of the parent frame; ``world`` is the root of all.
    factors
        Transforms whose product is parent_T_frame: constants as :class:`Pose`, the rest as 4×4 expressions.
        Kept apart because the geometric Jacobian of a product is far shorter than that of the multiplied
        matrix.
    """

    parent: str
    factors: tuple[Pose | Expression, ...]

    @staticmethod
    def of(parent: str, transform: TransformLike | Sequence[TransformLike]) -> Frame:
        """Build a frame from a 4×4 transform, or from a sequence of them whose product it is.

        Raises
        ------
        ShapeError
            If a transform is not 4×4.
        ValueRejectedError
            If a constant one is not rigid.
        """
        if isinstance(transform, Pose):
            return Frame(parent, (transform,))
        if isinstance(transform, (list, tuple)) and transform and not np.isscalar(transform[0]):
            parts: Sequence[Any] = transform
            if not all(isinstance(p, Pose) or np.shape(p) == (4, 4) for p in parts):
                parts = [as_expression(transform)]  # a nested list of rows is one matrix
        else:
            parts = [transform]
        return Frame(parent, tuple(_factor(part) for part in parts))

    @cached_property
    def transform(self) -> Expression:
        """parent_T_frame, a 4×4 expression."""
        result = as_expression(np.eye(4))
        for factor in self.factors:
            result = result @ (as_expression(factor.matrix) if isinstance(factor, Pose) else factor)
        return result


def _factor(transform: TransformLike) -> Pose | Expression:
    if isinstance(transform, Pose):
        return transform
    expression = as_expression(transform)
    if expression.shape != (4, 4):
        raise ShapeError(f"A frame is placed by a 4×4 transform, not by one of shape {expression.shape}.")
    if not expression.is_constant:
        return expression
    matrix = np.array(ca.DM(expression.casadi))
    rotation = matrix[:3, :3]
    rigid = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6) and np.linalg.det(rotation) > 0
    if not rigid or not np.array_equal(matrix[3], [0, 0, 0, 1]) or not np.isfinite(matrix).all():
        raise ValueRejectedError(
            "The transform is not rigid: its upper left 3×3 must be a rotation and its last row (0, 0, 0, 1)."
        )
    return Pose.of(matrix)
