"""How a kitchen lives: everything opens and shuts, smoothly, a few things at a time."""

from __future__ import annotations

import math
from dataclasses import dataclass

from kineverse.model.model_view import ModelView

EVERY = 0.9
"""From when one thing starts to open until the next one does [s]."""

OPENING, OPEN = 2.6, 2.2
"""How long it takes to open at least, and how long it stays open [s]."""

SHARE = 0.9
"""The part of a range that is used."""

STEEPEST = 1.875
"""The greatest slope of :func:`smooth`."""

HASTE = 0.8
"""The part of a speed limit that is used."""


@dataclass(frozen=True, slots=True)
class _Turn:
    """When one degree of freedom starts, from where to where it goes, and how long that takes."""

    start: float
    shut: float
    opened: float
    lasts: float


class Routine:
    """The degrees of freedom of a model between their limits, as a function of time that repeats.

    Parameters
    ----------
    model
        Those of its coordinates move whose limits are finite numbers.

    Attributes
    ----------
    period
        After this time everything repeats [s].
    """

    def __init__(self, model: ModelView) -> None:
        limited = [
            (symbol, *limits)
            for symbol in model.degrees_of_freedom
            if all(map(math.isfinite, limits := model.limits(symbol)))
        ]
        self._turns: dict[str, _Turn] = {}
        # Neighbours in the list are neighbours in the kitchen: what opens next is somewhere else.
        stride = _coprime(len(limited))
        for number in range(len(limited)):
            symbol, low, high = limited[number * stride % len(limited)]
            way = SHARE * (high - low)
            fastest = HASTE * min(abs(v) for v in model.limits(symbol.derivative()))
            lasts = max(OPENING, STEEPEST * way / fastest) if fastest > 0.0 else OPENING
            self._turns[str(symbol)] = _Turn(EVERY * number, low, low + way, lasts)
        longest = max((turn.lasts for turn in self._turns.values()), default=OPENING)
        self.period = max(EVERY * len(limited), 2.0 * longest + OPEN)

    @property
    def names(self) -> list[str]:
        """What moves, in the order in which it does."""
        return list(self._turns)

    def at(self, time: float) -> dict[str, float]:
        """Return the values at a time [s], by name [m], [rad]."""
        return {name: self._value(turn, time) for name, turn in self._turns.items()}

    def _value(self, turn: _Turn, time: float) -> float:
        since = (time - turn.start) % self.period if time >= turn.start else 0.0
        left = 2.0 * turn.lasts + OPEN - since
        share = min(smooth(since / turn.lasts), smooth(left / turn.lasts))
        return turn.shut + share * (turn.opened - turn.shut)


def smooth(share: float) -> float:
    """Return a way from 0 to 1 that starts and ends without a jerk, 10 s³ - 15 s⁴ + 6 s⁵."""
    s = min(max(share, 0.0), 1.0)
    return s**3 * (10.0 - 15.0 * s + 6.0 * s * s)


def _coprime(count: int) -> int:
    """Return a stride by which all of so many places are visited, far from one to the next."""
    return next((k for k in range(max(count // 3, 1), count + 1) if math.gcd(k, count) == 1), 1)
