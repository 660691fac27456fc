"""The model of parts that move, from noisy poses."""

from .fit import Fit, Found
from .identifier import Identifier
from .identify import identify

__all__ = ["Fit", "Found", "Identifier", "identify"]
