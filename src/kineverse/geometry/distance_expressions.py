"""Signed distances as expressions.

Let the nearest points be fixed in their bodies, at a_p and b_p, and let n be the normal from a to b, fixed in
the world. Then

    d = nᵀ (world_T_b b_p - world_T_a a_p)

equals the signed distance at the state of the query, and so do its derivatives by all coordinates: by the
envelope theorem, neither the sliding of the points along the surfaces nor the rotation of n contributes to
first order. In penetration d is negative and n keeps its direction, so the gradient is continuous at contact.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from kineverse.expressions import Expression, array
from kineverse.model.model_view import ModelView
from kineverse.symbols import Symbol, parameter

from .mesh_files import Floats
from .results import DistanceResult

_ROWS = ("point_a", "point_b", "normal")


@dataclass(frozen=True, eq=False)
class PairDistance:
    """Signed distance of two bodies as an expression of the coordinates that move them.

    Attributes
    ----------
    expression
        The signed distance [m], a scalar. Value and gradient are exact for up-to-date parameters.
    point_a, point_b
        The nearest points in the world, (3,) [m], fixed in their bodies: expressions of the same coordinates.
    normal
        The unit normal from a to b in the world, (3,): an expression of parameters only.
    parameters
        (3, 3) symbols: the nearest point of a in a, the nearest point of b in b, and the normal in the world.
        Their default values are those at the state of construction.

    See Also
    --------
    kineverse.geometry.Scene.expression
    """

    a: str
    b: str
    expression: Expression
    point_a: Expression
    point_b: Expression
    normal: Expression
    parameters: tuple[tuple[Symbol, ...], ...]

    def values(self, closest: DistanceResult, world_T_a: Floats, world_T_b: Floats) -> dict[Symbol, float]:
        """Return the values of the parameters at a state.

        Parameters
        ----------
        closest
            Distance of the two bodies at the state.
        world_T_a, world_T_b
            (4, 4) poses of the two bodies at the state.
        """
        rows = _parameter_rows(closest, world_T_a, world_T_b)
        return {
            symbol: float(value)
            for symbols, row in zip(self.parameters, rows, strict=True)
            for symbol, value in zip(symbols, row, strict=True)
        }


DistanceParameters = tuple[tuple[Symbol, ...], ...]


def distance_parameters(
    model: ModelView, closest: DistanceResult, world_T_a: Floats, world_T_b: Floats
) -> DistanceParameters:
    """Return symbols for the nearest points and the normal of two bodies.

    Symbols that the model already contains are reused; new ones have the present values as defaults.
    """
    known = {symbol.path: symbol for symbol in model.symbols}
    path = f"distance/{_escape_to(closest.a)}/to/{_escape_to(closest.b)}"
    result = []
    for name, row in zip(_ROWS, _parameter_rows(closest, world_T_a, world_T_b), strict=True):
        values = {f"{path}/{name}/{axis}": value for axis, value in zip("xyz", row.tolist(), strict=True)}
        result.append(tuple(known[p] if p in known else parameter(p, v) for p, v in values.items()))
    return tuple(result)


def distance_expression(model: ModelView, a: str, b: str, parameters: DistanceParameters) -> PairDistance:
    """Return the distance of two bodies as an expression of a model's coordinates."""
    a_p, b_p, normal = (array(list(row)) for row in parameters)
    world_T_a, world_T_b = model.fk(a), model.fk(b)
    point_a = world_T_a[:3, :3] @ a_p + world_T_a[:3, 3]
    point_b = world_T_b[:3, :3] @ b_p + world_T_b[:3, 3]
    return PairDistance(a, b, normal @ (point_b - point_a), point_a, point_b, normal, parameters)


def _escape_to(body: str) -> str:
    """Return a body's name with its parts ``to`` escaped, as ``to`` separates two names; it is injective."""
    return re.sub(r"(^|/)(to_*)(?=/|$)", r"\1\2_", body)


def _parameter_rows(
    closest: DistanceResult, world_T_a: Floats, world_T_b: Floats
) -> tuple[Floats, Floats, Floats]:
    point_a = world_T_a[:3, :3].T @ (closest.point_a - world_T_a[:3, 3])
    point_b = world_T_b[:3, :3].T @ (closest.point_b - world_T_b[:3, 3])
    return np.asarray(point_a), np.asarray(point_b), closest.normal
