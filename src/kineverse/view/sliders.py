"""Ranges, units and quaternion angles of the sliders.

Models do not declare units of coordinates, so they are derived from the motion. A coordinate that rotates
some frame by one radian a unit is an angle, one that shifts a frame by one metre a unit is a length. Others
(a door lifted by a rope, a screw) have no unit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

import kineverse as kv
from kineverse.model.model_view import ModelView
from kineverse.state import State

from .html import format_significant
from .poses import roll_pitch_yaw

DEGREES = {"rad": ("°", math.degrees(1.0)), "rad/s": ("°/s", math.degrees(1.0))}
CENTIMETRES = {"m": ("cm", 100.0), "m/s": ("cm/s", 100.0)}
"""The other unit in which numbers may be shown, by unit, and the factor to it."""

UNLIMITED_RANGE = {"rad": np.pi, "m": 2.0, "": 2.0}  # half of the range of a slider without limits [rad], [m]

STANDSTILL_SPEED = 1e-6  # largest speed at standstill [rad/s], [m/s]; locks are as sharp as their logic


class Ranges:
    """Limits of all degrees of freedom of a model, evaluated at states.

    Numeric limits are evaluated once. Limits that are expressions (a drawer that opens only as far as the
    door beside it) are evaluated at each state.
    """

    def __init__(self, model: ModelView) -> None:
        self._model = model
        free = model.degrees_of_freedom
        self.names = [str(symbol) for symbol in free]
        self._limits = {str(symbol): model.limits(symbol) for symbol in free}
        bounded = {
            constraint.expression.symbols[0]
            for constraint in model.constraints.values()
            if len(constraint.expression.symbols) == 1
            and (constraint.lower.symbols or constraint.upper.symbols)
        }
        self._dependent = [symbol for symbol in free if symbol in bounded]
        one_way = {symbol for symbol in free if 0.0 in model.limits(symbol.derivative())}
        self._locked = [s for s in free if s in one_way or s.derivative() in bounded]

    @property
    def varying(self) -> list[str]:
        """The degrees of freedom whose limits may depend on the state."""
        return [str(symbol) for symbol in self._dependent]

    @property
    def lockable(self) -> list[str]:
        """The degrees of freedom that the state may keep from moving in a direction."""
        return [str(symbol) for symbol in self._locked]

    def locked_directions(self, values: Mapping[str, float]) -> dict[str, tuple[bool, bool]]:
        """Return a pair for each lockable coordinate: True if it cannot decrease, True if it cannot increase.

        Locks are limits of speeds. A coordinate at its own limit cannot go on either, which counts if it is
        locked in the other direction.
        """
        found = {}
        state = State(values) if self._locked else None
        for symbol in self._locked:
            slowest, fastest = self._model.limits(symbol.derivative(), state)
            lower, upper = self._model.limits(symbol, state)
            value, down, up = values[str(symbol)], slowest > -STANDSTILL_SPEED, fastest < STANDSTILL_SPEED
            at_end = down and value >= upper - STANDSTILL_SPEED, up and value <= lower + STANDSTILL_SPEED
            found[str(symbol)] = (down or at_end[1], up or at_end[0])
        return found

    def limits_at(self, values: Mapping[str, float]) -> dict[str, tuple[float, float]]:
        """Return lower and upper limit of each degree of freedom, -inf and inf where there is none."""
        limits = dict(self._limits)
        state = State(values) if self._dependent else None
        for symbol in self._dependent:
            limits[str(symbol)] = self._model.limits(symbol, state)
        return limits


@dataclass
class DisplayUnits:
    """Units in which the page shows numbers."""

    degrees: bool = False  # instead of radians
    centimetres: bool = False  # instead of metres

    def scale(self, unit: str) -> tuple[float, str]:
        """Return the factor from a unit of the model to the one that is shown, and the name of that."""
        other = (DEGREES if self.degrees else {}) | (CENTIMETRES if self.centimetres else {})
        name, factor = other.get(unit, (unit, 1.0))
        return factor, name

    def format(self, value: float, unit: str) -> str:
        """Format a number that is given in a unit of the model."""
        factor, name = self.scale(unit)
        return f"{format_significant(factor * value)} {name}".rstrip()


def choose_slider_range(
    limits: tuple[float, float], value: float, unit: str, beyond: float = 0.0
) -> tuple[float, float]:
    """Return the range of a slider."""
    reach = UNLIMITED_RANGE.get(unit, 2.0)
    lower, upper = limits
    if not np.isfinite(lower):
        lower = -reach if upper > -reach else upper - 2 * reach
    if not np.isfinite(upper):
        upper = reach if lower < reach else lower + 2 * reach
    if upper < lower:  # No value is allowed at this state; the slider keeps its value.
        lower = upper = value
    wider = beyond * max(upper - lower, 1e-3)
    # Limits are shown to the last digit; the ends beyond them are rounded.
    wider = float(f"{wider:.1g}")
    if wider:
        lower, upper = round(lower - wider, 6), round(upper + wider, 6)
    lower, upper = min(lower, value), max(upper, value)
    if upper - lower < 1e-6:
        lower, upper = lower - 0.5e-3, upper + 0.5e-3
    return float(lower), float(upper)


def choose_slider_step(limits: tuple[float, float]) -> float:
    """Return the largest power of ten that divides a range into at least a thousand steps."""
    return float(10.0 ** np.floor(np.log10(max(limits[1] - limits[0], 1e-6) / 999.0)))


def on_input(control: Any, call: Callable[[Any], object]) -> None:
    """Have a call with the value of a control whenever a browser sets it."""
    # Values set by this program come back as events without a client.
    control.on_update(lambda event: call(event.target.value) if event.client is not None else None)


ANGLES = ("roll", "pitch", "yaw")
ELEMENTS = ("qx", "qy", "qz", "qw")

ANGLE_REACH = {"roll": math.pi, "pitch": math.pi / 2, "yaw": math.pi}
"""Limits of the angles in both directions [rad], within which they are unique."""


class QuaternionAngles:
    """Quaternions among the coordinates of a model, each as three angles about fixed x, y and z.

    A quaternion is four coordinates ``name/qx`` to ``name/qw`` that are moved by the same three speeds. Its
    angles are ``name/roll``, ``name/pitch`` and ``name/yaw`` [rad].
    """

    def __init__(self, model: ModelView, values: Mapping[str, float]) -> None:
        rows = {str(coordinate): frozenset(row) for coordinate, row in model.rates.items()}
        self._names = []
        for name in sorted({path.rpartition("/")[0] for path in rows}):
            speeds = {rows.get(f"{name}/{element}", frozenset()) for element in ELEMENTS}
            if len(speeds) == 1 and len(speeds.pop()) == 3:
                self._names.append(name)
        self.angles: dict[str, float] = {}
        self.update(values)

    @property
    def coordinates(self) -> frozenset[str]:
        """The coordinates that are elements of quaternions, by name."""
        return frozenset(f"{name}/{element}" for name in self._names for element in ELEMENTS)

    @property
    def limits(self) -> dict[str, tuple[float, float]]:
        """The limits of the angles, by name [rad]."""
        return {
            f"{name}/{angle}": (-ANGLE_REACH[angle], ANGLE_REACH[angle])
            for name in self._names
            for angle in ANGLES
        }

    def slider_names(self, names: Iterable[str]) -> list[str]:
        """Return names of coordinates, with angles in place of the elements of quaternions."""
        found: dict[str, None] = {}
        for name in names:
            stem = name.rpartition("/")[0]
            for shown in [f"{stem}/{a}" for a in ANGLES] if name in self.coordinates else [name]:
                found[shown] = None
        return list(found)

    def set_angle(self, angle: str, value: float) -> dict[str, float]:
        """Set an angle [rad] and return the quaternion's elements, by name."""
        self.angles[angle] = value
        name = angle.rpartition("/")[0]
        (cr, sr), (cp, sp), (cy, sy) = (
            (math.cos(half), math.sin(half)) for half in (self.angles[f"{name}/{a}"] / 2 for a in ANGLES)
        )
        elements = (
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
            cr * cp * cy + sr * sp * sy,
        )
        return {f"{name}/{e}": value for e, value in zip(ELEMENTS, elements, strict=True)}

    def update(self, values: Mapping[str, float]) -> None:
        """Set the angles from the quaternions in values; those of a zero quaternion become 0."""
        for name in self._names:
            q = np.array([values[f"{name}/{element}"] for element in ELEMENTS])
            size = float(np.linalg.norm(q))
            found = np.zeros(3)
            if math.isfinite(size) and size > 1e-9:
                found = roll_pitch_yaw(kv.quaternion(*q / size)())
            self.angles.update({f"{name}/{a}": float(v) for a, v in zip(ANGLES, found, strict=True)})
