"""The ranges in which degrees of freedom can be moved, which may depend on the state."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from kineverse.model.view import ModelView
from kineverse.state import State

UNLIMITED = {"rad": np.pi, "m": 2.0, "": 2.0}
"""Half of the range offered where the model sets no limit [rad], [m]."""


STILL = 1e-6
"""What is slower than this does not move [rad/s], [m/s]: a lock is as sharp as its logic is."""


class Ranges:
    """The limits of all degrees of freedom of a model, evaluated at states.

    Limits that are numbers are asked for once; those whose bounds are expressions (a drawer that opens only
    as far as the door beside it) are asked for again at every state.

    Attributes
    ----------
    names
        The degrees of freedom, in the order of the model.
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
        """The degrees of freedom that the state may keep from moving one way or both."""
        return [str(symbol) for symbol in self._locked]

    def held(self, values: Mapping[str, float]) -> dict[str, tuple[bool, bool]]:
        """Return, for each that is lockable, whether it cannot go down, and whether it cannot go up.

        Locks are limits of speeds. At a limit of its own it cannot go on either, which counts if it is locked
        the other way.
        """
        found = {}
        state = State(values) if self._locked else None
        for symbol in self._locked:
            slowest, fastest = self._model.limits(symbol.derivative(), state)
            lower, upper = self._model.limits(symbol, state)
            value, down, up = values[str(symbol)], slowest > -STILL, fastest < STILL
            at_end = down and value >= upper - STILL, up and value <= lower + STILL
            found[str(symbol)] = (down or at_end[1], up or at_end[0])
        return found

    def at(self, values: Mapping[str, float]) -> dict[str, tuple[float, float]]:
        """Return lower and upper limit of each degree of freedom, -inf and inf where there is none."""
        limits = dict(self._limits)
        state = State(values) if self._dependent else None
        for symbol in self._dependent:
            limits[str(symbol)] = self._model.limits(symbol, state)
        return limits


def offered(limits: tuple[float, float], value: float, unit: str, beyond: float = 0.0) -> tuple[float, float]:
    """Return the range of a slider.

    Parameters
    ----------
    limits
        Lower and upper limit, possibly infinite.
    value
        The current value, which is always inside of what is returned.
    unit
        ``"rad"``, ``"m"`` or ``""``, which decides the range where there is no limit.
    beyond
        The part of the range by which it is widened at either end.
    """
    reach = UNLIMITED.get(unit, 2.0)
    lower, upper = limits
    if not np.isfinite(lower):
        lower = -reach if upper > -reach else upper - 2 * reach
    if not np.isfinite(upper):
        upper = reach if lower < reach else lower + 2 * reach
    if upper < lower:  # No value is allowed at this state; the slider stays where it is.
        lower = upper = value
    wider = beyond * max(upper - lower, 1e-3)
    # Limits are shown to the last digit; what lies beyond them may as well be a round number.
    wider = float(f"{wider:.1g}")
    if wider:
        lower, upper = round(lower - wider, 6), round(upper + wider, 6)
    lower, upper = min(lower, value), max(upper, value)
    if upper - lower < 1e-6:
        lower, upper = lower - 0.5e-3, upper + 0.5e-3
    return float(lower), float(upper)


def step(limits: tuple[float, float]) -> float:
    """Return a power of ten of which a range has at least a thousand."""
    return float(10.0 ** np.floor(np.log10(max(limits[1] - limits[0], 1e-6) / 999.0)))
