"""Layouts of kitchens: units in rows at an aisle, drawn from a seed.

A layout says which units there are and where. Their dimensions in height belong to the style, their fronts to
:mod:`~kineverse.gallery.kitchens.units`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple, TypeAlias

import numpy as np

OBJECTS = (8, 14)  # least and largest number of doors, drawers and flaps of a kitchen
AISLES = (1.0, 1.6)  # least and largest width of the aisle, from fronts to fronts [m]
SIDE_MARGIN = 0.12  # distance of wall cupboards from a tall unit, whose side is before their fronts [m]

Opposite: TypeAlias = Literal["row", "island", "wall"]


class Kind(NamedTuple):
    """Kind of unit: the number of its doors, drawers and flaps, its widths [m], and how often it is drawn."""

    objects: int
    widths: tuple[float, ...]
    weight: float = 1.0


BASE: Mapping[str, Kind] = {
    "door": Kind(1, (0.3, 0.4, 0.45, 0.5, 0.6), 2.0),
    "doors": Kind(2, (0.6, 0.7, 0.8, 0.9), 2.0),
    "drawer_door": Kind(2, (0.4, 0.45, 0.5, 0.6), 1.5),
    "drawer_doors": Kind(3, (0.6, 0.8, 0.9), 1.0),
    "drawers_2": Kind(2, (0.5, 0.6, 0.8, 0.9), 1.5),
    "drawers_3": Kind(3, (0.4, 0.5, 0.6, 0.8), 2.0),
    "drawers_4": Kind(4, (0.4, 0.5, 0.6), 1.0),
    "drawers_5": Kind(5, (0.4, 0.5, 0.6), 0.5),
    "pull_out": Kind(1, (0.3, 0.4, 0.6), 1.0),
}
"""Units below the countertop that a kitchen has any number of."""
SINK: Mapping[str, Kind] = {
    "sink_door": Kind(1, (0.6,)),
    "sink_pull_out": Kind(1, (0.6, 0.8)),
    "sink_doors": Kind(2, (0.8, 0.9)),
}
DISHWASHER, OVEN = Kind(1, (0.6,)), Kind(1, (0.6,))
FRIDGE: Mapping[str, Kind] = {
    "fridge": Kind(1, (0.6,)),
    "fridge_freezer": Kind(2, (0.6,), 2.0),
    "fridge_drawers": Kind(3, (0.6, 0.7)),
    "fridge_top": Kind(2, (0.6,), 1.5),
}
TALL: Mapping[str, Kind] = {
    "oven_column": Kind(3, (0.6,), 2.0),
    "oven_column_drawers": Kind(4, (0.6,)),
    "larder": Kind(2, (0.4, 0.5, 0.6), 1.5),
    "larder_drawers": Kind(3, (0.5, 0.6)),
}
WALL: Mapping[str, Kind] = {
    "wall_door": Kind(1, (0.4, 0.5, 0.6), 2.0),
    "wall_doors": Kind(2, (0.6, 0.8, 0.9), 1.5),
    "wall_flap": Kind(1, (0.6, 0.8, 0.9), 1.5),
    "wall_flaps": Kind(2, (0.6, 0.8), 0.7),
    "wall_folding": Kind(1, (0.6,), 1.3),
}
_SHELF = Kind(0, (0.4, 0.5, 0.6))
_OVEN_KINDS = ("oven_column", "oven_column_drawers")
_LEAST_BELOW = 4


@dataclass(frozen=True, slots=True)
class Unit:
    """Unit of a row."""

    kind: str
    name: str  # its name in the kitchen
    y: float  # middle of the unit along its row [m]
    width: float  # width [m]


@dataclass(frozen=True, slots=True)
class Row:
    """Units side by side, with their fronts in one plane."""

    tall: tuple[Unit, ...]  # units from the floor to the top
    base: tuple[Unit, ...]  # units below the countertop
    wall: tuple[Unit, ...]  # cupboards above it
    counter: tuple[float, float]  # ends of the countertop along the row [m]
    length: tuple[float, float]  # ends of the row [m]


@dataclass(frozen=True, slots=True)
class KitchenLayout:
    """Rows of a kitchen."""

    aisle: float  # distance between the fronts of the first row and the opposite side [m]
    opposite: Opposite  # what is opposite the first row: a second row at a wall, an island, or a bare wall
    rows: tuple[Row, ...]  # one row or two


def draw_layout(rng: np.random.Generator) -> KitchenLayout:
    """Return a layout with a number of objects within :data:`OBJECTS`."""
    objects = int(rng.integers(OBJECTS[0], OBJECTS[1] + 1))
    aisle = round(float(rng.uniform(*AISLES)), 3)
    opposites: tuple[Opposite, ...] = ("row", "island", "wall")
    opposite = opposites[_draw_index(rng, (0.35, 0.35, 0.3))]
    tall, base, wall = _draw_kinds(rng, objects)
    second: list[str] = []
    if opposite != "wall":  # a third to two thirds of the units below the countertop
        count = max(1, round(len(base) * float(rng.uniform(0.33, 0.67))))
        base, second = base[:-count], base[-count:]
    names = _Names()
    rows = [_row(rng, tall, base, wall, names)]
    if second:
        rows.append(_row(rng, [], second, [], names))
    return KitchenLayout(aisle, opposite, tuple(rows))


def draw_kind(rng: np.random.Generator, kinds: Mapping[str, Kind], most: int) -> str | None:
    """Return the name of a kind with at most so many objects, by weight; None if there is none."""
    fitting = [name for name, kind in kinds.items() if kind.objects <= most]
    if not fitting:
        return None
    return fitting[_draw_index(rng, [kinds[name].weight for name in fitting])]


def find_kind(name: str) -> Kind:
    """Return a kind by its name."""
    others = {"dishwasher": DISHWASHER, "oven": OVEN, "open_shelf": _SHELF}
    return {**BASE, **SINK, **FRIDGE, **TALL, **WALL, **others}[name]


def _draw_kinds(rng: np.random.Generator, objects: int) -> tuple[list[str], list[str], list[str]]:
    """Return the kinds of the tall units, of those below the countertop, and of the wall cupboards."""
    left = objects
    tall: list[str] = []
    for kinds, chance in ((FRIDGE, 0.9), (TALL, 0.6)):
        kind = draw_kind(rng, kinds, min(objects // 2 - (objects - left), left - _LEAST_BELOW))
        if rng.random() < chance and kind is not None:
            tall.append(kind)
            left -= find_kind(kind).objects
    wall: list[str] = []
    for _ in range(int(rng.integers(0, 4))):
        kind = draw_kind(rng, WALL, left - _LEAST_BELOW)
        if kind is not None and (kind != "wall_folding" or kind not in wall):
            wall.append(kind)
            left -= find_kind(kind).objects
    base: list[str] = []
    sink = draw_kind(rng, SINK, left)
    assert sink is not None  # enough objects are left for what is below the countertop
    for kind, chance in (
        (sink, 1.0),
        ("dishwasher", 0.6),
        ("oven", 0.0 if any(k in _OVEN_KINDS for k in tall) else 0.8),
    ):
        if rng.random() < chance and find_kind(kind).objects <= left:
            base.append(kind)
            left -= find_kind(kind).objects
    while left:
        drawn = draw_kind(rng, BASE, left)
        assert drawn is not None  # some have one object
        base.append(drawn)
        left -= find_kind(drawn).objects
    return tall, [base[k] for k in rng.permutation(len(base))], wall


def _row(
    rng: np.random.Generator, tall: Iterable[str], base: Iterable[str], wall: Iterable[str], names: _Names
) -> Row:
    """Return units side by side: tall ones at the ends, wall cupboards above the countertop."""
    drawn = {place: [(kind, _draw_width(rng, kind)) for kind in kinds] for place, kinds in
             (("tall", tall), ("base", base), ("wall", wall))}  # fmt: skip
    ends: tuple[list[tuple[str, float]], list[tuple[str, float]]] = ([], [])
    together = rng.random() < 0.4
    first = int(rng.integers(2))
    for k, unit in enumerate(drawn["tall"]):
        ends[first if together else (first + k) % 2].append(unit)
    run = drawn["base"]
    margins = [SIDE_MARGIN if end else 0.0 for end in ends]
    needed = _total(drawn["wall"]) + sum(margins) if drawn["wall"] else 0.0
    while _total(run) < max(needed, 0.6):
        run.insert(int(rng.integers(len(run) + 1)), ("open_shelf", _draw_width(rng, "open_shelf")))
    total = sum(map(_total, (*ends, run)))
    low = round(-total / 2, 4)
    counter = (low + _total(ends[0]), low + _total(ends[0]) + _total(run))
    spare = _total(run) - needed
    start = counter[0] + margins[0] + round(spare * float(rng.uniform(0.0, 1.0)), 2)
    return Row(
        tall=(*_place(ends[0], low, names), *_place(ends[1], counter[1], names)),
        base=_place(run, counter[0], names),
        wall=_place(drawn["wall"], start, names),
        counter=counter,
        length=(low, low + total),
    )


def _place(units: Iterable[tuple[str, float]], low: float, names: _Names) -> tuple[Unit, ...]:
    placed = []
    for kind, width in units:
        placed.append(Unit(kind, names.take(kind), round(low + width / 2, 5), width))
        low += width
    return tuple(placed)


class _Names:
    """Names of the units: those of the appliances, or numbered."""

    def __init__(self) -> None:
        self._counts: dict[str, int] = {}

    def take(self, kind: str) -> str:
        first = kind.partition("_")[0]
        single = ("sink", "dishwasher", "oven", "fridge", "larder")
        stem = first if first in (*single, "wall") else "shelf" if kind == "open_shelf" else "base"
        if stem in single:
            return stem
        self._counts[stem] = self._counts.get(stem, 0) + 1
        return f"{stem}_{self._counts[stem]}"


def _total(units: Iterable[tuple[str, float]]) -> float:
    return round(sum(width for _, width in units), 4)


def _draw_width(rng: np.random.Generator, kind: str) -> float:
    widths = find_kind(kind).widths
    return widths[int(rng.integers(len(widths)))]


def _draw_index(rng: np.random.Generator, weights: Iterable[float]) -> int:
    sums = np.cumsum(tuple(weights))
    return int(np.searchsorted(sums, rng.random() * sums[-1], side="right"))
