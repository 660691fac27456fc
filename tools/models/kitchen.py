"""The kitchen that ships: 15 drawers, 3 doors and 5 knobs around a robot at the origin.

Every area has its frame on the floor, in the middle of the plane its fronts lie on: x points out of the
fronts, y to the right of whoever stands before them, z up. So has every drawer (x is the way it opens) and
every handle (x away from the surface it is mounted on, y along the bar).
"""

from __future__ import annotations

from math import pi

from cabinets import (
    BOARD,
    DEPTH,
    FRONT,
    GAP,
    carcass,
    drawer,
    flap,
    handle,
    knob,
    larder,
    open_box,
    open_front,
)
from description import Description
from shapes import Material, Span, for_the_eye, pipe, rod, slab, sphere

ABOUT = """\
A kitchen with 23 degrees of freedom: 15 drawers, 3 doors, 5 knobs.
Sink, oven and fridge stand on the +x side, the island on the -x side, a robot at the origin between them;
z up, floor at z = 0.
Units: m, rad, kg. Frames of handles: x away from the front, y along the bar.

Written for Kineverse by tools/models/kitchen.py; change it there.
SPDX-License-Identifier: Apache-2.0"""

MATERIALS = {
    "white": Material((0.94, 0.93, 0.90, 1), 680),
    "sage": Material((0.55, 0.64, 0.57, 1), 680),
    "oak": Material((0.74, 0.56, 0.37, 1), 700),
    "birch": Material((0.87, 0.77, 0.62, 1), 620),
    "plinth": Material((0.23, 0.24, 0.26, 1), 680),
    "plaster": Material((0.90, 0.88, 0.84, 1), 900),
    "tile": Material((0.78, 0.84, 0.81, 1), 2300),
    "steel": Material((0.74, 0.76, 0.78, 1), 450),
    "dark_steel": Material((0.36, 0.38, 0.41, 1), 900),
    "bar": Material((0.62, 0.64, 0.66, 1), 7800),
    "enamel": Material((0.16, 0.17, 0.19, 1), 1500),
    "liner": Material((0.95, 0.97, 0.98, 1), 300),
    "glass": Material((0.06, 0.07, 0.09, 1), 2500),
    "smoked_glass": Material((0.10, 0.11, 0.13, 0.55), 2500),
    "clear_glass": Material((0.75, 0.88, 0.92, 0.45), 2500),
    "knob": Material((0.20, 0.21, 0.23, 1), 1400),
    "mark": Material((0.95, 0.45, 0.20, 1), 1400),
    "plastic": Material((0.42, 0.46, 0.50, 1), 950),
    "glow": Material((0.45, 0.85, 0.95, 1), 1200),
    "terracotta": Material((0.80, 0.45, 0.32, 1), 1800),
    "leaf": Material((0.33, 0.55, 0.32, 1), 300),
    "honey": Material((0.90, 0.68, 0.28, 1), 1300),
}

PLINTH = 0.10
COUNTER: Span = (0.88, 0.92)
TALL = 2.10


def kitchen() -> Description:
    """Return the kitchen."""
    d = Description("kitchen", ABOUT, MATERIALS, root="kitchen")
    _wall(d)
    _sink_area(d)
    _oven_area(d)
    _fridge_area(d)
    _island(d)
    return d


def _wall(d: Description) -> None:
    d.section("The wall behind the row, with tiles and two shelves")
    shapes = [
        slab((0.0, 0.06), (-2.05, 2.05), (0, 2.45), "plaster"),
        slab((-0.01, 0), (-1.245, 0.745), (0.921, 1.48), "tile"),
    ]
    for z in (1.50, 1.82):
        shapes.append(slab((-0.24, 0), (-1.15, 0.65), (z, z + 0.03), "oak"))
        shapes += [slab((-0.20, 0), (y, y + 0.02), (z - 0.02, z), "dark_steel") for y in (-0.9, 0.4)]
    for y, radius, height, material in (
        (0.50, 0.055, 0.17, "terracotta"),
        (0.34, 0.050, 0.14, "clear_glass"),
        (0.20, 0.050, 0.14, "honey"),
        (-0.62, 0.06, 0.12, "sage"),
        (-0.80, 0.06, 0.16, "white"),
    ):
        shapes.append(rod((-0.12, y, 1.53), (-0.12, y, 1.53 + height), radius, material))
    shapes.append(rod((-0.12, -0.2, 1.85), (-0.12, -0.2, 1.97), 0.065, "terracotta"))
    shapes.append(sphere(0.085, (-0.12, -0.2, 2.03), "leaf"))
    shapes += for_the_eye(
        [sphere(0.06, (-0.10, -0.12, 2.00), "leaf"), sphere(0.06, (-0.13, -0.28, 2.02), "leaf")]
    )
    d.fixed("wall", "kitchen", shapes, at=(1.80, 0, 0))


def _sink_area(d: Description) -> None:
    d.section("Sink area: three drawers, dishwasher, sink above the pull-out with the bins")
    basin_x, basin_y = (-0.50, -0.12), (0.46, 0.94)
    back, lip = -DEPTH - 0.02, 0.03
    shapes = [
        *carcass((-1.0, -0.2), (PLINTH, COUNTER[0])),
        *carcass((0.4, 1.0), (PLINTH, COUNTER[0])),
        slab((-0.53, -0.05), (-1.0, 1.0), (0, PLINTH), "plinth"),
        slab((back, lip), (-1.0, basin_y[0]), COUNTER, "oak"),
        slab((back, lip), (basin_y[1], 1.0), COUNTER, "oak"),
        slab((back, basin_x[0]), basin_y, COUNTER, "oak"),
        slab((basin_x[1], lip), basin_y, COUNTER, "oak"),
        slab(FRONT, (0.4 + GAP / 2, 1.0 - GAP / 2), (0.73 + GAP / 2, 0.872), "white"),
    ]
    d.fixed("sink_area", "kitchen", shapes, at=(1.20, -0.25, 0), rpy=(0, 0, pi))

    y = (-1.0, -0.2)
    drawer(d, "sink_left_upper_drawer", "sink_area", y, (0.73, 0.872), "white", bar=0.40)
    drawer(d, "sink_left_middle_drawer", "sink_area", y, (0.44, 0.73), "white", bar=0.40)
    drawer(d, "sink_left_bottom_drawer", "sink_area", y, (PLINTH, 0.44), "white", bar=0.40, lift=0.03)

    y = (0.4, 1.0)
    z = (PLINTH, 0.73)
    middle = (z[0] + z[1]) / 2
    bins = []
    for x, material in (((-0.49, -0.26), "plastic"), ((-0.24, -0.01), "sage")):
        bins += open_box(x, (-0.22, 0.22), (0.15 - middle, 0.56 - middle), 0.006, material, bottom=0.006)
    drawer(d, "sink_trash_drawer", "sink_area", y, z, "white", bar=0.30, lift=0.03, rim=0.17, inside=bins)

    d.section("Dishwasher: the tub, and the door about its lower edge")
    tub = [
        *open_front((-0.56, 0.0), (-0.285, 0.285), (0.105, 0.86), 0.012, "steel"),
        slab((-0.50, -0.06), (-0.26, 0.26), (0.30, 0.31), "dark_steel"),
        slab((-0.50, -0.06), (-0.26, 0.26), (0.58, 0.59), "dark_steel"),
    ]
    d.fixed("dishwasher", "sink_area", tub, at=(0, 0.1, 0))
    z = (0.115, 0.868)
    width, height, hinge = 0.594, z[1] - z[0], 0.012
    shapes = [
        slab((-0.029, 0.011), (-width / 2, width / 2), (-hinge, height - hinge), "white"),
        slab((-0.031, -0.029), (-0.26, 0.26), (0.03, height - 0.10), "steel"),
        *for_the_eye([slab((0.011, 0.012), (0.16, 0.26), (height - 0.052, height - 0.032), "glow")]),
    ]
    bar = (height - 0.09, 0.40)
    flap(d, "dishwasher_door", "dishwasher", shapes, z=z[0] + hinge, bar=bar, friction=6, damping=2)

    d.section("Sink and tap")
    shapes = open_box(
        basin_x, (basin_y[0] - 0.7, basin_y[1] - 0.7), (0.72, 0.924), 0.008, "steel", bottom=0.008
    )
    shapes += for_the_eye([rod((-0.31, 0, 0.728), (-0.31, 0, 0.732), 0.035, "dark_steel")])
    tap = (-0.55, 0.0)
    shapes.append(rod((*tap, 0.92), (*tap, 0.99), 0.024, "bar"))
    arch = [
        (*tap, 0.99),
        (*tap, 1.20),
        (tap[0] + 0.03, 0, 1.27),
        (tap[0] + 0.10, 0, 1.30),
        (tap[0] + 0.17, 0, 1.27),
        (tap[0] + 0.20, 0, 1.20),
        (tap[0] + 0.20, 0, 1.15),
    ]
    shapes += pipe(arch, 0.012, "bar")
    shapes += pipe([(tap[0], 0.02, 0.965), (tap[0] + 0.01, 0.09, 0.985)], 0.007, "bar")
    d.fixed("sink", "sink_area", shapes, at=(0, 0.7, 0))


def _oven_area(d: Description) -> None:
    d.section("Oven area: two tall pull-outs, and between them two drawers, the oven and a niche")
    shapes = [
        *carcass((-0.6, -0.3), (PLINTH, TALL), top=True),
        *carcass((-0.3, 0.3), (PLINTH, TALL), top=True),
        *carcass((0.3, 0.6), (PLINTH, TALL), top=True),
        slab((-0.53, -0.05), (-0.6, 0.6), (0, PLINTH), "plinth"),
        slab((-0.56, 0), (-0.282, 0.282), (0.682, 0.70), "white"),
        slab((-0.56, 0), (-0.282, 0.282), (1.31, 1.328), "white"),
        slab((-0.56, FRONT[1]), (-0.282, 0.282), (1.70, 1.718), "white"),
        slab(FRONT, (-0.2985, 0.2985), (1.72, TALL - GAP / 2), "white"),
        slab((-0.545, -0.05), (-0.27, 0.27), (1.329, 1.335), "oak"),
        rod((-0.25, -0.15, 1.335), (-0.25, -0.15, 1.40), 0.09, "tile"),
        rod((-0.25, 0.12, 1.335), (-0.25, 0.12, 1.56), 0.06, "terracotta"),
    ]
    d.fixed("oven_area", "kitchen", shapes, at=(1.20, 1.35, 0), rpy=(0, 0, pi))
    for side, y in (("left", (-0.6, -0.3)), ("right", (0.3, 0.6))):
        larder(d, f"oven_{side}_drawer", "oven_area", y, (PLINTH, TALL))
    y = (-0.3, 0.3)
    drawer(d, "oven_middle_lower_drawer", "oven_area", y, (PLINTH, 0.40), "white", bar=0.30, lift=0.03)
    drawer(d, "oven_middle_upper_drawer", "oven_area", y, (0.40, 0.69), "white", bar=0.30)

    d.section("Oven: the box with its panel, and the door about its lower edge")
    panel = 1.19
    shapes = [
        *open_front((-0.54, 0.0), (-0.275, 0.275), (0.705, panel - 0.01), 0.02, "enamel"),
        slab((-0.54, 0), (-0.275, 0.275), (panel, 1.308), "enamel"),
        slab((0, 0.04), (-0.2985, 0.2985), (panel, 1.308), "steel"),
        slab((-0.50, -0.04), (-0.255, 0.255), (0.90, 0.908), "bar"),
        *for_the_eye(
            [
                slab((0.04, 0.042), (-0.25, -0.02), (panel + 0.03, panel + 0.09), "glass"),
                slab((0.042, 0.043), (-0.17, -0.10), (panel + 0.05, panel + 0.07), "glow"),
            ]
        ),
    ]
    d.fixed("oven", "oven_area", shapes)
    z = (0.702, panel - 0.004)
    half, height, hinge = 0.297, z[1] - z[0], 0.012
    low, high = -hinge, height - hinge
    shapes = [
        slab((-0.029, 0.011), (-half, half), (low, low + 0.07), "steel"),
        slab((-0.029, 0.011), (-half, half), (high - 0.10, high), "steel"),
        slab((-0.029, 0.011), (-half, -half + 0.07), (low + 0.07, high - 0.10), "steel"),
        slab((-0.029, 0.011), (half - 0.07, half), (low + 0.07, high - 0.10), "steel"),
        slab((-0.012, 0.008), (-half + 0.07, half - 0.07), (low + 0.07, high - 0.10), "smoked_glass"),
    ]
    flap(d, "oven_door", "oven", shapes, z=z[0] + hinge, bar=(high - 0.05, 0.44), friction=3, damping=1)
    knob(d, "oven_knob", "oven", (0.04, 0.17, panel + 0.06), radius=0.026)


def _fridge_area(d: Description) -> None:
    d.section("Fridge area: freezer drawer below, fridge above; its door hangs on the right")
    half = 0.35
    split = 0.57
    shapes = [
        *carcass((-half, half), (PLINTH, TALL), top=True),
        slab((-0.53, -0.05), (-half, half), (0, PLINTH), "plinth"),
        slab((-0.56, 0), (-half + BOARD, half - BOARD), (split - 0.02, split), "white"),
    ]
    d.fixed("fridge_area", "kitchen", shapes, at=(1.20, -1.60, 0), rpy=(0, 0, pi))
    y = (-half, half)
    drawer(
        d,
        "fridge_lower_drawer",
        "fridge_area",
        y,
        (PLINTH, split - 0.008),
        "steel",
        bar=0.40,
        lift=0.03,
        rim=0.08,
        box_material="liner",
    )

    inside = (half - BOARD) - 0.001
    shapes = [*open_front((-0.555, -0.001), (-inside, inside), (split + 0.001, TALL - 0.019), 0.02, "liner")]
    shapes += [
        slab((-0.53, -0.13), (-inside + 0.025, inside - 0.025), (z, z + 0.008), "clear_glass")
        for z in (0.86, 1.14, 1.42, 1.70)
    ]
    shapes += [
        slab((-0.50, -0.14), (-0.29, -0.01), (0.60, 0.80), "clear_glass"),
        slab((-0.50, -0.14), (0.01, 0.29), (0.60, 0.80), "clear_glass"),
        rod((-0.30, -0.15, 0.868), (-0.30, -0.15, 1.07), 0.045, "honey"),
        rod((-0.30, 0.05, 1.148), (-0.30, 0.05, 1.24), 0.07, "terracotta"),
        rod((-0.34, -0.12, 1.428), (-0.34, -0.12, 1.58), 0.05, "sage"),
    ]
    d.fixed("fridge", "fridge_area", shapes)

    z = (split, TALL - GAP / 2)
    middle = (z[0] + z[1]) / 2
    hinge = (0.031, half - 0.014)
    width, height = 2 * half - GAP, z[1] - z[0]
    edge = half - GAP / 2 - hinge[1]
    shapes = [
        slab((-0.028, 0.032), (edge - width, edge), (-height / 2, height / 2), "steel"),
        slab(
            (-0.034, -0.028),
            (edge - width + 0.04, edge - 0.04),
            (0.04 - height / 2, height / 2 - 0.04),
            "liner",
        ),
        *for_the_eye([slab((0.032, 0.033), (-0.40, -0.30), (0.40, 0.44), "glow")]),
    ]
    for bottom in (-0.55, -0.15, 0.30):
        y = (edge - width + 0.09, edge - 0.09)
        shapes.append(slab((-0.11, -0.034), y, (bottom, bottom + 0.008), "clear_glass"))
        shapes.append(slab((-0.11, -0.104), y, (bottom + 0.008, bottom + 0.09), "clear_glass"))
    d.moving(
        "fridge_door",
        "fridge",
        "revolute",
        (0, 0, 1),
        shapes,
        at=(*hinge, middle),
        limits=(0, pi / 2),
        velocity=1.5,
        effort=60,
    )
    handle(d, "fridge_door", (0.032, edge - width + 0.06, -0.15), 0.60, upright=True)


def _island(d: Description) -> None:
    d.section("Kitchen island: six drawers, hob with its knobs, hood, stools behind")
    back, lip = -0.86, 0.03
    shapes = []
    for y in ((-1.2, -0.4), (-0.4, 0.4), (0.4, 1.2)):
        shapes += carcass(y, (PLINTH, COUNTER[0]), material="sage")
        shapes.append(slab(FRONT, (y[0] + GAP / 2, y[1] - GAP / 2), (0.77 + GAP / 2, 0.872), "sage"))
    shapes += [
        slab((-0.53, -0.05), (-1.2, 1.2), (0, PLINTH), "plinth"),
        slab((back, lip), (-1.24, 1.24), COUNTER, "oak"),
        slab((back, lip), (-1.24, -1.2), (0, COUNTER[0]), "oak"),
        slab((back, lip), (1.2, 1.24), (0, COUNTER[0]), "oak"),
        slab((-0.38, -0.14), (-0.98, -0.62), (0.92, 0.945), "birch"),
        rod((-0.30, -0.05, 0.92), (-0.30, -0.05, 0.93), 0.06, "tile"),
        rod((-0.30, -0.05, 0.93), (-0.30, -0.05, 0.975), 0.14, "tile"),
        sphere(0.045, (-0.33, -0.09, 1.005), "mark"),
        sphere(0.045, (-0.25, -0.03, 1.005), "mark"),
        sphere(0.042, (-0.33, 0.02, 1.002), "leaf"),
    ]
    d.fixed("island", "kitchen", shapes, at=(-1.0, 0, 0))
    for name, y in (("left", (-1.2, -0.4)), ("middle", (-0.4, 0.4)), ("right", (0.4, 1.2))):
        drawer(d, f"island_{name}_upper_drawer", "island", y, (0.47, 0.77), "sage", bar=0.40)
        drawer(d, f"island_{name}_lower_drawer", "island", y, (PLINTH, 0.47), "sage", bar=0.40, lift=0.03)

    shapes = [slab((-0.54, -0.06), (-0.30, 0.30), (0.92, 0.927), "glass")]
    small, large = 0.080, 0.105
    for x, y, radius in (
        (-0.42, -0.16, large),
        (-0.42, 0.16, small),
        (-0.18, -0.16, small),
        (-0.18, 0.16, large),
    ):
        ring = rod((x, y, 0.927), (x, y, 0.928), radius, "dark_steel")
        shapes += for_the_eye([ring, rod((x, y, 0.928), (x, y, 0.929), radius - 0.012, "glass")])
    shapes += [rod((-0.42, -0.16, 0.929), (-0.42, -0.16, 1.05), 0.095, "steel")]
    shapes += pipe([(-0.42, -0.055, 1.02), (-0.42, 0.07, 1.04)], 0.009, "knob")
    d.fixed("hob", "island", shapes, at=(0, 0.8, 0))
    for number, y in enumerate((0.575, 0.725, 0.875, 1.025), start=1):
        knob(d, f"stove_knob_{number}", "island", (FRONT[1], y, 0.822), radius=0.024)

    shapes = [
        slab((-0.78, -0.71), (-0.09, 0.09), (0.92, 1.80), "steel"),
        slab((-0.78, -0.06), (-0.09, 0.09), (1.84, 1.88), "steel"),
        slab((-0.78, -0.06), (-0.30, 0.30), (1.80, 1.84), "steel"),
        *for_the_eye(
            [
                slab((-0.60, -0.12), (-0.24, 0.24), (1.796, 1.80), "dark_steel"),
                slab((-0.06, -0.059), (-0.06, 0.06), (1.81, 1.83), "glow"),
            ]
        ),
    ]
    d.fixed("hood", "island", shapes, at=(0, 0.8, 0))

    shapes = []
    for y in (-0.75, -0.05):
        shapes += [
            rod((0, y, 0), (0, y, 0.02), 0.20, "dark_steel"),
            rod((0, y, 0.02), (0, y, 0.62), 0.025, "bar"),
            rod((0, y, 0.62), (0, y, 0.66), 0.18, "oak"),
            rod((0, y, 0.22), (0, y, 0.235), 0.12, "dark_steel"),
        ]
    d.fixed("stools", "island", shapes, at=(-1.10, 0, 0))
