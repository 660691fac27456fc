"""Covers of collision shapes by few spheres, with a hierarchy."""

from .quality import CoverQuality, measure_cover
from .sphere_cover import SphereCover, cover_solid, default_protrusion
from .sphere_tree import SphereTree, enclosing_ball, make_sphere_tree

__all__ = [
    "CoverQuality",
    "SphereCover",
    "SphereTree",
    "cover_solid",
    "default_protrusion",
    "enclosing_ball",
    "make_sphere_tree",
    "measure_cover",
]
