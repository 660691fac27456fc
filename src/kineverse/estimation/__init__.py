"""Layer 5: where things are, from noisy observations, and how they move.

:mod:`kineverse.estimation.tracking` estimates the state of a model that is known,
:mod:`kineverse.estimation.identification` the model of parts whose poses are known, and
:mod:`kineverse.estimation.rating` says whether a model explains what is seen.
"""

from kineverse.vocabulary import MODULE, unknown_attribute

from .identification import Family, Fit, Found, Identifier, Unknown, identify
from .identification.bodies import RigidBody
from .identification.graph import Edge, Graph, identify_graph
from .noise import pose_covariance
from .rating import ImplausibleError, Plausibility, PlausibilityMonitor, Rating, plausibility
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
    "Edge",
    "Estimate",
    "Family",
    "Fit",
    "Found",
    "Graph",
    "Hypotheses",
    "Identifier",
    "ImplausibleError",
    "ObservedExpression",
    "ObservedPose",
    "ObservedPosition",
    "Outliers",
    "Plausibility",
    "PlausibilityMonitor",
    "Rating",
    "RigidBody",
    "Tracker",
    "Unknown",
    "identify",
    "identify_graph",
    "plausibility",
    "pose_covariance",
]


def __getattr__(name: str) -> object:
    raise unknown_attribute("The package kineverse.estimation", name, __all__, MODULE)
