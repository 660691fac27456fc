"""Covers of collision shapes by few spheres, with a hierarchy.

:func:`cover_object` covers a collision object of a scene, :func:`cover_solid` any convex solid. Covers
contain what they cover, provably, and say how far they stick out of it.
"""

from .object_covers import cover_object
from .quality import CoverQuality, measure_cover
from .sphere_cover import SphereCover, cover_solid, default_protrusion
from .sphere_tree import SphereTree, enclosing_ball, make_sphere_tree

__all__ = [
    "CoverQuality",
    "SphereCover",
    "SphereTree",
    "cover_object",
    "cover_solid",
    "default_protrusion",
    "enclosing_ball",
    "make_sphere_tree",
    "measure_cover",
]
