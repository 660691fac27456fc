"""Collision geometry of a model (layer 4); a scene needs the extra ``geometry``."""

from kineverse._synonyms import MODULE_SYNONYMS
from kineverse.errors import unknown_attribute_error

from .collision_filter import RULES, Rule, rules_as_data
from .distance_expressions import PairDistance
from .distance_queries import PreparedQuery
from .results import DistanceResult, DistanceResults, NearestPoint, RayHit
from .scene import Scene

__all__ = [
    "RULES",
    "DistanceResult",
    "DistanceResults",
    "NearestPoint",
    "PairDistance",
    "PreparedQuery",
    "RayHit",
    "Rule",
    "Scene",
    "rules_as_data",
]


def __getattr__(name: str) -> object:
    raise unknown_attribute_error("The package kineverse.geometry", name, __all__, MODULE_SYNONYMS)
