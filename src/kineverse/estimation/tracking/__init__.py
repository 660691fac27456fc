"""The state of a model that is known, from noisy observations."""

from .estimate import Estimate
from .hypotheses import Hypotheses
from .observed import ObservedExpression, ObservedPose, ObservedPosition
from .outliers import Outliers
from .tracker import Tracker

__all__ = [
    "Estimate",
    "Hypotheses",
    "ObservedExpression",
    "ObservedPose",
    "ObservedPosition",
    "Outliers",
    "Tracker",
]
