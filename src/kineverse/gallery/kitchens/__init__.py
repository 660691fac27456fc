"""Kitchens generated from seeds, loaded by number.

>>> import kineverse as kv
>>> model = kv.load("kitchens/17")
>>> model.degrees_of_freedom[:2]
(kitchen/base_1_door, kitchen/base_1_drawer)

A seed is any whole number that is not negative. It gives the same kitchen everywhere: 8 to 14 doors, drawers
and flaps, with bar handles, in one row or two at an aisle of 1.0 to 1.6 m. The middle of the aisle is the
origin, z is up. Nothing touches anything while all is shut, or while any one of the objects opens.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from kineverse.errors import UnknownNameError
from kineverse.gallery import LONGEST_SEED, is_seed
from kineverse.model.model import Model
from kineverse.model.operation import Operation

from .builder import KitchenBuilder, draw_style
from .layout import draw_layout
from .room import add_countertop, add_room
from .units import add_base_unit, add_tall_unit, add_wall_unit

__all__ = ["example_seeds", "generate_kitchen", "kitchen_operations"]

_EXAMPLES = 10


def generate_kitchen(seed: int, prefix: str | None = "kitchen") -> Model:
    """Generate a kitchen.

    Parameters
    ----------
    seed
        Whole number that is not negative.
    prefix
        Prefix of the names of frames, articulations and coordinates, without the slash; None for none.

    Raises
    ------
    UnknownNameError
        If the seed is no such number.
    """
    model = Model()
    with model.edit() as edit:
        for operation in kitchen_operations(str(seed), prefix):
            edit.apply(operation)
    return model


def example_seeds() -> tuple[str, ...]:
    """Return the first seeds, as examples."""
    return tuple(map(str, range(_EXAMPLES)))


def kitchen_operations(name: str, prefix: str | None = None) -> Iterator[Operation]:
    """Yield the operations of a kitchen.

    Parameters
    ----------
    name
        Its seed.
    prefix
        Prefix of the names, without the slash.
    """
    if not is_seed(name):
        raise UnknownNameError(
            f"There is no kitchen {name!r}: a kitchen is named by its seed, a whole number from 0 on with at "
            f"most {LONGEST_SEED} digits, such as 'kitchens/17'."
        )
    rng = np.random.default_rng(int(name))
    kitchen = KitchenBuilder(prefix, draw_style(rng))
    layout = draw_layout(rng)
    for number, (row, frame) in enumerate(zip(layout.rows, add_room(kitchen, layout), strict=True)):
        for unit in row.tall:
            add_tall_unit(kitchen, rng, unit, frame)
        for unit in row.base:
            add_base_unit(kitchen, rng, unit, frame)
        for unit in row.wall:
            add_wall_unit(kitchen, rng, unit, frame)
        add_countertop(kitchen, row, frame, layout.opposite if number else None)
    yield from kitchen.operations
