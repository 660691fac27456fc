"""Units of a kitchen: carcasses with the fronts that belong to their kind."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from kineverse.articulations.mechanisms import FoldingDoor
from kineverse.articulations.mechanisms.mechanism import shift
from kineverse.model.body import Pose

from .builder import BOARD, ENAMEL, FOAM, GLASS, STEEL, KitchenBuilder, Material, Span, open_box, slab
from .fronts import FRONT, GAP, WALL, Area, door, drawer, flap
from .layout import Unit

DEPTH = 0.56  # depth of the carcasses on the floor [m]
WALL_DEPTH = 0.35  # depth of the wall cupboards [m]
BACK = 0.58  # distance from the fronts' plane of a row to the wall behind it [m]

_FOLDING_SIZE = (0.336, 0.6, 0.72)
"""Cupboard of the folding door: its panels swing clear of it, as they would not with the depth by default."""
_WIDE_OPEN, _OPEN = 1.9, 1.57
_HANDLE_HEIGHT = 1.05  # height of the handles of tall doors that reach above and below it [m]

_HIGHEST_HANDLE = 1.9

Hand: TypeAlias = Literal["left", "right"]


@dataclass(frozen=True, slots=True)
class UnitBuilder:
    """Builder of one unit, in its frame."""

    kitchen: KitchenBuilder
    rng: np.random.Generator  # source of the details
    unit: Unit
    z: Span  # ends of the carcass in height [m]

    @property
    def y(self) -> Span:
        """Ends across [m]."""
        return -self.unit.width / 2, self.unit.width / 2

    def name(self, part: str) -> str:
        """Return the name of a part of the unit."""
        return f"{self.unit.name}_{part}"

    def area(self, low: float, high: float) -> Area:
        """Return the part of the face between two heights [m]."""
        return Area(self.y, (low, high))

    def halves(self, low: float, high: float) -> tuple[Area, Area]:
        """Return the left and the right half of the face between two heights [m]."""
        return Area((self.y[0], 0.0), (low, high)), Area((0.0, self.y[1]), (low, high))

    def front(self, part: str, low: float, high: float) -> tuple[KitchenBuilder, str, str, Area]:
        """Return what a front between two heights [m] is built from: kitchen, name, unit and area."""
        return self.kitchen, self.name(part), self.unit.name, self.area(low, high)

    def panel(self, part: str, low: float, high: float, material: Material) -> None:
        """Add a panel in the plane of the fronts that does not open."""
        y, z = self.area(low, high).front
        self.kitchen.fixed(self.name(part), self.unit.name, shift(), [slab(FRONT, y, z, material)])

    def hand(self) -> Hand:
        """Return the side of a door's hinges."""
        return "left" if self.rng.random() < 0.5 else "right"

    def carcass(
        self,
        row: str,
        depth: float = DEPTH,
        *,
        x: float = 0.0,
        shelves: Sequence[float] = (),
        top: bool = True,
    ) -> None:
        """Add the carcass with its shelves at a frame of the unit, x before the plane of the row [m]."""
        walls = open_box((-depth, 0.0), self.y, self.z, WALL, self.kitchen.style.carcass, opening="+x")
        if not top:
            walls.pop()
        inner = (self.y[0] + WALL, self.y[1] - WALL)
        boards = [slab((-depth + WALL, -0.06), inner, (h, h + WALL), BOARD) for h in shelves]
        self.kitchen.fixed(self.unit.name, row, shift(x, self.unit.y, 0.0), [*walls, *boards])

    def drawers(
        self, heights: Sequence[float], first: int = 1, *, name: str = "drawer", only: bool = False
    ) -> None:
        """Add drawers between heights, from the top down, numbered unless it is the only one."""
        pairs = list(zip(heights[1:], heights, strict=False))
        for k, (low, high) in enumerate(pairs):
            number = "" if only else f"_{first + k}"
            drawer(*self.front(f"{name}{number}", low, high), DEPTH)

    def doors(self, low: float, high: float, end: Literal["low", "high"], upper: float = _OPEN) -> None:
        """Add a pair of doors."""
        bar = (end, self.rng.random() < 0.75)
        left, right = self.halves(low, high)
        door(self.kitchen, self.name("left_door"), self.unit.name, left, "left", bar=bar, upper=upper)
        door(self.kitchen, self.name("right_door"), self.unit.name, right, "right", bar=bar, upper=upper)

    def door(
        self, low: float, high: float, end: Literal["low", "high"], part: str = "door", upper: float = _OPEN
    ) -> None:
        """Add a door as wide as the unit."""
        bar = (end, self.rng.random() < 0.75)
        door(*self.front(part, low, high), self.hand(), bar=bar, upper=upper)

    def tall_door(self, low: float, high: float, part: str, *, cold: bool = False, hand: Hand) -> None:
        """Add a door of a tall unit, insulated if it is cold inside, with an upright handle."""
        inside = []
        if cold:
            half = self.unit.width / 2 - 0.035
            inside = [slab((-0.045, FRONT[0]), (-half, half), (low + 0.03, high - 0.03), FOAM)]
        room = self.kitchen.style.length / 2 + 0.08
        height = round(min(max(_HANDLE_HEIGHT, low + room), high - room), 3)
        material = self.kitchen.style.tall_front
        door(*self.front(part, low, high), hand, bar=height, material=material, inside=inside)

    def oven(self, low: float, high: float) -> None:
        """Add the panel and the flap of an oven."""
        half = self.unit.width / 2 - 0.04
        inside = [slab((-0.03, FRONT[0]), (-half, half), (low + 0.03, high - 0.15), ENAMEL)]
        flap(*self.front("door", low, high - 0.12), "bottom", material=GLASS, inside=inside)
        self.panel("panel", high - 0.12, high, STEEL)

    def wide(self) -> float:
        """Return the largest angle of a door between flush neighbours [rad]."""
        return _WIDE_OPEN if self.rng.random() < 0.25 else _OPEN


def add_base_unit(kitchen: KitchenBuilder, rng: np.random.Generator, unit: Unit, row: str) -> None:
    """Add a unit below the countertop."""
    style = kitchen.style
    u = UnitBuilder(kitchen, rng, unit, (style.plinth, style.counter))
    low, high = style.plinth, style.counter - GAP / 2
    _BASE[unit.kind](u, row, low, high)


def add_tall_unit(kitchen: KitchenBuilder, rng: np.random.Generator, unit: Unit, row: str) -> None:
    """Add a unit from the floor to the top."""
    style = kitchen.style
    u = UnitBuilder(kitchen, rng, unit, (style.plinth, style.top))
    _TALL[unit.kind](u, row, style.plinth, style.top)


def add_wall_unit(kitchen: KitchenBuilder, rng: np.random.Generator, unit: Unit, row: str) -> None:
    """Add a cupboard above the countertop."""
    style = kitchen.style
    low, high = style.wall_cupboards, style.wall_cupboards + _FOLDING_SIZE[2]
    u = UnitBuilder(kitchen, rng, unit, (low, high))
    x = -BACK + WALL_DEPTH
    if unit.kind == "wall_folding":
        middle = round((low + high) / 2, 4)
        # The cupboard of the mechanism opens towards its -x.
        behind = -BACK + _FOLDING_SIZE[0] / 2
        pose = Pose((-1.0, 0.0, 0.0, behind, 0.0, -1.0, 0.0, unit.y, 0.0, 0.0, 1.0, middle))
        kitchen.mechanism(FoldingDoor, f"{unit.name}_door", row, pose, 600.0, size=_FOLDING_SIZE)
        return
    half = (low + high) / 2
    u.carcass(row, WALL_DEPTH, x=x, shelves=(half - WALL / 2,))
    if unit.kind == "wall_door":
        u.door(low, high, "low")
    elif unit.kind == "wall_doors":
        u.doors(low, high, "low")
    elif unit.kind == "wall_flap":
        # The upper half stays open, as a shelf.
        flap(*u.front("flap", low, half), "top", upper=_OPEN)
    else:
        flap(*u.front("upper_flap", half, high), "top", upper=_OPEN)
        flap(*u.front("lower_flap", low, half), "top", upper=_OPEN)


# -- units below the countertop ------------------------------------------------------------------------------


def _door(u: UnitBuilder, row: str, low: float, high: float) -> None:
    u.carcass(row, shelves=(0.5,))
    u.door(low, high, "high", upper=u.wide())


def _doors(u: UnitBuilder, row: str, low: float, high: float) -> None:
    u.carcass(row, shelves=(0.5,))
    u.doors(low, high, "high", upper=u.wide())


def _drawer_door(u: UnitBuilder, row: str, low: float, high: float) -> None:
    u.carcass(row, shelves=(0.4,))
    u.drawers((high, high - 0.16), only=True)
    u.door(low, high - 0.16, "high", upper=u.wide())


def _drawer_doors(u: UnitBuilder, row: str, low: float, high: float) -> None:
    u.carcass(row, shelves=(0.4,))
    u.drawers((high, high - 0.16), only=True)
    u.doors(low, high - 0.16, "high")


def _drawers(parts: Sequence[float]) -> UnitKind:
    """Return the kind with drawers whose heights are in proportion to parts, from the top down."""

    def build(u: UnitBuilder, row: str, low: float, high: float) -> None:
        u.carcass(row)
        steps = np.cumsum((0.0, *parts)) / sum(parts)
        u.drawers([round(high - (high - low) * float(s), 4) for s in steps])

    return build


def _pull_out(u: UnitBuilder, row: str, low: float, high: float) -> None:
    u.carcass(row)
    drawer(*u.front("pull_out", low, high), DEPTH)


def _sink_door(u: UnitBuilder, row: str, low: float, high: float) -> None:
    u.carcass(row, top=False)
    u.door(low, high, "high")


def _sink_doors(u: UnitBuilder, row: str, low: float, high: float) -> None:
    u.carcass(row, top=False)
    u.doors(low, high, "high")


def _sink_pull_out(u: UnitBuilder, row: str, low: float, high: float) -> None:
    u.carcass(row, top=False)
    drawer(*u.front("pull_out", low, high - 0.16), DEPTH)
    u.panel("panel", high - 0.16, high, u.kitchen.style.front)


def _dishwasher(u: UnitBuilder, row: str, low: float, high: float) -> None:
    u.carcass(row)
    half = u.unit.width / 2 - 0.04
    material = u.kitchen.style.front if u.rng.random() < 0.5 else STEEL
    inside = [slab((-0.03, FRONT[0]), (-half, half), (low + 0.03, high - 0.04), STEEL)]
    flap(*u.front("door", low, high), "bottom", material=material, inside=inside)


def _oven(u: UnitBuilder, row: str, low: float, high: float) -> None:
    u.carcass(row)
    u.oven(high - 0.6, high)
    u.panel("plinth_panel", low, high - 0.6, u.kitchen.style.front)


def _open_shelf(u: UnitBuilder, row: str, low: float, high: float) -> None:
    u.carcass(row, shelves=(0.35, 0.62))


# -- tall units ----------------------------------------------------------------------------------------------


def _fridge(u: UnitBuilder, row: str, low: float, high: float) -> None:
    u.carcass(row, shelves=(0.6, 0.95, 1.3))
    u.tall_door(low, high, "door", cold=True, hand=u.hand())


def _fridge_freezer(u: UnitBuilder, row: str, low: float, high: float) -> None:
    u.carcass(row, shelves=(0.75, 1.1, 1.45))
    hand = u.hand()
    u.tall_door(0.76, high, "door", cold=True, hand=hand)
    u.tall_door(low, 0.76, "freezer_door", cold=True, hand=hand)


def _fridge_drawers(u: UnitBuilder, row: str, low: float, high: float) -> None:
    u.carcass(row, shelves=(0.75, 1.1, 1.45))
    u.tall_door(0.76, high, "door", cold=True, hand=u.hand())
    u.drawers((0.76, round((0.76 + low) / 2, 4), low), name="freezer_drawer")


def _fridge_top(u: UnitBuilder, row: str, low: float, high: float) -> None:
    top = min(round(high - float(u.rng.choice((0.32, 0.4, 0.5))), 3), _HIGHEST_HANDLE - 0.06)
    u.carcass(row, shelves=(0.6, 0.95, top - WALL / 2))
    u.tall_door(low, top, "door", cold=True, hand=u.hand())
    material = u.kitchen.style.tall_front
    if u.rng.random() < 0.5:
        flap(*u.front("top_flap", top, high), "top", upper=_OPEN, material=material)
    else:
        door(*u.front("top_door", top, high), u.hand(), bar=("low", False), material=material)


def _oven_column(u: UnitBuilder, row: str, low: float, high: float) -> None:
    u.carcass(row, shelves=(0.65 - WALL / 2, 1.27 - WALL / 2))
    u.drawers((0.65, low), only=True)
    u.oven(0.65, 1.27)
    u.door(1.27, high, "low", "upper_door")


def _oven_column_drawers(u: UnitBuilder, row: str, low: float, high: float) -> None:
    u.carcass(row, shelves=(0.65 - WALL / 2, 1.27 - WALL / 2))
    u.drawers((0.65, 0.38, low))
    u.oven(0.65, 1.27)
    u.door(1.27, high, "low", "upper_door")


def _larder(u: UnitBuilder, row: str, low: float, high: float) -> None:
    u.carcass(row, shelves=(0.4, 0.8 - WALL / 2, 1.2, 1.6))
    hand = u.hand()
    u.tall_door(0.8, high, "door", hand=hand)
    u.tall_door(low, 0.8, "lower_door", hand=hand)


def _larder_drawers(u: UnitBuilder, row: str, low: float, high: float) -> None:
    u.carcass(row, shelves=(0.8 - WALL / 2, 1.2, 1.6))
    u.tall_door(0.8, high, "door", hand=u.hand())
    u.drawers((0.8, round((0.8 + low) / 2, 4), low))


UnitKind: TypeAlias = Callable[[UnitBuilder, str, float, float], None]

_BASE: Mapping[str, UnitKind] = {
    "door": _door,
    "doors": _doors,
    "drawer_door": _drawer_door,
    "drawer_doors": _drawer_doors,
    "drawers_2": _drawers((1.0, 1.0)),
    "drawers_3": _drawers((1.0, 1.6, 2.2)),
    "drawers_4": _drawers((1.0, 1.3, 1.5, 1.6)),
    "drawers_5": _drawers((1.0, 1.0, 1.0, 1.0, 1.0)),
    "pull_out": _pull_out,
    "sink_door": _sink_door,
    "sink_doors": _sink_doors,
    "sink_pull_out": _sink_pull_out,
    "dishwasher": _dishwasher,
    "oven": _oven,
    "open_shelf": _open_shelf,
}
_TALL: Mapping[str, UnitKind] = {
    "fridge": _fridge,
    "fridge_freezer": _fridge_freezer,
    "fridge_drawers": _fridge_drawers,
    "fridge_top": _fridge_top,
    "oven_column": _oven_column,
    "oven_column_drawers": _oven_column_drawers,
    "larder": _larder,
    "larder_drawers": _larder_drawers,
}
