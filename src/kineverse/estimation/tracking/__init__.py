"""State estimation of a known model from noisy measurements."""

from kineverse.estimation.robust import Outliers

from .estimate import Estimate
from .measurements import ObservedExpression, ObservedPose, ObservedPosition
from .model_bank import HypothesisBank
from .tracker import Tracker

__all__ = [
    "Estimate",
    "HypothesisBank",
    "ObservedExpression",
    "ObservedPose",
    "ObservedPosition",
    "Outliers",
    "Tracker",
]
