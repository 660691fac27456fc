"""Two small shelves to open: one with a hinged door, one with two drawers.

The root frame `shelf` is the middle of the body and the fronts look along its -x, as those of the folding
cupboard door do. Below it x points out of the fronts: for the body, the moving parts and the handles, whose y
runs along the bar.
"""

from __future__ import annotations

from math import pi

from description import Description
from shapes import Material, Shape, Span, for_the_eye, rod, slab, sphere

NOTES = """\
Units: m, rad, kg. The root is the middle of the body; the fronts look along -x. Frames of handles: x away
from the front, y along the bar.

Written for Kineverse by tools/models/shelves.py; change it there.
SPDX-License-Identifier: Apache-2.0"""

MATERIALS = {
    "body": Material((0.93, 0.91, 0.87, 1), 650),
    "back": Material((0.84, 0.80, 0.73, 1), 650),
    "front": Material((0.33, 0.50, 0.57, 1), 650),
    "birch": Material((0.87, 0.77, 0.62, 1), 620),
    "bar": Material((0.62, 0.64, 0.66, 1), 7800),
}

DEPTH, WIDTH, HEIGHT = 0.36, 0.42, 0.42
BOARD = 0.018
FRONT: Span = (0.002, 0.018)
"""Before the body, in its frame; the body reaches from -DEPTH / 2 to DEPTH / 2."""


def shelf_door() -> Description:
    """Return the shelf with the hinged door."""
    about = f"A small shelf with a hinged door: one degree of freedom.\n{NOTES}"
    d = Description("shelf_door", about, MATERIALS, root="shelf")
    _body(d, shelf=0.0)
    hinge = (DEPTH / 2 + FRONT[0], WIDTH / 2)
    thickness = FRONT[1] - FRONT[0]
    gap = 0.002
    door = [
        slab((0, thickness), (-WIDTH + gap, -gap), (-HEIGHT / 2, HEIGHT / 2), "front"),
    ]
    d.moving(
        "door",
        "body",
        "revolute",
        (0, 0, 1),
        door,
        at=(*hinge, 0),
        limits=(0, 1.57),
        velocity=1.0,
        effort=30,
    )
    d.fixed("door_handle", "door", _bar(), at=(thickness, -WIDTH + 0.04, 0), rpy=(pi / 2, 0, 0))
    return d


def shelf_drawers() -> Description:
    """Return the shelf with two drawers."""
    about = f"A small shelf with two drawers: two degrees of freedom.\n{NOTES}"
    d = Description("shelf_drawers", about, MATERIALS, root="shelf")
    _body(d)
    for name, low, high in (("upper", 0.0, HEIGHT / 2), ("lower", -HEIGHT / 2, 0.0)):
        half = (high - low) / 2 - 0.0015
        side = WIDTH / 2 - BOARD - 0.006
        bottom = (-half + 0.03, -half + 0.038)
        rim = (bottom[1], half - 0.05)
        shapes = [
            slab(FRONT, (-WIDTH / 2, WIDTH / 2), (-half, half), "front"),
            slab((-0.30, FRONT[0]), (-side, side), bottom, "birch"),
            slab((-0.30, FRONT[0]), (-side, -side + 0.010), rim, "birch"),
            slab((-0.30, FRONT[0]), (side - 0.010, side), rim, "birch"),
            slab((-0.30, -0.29), (-side + 0.010, side - 0.010), rim, "birch"),
        ]
        d.moving(
            f"{name}_drawer",
            "body",
            "prismatic",
            (1, 0, 0),
            shapes,
            at=(DEPTH / 2, 0, (low + high) / 2),
            limits=(0, 0.22),
            velocity=1.0,
            effort=30,
        )
        d.fixed(f"{name}_drawer_handle", f"{name}_drawer", _bar(), at=(FRONT[1], 0, 0.03))
    return d


def _body(d: Description, shelf: float | None = None) -> None:
    x, y, z = (DEPTH / 2, WIDTH / 2, HEIGHT / 2)
    shapes = [
        slab((-x, x), (-y, -y + BOARD), (-z, z), "body"),
        slab((-x, x), (y - BOARD, y), (-z, z), "body"),
        slab((-x, x), (-y + BOARD, y - BOARD), (z - BOARD, z), "body"),
        slab((-x, x), (-y + BOARD, y - BOARD), (-z, -z + BOARD), "body"),
        slab((-x, -x + 0.008), (-y + BOARD, y - BOARD), (-z + BOARD, z - BOARD), "back"),
    ]
    if shelf is not None:
        level = (shelf - 0.007, shelf + 0.007)
        shapes.append(slab((-x + 0.008, x - 0.04), (-y + BOARD, y - BOARD), level, "birch"))
    d.fixed("body", "shelf", shapes, rpy=(0, 0, pi))


def _bar() -> list[Shape]:
    ends = [(0.04, -0.07, 0.0), (0.04, 0.07, 0.0)]
    shapes = [rod(*ends, 0.006, "bar"), *for_the_eye(sphere(0.006, end, "bar") for end in ends)]
    return shapes + [rod((0, y, 0), (0.04, y, 0), 0.004, "bar") for y in (-0.05, 0.05)]
