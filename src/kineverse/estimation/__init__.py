"""Layer 5: where things are, from noisy observations, and how they move.

:mod:`kineverse.estimation.tracking` estimates the state of a model that is known,
:mod:`kineverse.estimation.identification` the model of parts whose poses are known.
"""

from .identification import Fit, Found, identify
from .noise import pose_covariance
from .tracking import Estimate, ObservedExpression, ObservedPose, ObservedPosition, Tracker

__all__ = [
    "Estimate",
    "Fit",
    "Found",
    "ObservedExpression",
    "ObservedPose",
    "ObservedPosition",
    "Tracker",
    "identify",
    "pose_covariance",
]
