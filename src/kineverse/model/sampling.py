"""Random states of models within limits, and values of expressions there."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from zlib import crc32

import casadi as ca
import numpy as np

from kineverse.expressions.expression import SYMBOLS, Expression
from kineverse.expressions.graph import lower
from kineverse.lie import Array
from kineverse.symbols import Symbol

from .model_view import ModelView

REACH = np.pi  # half width of the range of a symbol without limits, about its default [rad], [m] and rates


class StateSamples:
    """Samples of states of one or several models: the default state first, then random ones within limits.

    The values of a symbol are a function of its name alone, so models with the same names get the same
    states. Of several models, the first one with a symbol determines its range. Limits of single symbols
    hold; other constraints may be violated.
    """

    def __init__(self, *models: ModelView, count: int = 16) -> None:
        self.size = count + 1
        self._models = models
        self._columns: dict[Symbol, Array] = {}

    @cached_property
    def _known(self) -> dict[Symbol, tuple[ModelView, float]]:
        """Model and default value of each symbol."""
        result: dict[Symbol, tuple[ModelView, float]] = {}
        for model in self._models:
            for symbol, value in model.default_state().items():
                result.setdefault(symbol, (model, value))
        return result

    def values_of(self, symbol: Symbol) -> Array:
        """Return the values of a symbol, one for each state."""
        if symbol not in self._columns:
            self._columns[symbol] = self._draw(symbol)
        return self._columns[symbol]

    def _draw(self, symbol: Symbol) -> Array:
        if symbol.value is not None:
            return np.full(self.size, symbol.value)
        model, default = self._known.get(symbol.position) or (None, 0.0)
        if symbol.order:
            default = 0.0
        owner = model or (self._models[0] if self._models else None)
        low, high = owner.limits(symbol) if owner is not None else (-np.inf, np.inf)
        low = low if np.isfinite(low) else min(default, high) - REACH
        high = high if np.isfinite(high) else max(default, low) + REACH
        chance = np.random.default_rng([0, crc32(str(symbol).encode(errors="replace"))])
        values = low + (high - low) * chance.random(self.size)
        values[0] = default
        return values

    def values(self, expressions: Sequence[Expression]) -> list[Array]:
        """Return the values of each expression, shape (states, *shape); NaN where a loop does not close."""
        if not expressions:
            return []
        stacked = ca.vertcat(*lower(expressions))
        # One set for all expressions: in a long chain, most poses contain most joints.
        symbols = [SYMBOLS[leaf.element_hash()] for leaf in ca.symvar(stacked)]
        vector = ca.vertcat(*(symbol.sx for symbol in symbols)) if symbols else ca.SX(0, 1)
        function = ca.Function("samples", [vector], [stacked])
        if symbols:
            numbers = np.array(function(np.array([self.values_of(symbol) for symbol in symbols]))).T
        else:
            numbers = np.tile(np.array(function(ca.DM(0, 1))).T, (self.size, 1))
        ends = np.cumsum([e.size for e in expressions])[:-1]
        parts = np.split(numbers, ends, axis=1)
        return [part.reshape(self.size, *e.shape) for part, e in zip(parts, expressions, strict=True)]
