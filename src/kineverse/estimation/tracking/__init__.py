"""State estimation of a known model from noisy measurements."""

from kineverse.estimation.noise import Outliers

from .estimate import Estimate
from .hypothesis_bank import HypothesisBank
from .measurements import ObservedExpression, ObservedPose, ObservedPosition
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
