"""Configurations of a model: limits, periods and quaternions of its coordinates, random starts."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import numpy.typing as npt

from kineverse.errors import UnknownNameError, suggest
from kineverse.lie import Array
from kineverse.model.constraint import Constraint
from kineverse.model.model_view import ModelView, find_symbols
from kineverse.symbols import Symbol

_QUATERNION = ("qx", "qy", "qz", "qw")
_SAME = 1e-9


class ConfigurationSpace:
    """Ranges of some coordinates of a model."""

    def __init__(
        self, model: ModelView, coordinates: Sequence[Symbol], ranges: Mapping[str, Constraint]
    ) -> None:
        self.coordinates = tuple(coordinates)
        place = {s: k for k, s in enumerate(coordinates)}
        self.quaternions = [
            [place[s] for s in four]
            for record in model.articulations.values()
            for four in [[s for s in record.coordinates if s.path.rpartition("/")[2] in _QUATERNION]]
            if len(four) == 4 and all(s in place for s in four)
        ]
        self.turning = np.zeros(len(coordinates), dtype=bool)
        limits = np.array([model.limits(s) for s in coordinates], dtype=float).reshape(-1, 2)
        self.lower, self.upper = limits[:, 0].copy(), limits[:, 1].copy()
        numeric = np.ones(len(coordinates), dtype=bool)
        for i, symbol in enumerate(coordinates):
            for c in ranges.values():
                if symbol in c.expression.symbols and (c.lower.symbols or c.upper.symbols):
                    numeric[i] = False
                elif c.expression == symbol:
                    self.lower[i] = max(self.lower[i], float(c.lower))
                    self.upper[i] = min(self.upper[i], float(c.upper))
        # An empty range is reported by the search, as a constraint that is violated.
        self.upper = np.maximum(self.lower, self.upper)
        self._least = np.where(numeric, self.lower, -np.inf)
        self._largest = np.where(numeric, self.upper, np.inf)

    def find_turning_candidates(self, ranges: Mapping[str, Constraint]) -> npt.NDArray[np.bool_]:
        """Return flags of coordinates that may turn fully and have no bounds that are expressions."""
        turning = np.asarray(self.upper - self.lower >= math.tau - _SAME)
        bound = {c.expression for c in ranges.values() if c.lower.symbols or c.upper.symbols}
        turning &= np.array([symbol not in bound for symbol in self.coordinates], dtype=bool)
        for four in self.quaternions:
            turning[four] = False
        return turning

    def draw(self, generator: np.random.Generator, start: Array) -> Array:
        """Draw coordinates (n,): uniform within limits, or around others (n,) where there are no limits."""
        width = np.where(self.turning, math.pi, 1.0)
        low = np.where(np.isfinite(self.lower), self.lower, np.minimum(start, self.upper) - width)
        high = np.where(np.isfinite(self.upper), self.upper, np.maximum(start, self.lower) + width)
        q = generator.uniform(low, np.maximum(low, high))
        for four in self.quaternions:
            q[four] = start[four] + generator.standard_normal(4) / 2
        self.normalize(q)
        return q

    def normalize(self, q: Array) -> None:
        """Give quaternions their unit length, in place."""
        for four in self.quaternions:
            q[four] /= math.sqrt(q[four].dot(q[four])) or 1.0

    def clip(self, q: Array) -> None:
        """Clip coordinates to those limits that are numbers, in place; turning ones are left as they are."""
        np.copyto(q, np.minimum(np.maximum(q, self._least), self._largest), where=~self.turning)

    def bring_back(self, q: Array, start: Array) -> None:
        """Bring coordinates with the period 2π within their limits, as near to others (n,) as possible."""
        for i in np.flatnonzero(self.turning):
            value = q[i] - math.tau * round((q[i] - start[i]) / math.tau)
            if value > self.upper[i]:
                value -= math.tau * math.ceil((value - self.upper[i]) / math.tau)
            elif value < self.lower[i]:
                value += math.tau * math.ceil((self.lower[i] - value) / math.tau)
            q[i] = value
        np.minimum(np.maximum(q, self._least), self._largest, out=q)


def find_coordinates(
    model: ModelView, names: Iterable[Symbol | str], argument: str = "fixed"
) -> frozenset[Symbol]:
    """Find the independent coordinates of symbols or names.

    A dependent coordinate stands for those that determine it, an articulation for all of its coordinates, and
    a speed for the coordinates that it drives.
    """
    result: set[Symbol] = set()
    known = {*model.symbols, *model.rates.dependent, *model.speeds}
    for symbol in find_symbols(model, names, f"{argument}="):
        if symbol not in known and symbol.position not in known:
            raise UnknownNameError(
                f"{argument}=: the model has no '{symbol}'. {suggest(str(symbol), map(str, known), 'symbol')}"
            )
        dependent = model.rates.dependent.get(symbol.position)
        if dependent is not None:
            result |= {s for s in dependent.symbols if s.has_derivative}
        else:
            result.add(symbol.position)
        if symbol.order == 1:
            result |= {x for x, row in model.rates.items() if symbol in row}
    return frozenset(result)
