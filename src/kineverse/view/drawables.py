"""Drawable parts: visual shapes, collision hulls, frame axes, sphere covers, frame paths, ghosts."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import cycle
from typing import Literal

import numpy as np

from kineverse.errors import KineverseError
from kineverse.geometry import decomposition
from kineverse.geometry.exclusions import is_installed
from kineverse.geometry.mesh_files import Faces
from kineverse.geometry.objects import collision_shapes
from kineverse.geometry.shapes import Solid, solid_from_geometry, solid_from_points, solid_surface
from kineverse.lie import translation
from kineverse.model.body import Body, Box, Mesh, Shape, Sphere
from kineverse.model.model_view import ModelView
from kineverse.planning.spheres import SphereCover
from kineverse.state import State

from .meshes import LoadedMesh, load_mesh, mesh_geometry
from .poses import FramePoses, complete
from .rendering.triangle_mesh import Floats, TriangleMesh, build_creased_mesh


def load_hull(mesh: Mesh) -> LoadedMesh:
    """Return the convex hull of a mesh that distances are computed to [m], or the problem if there is none.

    Without the extra ``geometry``, or for a mesh without a hull, that is the mesh itself, or its placeholder.
    """
    return _load_hull(mesh, mesh.root)


@lru_cache(maxsize=4096)
def _load_hull(mesh: Mesh, root: str | None) -> LoadedMesh:
    """Return the hull of a mesh; the root is part of the key, since equal meshes may have different ones."""
    as_seen = load_mesh(mesh)
    if as_seen.problem or not is_installed():
        return as_seen
    try:
        return LoadedMesh(_mesh_hull(solid_from_geometry(mesh)))
    except (KineverseError, OSError) as error:
        return LoadedMesh(as_seen.surface, f"no distances: {error}")


def load_hulls(mesh: Mesh) -> list[LoadedMesh]:
    """Return the hulls that ``kineverse decompose`` computed for a mesh, else that of :func:`load_hull`."""
    if is_installed():
        with suppress(KineverseError, OSError):
            hulls = decomposition.find_hulls(mesh)
            if hulls is not None:
                return [LoadedMesh(_mesh_hull(solid_from_points(points))) for points in hulls]
    return [load_hull(mesh)]


def _mesh_hull(solid: Solid) -> TriangleMesh:
    surface = solid_surface(solid)
    assert isinstance(surface, Faces)  # no primitive is made of a mesh
    return build_creased_mesh(surface.vertices, surface.faces)[0]


Kind = Literal["visual", "collision"]
Rgba = tuple[float, float, float, float]

MISSING: Rgba = (0.91, 0.12, 0.55, 1.0)  # colour of placeholders: one that no kitchen has

COLLISION: Rgba = (0.95, 0.55, 0.15, 0.35)

STAND_IN: Rgba = (0.25, 0.62, 0.66, 0.35)  # colour of the collision shapes of a body that has none of its own
HULL_SHADES = (1.0, 0.7, 0.85, 0.55)  # brightness of the hulls of one mesh, in turns

UNPAINTED: tuple[Rgba, ...] = (
    (0.72, 0.74, 0.77, 1.0),
    (0.58, 0.66, 0.75, 1.0),
    (0.80, 0.74, 0.64, 1.0),
    (0.63, 0.71, 0.62, 1.0),
    (0.76, 0.66, 0.66, 1.0),
)
"""Colours of bodies without a colour: muted, and different enough to tell neighbours apart."""


@dataclass(frozen=True, slots=True, eq=False)
class Drawable:
    """Shape of a body, with its frame and colour."""

    frame: str  # frame it moves with
    surface: TriangleMesh  # its triangles in that frame [m]
    color: Rgba  # red, green, blue, alpha in [0, 1]; colours of the surface take precedence, as in RViz
    kind: Kind  # "visual" or "collision"
    problem: str = ""  # mesh that could not be loaded, and the reason; empty if there is none
    placeholder: bool = False  # True if the surface only marks the place of a mesh that could not be loaded


def collect_drawables(model: ModelView, kind: Kind = "visual", decomposed: bool = False) -> list[Drawable]:
    """Return all shapes of a model, in the order of its bodies."""
    found: list[Drawable] = []
    bare = kind == "visual" and not any(body.visuals for body in model.bodies.values())
    for number, (frame, body) in enumerate(model.bodies.items()):
        if kind == "collision":
            color = COLLISION if body.collisions else STAND_IN
            for shape in collision_shapes(body):
                found += _build_collision_drawables(frame, shape, color, decomposed)
            continue
        fallback = UNPAINTED[number % len(UNPAINTED)]
        shapes = body.collisions if bare else body.visuals
        found += _fall_back_to_collisions(
            [_build_drawable(frame, shape, "visual", fallback) for shape in shapes], body, fallback
        )
    return found


def _fall_back_to_collisions(visuals: list[Drawable], body: Body, color: Rgba) -> list[Drawable]:
    """Return the visual parts of a body, or its collision shapes if no visual one could be loaded.

    Descriptions are often passed on with the small collision meshes only; those show a robot well enough.
    """
    if not visuals or not all(part.placeholder for part in visuals):
        return visuals
    frame, problem = visuals[0].frame, visuals[0].problem
    touched = [_build_drawable(frame, shape, "visual", color) for shape in body.collisions]
    touched = [part for part in touched if not part.placeholder]
    return [replace(touched[0], problem=problem), *touched[1:]] if touched else visuals


def _build_drawable(frame: str, shape: Shape, kind: Kind, fallback: Rgba) -> Drawable:
    surface, problem, color = mesh_geometry(shape.geometry), "", shape.color or fallback
    if isinstance(shape.geometry, Mesh):
        problem = load_mesh(shape.geometry).problem
    if problem:
        color = MISSING
    return Drawable(frame, surface.transform(shape.origin.matrix), color, kind, problem, bool(problem))


def _build_collision_drawables(frame: str, shape: Shape, color: Rgba, decomposed: bool) -> list[Drawable]:
    if not isinstance(shape.geometry, Mesh):
        loaded = [LoadedMesh(mesh_geometry(shape.geometry))]
    else:
        loaded = load_hulls(shape.geometry) if decomposed else [load_hull(shape.geometry)]
    found = []
    red, green, blue, alpha = color
    for one, shade in zip(loaded, cycle(HULL_SHADES), strict=False):
        own = MISSING if one.problem else (shade * red, shade * green, shade * blue, alpha)
        placed = replace(one.surface, colors=None).transform(shape.origin.matrix)
        found.append(Drawable(frame, placed, own, "collision", one.problem, bool(one.problem)))
    return found


AXIS_COLORS = ((0.86, 0.16, 0.16, 1.0), (0.13, 0.62, 0.20, 1.0), (0.16, 0.33, 0.88, 1.0))


def choose_axis_length(corners: Floats, poses: Mapping[str, Floats]) -> float:
    """Return a length of axes for the size of a scene, in [0.02, 0.5] [m]."""
    origins = np.array([pose[:3, 3] for pose in poses.values()]).reshape(-1, 3)
    points = np.concatenate([corners.reshape(-1, 3), origins])
    spread = float(np.linalg.norm(points.max(axis=0) - points.min(axis=0))) if len(points) else 1.0
    return float(np.clip(0.05 * spread, 0.02, 0.5))


def create_axes(model: ModelView, corners: Floats, poses: Mapping[str, Floats]) -> list[Drawable]:
    """Return the axes of the world and all frames of a model, three bars each."""
    length = choose_axis_length(corners, poses)
    width = 0.07 * length
    bars = []
    for axis, color in enumerate(AXIS_COLORS):
        size = np.full(3, width)
        size[axis] = length
        shift = translation(0.5 * length * np.eye(3)[axis])
        bars.append((mesh_geometry(Box((size[0], size[1], size[2]))).transform(shift), color))
    return [Drawable(name, surface, color, "visual") for name in poses for surface, color in bars]


SPHERES: Rgba = (0.16, 0.47, 0.86, 0.3)  # colour of the spheres of a cover


def draw_cover(frame: str, cover: SphereCover) -> Drawable:
    """Return the spheres of a cover in a frame as one drawable."""
    return Drawable(frame, build_spheres(cover.centres, cover.radii), SPHERES, "collision")


def build_spheres(centres: Floats, radii: Floats) -> TriangleMesh:
    """Return the surfaces of spheres with centres (N, 3) and radii (N,) [m]."""
    unit = mesh_geometry(Sphere(1.0))
    count, size = len(centres), len(unit.vertices)
    vertices = centres[:, None] + radii[:, None, None] * unit.vertices
    return TriangleMesh(
        vertices.reshape(-1, 3),
        (unit.faces + size * np.arange(count)[:, None, None]).reshape(-1, 3),
        np.tile(unit.normals, (count, 1)),
        closed=True,
    )


TRACE: Rgba = (0.93, 0.42, 0.13, 1.0)  # colour of the way of a frame

_RADIUS, _OPACITY = 0.006, 0.3
_WORLD = "world"


def draw_frame_path(model: ModelView, frame: str, states: Iterable[State]) -> Drawable:
    """Return the origins of a frame at some states as small spheres."""
    poses = FramePoses(model, [frame])
    origins = np.array([poses.evaluate(complete(model, state))[0, :3, 3] for state in states])
    surface = build_spheres(origins, np.full(len(origins), _RADIUS))
    return Drawable(_WORLD, surface, TRACE, "visual")


def draw_ghosts(model: ModelView, bodies: Sequence[str], states: Iterable[State]) -> list[Drawable]:
    """Return translucent visual shapes of some bodies at some states."""
    parts = [part for part in collect_drawables(model) if part.frame in bodies]
    poses = FramePoses(model, bodies)
    found = []
    for state in states:
        world_T = dict(zip(bodies, poses.evaluate(complete(model, state)), strict=True))
        for part in parts:
            surface = replace(part.surface.transform(world_T[part.frame]), colors=None)
            found.append(replace(part, frame=_WORLD, surface=surface, color=(*part.color[:3], _OPACITY)))
    return found
