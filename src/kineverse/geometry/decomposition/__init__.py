"""Meshes as unions of convex hulls: made offline by CoACD, kept in the user's cache, measured.

Distances to convex solids are fast and have a depth; a mug is not convex. :func:`decompose` takes seconds
to minutes, so nothing calls it by itself: ``kineverse decompose`` does, and :func:`pieces` returns what is
there.
"""

from .accuracy import Accuracy
from .making import Outcome, decompose, decompose_all, pieces
from .result import Decomposition, Settings
from .store import Kept, clear, folder, listing
from .worker import DecompositionError, Limits

__all__ = [
    "Accuracy",
    "Decomposition",
    "DecompositionError",
    "Kept",
    "Limits",
    "Outcome",
    "Settings",
    "clear",
    "decompose",
    "decompose_all",
    "folder",
    "listing",
    "pieces",
]
