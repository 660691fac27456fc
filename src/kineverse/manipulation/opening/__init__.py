"""Grasped opening: base placement, motions of the hand, and motion of the held object."""

from .base_placement import BasePlacement, PlacementSearch
from .grasped_opening import open_object

__all__ = ["BasePlacement", "PlacementSearch", "open_object"]
