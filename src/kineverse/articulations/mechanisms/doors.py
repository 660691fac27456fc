"""Doors whose parts move along: folding door, garage door."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, TypeAlias

from kineverse.articulations.joint import check_joint_number
from kineverse.articulations.limits import Limits
from kineverse.articulations.locks import BoundedExpression, speed_lock
from kineverse.errors import InvalidValueError
from kineverse.expressions.expression import Expression
from kineverse.expressions.functions import arccos, arctan2, cos, sin, sqrt
from kineverse.model.body import Pose, Vector3
from kineverse.spatial import X, Y, Z, rotation_about, translation_along

from .mechanism import DARK, PALE, STEEL, WOOD, Mechanism, MechanismPart, box_shape, case, rod_shape, shift

Point: TypeAlias = tuple[float, float]

_CLEARANCE = 0.007  # distance of the front edges of the walls behind those of the cupboard [m]


@dataclass(frozen=True, kw_only=True)
class FoldingDoor(Mechanism, document_kind="FoldingDoor"):
    """Cupboard door of two panels that fold while they rise; an arm guides the lower panel.

    The motion is in the (x, z) plane of the base, the centre of the cupboard, which opens towards -x. The
    upper panel rotates about A by the coordinate ``name``, q [rad], 0 when shut. The directions along it and
    outward of it are e1 = (-sin q, -cos q) and e2 = (-cos q, sin q), those of the lower panel f1 and
    f2 = (f1z, -f1x). A point (u, v) of a panel is u along and v outward. With points of the upper panel from
    A, and of the lower one from the hinge B between them::

        B = A + (e1, e2)·panel_hinge,      C = B + (f1, f2)·arm_end,      |C - D| = arm

    C is the intersection of two circles, about B and about D. With ``c = |arm_end|``, ``d = |D - B|`` and
    w = (D - B)/d::

        C - B = m w + h (w_z, -w_x),       m = (c² + d² - arm²)/2d,       h = √(c² - m²)

    which gives f1 = (u r + v (-r_z, r_x))/c² for r = C - B and (u, v) = arm_end. The arm reaches the lower
    panel from inside, so h is positive, and the panels hang one below the other at q = 0.

    A spring opens the door beyond the angle ``tipping`` and shuts it before. Together with the weight of the
    panels it exerts on the upper panel the torque::

        τ = stiffness (q - tipping)      [N m],

    which is the datum ``name/spring``, an expression; the record has its two parameters. They are not
    measured, as the authors give none.

    Frames are ``base``, ``upper_panel`` and ``lower_panel`` (at their centres), ``panel_hinge`` (B, on the
    upper panel), ``arm`` (at D, z towards C), ``arm_end`` (C, on the lower panel) and ``handle``. Except for
    the base, the arm and its end, they have x inward, y to the side and z up when shut.

    Attributes
    ----------
    size, wall
        Depth, width and height of the cupboard, and thickness of its walls [m].
    panel
        Width, height and thickness of the panels [m].
    top_hinge, arm_pivot
        A and D in the cupboard, (x, z) [m].
    upper_middle, panel_hinge
        Points of the upper panel (u, v) from A [m].
    lower_middle, arm_end
        Points of the lower panel (u, v) from B [m].
    handle
        Point of the lower panel (u, v) from its centre [m].
    handle_size
        Width, depth and thickness of the handle [m].
    arm
        Length of the arm [m].
    opening
        Limits of q and of its speed; numbers.
    stiffness, tipping
        Stiffness of the spring [N m/rad], and the angle at which its torque changes sign [rad].

    Raises
    ------
    InvalidValueError
        For lengths that are not positive, or with which the arm does not reach at some angle; for a stiffness
        that is not positive.

    Examples
    --------
    >>> model = kv.Model()
    >>> with model.edit() as edit:
    ...     edit.apply(kv.articulations.FoldingDoor(name="cupboard", parent="world"))
    'folding door cupboard'
    >>> model.fk("cupboard/handle")({"cupboard": 0.92})[[0, 2], 3].round(3)
    array([-0.45 , -0.131])
    >>> model.data["cupboard/spring"]({"cupboard": 0.0}).round(2)
    np.float64(-2.4)
    """

    main: ClassVar[str] = "lower_panel"

    size: Vector3 = (0.35, 0.6, 0.72)
    wall: float = 0.016
    panel: Vector3 = (0.595, 0.357, 0.016)
    top_hinge: Point = (-0.18562, 0.34566)
    arm_pivot: Point = (-0.085, 0.168)
    upper_middle: Point = (0.16637, -0.00229)
    panel_hinge: Point = (0.37012, 0.00039)
    lower_middle: Point = (0.15621, -0.0031)
    arm_end: Point = (0.17871, -0.0671)
    handle: Point = (0.0985, 0.008)
    handle_size: Vector3 = (0.16, 0.05, 0.012)
    arm: float = 0.372
    opening: Limits = Limits(0.0, 1.84, 0.25)
    stiffness: float = 4.0
    tipping: float = 0.6

    def __post_init__(self) -> None:
        self.check_lengths("wall", "arm", "stiffness")
        self.number("tipping")
        for field, count, positive in (
            *((field, 3, True) for field in ("size", "panel", "handle_size")),
            *((field, 2, False) for field in ("top_hinge", "arm_pivot", "upper_middle", "panel_hinge")),
            *((field, 2, False) for field in ("lower_middle", "arm_end", "handle")),
        ):
            object.__setattr__(self, field, self._numbers(field, count, positive))
        super().__post_init__()
        self._check_reach()

    @property
    def limits(self) -> Mapping[str, Limits]:
        """Limits of q."""
        return {self.path(): self.opening}

    def dynamics(self) -> tuple[tuple[str, Any], ...]:
        """Return the parameters of the spring."""
        return (("spring/stiffness", self.stiffness), ("spring/tipping", self.tipping))

    def data(self) -> Mapping[str, Any]:
        """Return the torque of the spring on q."""
        return {"spring": self.stiffness * (self.q() - self.tipping)}

    def parts(self) -> Mapping[str, MechanismPart]:
        """Return the cupboard, the panels, the arm and the handle."""
        q = self.q()
        (ax, az), (dx, dz), (ux, uv) = self.top_hinge, self.arm_pivot, self.panel_hinge
        bx = ax - ux * sin(q) - uv * cos(q)
        bz = az - ux * cos(q) + uv * sin(q)
        x, z = self._arm_end_from(bx, bz)
        u, v = self.arm_end
        # The angle θ of f1 = (-sin θ, -cos θ), as q of e1; the division by c² does not change it.
        lower = arctan2(v * z - u * x, -u * z - v * x)
        width, height, thickness = self.panel
        leaf = box_shape((thickness, width, height), (0.0, 0.0, 0.0), WOOD)
        grip_width, grip_depth, grip_thickness = self.handle_size
        grip = box_shape((grip_depth, grip_width, grip_thickness), (-grip_depth / 2, 0.0, 0.0), STEEL)
        side = self.size[1] / 2 - 2 * self.wall
        bar = rod_shape((0.0, side, 0.0), (0.0, side, self.arm), 0.008, STEEL)
        depth, *front = self.size
        # The walls end behind the ends of the panels, which turn inwards.
        walls = case((depth - _CLEARANCE, front[0], front[1]), self.wall, PALE, (_CLEARANCE / 2, 0.0, 0.0))
        hinge, turned = (shift(ax, 0, az), rotation_about(Y, q)), rotation_about(Y, lower - q)
        lean = rotation_about(Y, arctan2(bx + x - dx, bz + z - dz))
        return {
            "base": self.base(*walls),
            "upper_panel": MechanismPart("base", (*hinge, _on(self.upper_middle)), (leaf,)),
            "panel_hinge": MechanismPart("base", (*hinge, _on(self.panel_hinge))),
            "lower_panel": MechanismPart("panel_hinge", (turned, _on(self.lower_middle)), (leaf,)),
            "arm_end": MechanismPart("panel_hinge", (turned, _on(self.arm_end))),
            "handle": MechanismPart("lower_panel", (_on(self.handle),), (grip,)),
            "arm": MechanismPart("base", (shift(dx, 0, dz), lean), (bar,)),
        }

    def _arm_end_from(self, bx: Expression, bz: Expression) -> tuple[Expression, Expression]:
        c = math.hypot(*self.arm_end)
        to_x, to_z = self.arm_pivot[0] - bx, self.arm_pivot[1] - bz
        square = to_x**2 + to_z**2
        along = (c**2 + square - self.arm**2) / 2 / square
        across = sqrt(c**2 / square - along**2)
        return along * to_x + across * to_z, along * to_z - across * to_x

    def _numbers(self, field: str, count: int, positive: bool) -> tuple[float, ...]:
        """Return a field after checking that it is a tuple of so many numbers."""
        given = getattr(self, field)
        try:
            numbers = tuple(given)
        except TypeError:
            numbers = ()
        if len(numbers) != count:
            raise InvalidValueError(f"{self.describe(field)} has {count} numbers, which {given!r} has not.")
        what = f"{self.describe(field)}, each of it,"
        return tuple(check_joint_number(n, what, positive=positive) for n in numbers)

    def _check_reach(self) -> None:
        """Check that the triangle of B, C and D closes at all angles without becoming flat."""
        lower, upper = self.numeric_range("opening", -math.pi, math.pi)
        r, c = math.hypot(*self.panel_hinge), math.hypot(*self.arm_end)
        across, up = (d - a for a, d in zip(self.top_hinge, self.arm_pivot, strict=True))
        for what, length in (("panel hinge", r), ("arm end", c)):
            if not length:
                where = "is at (0, 0), which is no place for another hinge"
                raise InvalidValueError(f"{self.describe(what)} {where}.")
        # B is nearest to D, or farthest from it, where the upper panel points along the line from A to D.
        u, v = self.panel_hinge
        straight = math.atan2(-across, -up) - math.atan2(v, u)
        angles = [lower, upper, *(straight + k * math.pi for k in range(-3, 4))]
        for q in (a for a in angles if lower <= a <= upper):
            x = -u * math.sin(q) - v * math.cos(q) - across
            z = -u * math.cos(q) + v * math.sin(q) - up
            d = math.hypot(x, z)
            if not abs(c - self.arm) < d < c + self.arm:
                raise InvalidValueError(
                    f"{self.describe('arm')}, {self.arm:g}, does not reach at {q:.6g} rad: its pivot is "
                    f"{d:.6g} from the hinge between the panels there, and its other end {c:.6g}."
                )


def _on(point: Point) -> Pose:
    """Return the pose of a point in the axes of a panel, which hangs along -z and faces -x."""
    along, outward = point
    return shift(-outward, 0.0, -along)


@dataclass(frozen=True, kw_only=True)
class GarageDoor(Mechanism, document_kind="GarageDoor"):
    """Garage door: the lower edge moves along a vertical rail, the upper edge along one under the ceiling.

    2022 paper, Eqs. 11-13. With the length l and the angle α, 0 when closed::

        base_T_door = translation(0, 0, l (1 - cos α)) · rotation_y(α)

    Note that the coordinate is α, and not the papers' position a = l cos α, which is l when closed and
    0 when open. There α = arccos(a/l) has an infinite slope at a = l, exactly where the door is locked. With
    ``form="published"`` the coordinate is a, and the height is l - a, because the a that Eq. 12 prints is not
    0 at the floor when closed.

    =================  ==================================================================
    ``name/door``      q = α in [0, π/2] [rad], or as published q = a in [0, l] [m]
    ``name/bolt``      b, the handle of the lock [rad]
    frames             ``base``, ``door`` (lower edge, z along the door), ``upper_edge``, ``bolt``
    ``name/lock``      -speed·unlocked <= q̇ <= speed·unlocked
    unlocked           ~((b < catch) & closed), closed if a > l - play
    =================  ==================================================================

    Attributes
    ----------
    length, width, thickness
        Dimensions of the door [m].
    form
        ``"regular"``, or ``"published"`` with the coordinate of the papers.
    bolt
        Limits of b.
    catch
        Angle b below which the bolt locks [rad].
    play
        Largest distance of a from l at which the bolt still catches [m].
    speed
        Limit of ``|q̇|`` while it is unlocked [rad/s], or as published [m/s].

    Raises
    ------
    InvalidValueError
        For lengths that are not positive, a play that is not below the length, or a catch beyond the bolt's
        limits.

    Examples
    --------
    >>> model = kv.Model()
    >>> with model.edit() as edit:
    ...     edit.apply(kv.articulations.GarageDoor(name="garage", parent="world"))
    'garage door garage'
    >>> model.limits("garage/door:velocity", {"garage/door": 0, "garage/bolt": 0})
    (0.0, 0.0)
    >>> model.limits("garage/door:velocity", {"garage/door": 0, "garage/bolt": 0.5})
    (-1.0, 1.0)
    """

    main: ClassVar[str] = "door"

    length: float = 2.0
    width: float = 2.5
    thickness: float = 0.04
    form: Literal["regular", "published"] = "regular"
    bolt: Limits = Limits(0.0, 0.6)
    catch: float = 0.3
    play: float = 0.01
    speed: float = 1.0

    def __post_init__(self) -> None:
        self.check_lengths("length", "width", "thickness", "play", "speed")
        if not isinstance(self.form, str) or self.form not in ("regular", "published"):
            form = self.describe("form")
            raise InvalidValueError(f"{form} is 'regular' or 'published', not {self.form!r}.")
        if not self.play < self.length:
            most = f"less than its length {self.length:g}"
            raise InvalidValueError(f"{self.describe('play')} is {most}, and not {self.play:g}.")
        super().__post_init__()
        self.check_threshold("catch", self.bolt)

    @property
    def limits(self) -> Mapping[str, Limits]:
        """Limits of the door and of the bolt."""
        most = self.length if self.form == "published" else math.pi / 2
        return {self.path("door"): Limits(0.0, most), self.path("bolt"): self.bolt}

    @property
    def closed(self) -> Expression:
        """Condition a > l - play."""
        if self.form == "published":
            return self.q("door") > self.length - self.play
        return self.q("door") < math.acos(1 - self.play / self.length)

    def locks(self) -> Mapping[str, BoundedExpression]:
        """Return the lock, c2 of Eq. 13."""
        q, raised = self.q("door"), self.q("bolt") > self.catch
        return {"lock": speed_lock(q, open_if=raised, engaged_if=self.closed, max_speed=self.speed)}

    def parts(self) -> Mapping[str, MechanismPart]:
        """Return rails, door and bolt."""
        q, length, side = self.q("door"), self.length, self.width / 2 + 0.03
        if self.form == "published":
            height, angle = length - q, arccos(q / length)
        else:
            height, angle = length * (1 - cos(q)), q
        rails = [box_shape((0.05, 0.05, length), (0.0, y, length / 2), STEEL) for y in (-side, side)]
        rails += [box_shape((length, 0.05, 0.05), (length / 2, y, length), STEEL) for y in (-side, side)]
        leaf = box_shape((self.thickness, self.width, length), (0.0, 0.0, length / 2), WOOD)
        grip = shift(-self.thickness / 2 - 0.04, 0.0, 0.15 * length)
        stem = rod_shape((0.0, 0.0, 0.0), (0.04, 0.0, 0.0), 0.01, DARK)
        lever = box_shape((0.02, 0.2, 0.02), (0, 0, 0), DARK)
        return {
            "base": self.base(*rails),
            "door": MechanismPart("base", (translation_along(Z, height), rotation_about(Y, angle)), (leaf,)),
            "upper_edge": MechanismPart("door", (shift(z=length),)),
            "bolt": MechanismPart("door", (grip, rotation_about(X, self.q("bolt"))), (stem, lever)),
        }
