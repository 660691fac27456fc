"""Parts with an unknown joint: the hand pulls, the joint is learned, and written into the model."""

from .unknown_opening import open_unknown
from .unmodelled_joint import forget_joint

__all__ = ["forget_joint", "open_unknown"]
