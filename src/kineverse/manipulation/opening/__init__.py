"""Grasped opening: base placement, motions of the hand, and motion of the held object."""

from typing import TYPE_CHECKING

from kineverse._lazy import lazy_face

if TYPE_CHECKING:
    from .base_placement import BasePlacement as BasePlacement, PlacementSearch as PlacementSearch
    from .grasped_opening import open_object as open_object

lazy_face(__name__)
