"""Layer 5: where things are, from noisy observations, and how they move.

:mod:`kineverse.estimation.tracking` estimates the state of a model that is known,
:mod:`kineverse.estimation.identification` the model of parts whose poses are known.
"""

from .identification import Fit, Found, identify
from .noise import pose_covariance
from .tracking import (
    Estimate,
    Hypotheses,
    ObservedExpression,
    ObservedPose,
    ObservedPosition,
    Outliers,
    Tracker,
)

__all__ = [
    "Estimate",
    "Fit",
    "Found",
    "Hypotheses",
    "ObservedExpression",
    "ObservedPose",
    "ObservedPosition",
    "Outliers",
    "Tracker",
    "identify",
    "pose_covariance",
]
