"""What there is to draw: the shapes of all bodies, as triangles in the frames they move with."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from kineverse.geometry.pieces import touchable
from kineverse.model.body import Body, Mesh, Shape
from kineverse.model.view import ModelView
from kineverse.view.geometry import triangles_of
from kineverse.view.hulls import load_hull, load_hulls
from kineverse.view.meshes import Loaded, load
from kineverse.view.triangles import Triangles

Kind = Literal["visual", "collision"]
Rgba = tuple[float, float, float, float]

MISSING: Rgba = (0.91, 0.12, 0.55, 1.0)
"""The colour of what could not be loaded: one that no kitchen has."""

COLLISION: Rgba = (0.95, 0.55, 0.15, 0.35)

STAND_IN: Rgba = (0.25, 0.62, 0.66, 0.35)
"""The colour of what stands for the collision shapes of a body that has none."""

SHADES = (1.0, 0.7, 0.85, 0.55)
"""How bright the hulls of one mesh are, in turns."""

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
        Red, green, blue, alpha in [0, 1]; colours that the surface brings count more, as in RViz.
    kind
        Whether it is there to be seen or to be touched.
    problem
        What could not be loaded, and why; empty if nothing.
    placeholder
        Whether the surface only marks the place of what could not be loaded.
    """

    frame: str
    surface: Triangles
    color: Rgba
    kind: Kind
    problem: str = ""
    placeholder: bool = False


def parts(model: ModelView, kind: Kind = "visual", decomposed: bool = False) -> list[Part]:
    """Return everything a model has to show, in the order of its bodies.

    Parameters
    ----------
    model
        The model.
    kind
        ``"visual"``: what is meant to be seen; of a model where nothing is, the collision shapes.
        ``"collision"``: what is meant to be touched, or of a body without it, what is seen; meshes as the
        hulls that distances are computed to.
    decomposed
        Whether meshes to be touched are the hulls that they were decomposed into, as far as they were.
    """
    found: list[Part] = []
    bare = kind == "visual" and not any(body.visuals for body in model.bodies.values())
    for number, (frame, body) in enumerate(model.bodies.items()):
        if kind == "collision":
            color = COLLISION if body.collisions else STAND_IN
            for shape in touchable(body):
                found += _touched(frame, shape, color, decomposed)
            continue
        fallback = UNPAINTED[number % len(UNPAINTED)]
        shapes = body.collisions if bare else body.visuals
        found += _instead([_part(frame, shape, "visual", fallback) for shape in shapes], body, fallback)
    return found


def _instead(visuals: list[Part], body: Body, color: Rgba) -> list[Part]:
    """Return the visual parts of a body, or its collision shapes if no visual one could be loaded.

    Descriptions are often passed on with the small collision meshes only; those show a robot well enough.
    """
    if not visuals or not all(part.placeholder for part in visuals):
        return visuals
    frame, problem = visuals[0].frame, visuals[0].problem
    touched = [_part(frame, shape, "visual", color) for shape in body.collisions]
    touched = [part for part in touched if not part.placeholder]
    return [replace(touched[0], problem=problem), *touched[1:]] if touched else visuals


def _part(frame: str, shape: Shape, kind: Kind, fallback: Rgba) -> Part:
    surface, problem, color = triangles_of(shape.geometry), "", shape.color or fallback
    if isinstance(shape.geometry, Mesh):
        problem = load(shape.geometry).problem
    if problem:
        color = MISSING
    return Part(frame, surface.moved(shape.origin.matrix), color, kind, problem, bool(problem))


def _touched(frame: str, shape: Shape, color: Rgba, decomposed: bool) -> list[Part]:
    if not isinstance(shape.geometry, Mesh):
        loaded = [Loaded(triangles_of(shape.geometry))]
    else:
        loaded = load_hulls(shape.geometry) if decomposed else [load_hull(shape.geometry)]
    found = []
    for number, (surface, problem) in enumerate((one.surface, one.problem) for one in loaded):
        own = MISSING if problem else _shaded(color, number)
        placed = surface.unpainted().moved(shape.origin.matrix)
        found.append(Part(frame, placed, own, "collision", problem, bool(problem)))
    return found


def _shaded(color: Rgba, number: int) -> Rgba:
    """Return a colour that tells a hull from its neighbours; that of the first is the colour itself."""
    red, green, blue, alpha = color
    factor = SHADES[number % len(SHADES)]
    return (factor * red, factor * green, factor * blue, alpha)
