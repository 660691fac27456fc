"""Convex decomposition of meshes: made offline by CoACD, cached, measured.

Distances to convex solids are fast and have a depth, but many meshes, such as a mug, are not convex.
:func:`decompose` takes seconds to minutes, so scenes never call it. The command ``kineverse decompose`` fills
the cache, and :func:`find_hulls` reads it.
"""

from .accuracy import Accuracy
from .coacd_process import DecompositionError, ResourceLimits
from .convex_decomposition import DecompositionOutcome, decompose, decompose_all, find_hulls
from .result import CacheEntry, Decomposition, DecompositionSettings, clear, folder, list_entries

__all__ = [
    "Accuracy",
    "CacheEntry",
    "Decomposition",
    "DecompositionError",
    "DecompositionOutcome",
    "DecompositionSettings",
    "ResourceLimits",
    "clear",
    "decompose",
    "decompose_all",
    "find_hulls",
    "folder",
    "list_entries",
]
