"""A limited norm as flat rows: the polygon inscribed in the circle, the polyhedron in the sphere."""

from __future__ import annotations

import math

import casadi as ca

from kineverse.expressions.expression import Expression
from kineverse.expressions.kinks import Norm

SIDES = 16


def components_of(expression: Expression) -> tuple[float, list[Expression]] | None:
    """Return factor and components of ``factor·norm(components)``, None if it is something else."""
    if len(expression._nodes) != 1:
        return None
    (node,) = expression._nodes
    if not isinstance(node, Norm):
        return None
    factor = ca.jacobian(expression._sx, node.sx)
    rest = ca.simplify(ca.substitute(expression._sx, node.sx, 0))
    if not factor.is_constant() or not float(factor) > 0 or not rest.is_zero():
        return None
    return float(factor), list(node.arguments[0])


def directions(dimensions: int) -> list[tuple[float, ...]]:
    """Return the normals of a regular polygon, or of its faces turned about to cover a sphere.

    The nearest normal is at most at half a step from any direction in the plane, π/16, and at half a step in
    latitude and in longitude in space. So the cosine between the two is at least :func:`inner_radius`: a
    polyhedron at that distance from 0 lies inside the unit sphere.
    """
    if dimensions == 1:
        return [(1.0,), (-1.0,)]
    step = 2 * math.pi / SIDES
    ring = [(math.cos(a), math.sin(a)) for a in (step * (k + 0.5) for k in range(SIDES))]
    if dimensions == 2:
        return list(ring)
    latitudes = [step * (k + 0.5) for k in range(-SIDES // 4, SIDES // 4)]
    return [(x * math.cos(b), y * math.cos(b), math.sin(b)) for b in latitudes for x, y in ring]


def inner_radius(dimensions: int) -> float:
    """Return the radius of the ball inside the body that has these directions, and whose corners touch 1."""
    return math.cos(math.pi / SIDES) ** (dimensions - 1)
