"""Transmissions: gearbox, rack and pinion, cam."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass

import numpy as np

from kineverse.errors import InvalidValueError, KineverseError, UnknownNameError
from kineverse.expressions.expression import Expression
from kineverse.expressions.piecewise import spline
from kineverse.model.body import Pose
from kineverse.model.operation import Writes
from kineverse.model.read_recorder import ReadRecorder
from kineverse.spatial import translation_along

from .joint import OneAxisMotion, check_joint_number, check_position_expression
from .single_axis import rotation_factors, unit_axis


@dataclass(frozen=True, kw_only=True)
class Transmission(OneAxisMotion):
    """Base of the transmissions: joints whose position q is a function of the position d of a driver.

    Limits of q and of its speed are constraints on that function. A transmission may drive another one. The
    driver's position is read from the model, so a gear train follows when its first gear is replaced.

    Attributes
    ----------
    driver
        Name of an articulation with one coordinate, or an expression of positions [rad].

    Raises
    ------
    InvalidValueError
        For a driver without a position or with several coordinates, or a constant one.

    See Also
    --------
    kineverse.articulations.Gearbox
    """

    driver: str | Expression

    def __post_init__(self) -> None:
        super().__post_init__()
        if isinstance(self.driver, str):
            return
        if not isinstance(self.driver, Expression):
            wanted = "the name of an articulation or an expression"
            raise InvalidValueError(f"{self._driver_noun} is {wanted}, not {self.driver!r}.")
        if not check_position_expression(self.driver, self._driver_noun).symbols:
            raise InvalidValueError(f"{self._driver_noun} is constant: {self.driver!r}.")

    @abstractmethod
    def transmit(self, driver: Expression) -> Expression:
        """Return q as a function of the driver's position."""

    def apply(self, model: ReadRecorder) -> Writes:
        """Write the child frame and the limits."""
        self.check_free(model)
        return self.joint_writes(self.transmit(self._find_driver(model)))

    @property
    def _driver_noun(self) -> str:
        return f"The driver of the {self.noun} '{self.name}'"

    def _find_driver(self, model: ReadRecorder) -> Expression:
        if isinstance(self.driver, Expression):
            return self.driver
        try:
            record = model.articulations[self.driver]
        except UnknownNameError as error:
            raise UnknownNameError(f"{self._driver_noun} is missing. {error}") from None
        if record.position is None:
            names = ", ".join(f"'{s}'" for s in record.coordinates)
            has = "no position"
            if names:
                example = f"driver=kv.position('{record.coordinates[0]}')"
                has = f"{len(record.coordinates)} coordinates, {names}; give one of them, as {example}"
            raise InvalidValueError(f"{self._driver_noun}, '{self.driver}', has {has}.")
        return record.position


@dataclass(frozen=True, kw_only=True)
class Gearbox(Transmission, document_kind="Gearbox"):
    """Gearbox or belt: parent_T_child = origin · rotation(axis, q) with q = ratio · d + offset [rad].

    Attributes
    ----------
    ratio
        Revolutions of the child per revolution of the driver; negative for opposite senses.
    offset
        q at d = 0 [rad].

    Raises
    ------
    InvalidValueError
        For a ratio of 0 or NaN.

    Examples
    --------
    >>> model = kv.Model()
    >>> with model.edit() as edit:
    ...     edit.apply(kv.Continuous(name="motor", parent="world", child="motor", axis=(0, 0, 1)))
    ...     edit.apply(
    ...         kv.articulations.Gearbox(
    ...             name="wheel", parent="world", child="wheel", axis=(0, 0, 1), driver="motor", ratio=-0.25
    ...         )
    ...     )
    'joint motor'
    'joint wheel'
    >>> model.degrees_of_freedom
    (motor,)
    >>> kv.spatial.to_rpy(model.fk("wheel"))({"motor": 2.0})
    array([ 0. ,  0. , -0.5])
    """

    ratio: float
    offset: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not check_joint_number(self.ratio, f"The ratio of the gearbox '{self.name}'"):
            raise InvalidValueError(f"The ratio of the gearbox '{self.name}' is 0, so nothing would turn.")
        check_joint_number(self.offset, f"The offset of the gearbox '{self.name}'")

    def transmit(self, driver: Expression) -> Expression:
        """Return the angle of the child [rad]."""
        return self.ratio * driver + self.offset

    def motion(self, q: Expression) -> tuple[Pose | Expression, ...]:
        """Return the factors of joint_T_child."""
        return rotation_factors(self.axis, q)


@dataclass(frozen=True, kw_only=True)
class RackAndPinion(Transmission, document_kind="RackAndPinion"):
    """Rack and pinion: parent_T_child = origin · translation(axis · q), q = radius · d + offset.

    Attributes
    ----------
    radius
        Radius of the pinion's pitch circle [m]. The axis gives the direction of the rack.
    offset
        q at d = 0 [m].

    Raises
    ------
    InvalidValueError
        For a radius that is not positive.

    Examples
    --------
    >>> model = kv.Model()
    >>> with model.edit() as edit:
    ...     edit.apply(kv.Continuous(name="pinion", parent="world", child="pinion", axis=(0, 0, 1)))
    ...     edit.apply(
    ...         kv.articulations.RackAndPinion(
    ...             name="rack", parent="world", child="rack", axis=(1, 0, 0), driver="pinion", radius=0.02
    ...         )
    ...     )
    'joint pinion'
    'joint rack'
    >>> model.fk("rack")({"pinion": 2.0})[0, 3]
    np.float64(0.04)
    """

    radius: float
    offset: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check_joint_number(self.radius, f"The radius of the rack and pinion '{self.name}'", positive=True)
        check_joint_number(self.offset, f"The offset of the rack and pinion '{self.name}'")

    def transmit(self, driver: Expression) -> Expression:
        """Return the position of the rack [m]."""
        return self.radius * driver + self.offset

    def motion(self, q: Expression) -> tuple[Pose | Expression, ...]:
        """Return the factors of joint_T_child."""
        return (translation_along(unit_axis(self.axis), q),)


@dataclass(frozen=True, kw_only=True)
class Cam(Transmission, document_kind="Cam"):
    """Cam with a follower: parent_T_child = origin · translation(axis · q), q = profile(d) [m].

    With ``turns`` it is origin · rotation(axis, q), q = profile(d) [rad]. The profile is a cubic spline
    through points, see :func:`kineverse.spline`: twice continuously differentiable, so the follower's
    acceleration is continuous.

    Attributes
    ----------
    angles
        Increasing angles of the cam [rad].
    values
        Positions of the follower at these angles [m], or [rad] if it turns.
    periodic
        True if the profile is periodic: the last angle is the first one after a revolution, with the same
        value. Otherwise the follower rests before the first angle and after the last.
    turns
        True if the follower rotates about the axis, False if it slides along it.

    Raises
    ------
    InvalidValueError
        For angles that do not increase, different numbers of angles and values, NaN, or a periodic profile
        whose ends differ.

    Examples
    --------
    >>> model = kv.Model()
    >>> with model.edit() as edit:
    ...     edit.apply(kv.Continuous(name="shaft", parent="world", child="cam", axis=(0, 1, 0)))
    ...     edit.apply(
    ...         kv.articulations.Cam(
    ...             name="valve",
    ...             parent="world",
    ...             child="valve",
    ...             axis=(0, 0, 1),
    ...             driver="shaft",
    ...             angles=(0, np.pi, 2 * np.pi),
    ...             values=(0, 0.01, 0),
    ...             periodic=True,
    ...         )
    ...     )
    'joint shaft'
    'joint valve'
    >>> model.fk("valve")({"shaft": np.pi})[2, 3]
    np.float64(0.01)
    """

    angles: tuple[float, ...]
    values: tuple[float, ...]
    periodic: bool = True
    turns: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        for what in ("angles", "values"):
            given = getattr(self, what)
            try:
                object.__setattr__(self, what, tuple(given))
            except (KineverseError, TypeError):
                told = f"The {what} of the cam '{self.name}' are numbers, not {given!r}."
                raise InvalidValueError(told) from None
        for what in ("periodic", "turns"):
            flag = getattr(self, what)
            if not isinstance(flag, (bool, np.bool_)):
                raise InvalidValueError(f"'{what}' of the cam '{self.name}' is True or False, not {flag!r}.")
        try:
            spline(0.0, self.angles, self.values, self.periodic)
        except InvalidValueError as error:
            raise InvalidValueError(f"The profile of the cam '{self.name}' is invalid. {error}") from None
        for what in ("angles", "values"):
            object.__setattr__(self, what, tuple(map(float, getattr(self, what))))

    def transmit(self, driver: Expression) -> Expression:
        """Return the position of the follower [m] or [rad]."""
        return spline(driver, self.angles, self.values, self.periodic)

    def motion(self, q: Expression) -> tuple[Pose | Expression, ...]:
        """Return the factors of joint_T_child."""
        return rotation_factors(self.axis, q) if self.turns else (translation_along(unit_axis(self.axis), q),)
