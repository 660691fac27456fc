"""Hinged doors with a handle, a spring-loaded bolt or a button."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from kineverse.articulations.limits import Limits
from kineverse.articulations.locks import BoundedExpression, position_lock, speed_lock
from kineverse.errors import InvalidValueError
from kineverse.model.body import Rgba, Shape
from kineverse.spatial import X, Z, rotation_about, translation_along

from .mechanism import (
    DARK,
    PALE,
    RED,
    STEEL,
    WOOD,
    Mechanism,
    MechanismPart,
    box_shape,
    case,
    constant_value,
    panel,
    rod_shape,
    shift,
)


@dataclass(frozen=True, kw_only=True)
class HingedDoor(Mechanism):
    """Base of doors about a vertical hinge at the base: base_T_door = rotation_z(q), q in [rad].

    The shut door, q = 0, lies in the (y, z) plane from the hinge to y = width, and opens towards -x.
    """

    main: ClassVar[str] = "door"

    width: float = 0.8  # [m]
    height: float = 2.0
    thickness: float = 0.04
    door: Limits = Limits(0.0, 1.9, 1.5)  # limits of q

    def __post_init__(self) -> None:
        self.check_lengths("width", "height", "thickness")
        super().__post_init__()
        if constant_value(self.door.lower) not in (None, 0.0) or self.door.lower is None:
            raise InvalidValueError(f"{self.describe('door')} is shut at 0, and not at {self.door.lower!r}.")

    def leaf(self, color: Rgba = WOOD, *shapes: Shape) -> MechanismPart:
        """Return the moving part of the door."""
        board = panel(self.width, self.height, self.thickness, color)
        return MechanismPart("base", (rotation_about(Z, self.q("door")),), (board, *shapes))

    def posts(self) -> tuple[Shape, Shape]:
        """Return the posts on both sides of the door, the first one clear of its corner that turns."""
        size = (self.thickness, 0.06, self.height)
        places = -0.035 - self.thickness, self.width + 0.035
        first, second = (box_shape(size, (0.0, y, self.height / 2), PALE) for y in places)
        return first, second

    def check_spring(self) -> None:
        """Check the fields ``stiffness`` and ``rest`` of the spring that returns a part to 0."""
        self.number("stiffness", positive=True)
        if (rest := self.number("rest")) > 0:
            raise InvalidValueError(
                f"{self.describe('rest')} is at 0 or before it, where the spring pushes to, and not at "
                f"{rest:g}."
            )

    def spring(self, part: str) -> tuple[tuple[str, Any], ...]:
        """Return the parameters of the spring that returns a part to 0."""
        return ((f"{part}/stiffness", self.number("stiffness")), (f"{part}/rest", self.number("rest")))


@dataclass(frozen=True, kw_only=True)
class DoorWithHandle(HingedDoor, document_kind="DoorWithHandle"):
    """Room door: shut, it opens only while the handle is pressed; once open, it moves freely.

    ================  ======================================================================
    ``name/door``     q [rad], see :class:`HingedDoor`
    ``name/handle``   h [rad]: door_T_handle = translation(…) · rotation_x(h), 0 at rest
    frames            ``base``, ``door``, ``handle``
    ``name/lock``     -speed <= q̇ <= speed·unlocked: closing is always free
    unlocked          (h > threshold) | ~(q < shut)
    record            ``handle/stiffness`` [N m/rad], ``handle/rest`` [rad]
    ================  ======================================================================

    Attributes
    ----------
    handle
        Limits of h.
    threshold
        Angle h beyond which the door is unlocked [rad].
    shut
        Angle q up to which the latch catches [rad].
    speed
        Limit of the angular speed of the door [rad/s].
    handle_height
        Height of the handle above the floor [m].
    stiffness
        Stiffness of the spring that lifts the handle, with the torque stiffness·(rest - h) [N m/rad].
    rest
        Angle at which it is slack [rad], before 0: it lifts the handle to its stop.

    Raises
    ------
    InvalidValueError
        For lengths that are not positive, a door that is not shut at 0, a threshold that the handle does not
        reach, a handle above the door, or a spring that does not lift the handle to 0.

    Examples
    --------
    >>> model = kv.Model()
    >>> with model.edit() as edit:
    ...     edit.apply(kv.articulations.DoorWithHandle(name="room", parent="world"))
    'door with handle room'
    >>> model.limits("room/door:velocity", {"room/door": 0, "room/handle": 0})
    (-1.5, 0.0)
    >>> model.limits("room/door:velocity", {"room/door": 0, "room/handle": 0.8})
    (-1.5, 1.5)
    """

    door: Limits = Limits(0.0, 1.9)
    handle: Limits = Limits(0.0, 0.9, 3.0)
    threshold: float = 0.6
    shut: float = 0.01
    speed: float = 1.5
    handle_height: float = 1.0
    stiffness: float = 1.5
    rest: float = -0.3

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_lengths("shut", "speed", "handle_height")
        self.check_threshold("threshold", self.handle)
        self.check_spring()
        if not self.handle_height < self.height:
            raise InvalidValueError(
                f"{self.describe('handle_height')} is below its height {self.height:g}, and not "
                f"{self.handle_height:g}."
            )

    @property
    def limits(self) -> Mapping[str, Limits]:
        """Limits of door and handle."""
        return {self.path("door"): self.door, self.path("handle"): self.handle}

    def locks(self) -> Mapping[str, BoundedExpression]:
        """Return the lock."""
        q = self.q("door")
        pressed = self.q("handle") > self.threshold
        return {
            "lock": speed_lock(
                q, open_if=pressed, engaged_if=q < self.shut, max_speed=self.speed, blocks="forward"
            )
        }

    def dynamics(self) -> tuple[tuple[str, Any], ...]:
        """Return the parameters of the handle's spring."""
        return self.spring("handle")

    def parts(self) -> Mapping[str, MechanismPart]:
        """Return posts, door and handle."""
        out = 0.05
        lever = box_shape((0.02, 0.12, 0.02), (0.0, -0.05, 0.0), STEEL)
        stem = rod_shape((0.0, 0.0, 0.0), (out, 0.0, 0.0), 0.008, STEEL)
        place = shift(-self.thickness / 2 - out, 0.93 * self.width, self.handle_height)
        return {
            "base": self.base(*self.posts()),
            "door": self.leaf(),
            "handle": MechanismPart("door", (place, rotation_about(X, self.q("handle"))), (lever, stem)),
        }


@dataclass(frozen=True, kw_only=True)
class SprungDoor(HingedDoor):
    """Base of doors that a spring-loaded part locks while they are shut, unless that part is moved away.

    The lock is one of the position (:func:`kineverse.articulations.position_lock`): an open door is free, and
    can be shut, because the bolt gives way.
    """

    sprung: ClassVar[str]
    """Name of the spring-loaded part."""

    catch: float  # displacement of the bolt or the button that opens the lock [m]
    play: float = 0.003  # largest angle at which the door counts as shut [rad]
    stiffness: float = 300.0  # of the spring, stiffness·(rest - b) on a coordinate b [N/m]
    rest: float = -0.01  # [m]

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_lengths("play")
        self.check_threshold("catch", getattr(self, self.sprung))
        self.check_spring()

    @property
    def limits(self) -> Mapping[str, Limits]:
        """Limits of the door and of the spring-loaded part."""
        return {self.path("door"): self.door, self.path(self.sprung): getattr(self, self.sprung)}

    def locks(self) -> Mapping[str, BoundedExpression]:
        """Return the lock."""
        away = self.q(self.sprung) > self.catch
        return {"latch": position_lock(self.q("door"), open_if=away, upper=0.0, margin=self.play)}

    def dynamics(self) -> tuple[tuple[str, Any], ...]:
        """Return the parameters of the spring."""
        return self.spring(self.sprung)


@dataclass(frozen=True, kw_only=True)
class Latch(SprungDoor, document_kind="Latch"):
    """Door with a spring-loaded bolt.

    ================  ======================================================================
    ``name/door``     q [rad]: base_T_door = rotation_z(q)
    ``name/bolt``     b [m]: door_T_bolt = translation(0, width - b, height/2), 0 at rest
    frames            ``base``, ``door``, ``bolt``
    ``name/latch``    q <= 0 unless b > catch or q >= play
    record            ``bolt/stiffness`` [N/m], ``bolt/rest`` [m]
    ================  ======================================================================

    Attributes
    ----------
    bolt
        Limits of b.

    Examples
    --------
    >>> model = kv.Model()
    >>> with model.edit() as edit:
    ...     edit.apply(kv.articulations.Latch(name="shed", parent="world"))
    'latch shed'
    >>> model.limits("shed/door", {"shed/door": 0, "shed/bolt": 0})[1]
    0.0
    >>> model.limits("shed/door", {"shed/door": 0, "shed/bolt": 0.012})[1]
    1.9
    """

    sprung: ClassVar[str] = "bolt"

    bolt: Limits = Limits(0.0, 0.012, 0.2)
    catch: float = 0.008

    def parts(self) -> Mapping[str, MechanismPart]:
        """Return posts, door and bolt."""
        tongue = box_shape((0.4 * self.thickness, 0.04, 0.03), (0.0, -0.01, 0.0), STEEL)
        place = shift(0.0, self.width, self.height / 2)
        slide = translation_along((0.0, -1.0, 0.0), self.q("bolt"))
        return {
            "base": self.base(*self.posts()),
            "door": self.leaf(),
            "bolt": MechanismPart("door", (place, slide), (tongue,)),
        }


@dataclass(frozen=True, kw_only=True)
class Microwave(SprungDoor, document_kind="Microwave"):
    """Microwave oven: its door stays shut unless the button is pressed, and then springs ajar.

    The spring of the door opens it as far as the friction of its hinge allows, to door_rest - friction /
    door_stiffness, 0.1 rad. So it stays ajar once the button is let go. Friction holds the wide open door.

    ================  ======================================================================
    ``name/door``     q [rad]: base_T_door = rotation_z(q)
    ``name/button``   b [m]: base_T_button = translation(b, …), 0 at rest
    frames            ``base`` (at the hinge, on the floor of the oven), ``door``, ``button``
    ``name/latch``    q <= 0 unless b > catch or q >= play
    record            ``button/stiffness`` [N/m], ``button/rest`` [m], and of the door
                      ``door/stiffness`` [N m/rad], ``door/rest`` [rad],
                      ``door/friction`` [N m], ``door/damping`` [N m s/rad]
    ================  ======================================================================

    Attributes
    ----------
    depth
        Depth of the oven behind its door [m].
    button
        Limits of b.
    door_stiffness, door_rest
        Spring of the door, with the torque door_stiffness·(door_rest - q) [N m/rad], [rad].
    friction, damping
        Friction [N m] and damping [N m s/rad] of its hinge.

    Raises
    ------
    InvalidValueError
        For lengths that are not positive, a button that does not reach the catch, or a spring that does not
        open the door beyond ``play``.

    Examples
    --------
    >>> model = kv.Model()
    >>> with model.edit() as edit:
    ...     edit.apply(kv.articulations.Microwave(name="oven", parent="world"))
    'microwave oven'
    >>> shut = model.default_state()
    >>> model.limits("oven/door", shut), model.limits("oven/door", shut | {"oven/button": 0.01})
    ((0.0, 0.0), (0.0, 1.9))
    """

    sprung: ClassVar[str] = "button"

    width: float = 0.36
    height: float = 0.28
    thickness: float = 0.03
    depth: float = 0.34
    door: Limits = Limits(0.0, 1.9, 2.0)
    button: Limits = Limits(0.0, 0.006, 0.1)
    catch: float = 0.004
    stiffness: float = 500.0
    rest: float = -0.004
    door_stiffness: float = 3.0
    door_rest: float = 1.1
    friction: float = 3.0
    damping: float = 1.0

    def __post_init__(self) -> None:
        self.check_lengths("depth", "door_stiffness", "friction", "damping")
        super().__post_init__()
        ajar = self.number("door_rest") - self.friction / self.door_stiffness
        if not ajar > self.play:
            raise InvalidValueError(
                f"The spring of the door of the {self.noun} '{self.name}' opens it beyond the play "
                f"{self.play:g}; with its rest at {self.door_rest:g} and its friction it stops at {ajar:g}."
            )

    def dynamics(self) -> tuple[tuple[str, Any], ...]:
        """Return the parameters of the springs and of the hinge."""
        spring = ("door/stiffness", self.door_stiffness), ("door/rest", self.door_rest)
        return (
            *super().dynamics(),
            *spring,
            ("door/friction", self.friction),
            ("door/damping", self.damping),
        )

    def parts(self) -> Mapping[str, MechanismPart]:
        """Return the oven, its door and its button."""
        w, h, t, depth = self.width, self.height, self.thickness, self.depth
        controls = 0.3 * w
        behind = (t / 2 + depth / 2, w / 2, h / 2)
        out, across = -t / 2 - 0.025, 0.92 * w
        grip = rod_shape((out, across, 0.15 * h), (out, across, 0.85 * h), 0.008, STEEL)
        gap = 0.004  # the corner of the door sweeps over its edge
        side = box_shape((depth + t, controls - gap, h), (depth / 2, w + (controls + gap) / 2, h / 2), DARK)
        place = shift(-t / 2, w + controls / 2, 0.2 * h), translation_along(X, self.q("button"))
        knob = box_shape((0.02, 0.6 * controls, 0.12 * h), (0.0, 0.0, 0.0), RED)
        return {
            "base": self.base(*case((depth, w, h), 0.02, PALE, behind), side),
            "door": self.leaf(DARK, grip),
            "button": MechanismPart("base", place, (knob,)),
        }
