"""Which coordinates of a model are quaternions that move by an angular velocity."""

from __future__ import annotations

from collections.abc import Iterator

from kineverse.articulations.free_joints import orientation
from kineverse.expressions.expression import Expression
from kineverse.model.view import ModelView
from kineverse.spatial import quaternion

_X = "/qx"


def quaternions(model: ModelView) -> Iterator[tuple[str, Expression]]:
    """Yield names and rotations of coordinates ``name/qx`` ... ``name/qw`` with q̇ = ½ q ⊗ (ω, 0)."""
    rates = model.rates
    for coordinate in rates:
        if not coordinate.path.endswith(_X):
            continue
        name = coordinate.path.removesuffix(_X)
        usual = orientation(name)
        if all(x in rates and rates[x] == row for x, row in usual.rates.items()):
            yield name, quaternion(*usual.coordinates)
