"""Mass, centre of mass and inertia of a part from the shapes that are seen of it.

A part that is a shell in reality has a material whose density is that of the shell as a whole.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from math import cos, pi, sin

from shapes import Material, Shape, Vector


def mass_properties(
    shapes: Iterable[Shape], materials: Mapping[str, Material]
) -> tuple[float, Vector, list[list[float]]]:
    """Return mass [kg], centre of mass [m] and inertia about it [kg m^2], in the axes of the link."""
    solids = [(s, _volume(s) * materials[s.material].density) for s in shapes if s.seen]
    mass = sum(m for _, m in solids)
    centre = tuple(sum(m * s.at[i] for s, m in solids) / mass for i in range(3))
    total = [[0.0] * 3 for _ in range(3)]
    for shape, m in solids:
        principal, turn = _unit_inertia(shape), _rotation(shape.rpy)
        d = [shape.at[i] - centre[i] for i in range(3)]
        for i in range(3):
            for j in range(3):
                own = sum(turn[i][k] * principal[k] * turn[j][k] for k in range(3))
                steiner = (sum(e * e for e in d) if i == j else 0.0) - d[i] * d[j]
                total[i][j] += m * (own + steiner)
    return mass, centre, total


def _volume(shape: Shape) -> float:
    if shape.kind == "box":
        return shape.size[0] * shape.size[1] * shape.size[2]
    if shape.kind == "cylinder":
        return pi * shape.size[0] ** 2 * shape.size[1]
    return 4 / 3 * pi * shape.size[0] ** 3


def _unit_inertia(shape: Shape) -> Vector:
    if shape.kind == "box":
        x, y, z = (e * e / 12 for e in shape.size)
        return (y + z, x + z, x + y)
    if shape.kind == "cylinder":
        r, h = shape.size
        across = r * r / 4 + h * h / 12
        return (across, across, r * r / 2)
    return (0.4 * shape.size[0] ** 2,) * 3


def _rotation(rpy: Vector) -> list[list[float]]:
    (sr, cr), (sp, cp), (sy, cy) = ((sin(a), cos(a)) for a in rpy)
    return [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
