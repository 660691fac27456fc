"""Manipulation: skills that open, close and push articulated objects with a robot (layer 5)."""

from .articulated_objects import ArticulatedObject, find_articulated_objects
from .belief import Belief, TrueBelief
from .open_close import OpenCloseReport, OpenCloseRunner
from .opening import BasePlacement, PlacementSearch, open_object
from .outcome import Outcome, SkillError
from .pushing import push
from .session import Session
from .tracked_belief import TrackedBelief
from .unknown_objects import open_unknown
from .unlocking import LockExploration, PartMover, UnlockingExecution, execute_unlocking, explore_locks

__all__ = [
    "ArticulatedObject",
    "BasePlacement",
    "Belief",
    "LockExploration",
    "OpenCloseReport",
    "OpenCloseRunner",
    "Outcome",
    "PartMover",
    "PlacementSearch",
    "Session",
    "SkillError",
    "TrackedBelief",
    "TrueBelief",
    "UnlockingExecution",
    "execute_unlocking",
    "explore_locks",
    "find_articulated_objects",
    "open_object",
    "open_unknown",
    "push",
]
