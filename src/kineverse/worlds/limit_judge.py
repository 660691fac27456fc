"""Measurement of limit violations in the states of a world, independent of the world and of the skill."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from kineverse.lie import Array
from kineverse.model.model_view import ModelView
from kineverse.symbols import Symbol


class LimitJudge:
    """Largest excess of any constraint of a model in successive states.

    Positions are those of the states, speeds are differences of successive states by time; commanded speeds
    stand in where no coordinate is the integral of a speed. A limit of a speed that depends on the state,
    such as a lock, is violated if it was at the begin and at the end of a step.
    """

    violation: float  # largest excess since the last reset, in the unit of its constraint
    limit: str  # the constraint's name

    def __init__(self, model: ModelView, commanded: Sequence[Symbol] = ()) -> None:
        self.symbols, columns = model.symbols, model.speeds
        self._checker = model.constraint_checker((*self.symbols, *columns))
        known = model.constraints
        orders = [known[n].order if n in known else 0 for n in self._checker.names]
        self._about_speeds: npt.NDArray[np.bool_] = np.array(orders, dtype=int) > 0
        place = {s: k for k, s in enumerate(self.symbols)}
        own = [(k, place.get(v.position)) for k, v in enumerate(columns) if v.position not in model.rates]
        pairs = [(k, at) for k, at in own if at is not None]
        self._differed = np.array([k for k, _ in pairs], dtype=np.intp)
        self._coordinate = np.array([at for _, at in pairs], dtype=np.intp)
        column = {v: k for k, v in enumerate(columns)}
        self._commanded = np.array([column[v] for v in commanded], dtype=np.intp)
        self._vector = np.zeros(len(self.symbols) + len(columns))
        self.reset()

    def reset(self) -> None:
        """Forget all measurements."""
        self.violation, self.limit = 0.0, ""
        self._stamp: float | None = None
        self._values: Array = np.zeros(len(self.symbols))

    def update(self, values: Array, stamp: float, commanded: Array | None = None) -> None:
        """Measure a state."""
        vector, count = self._vector, len(self.symbols)
        rates = vector[count:]
        rates[:] = 0.0
        before = np.full(len(self._about_speeds), -np.inf)
        if self._stamp is not None:
            if commanded is not None:
                rates[self._commanded] = commanded
            moved = values[self._coordinate] - self._values[self._coordinate]
            rates[self._differed] = moved / (stamp - self._stamp)
            vector[:count] = self._values
            before = self._excesses(vector)
        vector[:count] = values
        excess = self._excesses(vector)
        self._stamp, self._values = stamp, np.array(values)
        # A lock that closes or opens within the step may have been open while it moved.
        excess[self._about_speeds] = np.minimum(excess, before)[self._about_speeds]
        if not len(excess):
            return
        worst = int(np.argmax(excess))
        if excess[worst] > self.violation:
            self.violation, self.limit = float(excess[worst]), self._checker.names[worst]

    def _excesses(self, vector: Array) -> Array:
        """Return the excess of each constraint: a constraint without a value is violated beyond measure."""
        self._checker(vector)
        return np.where(np.isnan(self._checker.excess), np.inf, self._checker.excess)
