"""Manipulation: skills that open, close and push articulated objects with a robot (layer 5)."""

from .base_placement import BasePlacement
from .belief import Belief, TrueBelief
from .opening import open_object
from .outcome import Outcome, SkillError
from .placement import PlacementSearch
from .pushing import push
from .session import Session
from .tracked_belief import TrackedBelief

__all__ = [
    "BasePlacement",
    "Belief",
    "Outcome",
    "PlacementSearch",
    "Session",
    "SkillError",
    "TrackedBelief",
    "TrueBelief",
    "open_object",
    "push",
]
