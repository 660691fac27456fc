"""Mobile bases: omnidirectional, differential drive, Ackermann steering, mecanum wheels.

All bases have the coordinates ``name/x``, ``name/y`` [m] and ``name/angle``, θ [rad], and the pose

    parent_T_child = origin · translation(x, y, 0) · rotation_z(θ),

x forward and y to the left at θ = 0. They differ in the speeds that move these coordinates.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from kineverse.errors import InvalidValueError
from kineverse.expressions.expression import Expression, array
from kineverse.expressions.functions import norm
from kineverse.model.constraint import Constraint
from kineverse.model.frame import Frame
from kineverse.model.operation import Writes
from kineverse.model.read_recorder import ReadRecorder
from kineverse.spatial import rotation_z, translation
from kineverse.symbols import Symbol, position, velocity

from .joint import Joint, Size, check_joint_number, check_size
from .limits import check_speed_limit, limit_constraints


@dataclass(frozen=True, kw_only=True)
class Base(Joint):
    """Base of the mobile bases: planar pose on the floor, limits of speeds.

    See Also
    --------
    kineverse.articulations.OmniBase
    kineverse.articulations.DifferentialDrive
    """

    @property
    def coordinates(self) -> tuple[Symbol, Symbol, Symbol]:
        """Coordinates x, y [m] and θ [rad]."""
        x, y, angle = (position(f"{self.name}/{c}") for c in ("x", "y", "angle"))
        return x, y, angle

    @property
    def frames(self) -> dict[str, Frame]:
        """Frame of the base, by its name."""
        x, y, angle = self.coordinates
        pose = self.origin, translation(x, y, 0), rotation_z(angle)
        return {self.child: Frame.from_transform(self.parent, pose)}

    def check_wheels(self, paths: object, count: int) -> None:
        """Check that paths are different names, one for each wheel.

        Raises
        ------
        InvalidValueError
            If their number is wrong, one occurs twice, or is no text.
        """
        given = paths if isinstance(paths, (tuple, list)) else ()
        texts = {path for path in given if isinstance(path, str) and path}
        if len(given) != count or len(texts) != count:
            what = f"The wheels of the {self.noun} '{self.name}'"
            raise InvalidValueError(f"{what} are {count} different paths, not {paths!r}.")

    def speed_bound(self, field: str) -> float | None:
        """Return the limit of a speed in a field, None if there is none."""
        return check_speed_limit(getattr(self, field), f"'{field}' of the {self.noun} '{self.name}'")

    def speed_limit(self, field: str, speed: Expression, name: str = "") -> dict[str, Constraint]:
        """Return the constraint -limit <= speed <= limit, if the field has a limit."""
        most = self.speed_bound(field)
        if most is None:
            return {}
        return {f"{self.name}/{name or field}": Constraint.from_expressions(-most, speed, most)}

    def speed_norm_limit(
        self, field: str, components: tuple[Expression, Expression]
    ) -> dict[str, Constraint]:
        """Return the constraint ``|velocity| <= limit``, if the field has a limit."""
        most = self.speed_bound(field)
        if most is None:
            return {}
        return {f"{self.name}/{field}": Constraint.from_expressions(0, norm(array(components)), most)}


@dataclass(frozen=True, kw_only=True)
class OmniBase(Base, document_kind="OmniBase"):
    """Omnidirectional base: its coordinates x, y [m] and θ [rad] are all free.

    Attributes
    ----------
    speed
        Limit of the speed √(ẋ² + ẏ²) [m/s]; None for no limit.
    turn
        Limit of the angular speed ``|θ̇|`` [rad/s]; None for no limit.

    Examples
    --------
    >>> model = kv.load("hsr")
    >>> with model.edit() as edit:
    ...     edit.apply(
    ...         kv.articulations.OmniBase(name="base", parent="world", child="base", speed=0.3, turn=1.0)
    ...     )
    ...     edit.attach("hsr/base_link", parent="base", transform=np.eye(4))
    'joint base'
    'attach hsr/base_link to base'
    >>> model.degrees_of_freedom[:3]
    (base/angle, base/x, base/y)
    """

    speed: float | None = 1.0
    turn: float | None = 0.6

    def apply(self, model: ReadRecorder) -> Writes:
        """Write the child frame and the speed limits."""
        x, y, angle = self.coordinates
        dx, dy, turning = (c.derivative() for c in (x, y, angle))
        return Writes(
            frames=self.frames,
            constraints={**self.speed_norm_limit("speed", (dx, dy)), **self.speed_limit("turn", turning)},
            articulations={self.name: self.record((x, y, angle))},
        )


@dataclass(frozen=True, kw_only=True)
class DifferentialDrive(Base, document_kind="DifferentialDrive"):
    """Differential drive: a base on two driven wheels, which cannot move sideways.

    The coordinates x, y [m] and θ [rad] move by the wheels' speeds (2022 paper, III-A1): with radius r and
    track b, ẋ = r/2 cos θ (ω_l + ω_r), ẏ = r/2 sin θ (ω_l + ω_r), θ̇ = r/b (ω_r - ω_l). With different radii,
    r_l ω_l and r_r ω_r stand for r ω_l and r ω_r.

    Attributes
    ----------
    radius
        Radius of the wheels [m], or those of the left and the right one; numbers or expressions.
    track
        Distance between the wheels [m], a number or an expression.
    left, right
        Paths of the wheels' degrees of freedom; by default ``name/left_wheel`` and ``name/right_wheel``.
    wheel_speed
        Limit of the wheels' speeds [rad/s]; None for no limit.
    speed
        Limit of the speed √(ẋ² + ẏ²) = ``|r_l ω_l + r_r ω_r|/2`` [m/s]; None for no limit.
    turn
        Limit of the angular speed ``|θ̇|`` [rad/s]; None for no limit.

    Raises
    ------
    InvalidValueError
        For a radius or a track that is not positive, or one wheel on both sides.

    Examples
    --------
    >>> model = kv.Model()
    >>> with model.edit() as edit:
    ...     edit.apply(
    ...         kv.articulations.DifferentialDrive(
    ...             name="base", parent="world", child="base", radius=0.1, track=0.5
    ...         )
    ...     )
    'joint base'
    >>> model.speeds_of("base")
    (base/left_wheel:velocity, base/right_wheel:velocity)
    >>> forward = {"base/left_wheel:velocity": 2.0, "base/right_wheel:velocity": 2.0}
    >>> model.integrate(model.default_state(), forward, dt=1.0)
    State({base/angle: 0, base/x: 0.2, base/y: 0})
    """

    radius: Size | tuple[Size, Size]
    track: Size
    left: str = ""
    right: str = ""
    wheel_speed: float | None = None
    speed: float | None = None
    turn: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        what = f"The radius of the {self.noun} '{self.name}'"
        if isinstance(self.radius, (tuple, list)):
            if len(self.radius) != 2:
                raise InvalidValueError(f"{what} is one number or a pair (left, right), not {self.radius!r}.")
            object.__setattr__(self, "radius", tuple(self.radius))
        for radius in self.radii:
            check_size(radius, what, positive=True)
        self.check_sizes("track")
        self.check_wheels(self.wheels, 2)

    @property
    def radii(self) -> tuple[Size, Size]:
        """Radii of the left and the right wheel [m]."""
        left, right = self.radius if isinstance(self.radius, tuple) else (self.radius, self.radius)
        return left, right

    @property
    def wheels(self) -> tuple[str, str]:
        """Paths of the left and the right wheel."""
        # Compared with "", because a wrong argument such as an array may have no truth value.
        return (
            f"{self.name}/left_wheel" if self.left == "" else self.left,
            f"{self.name}/right_wheel" if self.right == "" else self.right,
        )

    def apply(self, model: ReadRecorder) -> Writes:
        """Write the child frame, the rates and the limits."""
        x, y, angle = self.coordinates
        left, right = map(velocity, self.wheels)
        along = [radius / 2 for radius in self.radii]
        about = [radius / self.track for radius in self.radii]
        forward, turning = along[0] * left + along[1] * right, about[1] * right - about[0] * left
        if self.radii[0] == self.radii[1]:
            # The form that released documents have.
            forward, turning = along[0] * (left + right), about[0] * (right - left)
        return Writes(
            frames=self.frames,
            constraints={
                **self.speed_limit("wheel_speed", left, "left_wheel_speed"),
                **self.speed_limit("wheel_speed", right, "right_wheel_speed"),
                **self.speed_limit("speed", forward),
                **self.speed_limit("turn", turning),
            },
            rates={
                x: {left: along[0] * np.cos(angle), right: along[1] * np.cos(angle)},
                y: {left: along[0] * np.sin(angle), right: along[1] * np.sin(angle)},
                angle: {left: -about[0], right: about[1]},
            },
            articulations={self.name: self.record((x, y, angle), speeds=(left, right))},
        )


@dataclass(frozen=True, kw_only=True)
class Ackermann(Base, document_kind="Ackermann"):
    """Ackermann steering: the child frame is the middle of the rear axle, x forward; the front wheels steer.

    Coordinates are x, y [m], θ [rad] and the steering angle ``name/steering``, δ [rad], of a wheel in the
    middle of the front axle, positive to the left. Speeds are that of the rear axle, v = ``name/drive``
    [m/s], and δ̇. With the wheelbase L::

        ẋ = v cos θ,        ẏ = v sin θ,        θ̇ = v tan(δ)/L.

    Attributes
    ----------
    wheelbase
        L, the distance between the axles [m], a number or an expression.
    steering
        Limit of ``|δ|`` in (0, π/2) [rad]; the smallest turning radius is L/tan(steering).
    steering_speed
        Limit of ``|δ̇|`` [rad/s]; None for no limit.
    speed
        Limit of the speed ``|v| = √(ẋ² + ẏ²)`` [m/s]; None for no limit.

    Raises
    ------
    InvalidValueError
        For a wheelbase that is not positive, or a steering angle outside (0, π/2).

    Examples
    --------
    >>> model = kv.Model()
    >>> with model.edit() as edit:
    ...     edit.apply(
    ...         kv.articulations.Ackermann(name="car", parent="world", child="car", wheelbase=2.5)
    ...     )
    'joint car'
    >>> state = model.default_state().updated({"car/steering": 0.3})
    >>> model.integrate(state, {"car/drive:velocity": 1.0}, dt=1.0)
    State({car/angle: 0.123734, car/steering: 0.3, car/x: 0.99745, car/y: 0.0617884})
    """

    wheelbase: Size
    steering: float = 0.6
    steering_speed: float | None = None
    speed: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_sizes("wheelbase")
        text = f"The steering angle of the {self.noun} '{self.name}'"
        if not 0 < check_joint_number(self.steering, text) < math.pi / 2:
            raise InvalidValueError(f"{text} is limited to something in (0, π/2) rad, not {self.steering!r}.")

    def apply(self, model: ReadRecorder) -> Writes:
        """Write the child frame, the rates and the limits."""
        self.check_free(model)
        x, y, angle = self.coordinates
        steering, drive = position(f"{self.name}/steering"), velocity(f"{self.name}/drive")
        bound = self.speed_bound("steering_speed")
        limits = limit_constraints(f"{self.name}/steering", steering, -self.steering, self.steering, bound)
        speeds = drive, steering.derivative()
        return Writes(
            frames=self.frames,
            constraints={**dict(limits), **self.speed_limit("speed", drive)},
            rates={
                x: {drive: np.cos(angle)},
                y: {drive: np.sin(angle)},
                angle: {drive: np.tan(steering) / self.wheelbase},
            },
            articulations={self.name: self.record((x, y, angle, steering), speeds=speeds)},
        )


@dataclass(frozen=True, kw_only=True)
class Mecanum(Base, document_kind="Mecanum"):
    """Base on four mecanum wheels, which moves sideways too.

    The coordinates x, y [m] and θ [rad] move by the speeds of the four wheels, front left, front right, rear
    left, rear right, each positive where it drives forward. With the radius r, the track b and the wheelbase
    L, the velocity and the angular speed in the axes of the base are::

        v_x = r/4 ( ω_fl + ω_fr + ω_rl + ω_rr)
        v_y = r/4 (-ω_fl + ω_fr + ω_rl - ω_rr)
        θ̇   = r/(2(b + L)) (-ω_fl + ω_fr - ω_rl + ω_rr)

    and (ẋ, ẏ) is (v_x, v_y) rotated by θ. Four speeds move three coordinates: (1, 1, -1, -1) moves nothing,
    the wheels slip. Without slip, ω_fl + ω_fr = ω_rl + ω_rr; among all speeds for a motion, these have the
    smallest norm.

    Attributes
    ----------
    radius
        Radius of the wheels [m], a number or an expression, like the next two.
    track, wheelbase
        Distance between left and right wheels, and between front and rear ones [m].
    wheels
        Paths of the wheels' degrees of freedom in the order above; by default ``name/front_left_wheel`` and
        so on.
    wheel_speed
        Limit of the wheels' speeds [rad/s]; None for no limit.
    speed
        Limit of the speed √(ẋ² + ẏ²) [m/s]; None for no limit.
    turn
        Limit of the angular speed ``|θ̇|`` [rad/s]; None for no limit.

    Raises
    ------
    InvalidValueError
        For lengths that are not positive, or another number of wheels than four.

    Examples
    --------
    >>> model = kv.Model()
    >>> with model.edit() as edit:
    ...     edit.apply(
    ...         kv.articulations.Mecanum(
    ...             name="base", parent="world", child="base", radius=0.1, track=0.4, wheelbase=0.5
    ...         )
    ...     )
    'joint base'
    >>> sideways = dict(zip(model.speeds, (-1, 1, 1, -1)))
    >>> model.integrate(model.default_state(), sideways, dt=1.0)
    State({base/angle: 0, base/x: 0, base/y: 0.1})
    """

    radius: Size
    track: Size
    wheelbase: Size
    wheels: tuple[str, ...] = ()
    wheel_speed: float | None = None
    speed: float | None = None
    turn: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_sizes("radius", "track", "wheelbase")
        if not isinstance(self.wheels, tuple) or self.wheels:
            self.check_wheels(self.wheels, 4)
            object.__setattr__(self, "wheels", tuple(self.wheels))

    def apply(self, model: ReadRecorder) -> Writes:
        """Write the child frame, the rates and the limits."""
        self.check_free(model)
        x, y, angle = self.coordinates
        paths = self.wheels or tuple(f"{self.name}/{corner}_wheel" for corner in _CORNERS)
        wheels = tuple(map(velocity, paths))
        along = self.radius / 4
        about = self.radius / (2 * (self.track + self.wheelbase))
        forward = dict.fromkeys(wheels, along)
        sideways = {wheel: sign * along for wheel, sign in zip(wheels, (-1, 1, 1, -1), strict=True)}
        turning = {wheel: sign * about for wheel, sign in zip(wheels, (-1, 1, -1, 1), strict=True)}
        constraints: dict[str, Constraint] = {}
        for corner, wheel in zip(_CORNERS, wheels, strict=True):
            constraints |= self.speed_limit("wheel_speed", wheel, f"{corner}_wheel_speed")
        constraints |= self.speed_norm_limit("speed", (_total(forward), _total(sideways)))
        constraints |= self.speed_limit("turn", _total(turning))
        c, s = np.cos(angle), np.sin(angle)
        return Writes(
            frames=self.frames,
            constraints=constraints,
            rates={
                x: {wheel: forward[wheel] * c - sideways[wheel] * s for wheel in wheels},
                y: {wheel: forward[wheel] * s + sideways[wheel] * c for wheel in wheels},
                angle: turning,
            },
            articulations={self.name: self.record((x, y, angle), speeds=wheels)},
        )


_CORNERS = ("front_left", "front_right", "rear_left", "rear_right")


def _total(row: Mapping[Symbol, Any]) -> Expression:
    terms = [factor * wheel for wheel, factor in row.items()]
    total: Expression = sum(terms[1:], terms[0])
    return total
