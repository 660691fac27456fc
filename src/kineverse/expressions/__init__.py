"""Layer 1: expressions with augmented gradients."""

from typing import TYPE_CHECKING

from kineverse._lazy import lazy_face

if TYPE_CHECKING:
    from .expression import (
        Expression as Expression,
        ExpressionLike as ExpressionLike,
        array as array,
        as_expression as as_expression,
    )
    from .gradient import total_derivative as total_derivative
    from .graph import gradient_keys as gradient_keys, lower as lower

lazy_face(__name__)
