"""The model of parts that move, from noisy poses."""

from .family import Family, Unknown
from .fit import Fit, Found
from .identifier import Identifier
from .identify import identify

__all__ = ["Family", "Fit", "Found", "Identifier", "Unknown", "identify"]
