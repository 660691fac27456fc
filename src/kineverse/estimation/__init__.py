"""Estimation: state tracking, model identification and plausibility of models.

:mod:`kineverse.estimation.tracking` estimates the state of a known model,
:mod:`kineverse.estimation.identification` identifies joints between observed frames, and
:mod:`kineverse.estimation.plausibility` tests a model against observations. Layer 5.
"""

from kineverse._synonyms import MODULE_SYNONYMS
from kineverse.errors import unknown_attribute_error

from .identification import Family, FamilyParameter, Fit, IdentificationResult, Identifier, identify
from .identification.kinematic_graph.graph import KinematicEdge, KinematicGraph, RigidBody, identify_graph
from .noise import pose_covariance
from .plausibility import (
    ImplausibleError,
    JointVerdict,
    Plausibility,
    PlausibilityMonitor,
    check_plausibility,
)
from .tracking import (
    Estimate,
    HypothesisBank,
    ObservedExpression,
    ObservedPose,
    ObservedPosition,
    Outliers,
    Tracker,
)

__all__ = [
    "Estimate",
    "Family",
    "FamilyParameter",
    "Fit",
    "HypothesisBank",
    "IdentificationResult",
    "Identifier",
    "ImplausibleError",
    "JointVerdict",
    "KinematicEdge",
    "KinematicGraph",
    "ObservedExpression",
    "ObservedPose",
    "ObservedPosition",
    "Outliers",
    "Plausibility",
    "PlausibilityMonitor",
    "RigidBody",
    "Tracker",
    "check_plausibility",
    "identify",
    "identify_graph",
    "pose_covariance",
]


def __getattr__(name: str) -> object:
    raise unknown_attribute_error("The package kineverse.estimation", name, __all__, MODULE_SYNONYMS)
