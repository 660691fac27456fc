"""Checks of single bodies: inertia, centre of mass, density, and meshes that are inside out."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator

import numpy as np

from kineverse.errors import FormatError, InvalidValueError, list_some
from kineverse.expressions.printing import format_number
from kineverse.formats.validate import find_inertia_errors
from kineverse.geometry.decomposition.accuracy import is_closed
from kineverse.geometry.mesh_files import Faces, Integers, read_mesh
from kineverse.geometry.shapes import enclosed_volume
from kineverse.model.body import Body, Inertia, Mesh

from .moving_parts import MovingParts
from .part_shape import PartShape
from .report import MotionFinding, Severity, format_length

OUTSIDE = 0.25  # distance of a centre of mass from the hull of its shapes, in their size, that is too large

HEAVIEST = 23000.0  # largest density [kg/m³]: that of osmium is 22 600

LIGHTEST = 1.2
"""Least density [kg/m³]: that of air. It is the mass over the hull, which includes all hollows."""

THINNEST = 1e-3  # thickness below which a shape is drawn without any, and its volume says nothing [m]


def check_bodies(
    parts: MovingParts, names: Iterable[str], are_certain: bool, joint: str = ""
) -> Iterator[MotionFinding]:
    """Yield what is wrong about the inertias and meshes of bodies; what several have in common, once.

    Without certainty, as about links of a robot, a centre of mass outside is a suspect.
    """
    found: dict[tuple[str, Severity], list[MotionFinding]] = {}
    for name in names:
        for entry in _check_body(parts, name, are_certain, joint):
            found.setdefault((entry.kind, entry.severity), []).append(entry)
    for entries in found.values():
        first, bodies = entries[0], tuple(body for entry in entries for body in entry.bodies)
        text = f"'{first.bodies[0]}' {first.text}"
        if len(entries) > 1:
            text += f"; the like is true of {list_some((repr(body) for body in bodies[1:]), 3)}"
        yield MotionFinding(
            first.kind, first.severity, text, bodies, joint, first.value, first.limit, first.unit
        )


def _check_body(parts: MovingParts, name: str, is_certain: bool, joint: str) -> Iterator[MotionFinding]:
    body = parts.model.bodies[name]
    if body.inertia is not None:
        for text in find_inertia_errors(body.inertia):
            yield MotionFinding("impossible_inertia", "finding", f"has {text}", (name,), joint)
        if name in parts.solid_bodies and body.inertia.mass > 0.0:
            yield from _check_mass(parts, name, body.inertia, is_certain, joint)
    for mesh in _meshes(body):
        if is_inside_out(mesh):
            text = f"has the mesh {mesh.uri}, whose triangles face inwards"
            yield MotionFinding("inside_out", "finding", text, (name,), joint)


def _meshes(body: Body) -> list[Mesh]:
    """Return the meshes of a body, each once."""
    shapes = (*body.visuals, *body.collisions)
    return list(dict.fromkeys(s.geometry for s in shapes if isinstance(s.geometry, Mesh)))


def _check_mass(
    parts: MovingParts, name: str, inertia: Inertia, is_certain: bool, joint: str
) -> Iterator[MotionFinding]:
    if not any(_compare(parts, inertia, parts.body_shape(name), is_certain)):
        return
    # What collides is often less than what is there. The meshes that are drawn are read only now.
    shape = parts.whole_shape(name)
    if shape is None:
        text = f"'{name}' has mass, and some of its shapes are missing"
        yield MotionFinding("missing_shapes", "cannot_say", text, (name,), joint)
        return
    for kind, severity, text, value, limit, unit in _compare(parts, inertia, shape, is_certain):
        yield MotionFinding(kind, severity, text, (name,), joint, value, limit, unit)


def _compare(
    parts: MovingParts, inertia: Inertia, shape: PartShape, is_certain: bool
) -> Iterator[tuple[str, Severity, str, float, float, str]]:
    """Yield what the mass of a body and its shape do not agree in."""
    center = inertia.origin.matrix[:3, 3]
    outside = shape.distance_to(center)
    if outside > OUTSIDE * shape.size:
        text = f"has its centre of mass {format_length(outside)} outside of its shapes"
        severity: Severity = "finding" if is_certain else "suspect"
        yield "center_of_mass_outside", severity, text, outside, OUTSIDE * shape.size, "m"
        return
    if parts.is_normalized:
        return
    ixx, ixy, ixz, iyy, iyz, izz = inertia.tensor
    largest = float(np.linalg.eigvalsh([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]])[-1])
    gyration = math.sqrt(max(largest, 0.0) / inertia.mass)
    # No part of the mass is further from an axis through its centre than the farthest point of the shapes.
    farthest = float(np.linalg.norm(shape.points - center, axis=1).max())
    if gyration > farthest:
        within = format_length(farthest)
        text = f"has a radius of gyration of {format_length(gyration)}, and no shape beyond {within}"
        yield "inertia_too_large", "suspect", text, gyration, farthest, "m"
    if shape.hull is None or shape.thickness < THINNEST:
        return
    density = inertia.mass / shape.hull.volume
    if not LIGHTEST <= density <= HEAVIEST:
        text = f"has {format_number(inertia.mass, 3)} kg, a density of {format_number(density, 3)} kg/m³"
        limit = HEAVIEST if density > HEAVIEST else LIGHTEST
        yield "wrong_density", "suspect", text, density, limit, "kg/m³"


def is_inside_out(mesh: Mesh) -> bool:
    """Return True if the triangles of a closed mesh face inwards as its file has them.

    A negative scale mirrors a mesh on purpose, and readers turn its triangles around, so the scale does not
    count. Open surfaces have no inside. Corners at one place count as one, as STL has no others. A mesh that
    cannot be read is another matter.
    """
    try:
        mesh_faces = read_mesh(mesh)
    except (FormatError, InvalidValueError, OSError):
        return False
    if enclosed_volume(mesh_faces.vertices, mesh_faces.faces) >= 0.0:
        return False
    merged = _merge_corners(mesh_faces)
    return bool(len(merged)) and is_closed(merged)


def _merge_corners(mesh: Faces) -> Integers:
    """Return the triangles with one number for equal corners, without those that are lines or points."""
    _, number = np.unique(mesh.vertices, axis=0, return_inverse=True)
    triangles = number.reshape(-1)[mesh.faces]
    a, b, c = triangles.T
    return np.asarray(triangles[(a != b) & (b != c) & (c != a)])
