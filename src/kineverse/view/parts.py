"""What there is to draw: the shapes of all bodies, as triangles in the frames they move with."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from kineverse.model.body import Mesh, Shape
from kineverse.model.view import ModelView
from kineverse.view.meshes import load
from kineverse.view.primitives import triangles_of
from kineverse.view.triangles import Triangles

Kind = Literal["visual", "collision"]
Rgba = tuple[float, float, float, float]

MISSING: Rgba = (0.91, 0.12, 0.55, 1.0)
"""The colour of what could not be loaded: one that no kitchen has."""

COLLISION: Rgba = (0.95, 0.55, 0.15, 0.35)

UNPAINTED: tuple[Rgba, ...] = (
    (0.72, 0.74, 0.77, 1.0),
    (0.58, 0.66, 0.75, 1.0),
    (0.80, 0.74, 0.64, 1.0),
    (0.63, 0.71, 0.62, 1.0),
    (0.76, 0.66, 0.66, 1.0),
)
"""Colours of bodies that have none: muted, and different enough to tell neighbours apart."""


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """One shape of one body.

    Attributes
    ----------
    frame
        The frame it moves with.
    surface
        Its triangles in that frame [m].
    color
        Red, green, blue, alpha in [0, 1]; where the surface brings colours of its own, they count.
    kind
        Whether it is there to be seen or to be touched.
    problem
        Why it is a placeholder; empty if it is not.
    """

    frame: str
    surface: Triangles
    color: Rgba
    kind: Kind
    problem: str = ""


def parts(model: ModelView, kind: Kind = "visual") -> list[Part]:
    """Return everything a model has to show, in the order of its bodies.

    Parameters
    ----------
    model
        The model.
    kind
        ``"visual"``: what is meant to be seen; of a model where nothing is, the collision shapes.
        ``"collision"``: what is meant to be touched.
    """
    found: list[Part] = []
    for number, (frame, body) in enumerate(model.bodies.items()):
        shapes = body.visuals if kind == "visual" else body.collisions
        fallback = UNPAINTED[number % len(UNPAINTED)] if kind == "visual" else COLLISION
        found.extend(_part(frame, shape, kind, fallback) for shape in shapes)
    if not found and kind == "visual":
        for number, (frame, body) in enumerate(model.bodies.items()):
            fallback = UNPAINTED[number % len(UNPAINTED)]
            found.extend(_part(frame, shape, "visual", fallback) for shape in body.collisions)
    return found


def _part(frame: str, shape: Shape, kind: Kind, fallback: Rgba) -> Part:
    problem, surface = "", triangles_of(shape.geometry)
    if isinstance(shape.geometry, Mesh):
        problem = load(shape.geometry).problem
    color = shape.color or fallback
    if problem:
        color = MISSING
    elif kind == "collision":
        surface, color = Triangles(surface.vertices, surface.faces, surface.normals), COLLISION
    elif shape.color is not None and surface.colors is not None:
        # A description that names a colour means it, as in RViz.
        surface = Triangles(surface.vertices, surface.faces, surface.normals, closed=surface.closed)
    return Part(frame, surface.moved(shape.origin.matrix), color, kind, problem)
