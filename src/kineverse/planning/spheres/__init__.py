"""Covers of collision shapes by few spheres, with a hierarchy.

:func:`cover_objects` covers the collision objects of a body, :func:`cover_solid` and :func:`cover_solids` any
convex solids. Covers contain what they cover, provably, and say how far they stick out of it.
"""

from .object_covers import cover_objects
from .sphere_cover import SphereCover, cover_solid, cover_solids, default_protrusion
from .sphere_tree import SphereTree, enclosing_ball, make_sphere_tree

__all__ = [
    "SphereCover",
    "SphereTree",
    "cover_objects",
    "cover_solid",
    "cover_solids",
    "default_protrusion",
    "enclosing_ball",
    "make_sphere_tree",
]
