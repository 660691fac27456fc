"""Room of a kitchen: floor, walls, countertops with sink and hob."""

from __future__ import annotations

from kineverse.articulations.mechanisms.mechanism import shift
from kineverse.model.body import Pose
from kineverse.model.frame import WORLD

from .builder import (
    BAR,
    CLEAR,
    FLOOR,
    GLASS,
    PLASTER,
    PLINTH,
    STEEL,
    TILE,
    KitchenBuilder,
    Material,
    MaterialShape,
    Span,
    cylinder_between,
    open_box,
    slab,
)
from .layout import KitchenLayout, Opposite, Row, Unit
from .units import BACK, DEPTH

ROOM = "room"  # frame on the floor, in the middle of the aisle; y along the rows
_OVERHANG = 0.035  # end of a countertop before the fronts' plane [m]
_ISLAND_BACK = 0.75
_BASIN_X, _BASIN_DEPTH = (-0.47, -0.11), 0.17
_WHEEL_ROOM = 0.01  # depth of the floor's collision shape below what is seen [m], for wheels at height 0
_CEILING, _PARAPET, _SIDE_WALKWAY = 2.45, 1.1, 0.3


def add_room(kitchen: KitchenBuilder, layout: KitchenLayout) -> list[str]:
    """Add floor, walls and the frames of the rows, and return these.

    The frame of a row is on the floor in the plane of its fronts: x into the aisle, z up.
    """
    half = layout.aisle / 2
    reach = max(max(map(abs, row.length)) for row in layout.rows) + _SIDE_WALKWAY
    y: Span = (-reach, reach)
    far = {"row": half + BACK, "island": half + 1.6, "wall": half}[layout.opposite]
    kitchen.fixed(ROOM, WORLD, shift())
    floor = slab((-far - 0.1, half + BACK + 0.1), y, (-0.06, -_WHEEL_ROOM), FLOOR)
    surface = slab((-far - 0.1, half + BACK + 0.1), y, (-_WHEEL_ROOM, -0.0005), FLOOR)
    kitchen.fixed("floor", ROOM, shift(), [floor], [surface])
    _add_wall(kitchen, "room_wall_1", (half + BACK, half + BACK + 0.1), y, _CEILING, PLASTER)
    if layout.opposite == "row":
        _add_wall(kitchen, "room_wall_2", (-far - 0.1, -far), y, _PARAPET, PLASTER)
    elif layout.opposite == "wall":
        _add_wall(kitchen, "room_wall_2", (-far - 0.1, -far), y, _CEILING, CLEAR)
    facing = (Pose((-1.0, 0.0, 0.0, half, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0)), shift(-half, 0.0, 0.0))
    names = []
    for number, (row, pose) in enumerate(zip(layout.rows, facing, strict=False), 1):
        low, high = row.length
        plinth = slab((-DEPTH + 0.03, -0.05), (low, high), (0.0, kitchen.style.plinth), PLINTH)
        name = f"row_{number}"
        kitchen.fixed(name, ROOM, pose, [plinth])
        names.append(name)
    return names


def add_countertop(kitchen: KitchenBuilder, row: Row, name: str, opposite: Opposite | None = None) -> None:
    """Add the countertop of a row, with the basin and tap of a sink, and with a hob above an oven.

    ``opposite`` is the layout's, for the row opposite the first one.
    """
    style = kitchen.style
    x = (-_ISLAND_BACK if opposite == "island" else -BACK, _OVERHANG)
    z = (style.counter, style.worktop)
    low, high = row.counter
    sink = _find(row, "sink")
    if sink is None:
        tops = [slab(x, (low, high), z, style.counter_material)]
    else:
        y = (sink.y - sink.width / 2 + 0.08, sink.y + sink.width / 2 - 0.08)
        tops = [
            slab(x, (low, y[0]), z, style.counter_material),
            slab(x, (y[1], high), z, style.counter_material),
            slab((x[0], _BASIN_X[0]), y, z, style.counter_material),
            slab((_BASIN_X[1], x[1]), y, z, style.counter_material),
        ]
    decoration: list[MaterialShape] = []
    hob = _find(row, "oven")
    if hob is not None and low < hob.y < high:
        z_hob = (style.worktop, style.worktop + 0.004)
        decoration.append(slab((-0.51, -0.06), (hob.y - 0.28, hob.y + 0.28), z_hob, GLASS))
        for a, b in ((-0.4, -0.14), (-0.4, 0.14), (-0.17, -0.14), (-0.17, 0.14)):
            top = style.worktop + 0.0045
            decoration.append(cylinder_between((a, hob.y + b, top), (a, hob.y + b, top + 0.001), 0.08, STEEL))
    if opposite != "island":
        splash = (style.worktop, style.wall_cupboards if opposite is None else _PARAPET)
        decoration.append(slab((-BACK, -BACK + 0.008), (low, high), splash, TILE))
    kitchen.fixed(f"{name}_countertop", name, shift(), tops, decoration)
    if sink is not None:
        _add_sink(kitchen, sink, name)


def _add_wall(
    kitchen: KitchenBuilder, name: str, x: Span, y: Span, height: float, material: Material
) -> None:
    kitchen.fixed(name, ROOM, shift(), [slab(x, y, (0.0, height), material)])


def _add_sink(kitchen: KitchenBuilder, sink: Unit, row: str) -> None:
    style = kitchen.style
    half = sink.width / 2 - 0.08
    z = style.worktop
    basin = open_box(_BASIN_X, (-half, half), (z - _BASIN_DEPTH, z + 0.004), 0.006, STEEL, opening="+z")
    foot = _BASIN_X[0] - 0.035
    tap = [
        cylinder_between((foot, 0.0, z), (foot, 0.0, z + 0.3), 0.014, BAR),
        cylinder_between((foot, 0.0, z + 0.29), (foot + 0.2, 0.0, z + 0.29), 0.011, BAR),
        cylinder_between((foot + 0.19, 0.0, z + 0.24), (foot + 0.19, 0.0, z + 0.28), 0.011, BAR),
    ]
    kitchen.fixed(f"{sink.name}_basin", row, shift(0.0, sink.y, 0.0), [*basin, *tap])


def _find(row: Row, name: str) -> Unit | None:
    return next((unit for unit in row.base if unit.name == name), None)
