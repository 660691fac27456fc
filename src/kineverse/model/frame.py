"""Frames: named coordinate systems, each placed in a parent frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, TypeAlias

import casadi as ca
import numpy as np
import numpy.typing as npt

from kineverse.errors import ShapeError
from kineverse.expressions.expression import Expression, access_listener, as_expression
from kineverse.spatial import as_one_axis_transform

from .body import Pose

if TYPE_CHECKING:
    from .kinematics import Placement

WORLD = "world"
"""Name of the root frame."""

TransformLike: TypeAlias = "Expression | Pose | npt.ArrayLike"


@dataclass(frozen=True)
class Frame:
    """Frame with its parent and its pose in the parent.

    Attributes
    ----------
    parent
        Name of the parent frame; ``world`` is the root of all.
    factors
        Transforms whose product is parent_T_frame: constants as :class:`Pose`, others as 4×4 expressions. The
        geometric Jacobian of separate factors is far shorter than that of the multiplied matrix.

    Examples
    --------
    >>> frame = kv.model.Frame.from_transform("world", kv.translation(kv.position("drawer"), 0, 0))
    >>> frame.parent, frame.transform[:3, 3]
    ('world', Expression(3,)[drawer, 0, 0])
    """

    parent: str
    factors: tuple[Pose | Expression, ...]
    # Last pose in the world, and in another frame, shared by all models that share the frame.
    placement: Placement | None = field(default=None, init=False, repr=False, compare=False)
    relative_placement: Placement | None = field(default=None, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        # The lazy factors of a traced operation are not queried here.
        if type(self.factors) is tuple:
            object.__setattr__(self, "factors", tuple(map(_as_motion, self.factors)))

    def __reduce__(self) -> Any:
        return Frame, (self.parent, self.factors)

    @staticmethod
    def from_transform(parent: str, transform: TransformLike | Sequence[TransformLike]) -> Frame:
        """Build a frame from a 4×4 transform, or from the factors of one.

        Raises
        ------
        InvalidValueError
            If a constant one is not rigid.

        Examples
        --------
        >>> factors = [kv.translation(1, 0, 0), kv.rotation_z(kv.position("door"))]
        >>> len(kv.model.Frame.from_transform("world", factors).factors)
        2
        """
        if isinstance(transform, Pose):
            return Frame(parent, (transform,))
        if isinstance(transform, (list, tuple)) and not (transform and np.isscalar(transform[0])):
            parts: Sequence[Any] = transform
            if not all(map(_is_transform, parts)):
                parts = [as_expression(transform)]  # rows of one matrix
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


def _as_motion(factor: Any) -> Any:
    is_transform = isinstance(factor, Expression) and factor.shape == (4, 4)
    return as_one_axis_transform(factor) if is_transform else factor


def _factor(transform: TransformLike) -> Pose | Expression:
    if isinstance(transform, Pose):
        return transform
    expression = as_expression(transform)
    if expression.shape != (4, 4):
        raise ShapeError(f"A frame is placed by a 4×4 transform, not by one of shape {expression.shape}.")
    if access_listener(expression) is not None or not expression.is_constant:
        return expression
    matrix = np.array(ca.DM(expression.casadi))
    return Pose.from_matrix(matrix)


def _is_transform(part: Any) -> bool:
    if isinstance(part, (list, tuple)):
        return len(part) == 4 and all(isinstance(row, (list, tuple)) and len(row) == 4 for row in part)
    return isinstance(part, Pose) or getattr(part, "shape", None) == (4, 4)


def is_of_robot(name: str, robot: str) -> bool:
    """Return whether a frame, or the path of a coordinate, is below the prefix of a robot."""
    return not robot or name == robot or name.startswith(f"{robot}/")
