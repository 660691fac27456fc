"""Covers of collision shapes by few spheres, with a hierarchy.

:func:`cover_objects` covers the collision objects of a body, :func:`cover_solid` and :func:`cover_solids` any
convex solids. Covers contain what they cover, provably, and say how far they stick out of it.
"""

from typing import TYPE_CHECKING

from kineverse._lazy import lazy_face

if TYPE_CHECKING:
    from .object_covers import cover_objects as cover_objects
    from .sphere_cover import (
        SphereCover as SphereCover,
        cover_solid as cover_solid,
        cover_solids as cover_solids,
        default_protrusion as default_protrusion,
    )
    from .sphere_tree import (
        SphereTree as SphereTree,
        enclosing_ball as enclosing_ball,
        make_sphere_tree as make_sphere_tree,
    )

lazy_face(__name__)
