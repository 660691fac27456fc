"""Manipulation: skills that open, close and push articulated objects with a robot (layer 5)."""

from .belief import Belief, TrueBelief
from .opening import SkillError, open_object
from .outcome import Outcome
from .placement import BasePlacement, PlacementSearch
from .pushing import push
from .session import Session

__all__ = [
    "BasePlacement",
    "Belief",
    "Outcome",
    "PlacementSearch",
    "Session",
    "SkillError",
    "TrueBelief",
    "open_object",
    "push",
]
