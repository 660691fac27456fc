"""Parts whose joint nobody described: they are pulled, the joint is learned, and written into the model."""

from .part import forget_joint
from .unknown_opening import open_unknown

__all__ = ["forget_joint", "open_unknown"]
