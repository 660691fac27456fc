"""Layer 1: expressions with augmented gradients."""

from .expression import Expression, ExpressionLike, array, as_expression
from .gradient import total_derivative
from .graph import gradient_keys, lower

__all__ = [
    "Expression",
    "ExpressionLike",
    "array",
    "as_expression",
    "gradient_keys",
    "lower",
    "total_derivative",
]
