"""Collision shapes: primitives, convex hulls and triangle meshes as coal computes with them."""

from __future__ import annotations

import hashlib
import logging
import math
import threading
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, TypeAlias

import numpy as np
from msgspec import Struct, field
from msgspec.structs import replace

from kineverse._extras import install_command
from kineverse.compilation.cache_kinds import KINDS
from kineverse.errors import FormatError, InvalidValueError, MissingDependencyError
from kineverse.model.body import Box, Capsule, Cone, Cylinder, Ellipsoid, Geometry, Mesh, Sphere

from .mesh_files import Faces, Floats, Integers, MeshFile, find_mesh_file, read_faces

SMALLEST_MESH, LARGEST_MESH = 1e-6, 1e6
"""Smallest and largest extent of a mesh; beyond them its unit or scale is taken for a mistake [m]."""

THICKNESS = 2e-5
"""Least thickness of a hull [m]; flat hulls are thickened to it, or to 1e-5 of their size if that is more."""

_MESH_HULLS = KINDS["mesh_hulls"].make_cache(
    logging.getLogger("kineverse.geometry"), "The hull of a mesh %s %s and counts as absent."
)
_WHOLE_FILES = (".stl", ".obj", ".dae", ".ply", ".off")  # suffixes of files without further files
_HULL_VERSION = 1  # raise the number when the hulls of equal meshes change
_SEQUENCE = 1.2207440846057596 ** -np.arange(1.0, 4.0)  # steps of the sequence R3 (Roberts 2018)


def convex_hull(points: Floats) -> Any:
    """Return the convex hull of (N, 3) points [m] as a ``coal.Convex``.

    Distance algorithms fail for hulls without volume. A flat hull, such as a pane of glass, is therefore
    thickened to :data:`THICKNESS`, half of it on each side.
    """
    return _find_hull(thicken_flat(points))


def _find_hull(points: Floats) -> Any:
    import coal

    vector = coal.StdVec_Vec3s()
    for point in points:
        vector.append(point)
    try:
        return coal.Convex.convexHull(vector, True, "Qt")
    except Exception as error:  # The message of qhull is pages long.
        raise InvalidValueError("qhull finds no convex hull of its points.") from error


def thicken_flat(points: Floats) -> Floats:
    """Return points with a convex hull of volume: a flat set is doubled, see :func:`convex_hull`."""
    check_extent(points)
    unique = np.unique(points, axis=0)
    centred = unique - unique.mean(axis=0)
    axes = np.linalg.svd(centred, full_matrices=False)[2] if len(unique) > 2 else np.eye(3)
    size, width, thickness = np.ptp(centred @ axes.T, axis=0).tolist() if len(axes) == 3 else (0.0, 0.0, 0.0)
    least = max(THICKNESS, 1e-5 * size)
    if len(unique) < 3 or width < least:
        raise InvalidValueError(
            f"all its points lie on a line, or within {least:g} m of one, so that there is nothing to touch."
        )
    if thickness >= least:
        return unique
    normal = axes[2] * (least / 2)
    return np.concatenate([unique - normal, unique + normal])


def check_extent(points: Floats) -> None:
    """Raise InvalidValueError for points that are not finite, too close together or too far apart [m]."""
    if not np.isfinite(points).all():
        raise InvalidValueError("its points are not finite.")
    extent = float(np.ptp(points, axis=0).max()) if len(points) else 0.0
    if not SMALLEST_MESH <= extent <= LARGEST_MESH:
        raise InvalidValueError(
            f"its extent is {extent:g} m, and meshes from {SMALLEST_MESH:g} m to {LARGEST_MESH:g} m are "
            "taken. Is its scale right?"
        )
    if np.abs(points).max() > LARGEST_MESH:
        raise InvalidValueError(
            f"it lies further than {LARGEST_MESH:g} m from its origin. Is its scale right?"
        )


Primitive: TypeAlias = Box | Sphere | Cylinder | Capsule | Cone | Ellipsoid


class Hull(Struct, frozen=True, eq=False):
    """Convex polytope: the points x with ``normals @ x <= offsets``; (F, 3) and (F,) [m]."""

    normals: Floats
    offsets: Floats


class Core(Struct, frozen=True, eq=False):
    """Description of a convex solid by its support function, see ``support_functions.h``.

    A core is the hull of corners; or the Minkowski sum of a box, an ellipsoid and a ball about the origin; or
    a cone.
    """

    half: Floats  # (3,) half edges of the box [m]
    radius: float = 0.0  # of the ball [m]
    radii: Floats = field(
        default_factory=lambda: np.zeros(3)
    )  # of the ellipsoid; a disc if the last is 0 [m]
    # (3, n) corners; the first is repeated until n is a multiple of 8. n = 0 for a core that is no hull [m].
    corners: Floats = field(default_factory=lambda: np.empty((3, 0)))
    tip: float = 0.0  # half the height of a cone between (0, 0, tip) and a disc at (0, 0, -tip) [m]

    @staticmethod
    def from_corners(points: Floats) -> Core:
        """Return the core that is the hull of (n, 3) corners."""
        missing = -len(points) % 8
        corners = np.ascontiguousarray(np.vstack([points, *missing * [points[:1]]]).T)
        return Core(np.zeros(3), corners=corners)


class Solid(Struct, frozen=True, eq=False):
    """Immutable shape for distance computation; equal geometries share one solid."""

    engine: Any  # geometry of coal, which keeps pointers only: the solid outlives all functors made of it
    surface: Primitive | Hull | Faces
    centre: Floats  # (3,) centre and half edges of the bounding box [m]
    half: Floats
    radius: float  # of the bounding sphere about the centre [m]
    stand_in: Any = None  # geometry of coal for pairs with a cylinder; None if that is the engine
    core: Core | None = None  # None for triangles

    @property
    def is_convex(self) -> bool:
        """True for all solids but triangle meshes: convex solids have an inside and a depth."""
        return not isinstance(self.surface, Faces)


_by_content: dict[tuple[object, ...], Solid] = {}
_making = threading.Lock()


def solid_from_geometry(geometry: Geometry, triangles: bool = False) -> Solid:
    """Return the solid of a geometry."""
    import_coal()
    if not isinstance(geometry, Mesh):
        return _primitive_solid(geometry)
    scale = tuple(map(float, geometry.scale))
    if not all(math.isfinite(factor) and factor for factor in scale):
        raise InvalidValueError(f"its scale is {scale}: factors are finite and not 0.")
    file = find_mesh_file(geometry)
    key = (file.digest, file.kind, scale, triangles)
    with _making:
        if key not in _by_content:
            _by_content[key] = _from_file(file, np.array(scale), triangles)
        return _by_content[key]


def solid_from_points(points: Floats) -> Solid:
    """Return the solid of the convex hull of (n, 3) points [m]."""
    import_coal()
    key = ("hull", points.tobytes())
    with _making:
        if key not in _by_content:
            _by_content[key] = _hull_solid(points)
        return _by_content[key]


@lru_cache(maxsize=4096)
def scale_solid(solid: Solid, factor: float) -> Solid:
    """Return a convex solid scaled by a factor, with its bounding radius scaled by the same factor."""
    if isinstance(solid.surface, Hull):
        assert solid.core is not None
        made = _hull_solid(factor * solid.core.corners.T)
    else:
        assert not isinstance(solid.surface, Faces)
        sizes = [factor * size for size in _sizes(solid.surface)]
        made = _of_primitive(_resize_primitive(solid.surface, sizes))
    return replace(made, radius=factor * solid.radius)


def thicken_primitive(solid: Solid, ratio: float) -> tuple[Solid, float]:
    """Return a primitive that contains another one, with no size below a part of the largest one.

    Further, by how much it has grown at most [m].
    """
    assert not isinstance(solid.surface, Hull | Faces)
    sizes = _sizes(solid.surface)
    least = ratio * max(sizes)
    grown = [max(size, least) for size in sizes]
    if tuple(grown) == sizes:
        return solid, 0.0
    return _of_primitive(_resize_primitive(solid.surface, grown)), least * math.sqrt(len(sizes))


def import_coal() -> Any:
    """Import coal and return it."""
    try:
        import coal
    except ImportError as error:
        raise MissingDependencyError(f"distances need coal: {install_command('geometry')}") from error
    return coal


def _from_file(file: MeshFile, scale: Floats, triangles: bool) -> Solid:
    if not triangles:
        return _solid_of_hull(_find_hull(_hull_corners(file, scale)))
    mesh = read_faces(file)
    vertices = mesh.vertices * scale
    check_extent(vertices)
    return _triangle_solid(vertices, mesh.faces[:, ::-1] if np.prod(scale) < 0 else mesh.faces)


def _hull_corners(file: MeshFile, scale: Floats) -> Floats:
    """Return the sorted corners (n, 3) of the hull of a mesh [m].

    They are kept on the disk, since to import trimesh takes longer than to build a whole scene.
    """
    content = repr((_HULL_VERSION, file.digest, file.kind, scale.tolist())).encode()
    key = hashlib.sha256(content).hexdigest()[:40]
    corners = _MESH_HULLS.read(key, _parse_corners) if file.kind in _WHOLE_FILES else None
    if corners is None:
        mesh = read_faces(file)
        corners = np.unique(convex_hull((mesh.vertices * scale)[np.unique(mesh.faces)]).points(), axis=0)
        if file.kind in _WHOLE_FILES:
            _MESH_HULLS.write(key, corners.astype("<f8").tobytes())
    return corners


def _parse_corners(content: bytes) -> Floats:
    try:
        return np.frombuffer(content, dtype="<f8").reshape(-1, 3)
    except ValueError as error:
        raise FormatError("These are not corners.") from error


def _hull_solid(points: Floats) -> Solid:
    return _solid_of_hull(convex_hull(points))


def _solid_of_hull(convex: Any) -> Solid:
    corners = np.array(convex.points())
    low, high = corners.min(axis=0), corners.max(axis=0)
    surface = Hull(np.array(convex.normals()), -np.array(convex.offsets()).reshape(-1))
    return _solid_around(
        convex, surface, (low + high) / 2, (high - low) / 2, corners, Core.from_corners(corners)
    )


def _triangle_solid(vertices: Floats, faces: Integers) -> Solid:
    faces = _drop_degenerate(vertices, faces)
    bvh = build_bvh(vertices, faces)
    used = vertices[np.unique(faces)]
    low, high = used.min(axis=0), used.max(axis=0)
    return _solid_around(bvh, Faces(vertices, faces), (low + high) / 2, (high - low) / 2, used)


def build_bvh(vertices: Floats, faces: Integers) -> Any:
    """Return a bounding volume hierarchy of coal over triangles."""
    bvh = import_coal().BVHModelOBBRSS()
    bvh.beginModel(len(faces), len(vertices))
    bvh.addVertices(np.ascontiguousarray(vertices))
    bvh.addTriangles(np.ascontiguousarray(faces))
    bvh.endModel()
    return bvh


def _drop_degenerate(vertices: Floats, faces: Integers) -> Integers:
    """Return the triangles that are not lines or points, with which coal reports contacts everywhere."""
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    longest = np.max([((p - q) ** 2).sum(axis=1) for p, q in ((a, b), (b, c), (c, a))], axis=0)
    has_area = np.linalg.norm(np.cross(b - a, c - a), axis=1) > 1e-14 * longest
    if not has_area.any():
        raise InvalidValueError("all its triangles are lines or points, so that there is nothing to touch.")
    return np.asarray(faces[has_area])


def _solid_around(
    engine: Any, surface: Hull | Faces, centre: Floats, half: Floats, points: Floats, core: Core | None = None
) -> Solid:
    engine.computeLocalAABB()
    radius = float(np.linalg.norm(points - centre, axis=1).max())
    return Solid(engine, surface, centre, half, radius, core=core)


@lru_cache(maxsize=65536)
def _primitive_solid(geometry: Primitive) -> Solid:
    sizes = _sizes(geometry)
    if not all(math.isfinite(size) and size > 0.0 for size in sizes):
        raise InvalidValueError(f"{geometry} has sizes that are not positive numbers [m].")
    if not all(SMALLEST_SIZE <= size <= LARGEST_SIZE for size in sizes):
        raise InvalidValueError(
            f"{geometry} has sizes beyond {SMALLEST_SIZE:g} m to {LARGEST_SIZE:g} m, which cannot be right."
        )
    return _of_primitive(geometry)


def _of_primitive(geometry: Primitive) -> Solid:
    coal = import_coal()
    stand_in = core = None
    x, y, z = (*_sizes(geometry), 0.0, 0.0)[:3]
    if isinstance(geometry, Box):
        engine, half = coal.Box(x, y, z), (x / 2, y / 2, z / 2)
        radius = math.hypot(*half)
        core = Core(np.array(half))
    elif isinstance(geometry, Sphere):
        engine, half, radius = coal.Sphere(x), (x, x, x), x
        # For a sphere whose centre is inside of a cylinder, coal considers only the wall and not the ends.
        stand_in = coal.Capsule(x, 0.0)
        stand_in.computeLocalAABB()
        core = Core(np.zeros(3), x)
    elif isinstance(geometry, Ellipsoid):
        engine, half, radius = coal.Ellipsoid(x, y, z), (x, y, z), max(x, y, z)
        core = Core(np.zeros(3), radii=np.array([x, y, z]))
    elif isinstance(geometry, Capsule):
        engine, half, radius = coal.Capsule(x, y), (x, x, x + y / 2), x + y / 2
        core = Core(np.array([0.0, 0.0, y / 2]), x)
    elif isinstance(geometry, Cylinder):
        engine, half, radius = coal.Cylinder(x, y), (x, x, y / 2), math.hypot(x, y / 2)
        core = Core(np.array([0.0, 0.0, y / 2]), radii=np.array([x, x, 0.0]))
    else:
        engine, half, radius = coal.Cone(x, y), (x, x, y / 2), math.hypot(x, y / 2)
        core = Core(np.zeros(3), radii=np.array([x, x, 0.0]), tip=y / 2)
    engine.computeLocalAABB()
    return Solid(engine, geometry, np.zeros(3), np.array(half), radius, stand_in, core)


SMALLEST_SIZE, LARGEST_SIZE = 1e-7, 1e6
"""Smallest and largest size of a primitive; beyond them a size is taken for a mistake [m]."""


def _resize_primitive(geometry: Primitive, sizes: Sequence[float]) -> Primitive:
    if isinstance(geometry, Box | Ellipsoid):
        x, y, z = sizes
        return type(geometry)((x, y, z))
    return type(geometry)(*sizes)


def _sizes(geometry: Primitive) -> tuple[float, ...]:
    try:
        if isinstance(geometry, Box | Ellipsoid):
            x, y, z = geometry.size if isinstance(geometry, Box) else geometry.radii
            return (float(x), float(y), float(z))
        if isinstance(geometry, Sphere):
            return (float(geometry.radius),)
        if isinstance(geometry, Cylinder | Capsule | Cone):
            return (float(geometry.radius), float(geometry.length))
    except (TypeError, ValueError) as error:
        raise InvalidValueError(f"{geometry} has sizes that are not positive numbers [m].") from error
    raise InvalidValueError(f"{geometry!r} is not a geometry of a body.")


def solid_surface(solid: Solid) -> Faces | Primitive:
    """Return the surface of a solid: its primitive, or triangles that face outwards."""
    return hull_faces(solid.engine) if isinstance(solid.surface, Hull) else solid.surface


def hull_faces(convex: Any) -> Faces:
    """Return the triangles of a ``coal.Convex``, counter-clockwise seen from outside."""
    vertices = np.array(convex.points())
    triangles = [convex.polygons(k) for k in range(convex.num_polygons)]
    faces = np.array([[triangle[0], triangle[1], triangle[2]] for triangle in triangles], dtype=np.int64)
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), np.array(convex.normals())) < 0.0
    faces[inward] = faces[inward][:, ::-1]
    return Faces(vertices, faces)


def enclosed_volume(vertices: Floats, faces: Integers) -> float:
    """Return the volume that triangles enclose, positive if they are counter-clockwise from outside [m³]."""
    a, b, c = (vertices[faces[:, k]] - vertices[faces[0, 0]] for k in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)


def sample_inside(corners: Floats, faces: Integers, middle: Floats, count: int) -> Floats:
    """Return evenly spread points (n, 3) of the tetrahedra between triangles (F, 3) and a point [m]."""
    edges = corners[faces] - middle
    shares = np.cumsum(np.abs(np.linalg.det(edges)))
    places = (np.arange(count) + 0.5) / count
    chosen = edges[np.minimum(np.searchsorted(shares / shares[-1], places), len(edges) - 1)]
    # Weights of the corners of each tetrahedron, from a sequence that fills the cube.
    weights = np.diff(np.sort(np.arange(count)[:, None] * _SEQUENCE % 1.0, axis=1), axis=1, prepend=0.0)
    return np.asarray(middle + np.einsum("nk,nkj->nj", weights, chosen))
