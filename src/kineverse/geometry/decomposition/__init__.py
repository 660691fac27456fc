"""Convex decomposition of meshes: made offline by CoACD, cached, measured.

Distances to convex solids are fast and have a depth, but many meshes, such as a mug, are not convex.
:func:`decompose` takes seconds to minutes, so scenes never call it. The command ``kineverse decompose`` fills
the cache, and :func:`find_hulls` reads it.
"""

from typing import TYPE_CHECKING

from kineverse._lazy import lazy_face

if TYPE_CHECKING:
    from .accuracy import Accuracy as Accuracy
    from .convex_decomposition import (
        DecompositionError as DecompositionError,
        DecompositionOutcome as DecompositionOutcome,
        ResourceLimits as ResourceLimits,
        decompose as decompose,
        decompose_all as decompose_all,
        find_hulls as find_hulls,
    )
    from .result import (
        CacheEntry as CacheEntry,
        Decomposition as Decomposition,
        DecompositionSettings as DecompositionSettings,
        clear as clear,
        folder as folder,
        list_entries as list_entries,
    )

lazy_face(__name__)
