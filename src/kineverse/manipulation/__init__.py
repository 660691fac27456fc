"""Manipulation: skills that open, close and push articulated objects with a robot (layer 5)."""

from .belief import Belief, TrueBelief
from .opening import open_object
from .outcome import Outcome, SkillError
from .placement import BasePlacement, PlacementSearch
from .pushing import push
from .session import Session
from .unknown_opening import open_unknown

__all__ = [
    "BasePlacement",
    "Belief",
    "Outcome",
    "PlacementSearch",
    "Session",
    "SkillError",
    "TrueBelief",
    "open_object",
    "open_unknown",
    "push",
]
