"""Parts whose joint nobody described: they are pulled, the joint is learned, and written into the model."""

from .unknown_opening import open_unknown
from .unmodelled_joint import forget_joint

__all__ = ["forget_joint", "open_unknown"]
