"""Grasped opening: base placement, motions of the hand, and motion of the held object."""

from .base_placement import BasePlacement
from .grasped_opening import open_object
from .placement import PlacementSearch

__all__ = ["BasePlacement", "PlacementSearch", "open_object"]
