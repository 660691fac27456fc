"""Manipulation: skills that open, close and push articulated objects with a robot (layer 5)."""

from .belief import Belief, TrueBelief
from .opening import SkillError, open_object
from .outcome import Outcome
from .placement import Placement, PlacementSearch
from .pushing import push
from .session import Session

__all__ = [
    "Belief",
    "Outcome",
    "Placement",
    "PlacementSearch",
    "Session",
    "SkillError",
    "TrueBelief",
    "open_object",
    "push",
]
