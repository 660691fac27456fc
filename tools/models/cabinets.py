"""What kitchens are made of: carcasses, fronts, drawers, flaps, handles and knobs.

All of them are built in the frame of their area: x points out of the fronts, which lie just before x = 0.
"""

from __future__ import annotations

from math import pi

from description import Description
from shapes import ZERO, Shape, Span, Vector, box, for_the_eye, pipe, rod, slab

BOARD = 0.018
GAP = 0.003
DEPTH = 0.58
"""Of a carcass, behind the plane of the fronts."""
FRONT: Span = (0.002, 0.022)

TRAVEL: Span = (0.0, 0.48)
HANDLE_REACH = 0.04
"""From a front to the axis of the bar: the gap a finger fits into."""


def front(y: Span, z: Span, material: str) -> Shape:
    """Return the panel before an opening y × z, smaller by the gap to its neighbours."""
    return slab(FRONT, (y[0] + GAP / 2, y[1] - GAP / 2), (z[0] + GAP / 2, z[1] - GAP / 2), material)


def carcass(y: Span, z: Span, *, material: str = "white", top: bool = False) -> list[Shape]:
    """Return the boards of a cabinet between its sides `y`: open to the front, and above unless `top`."""
    inner = (y[0] + BOARD, y[1] - BOARD)
    boards = [
        slab((-DEPTH, 0), (y[0], inner[0]), z, material),
        slab((-DEPTH, 0), (inner[1], y[1]), z, material),
        slab((-DEPTH, 0), inner, (z[0], z[0] + BOARD), material),
        slab((-DEPTH, -DEPTH + 0.008), inner, (z[0] + BOARD, z[1] - (BOARD if top else 0)), material),
    ]
    if top:
        boards.append(slab((-DEPTH, 0), inner, (z[1] - BOARD, z[1]), material))
    return boards


def open_front(x: Span, y: Span, z: Span, wall: float, material: str) -> list[Shape]:
    """Return a box of this wall that is open to the front."""
    return [
        slab((x[0], x[0] + wall), y, z, material),
        slab((x[0] + wall, x[1]), y, (z[0], z[0] + wall), material),
        slab((x[0] + wall, x[1]), y, (z[1] - wall, z[1]), material),
        slab((x[0] + wall, x[1]), (y[0], y[0] + wall), (z[0] + wall, z[1] - wall), material),
        slab((x[0] + wall, x[1]), (y[1] - wall, y[1]), (z[0] + wall, z[1] - wall), material),
    ]


def open_box(x: Span, y: Span, z: Span, wall: float, material: str, *, bottom: float) -> list[Shape]:
    """Return a box of this wall that is open above."""
    return [
        slab(x, y, (z[0], z[0] + bottom), material),
        slab(x, (y[0], y[0] + wall), (z[0] + bottom, z[1]), material),
        slab(x, (y[1] - wall, y[1]), (z[0] + bottom, z[1]), material),
        slab((x[0], x[0] + wall), (y[0] + wall, y[1] - wall), (z[0] + bottom, z[1]), material),
        slab((x[1] - wall, x[1]), (y[0] + wall, y[1] - wall), (z[0] + bottom, z[1]), material),
    ]


def drawer(
    d: Description,
    name: str,
    parent: str,
    y: Span,
    z: Span,
    material: str,
    *,
    bar: float,
    lift: float = 0.015,
    rim: float | None = None,
    inside: list[Shape] | None = None,
    box_material: str = "birch",
) -> None:
    """Add a drawer with its front over y × z; its box starts `lift` above its edge and is `rim` high."""
    middle, half = _middle_and_half(y, z)
    side = half[0] - 0.03
    low = -half[1] + lift
    high = low + rim if rim else half[1] - 0.05
    shapes = [
        front((-half[0], half[0]), (-half[1], half[1]), material),
        *open_box((-0.52, 0.002), (-side, side), (low, high), 0.012, box_material, bottom=0.010),
        *(inside or ()),
    ]
    _sliding(d, name, parent, (0, *middle), shapes, effort=60)
    handle(d, name, (FRONT[1], 0, max(half[1] - 0.08, 0)), bar)


def larder(d: Description, name: str, parent: str, y: Span, z: Span) -> None:
    """Add a tall pull-out: a front with a column of trays behind it."""
    middle, half = _middle_and_half(y, z)
    side = half[0] - 0.03
    shapes = [
        front((-half[0], half[0]), (-half[1], half[1]), "white"),
        slab((-0.52, -0.508), (-side, side), (-half[1] + 0.03, half[1] - 0.08), "birch"),
        slab((-0.010, 0.002), (-side, side), (-half[1] + 0.03, half[1] - 0.08), "birch"),
    ]
    for level in range(4):
        low = -half[1] + 0.03 + 0.45 * level
        shapes.append(slab((-0.508, -0.010), (-side, side), (low, low + 0.010), "birch"))
        shapes += [
            slab((-0.508, -0.010), rail, (low + 0.010, low + 0.06), "birch")
            for rail in ((-side, -side + 0.010), (side - 0.010, side))
        ]
    _sliding(d, name, parent, (0, *middle), shapes, effort=90)
    handle(d, name, (FRONT[1], 0, 0), 0.50, upright=True)


def _sliding(d: Description, name: str, parent: str, at: Vector, shapes: list[Shape], effort: float) -> None:
    d.moving(name, parent, "prismatic", (1, 0, 0), shapes, at=at, limits=TRAVEL, velocity=1.0, effort=effort)


def flap(
    d: Description,
    name: str,
    parent: str,
    shapes: list[Shape],
    *,
    z: float,
    bar: tuple[float, float],
    friction: float,
    damping: float,
) -> None:
    """Add a door that opens downwards about its lower edge, .032 before the front plane at height `z`.

    Its spring, which a URDF cannot say, is in `kineverse.shipped.robots`.
    """
    d.moving(
        name,
        parent,
        "revolute",
        (0, 1, 0),
        shapes,
        at=(0.032, 0, z),
        limits=(0, pi / 2),
        velocity=1.5,
        effort=60,
        friction=friction,
        damping=damping,
    )
    handle(d, name, (0.011, 0, bar[0]), bar[1])


def handle(d: Description, part: str, at: Vector, length: float, *, upright: bool = False) -> None:
    """Add a bar handle to a front; `at` is on its surface."""
    post = length / 2 - 0.03
    shapes = pipe([(HANDLE_REACH, -length / 2, 0), (HANDLE_REACH, length / 2, 0)], 0.007, "bar")
    shapes += [rod((0, y, 0), (HANDLE_REACH, y, 0), 0.005, "bar") for y in (-post, post)]
    d.fixed(f"{part}_handle", part, shapes, at=at, rpy=(pi / 2, 0, 0) if upright else ZERO)


def knob(d: Description, name: str, parent: str, at: Vector, radius: float) -> None:
    """Add a knob that turns clockwise for whoever looks at it; its mark stands up at 0."""
    shapes = [
        rod((0, 0, 0), (0.006, 0, 0), radius + 0.004, "bar"),
        rod((0.006, 0, 0), (0.026, 0, 0), radius, "knob"),
        *for_the_eye([box((0.006, 0.004, radius), (0.027, 0, radius / 2 - 0.001), "mark")]),
    ]
    d.moving(name, parent, "revolute", (-1, 0, 0), shapes, at=at, limits=(0, pi), velocity=3.0, effort=2)


def _middle_and_half(y: Span, z: Span) -> tuple[tuple[float, float], tuple[float, float]]:
    return ((y[0] + y[1]) / 2, (z[0] + z[1]) / 2), ((y[1] - y[0]) / 2, (z[1] - z[0]) / 2)
