"""Checks of the arguments that all skills have: object, target, time and tolerance."""

from __future__ import annotations

import math
from typing import Any

from kineverse._checks import as_tolerance, finite_number
from kineverse.errors import InvalidValueError
from kineverse.model.model_view import ModelView
from kineverse.state import State
from kineverse.symbols import Symbol
from kineverse.worlds import Robot

TOLERANCE = 0.02  # distance from a limit at which an object is open or shut, in a long range [m], [rad]
_FIXED = 1e-9  # range of a coordinate up to which it counts as fixed [m], [rad]
_LEAST_TOLERANCE, _SHARE = 1e-3, 0.02  # least tolerance between limits [m], [rad], and share of the distance


def find_object_coordinate(robot: Robot, what: Symbol | str) -> Symbol:
    """Return the coordinate of an object by symbol or name."""
    if not isinstance(what, (str, Symbol)):
        raise InvalidValueError(f"what= is the coordinate of an object, by symbol or name, not {what!r:.60}.")
    coordinate = robot.model.symbol(str(what))
    if robot.moves(coordinate):
        raise InvalidValueError(f"'{coordinate}' is a coordinate of the robot; name one of an object.")
    return coordinate


def check_positive(name: str, given: Any) -> float:
    """Return a positive finite number, or raise InvalidValueError with the name of its argument."""
    number = finite_number(given)
    if number is None or number <= 0.0:
        raise InvalidValueError(f"{name}= is a positive finite number, not {given!r:.60}.")
    return number


def check_target(given: Any) -> float | None:
    """Return a wanted value [m], [rad], or None for the default, or raise InvalidValueError."""
    number = None if given is None else finite_number(given)
    if given is not None and number is None:
        raise InvalidValueError(f"target= is a finite number [m], [rad], not {given!r:.60}.")
    return number


def explain_fixed(model: ModelView, coordinate: Symbol, state: State) -> str:
    """Return why a coordinate cannot move from where it is in a state; empty if its limits let it.

    A lock is a limit of the coordinate or of its speed that depends on other coordinates, so these are named.
    """
    for symbol in (coordinate, coordinate.derivative()):
        lower, upper = (float(v) for v in model.limits(symbol, state))
        if upper - lower > _FIXED:
            continue
        limits = [c for c in model.constraints_for(symbol, exact=True).values() if c.expression == symbol]
        keys = sorted({str(s) for c in limits for s in c.symbols if s not in (symbol, coordinate)})
        at = ", ".join(f"'{key}' is {state[key]:.3g}" for key in keys if key in state)
        if at:
            return (
                f"'{coordinate}' is locked at {state[coordinate]:.3g} while {at}. "
                "'kineverse unlock' says what has to move before it."
            )
        if symbol.order:
            return f"'{coordinate}' cannot move: the limits of its speed are {lower:.3g} and {upper:.3g}."
        return f"'{coordinate}' cannot move: its lower and its upper limit are {upper:.3g}."
    return ""


def choose_tolerance(
    model: ModelView, coordinate: Symbol, state: State, target: float, given: Any = None
) -> float:
    """Return the distance from a target up to which an object is there [m], [rad].

    By default that is 2 % of the distance, between 1 and 20 mm (mrad). At a limit, where an object is open or
    shut, it is 20 mm. It is never more than a tenth of the coordinate's range.
    """
    lower, upper = (float(v) for v in model.limits(coordinate, state))
    if given is not None:
        tolerance = as_tolerance(given, "tolerance=")
    elif min(abs(target - lower), abs(target - upper)) <= _FIXED:
        tolerance = TOLERANCE
    else:
        distance = abs(target - float(state[coordinate]))
        tolerance = min(max(_LEAST_TOLERANCE, _SHARE * distance), TOLERANCE)
    return min(tolerance, max(0.0, 0.1 * (upper - lower))) if math.isfinite(upper - lower) else tolerance


def choose_target(model: ModelView, coordinate: Symbol, state: State, target: float | None) -> float:
    """Return a wanted value within limits, by default the limit that is the farthest away."""
    lower, upper = (float(v) for v in model.limits(coordinate, state))
    here = state[coordinate]
    if target is None:
        target = upper if abs(upper - here) >= abs(lower - here) else lower
        if not math.isfinite(target):
            raise InvalidValueError(f"'{coordinate}' has no limit to move to; name a target.")
    if not lower - 1e-9 <= target <= upper + 1e-9:
        raise InvalidValueError(f"'{coordinate}' moves from {lower:g} to {upper:g}, not to {target!r}.")
    return float(target)
