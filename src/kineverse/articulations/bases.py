"""Mobile bases: a frame that moves over the floor.

All of them have the coordinates ``name/x``, ``name/y`` [m] and ``name/angle``, θ [rad], and

    parent_T_child = origin · translation(x, y, 0) · rotation_z(θ),

x forward and y to the left at θ = 0. They differ in the speeds that move these.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

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

from .joint import Joint, check_joint_number
from .limits import check_speed_limit, limit_constraints


@dataclass(frozen=True, kw_only=True)
class Base(Joint):
    """What mobile bases have in common: where they are on the floor."""

    @property
    def coordinates(self) -> tuple[Symbol, Symbol, Symbol]:
        """x, y [m] and the angle [rad]."""
        x, y, angle = (position(f"{self.name}/{c}") for c in ("x", "y", "angle"))
        return x, y, angle

    @property
    def frames(self) -> dict[str, Frame]:
        """The child frame."""
        x, y, angle = self.coordinates
        return {
            self.child: Frame.of(self.parent, (self.origin, translation(x, y, 0), rotation_z(angle))),
        }

    def check_wheels(self, paths: object, count: int) -> None:
        """Look whether paths are those of so many wheels.

        Raises
        ------
        InvalidValueError
            If they are more or less, the same twice, or no texts.
        """
        given = paths if isinstance(paths, (tuple, list)) else ()
        texts = {path for path in given if isinstance(path, str) and path}
        if len(given) != count or len(texts) != count:
            raise InvalidValueError(
                f"The wheels of the {self.noun} '{self.name}' are {count} different paths, not {paths!r}."
            )

    def limit(self, field: str) -> float | None:
        """Return a limit among the fields, None if there is none."""
        return check_speed_limit(getattr(self, field), f"'{field}' of the {self.noun} '{self.name}'")

    def within(self, field: str, speed: Expression, name: str = "") -> dict[str, Constraint]:
        """Return the constraint that keeps a speed within a limit either way, if there is one."""
        most = self.limit(field)
        return {} if most is None else {f"{self.name}/{name or field}": Constraint.of(-most, speed, most)}

    def slower(self, field: str, components: tuple[Expression, Expression]) -> dict[str, Constraint]:
        """Return the constraint that keeps the length of a velocity below a limit, if there is one."""
        most = self.limit(field)
        return (
            {} if most is None else {f"{self.name}/{field}": Constraint.of(0, norm(array(components)), most)}
        )


@dataclass(frozen=True, kw_only=True)
class OmniBase(Base, document_kind="OmniBase"):
    """An omnidirectional base: its coordinates x, y [m] and θ [rad] are all free.

    Attributes
    ----------
    speed
        Limit of the speed √(ẋ² + ẏ²) [m/s], whatever the direction; None for no limit.
    turn
        Limit of the turning speed, either way [rad/s]; None for no limit.
    """

    speed: float | None = 1.0
    turn: float | None = 0.6

    def apply(self, model: ReadRecorder) -> Writes:
        """Write the child frame and the speed limits."""
        x, y, angle = self.coordinates
        dx, dy, turning = speeds = tuple(c.derivative() for c in (x, y, angle))
        return Writes(
            frames=self.frames,
            constraints={**self.slower("speed", (dx, dy)), **self.within("turn", turning)},
            articulations={self.name: self.record((x, y, angle), (0.0, 0.0, 0.0), speeds)},
        )


@dataclass(frozen=True, kw_only=True)
class DifferentialDrive(Base, document_kind="DifferentialDrive"):
    """A base on two driven wheels, which cannot go sideways.

    Its coordinates x, y [m] and θ [rad] move by the wheels' speeds only (2022 paper, III-A1): with radius r
    and track b, ẋ = r/2 cos θ (ω_l + ω_r), ẏ = r/2 sin θ (ω_l + ω_r), θ̇ = r/b (ω_r - ω_l).

    Attributes
    ----------
    radius, track
        Of the wheels, and the distance between them [m].
    left, right
        Paths of the wheels' degrees of freedom; by default ``name/left_wheel`` and ``name/right_wheel``.
    wheel_speed
        Limit of the wheels' speeds [rad/s]; None for no limit.
    speed
        Limit of the speed √(ẋ² + ẏ²) = r/2 |ω_l + ω_r| [m/s]; None for no limit.
    turn
        Limit of the turning speed |θ̇|, either way [rad/s]; None for no limit.

    Raises
    ------
    InvalidValueError
        For a radius or a track that is not positive, or one wheel on both sides.
    """

    radius: float
    track: float
    left: str = ""
    right: str = ""
    wheel_speed: float | None = None
    speed: float | None = None
    turn: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        self.lengths("radius", "track")
        self.check_wheels(self.wheels, 2)

    @property
    def wheels(self) -> tuple[str, str]:
        """The paths of the left and the right wheel."""
        # Compared with "" and not asked for its truth, which not everything has that is no text.
        return (
            f"{self.name}/left_wheel" if self.left == "" else self.left,
            f"{self.name}/right_wheel" if self.right == "" else self.right,
        )

    def apply(self, model: ReadRecorder) -> Writes:
        """Write the child frame, the rates and the limits."""
        x, y, angle = self.coordinates
        left, right = map(velocity, self.wheels)
        along, about = self.radius / 2, self.radius / self.track
        return Writes(
            frames=self.frames,
            constraints={
                **self.within("wheel_speed", left, "left_wheel_speed"),
                **self.within("wheel_speed", right, "right_wheel_speed"),
                **self.within("speed", along * (left + right)),
                **self.within("turn", about * (right - left)),
            },
            rates={
                x: {left: along * np.cos(angle), right: along * np.cos(angle)},
                y: {left: along * np.sin(angle), right: along * np.sin(angle)},
                angle: {left: -about, right: about},
            },
            articulations={self.name: self.record((x, y, angle), (0.0, 0.0, 0.0), (left, right))},
        )


@dataclass(frozen=True, kw_only=True)
class Ackermann(Base, document_kind="Ackermann"):
    """A car: the child is the middle of its rear axle, x forward, and its front wheels steer.

    Coordinates are x, y [m], θ [rad] and the steering angle ``name/steering``, δ [rad], that of a wheel in
    the middle of the front axle, positive to the left. Speeds are that of the rear axle, v = ``name/drive``
    [m/s], and δ̇. With the wheelbase L,

        ẋ = v cos θ,        ẏ = v sin θ,        θ̇ = v tan(δ)/L.

    Attributes
    ----------
    wheelbase
        L, the distance between the axles [m].
    steering
        Limit of the steering angle, either way, in (0, π/2) [rad]: the car turns on a circle of radius
        L/tan(steering) at least.
    steering_speed
        Limit of |δ̇| [rad/s]; None for no limit.
    speed
        Limit of the speed |v| = √(ẋ² + ẏ²) [m/s]; None for no limit.

    Raises
    ------
    InvalidValueError
        For a wheelbase that is not positive, or a steering angle outside (0, π/2).
    DuplicateNameError
        For an articulation or a frame that exists.
    """

    wheelbase: float
    steering: float = 0.6
    steering_speed: float | None = None
    speed: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        self.lengths("wheelbase")
        text = f"The steering angle of the {self.noun} '{self.name}'"
        if not 0 < check_joint_number(self.steering, text) < math.pi / 2:
            raise InvalidValueError(f"{text} is limited to something in (0, π/2) rad, not {self.steering!r}.")

    def apply(self, model: ReadRecorder) -> Writes:
        """Write the child frame, the rates and the limits."""
        self.check_free(model)
        x, y, angle = self.coordinates
        steering, drive = position(f"{self.name}/steering"), velocity(f"{self.name}/drive")
        bound = self.limit("steering_speed")
        return Writes(
            frames=self.frames,
            constraints={
                **dict(
                    limit_constraints(f"{self.name}/steering", steering, -self.steering, self.steering, bound)
                ),
                **self.within("speed", drive),
            },
            rates={
                x: {drive: np.cos(angle)},
                y: {drive: np.sin(angle)},
                angle: {drive: np.tan(steering) / self.wheelbase},
            },
            articulations={
                self.name: self.record(
                    (x, y, angle, steering), (0.0, 0.0, 0.0, 0.0), (drive, steering.derivative())
                )
            },
        )


@dataclass(frozen=True, kw_only=True)
class Mecanum(Base, document_kind="Mecanum"):
    """A base on four wheels with oblique rollers, which goes sideways too.

    Its coordinates x, y [m] and θ [rad] move by four speeds, those of the wheels, front left, front right,
    rear left, rear right, each positive where it drives forward. With the radius r, the track b and the
    wheelbase L, velocity and turning speed in the base's own axes are

        v_x = r/4 ( ω_fl + ω_fr + ω_rl + ω_rr)
        v_y = r/4 (-ω_fl + ω_fr + ω_rl - ω_rr)
        θ̇   = r/(2(b + L)) (-ω_fl + ω_fr - ω_rl + ω_rr)

    and ẋ, ẏ are (v_x, v_y) turned by θ. Four speeds move three coordinates: (1, 1, -1, -1) moves nothing, the
    wheels slip. Rolling without slip is ω_fl + ω_fr = ω_rl + ω_rr, which whoever picks speeds should keep to;
    of all speeds for a motion, those are the smallest.

    Attributes
    ----------
    radius
        Of the wheels [m].
    track, wheelbase
        Distance between left and right wheels, and between front and rear ones [m].
    wheels
        Paths of the wheels' degrees of freedom in the order above; by default ``name/front_left_wheel`` and
        so on.
    wheel_speed
        Limit of the wheels' speeds [rad/s]; None for no limit.
    speed
        Limit of the speed √(ẋ² + ẏ²) [m/s], whatever the direction; None for no limit.
    turn
        Limit of the turning speed, either way [rad/s]; None for no limit.

    Raises
    ------
    InvalidValueError
        For lengths that are not positive, or another number of wheels than four.
    DuplicateNameError
        For an articulation or a frame that exists.
    """

    radius: float
    track: float
    wheelbase: float
    wheels: tuple[str, ...] = ()
    wheel_speed: float | None = None
    speed: float | None = None
    turn: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        self.lengths("radius", "track", "wheelbase")
        if not isinstance(self.wheels, tuple) or self.wheels:
            self.check_wheels(self.wheels, 4)
            object.__setattr__(self, "wheels", tuple(self.wheels))

    def apply(self, model: ReadRecorder) -> Writes:
        """Write the child frame, the rates and the limits."""
        self.check_free(model)
        x, y, angle = self.coordinates
        paths = self.wheels or tuple(f"{self.name}/{corner}_wheel" for corner in _CORNERS)
        wheels = tuple(map(velocity, paths))
        along, about = self.radius / 4, self.radius / (2 * (self.track + self.wheelbase))
        forward = dict.fromkeys(wheels, along)
        sideways = {wheel: sign * along for wheel, sign in zip(wheels, (-1, 1, 1, -1), strict=True)}
        turning = {wheel: sign * about for wheel, sign in zip(wheels, (-1, 1, -1, 1), strict=True)}
        constraints: dict[str, Constraint] = {}
        for corner, wheel in zip(_CORNERS, wheels, strict=True):
            constraints |= self.within("wheel_speed", wheel, f"{corner}_wheel_speed")
        constraints |= self.slower("speed", (_total(forward), _total(sideways)))
        constraints |= self.within("turn", _total(turning))
        c, s = np.cos(angle), np.sin(angle)
        return Writes(
            frames=self.frames,
            constraints=constraints,
            rates={
                x: {wheel: forward[wheel] * c - sideways[wheel] * s for wheel in wheels},
                y: {wheel: forward[wheel] * s + sideways[wheel] * c for wheel in wheels},
                angle: turning,
            },
            articulations={self.name: self.record((x, y, angle), (0.0, 0.0, 0.0), wheels)},
        )


_CORNERS = ("front_left", "front_right", "rear_left", "rear_right")


def _total(row: Mapping[Symbol, float]) -> Expression:
    terms = [factor * wheel for wheel, factor in row.items()]
    return sum(terms[1:], terms[0])
