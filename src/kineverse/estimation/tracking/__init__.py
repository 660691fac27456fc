"""The state of a model that is known, from noisy observations."""

from .estimate import Estimate
from .observed import ObservedExpression, ObservedPose, ObservedPosition
from .tracker import Tracker

__all__ = ["Estimate", "ObservedExpression", "ObservedPose", "ObservedPosition", "Tracker"]
