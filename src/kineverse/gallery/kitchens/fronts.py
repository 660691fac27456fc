"""Fronts that open: drawers, doors and flaps, each with its bar handle.

All are placed in the frame of a unit: on the floor in the middle of its front plane, x out of the front, y to
the right of a person before it, z up. Hinges are at the outer edge of the front, so an open front never
crosses the gap to its neighbour.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal

from msgspec import structs

from kineverse.articulations import Prismatic, Revolute
from kineverse.articulations.mechanisms.mechanism import shift
from kineverse.model.body import Pose, Vector3

from .builder import (
    BIRCH,
    KitchenBuilder,
    Material,
    MaterialShape,
    Span,
    compute_inertia,
    cylinder_between,
    open_box,
    slab,
)

GAP = 0.003  # gap between fronts, and between a front and its carcass [m]
FRONT: Span = (GAP, GAP + 0.018)  # ends of a front along x [m]
WALL = 0.016  # thickness of the panels of a carcass [m]
GRAVITY = 9.81

_UPRIGHT = (1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0)
_LEVEL = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
_RUNNER = 0.013
_BEHIND = 0.03  # length of a drawer that stays in its carcass [m]


@dataclass(frozen=True, slots=True)
class Area:
    """Part of a unit's face that one front covers, up to half a gap on each side."""

    y: Span  # ends across [m]
    z: Span

    @property
    def front(self) -> tuple[Span, Span]:
        """Ends of the front across and in height [m]."""
        half = GAP / 2
        return (self.y[0] + half, self.y[1] - half), (self.z[0] + half, self.z[1] - half)


def drawer(
    builder: KitchenBuilder,
    name: str,
    unit: str,
    area: Area,
    depth: float,
    *,
    material: Material | None = None,
    handle_height: float | None = None,
    rim: float = 0.25,
) -> None:
    """Add a drawer on runners."""
    y, z = area.front
    middle, half = (z[0] + z[1]) / 2, (z[1] - z[0]) / 2
    side = (area.y[1] - area.y[0]) / 2 - WALL - _RUNNER
    back = -(depth - WALL - 0.01)
    low = -half + 0.02
    solids = [slab(FRONT, (y[0], y[1]), (-half, half), material or builder.style.front)]
    inner = (low, min(half - 0.035, low + rim))
    solids += open_box((back, FRONT[0]), (-side, side), inner, 0.012, BIRCH, opening="+z")
    mass = compute_inertia(solids).mass
    upper = min(builder.style.travel, round(-back - _BEHIND, 3))
    dynamics = (("effort", 100.0), ("damping", round(1.5 * mass, 2)), ("friction", round(0.4 * mass, 2)))
    fields = {"axis": (1.0, 0.0, 0.0), "lower": 0.0, "upper": upper, "velocity": 1.0, "dynamics": dynamics}
    builder.joint(Prismatic, name, unit, shift(0.0, 0.0, middle), solids, **fields)
    if handle_height is None:
        handle_height = 0.0 if half < 0.1 else half - 0.07
    add_handle(builder, name, (FRONT[1], (y[0] + y[1]) / 2, handle_height), y[1] - y[0])


def door(
    builder: KitchenBuilder,
    name: str,
    unit: str,
    area: Area,
    hinge: Literal["left", "right"],
    *,
    bar: tuple[Literal["low", "high"], bool] | float,
    upper: float = 1.57,
    material: Material | None = None,
    inside: Iterable[MaterialShape] = (),
) -> None:
    """Add a door about a vertical axis."""
    y, z = area.front
    width, sign = y[1] - y[0], 1.0 if hinge == "left" else -1.0
    hinge_y = y[0] if hinge == "left" else y[1]
    height, base = z[1] - z[0], z[0]
    panel = (0.0, width) if hinge == "left" else (-width, 0.0)
    thickness = FRONT[1] - FRONT[0]
    solids = [slab((-thickness, 0.0), panel, (0.0, height), material or builder.style.front)]
    solids += [_moved(s, (-FRONT[1], sign * width / 2, -base)) for s in inside]
    _hinge(builder, name, unit, (FRONT[1], hinge_y, base), (0.0, 0.0, -sign), upper, solids)
    free = sign * (width - 0.04)
    if isinstance(bar, float):
        add_handle(builder, name, (0.0, free, bar - base), height, upright=True)
    else:
        end, upright = bar
        length = bar_length(builder, height if upright else width)
        off = 0.05 + (length / 2 if upright else 0.0)
        across = free if upright else sign * (width - 0.035 - length / 2)
        at = (0.0, across, off if end == "low" else height - off)
        add_handle(builder, name, at, height if upright else width, upright=upright)


def flap(
    builder: KitchenBuilder,
    name: str,
    unit: str,
    area: Area,
    hinge: Literal["top", "bottom"],
    *,
    upper: float = 1.5,
    material: Material | None = None,
    inside: Iterable[MaterialShape] = (),
) -> None:
    """Add a door about a level axis.

    A flap with its hinge below has a spring that carries its weight where it is wide open, and friction that
    holds it on the way. Friction alone holds a flap with its hinge above, as its stays do.
    """
    y, z = area.front
    height, sign = z[1] - z[0], 1.0 if hinge == "bottom" else -1.0
    hinge_z = z[0] if hinge == "bottom" else z[1]
    panel = (0.0, height) if hinge == "bottom" else (-height, 0.0)
    middle = (y[0] + y[1]) / 2
    thickness = FRONT[1] - FRONT[0]
    span = (y[0] - middle, y[1] - middle)
    solids = [slab((-thickness, 0.0), span, panel, material or builder.style.front)]
    solids += [_moved(s, (-FRONT[1], 0.0, -hinge_z)) for s in inside]
    inertia = compute_inertia(solids)
    weight = GRAVITY * inertia.mass * abs(inertia.origin.matrix[2, 3])
    dynamics: list[tuple[str, float]] = []
    if hinge == "bottom":
        dynamics = [("spring_stiffness", round(weight / (math.pi / 2), 3)), ("spring_reference", 0.0)]
    friction = round((0.25 if hinge == "bottom" else 1.1) * weight, 3)
    at, axis, more = (FRONT[1], middle, hinge_z), (0.0, sign, 0.0), tuple(dynamics)
    _hinge(builder, name, unit, at, axis, upper, solids, friction=friction, more=more)
    add_handle(builder, name, (0.0, 0.0, sign * (height - 0.045)), y[1] - y[0])


def add_handle(
    builder: KitchenBuilder, part: str, at: Vector3, room: float, *, upright: bool = False
) -> None:
    """Add a bar on two mounts to a part, at a point of its surface; x of its frame is outward, y along it."""
    style = builder.style
    length = bar_length(builder, room)
    t, reach, end = style.thickness, style.clearance + style.thickness / 2, length / 2
    post = end - 0.02
    if style.round_bar:
        solids = [cylinder_between((reach, -end, 0.0), (reach, end, 0.0), t / 2, style.bar)]
        solids += [
            cylinder_between((0.0, p, 0.0), (reach, p, 0.0), 0.4 * t, style.bar) for p in (-post, post)
        ]
    else:
        across = (-t / 2, t / 2)
        solids = [slab((style.clearance, style.clearance + t), (-end, end), across, style.bar)]
        mount = (0.0, style.clearance)
        solids += [slab(mount, (p - t / 2, p + t / 2), across, style.bar) for p in (-post, post)]
    a, b, c, d, e, f, g, h, i = _UPRIGHT if upright else _LEVEL
    x, y, z = (round(v, 6) for v in at)
    builder.fixed(f"{part}_handle", part, Pose((a, b, c, x, d, e, f, y, g, h, i, z)), solids)


def bar_length(builder: KitchenBuilder, room: float) -> float:
    """Return the length of a bar on a front of a size along it [m]."""
    return round(max(0.1, min(builder.style.length, room - 0.12)), 3)


def _hinge(
    builder: KitchenBuilder,
    name: str,
    unit: str,
    at: Vector3,
    axis: Vector3,
    upper: float,
    solids: list[MaterialShape],
    *,
    friction: float = 0.3,
    more: tuple[tuple[str, float], ...] = (),
) -> None:
    x, y, z = (round(v, 6) for v in at)
    mass = compute_inertia(solids).mass
    dynamics = (("effort", 60.0), ("damping", round(0.08 * mass, 3)), ("friction", friction), *more)
    fields = {"axis": axis, "lower": 0.0, "upper": upper, "velocity": 1.0, "dynamics": dynamics}
    builder.joint(Revolute, name, unit, shift(x, y, z), solids, **fields)


def _moved(solid: MaterialShape, by: Vector3) -> MaterialShape:
    """Return a box that is displaced [m]."""
    rows = list(solid.shape.origin.rows)
    for k, step in zip((3, 7, 11), by, strict=True):
        rows[k] = round(rows[k] + step, 7)
    return replace(solid, shape=structs.replace(solid.shape, origin=Pose(tuple(rows))))
