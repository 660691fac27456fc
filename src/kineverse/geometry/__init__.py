"""Layer 4: the collision scene of a model. It needs the extra ``geometry`` when a scene is made."""

from .expressions import PairDistance
from .found import Found
from .results import Closest, Hit, Nearby
from .rules import RULES, Rule, rules_as_data
from .scene import Scene

__all__ = ["RULES", "Closest", "Found", "Hit", "Nearby", "PairDistance", "Rule", "Scene", "rules_as_data"]
