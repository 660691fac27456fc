"""Layer 4: the collision scene of a model. It needs the extra ``geometry`` when a scene is made."""

from kineverse.vocabulary import MODULE, unknown_attribute

from .expressions import PairDistance
from .found import Found
from .results import Closest, Hit, Nearby
from .rules import RULES, Rule, rules_as_data
from .scene import Scene

__all__ = ["RULES", "Closest", "Found", "Hit", "Nearby", "PairDistance", "Rule", "Scene", "rules_as_data"]


def __getattr__(name: str) -> object:
    raise unknown_attribute("The package kineverse.geometry", name, __all__, MODULE)
