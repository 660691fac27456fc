"""Replay of a trace on synthetic inputs, and comparison of what operations write.

Code can inspect values in ways that are not recorded, such as ``isinstance``. So an operation is applied once
more to query results of other types: constants instead of moving expressions, symbols and integers instead of
numbers. If its writes then differ from those of the trace, the operation depends on that result.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import casadi as ca
import numpy as np

from kineverse.errors import KineverseError
from kineverse.expressions.expression import Expression, as_expression
from kineverse.expressions.graph import leaves, lower
from kineverse.model.operation import (
    ARTICULATIONS,
    DATA,
    FRAMES,
    Cell,
    Operation,
    find_expressions,
    map_expressions,
)
from kineverse.model.read_recorder import ReadRecorder
from kineverse.spatial import translation
from kineverse.symbols import Symbol, position

from .trace import Trace, UntraceableError, substitute_results
from .trace_queries import EXPRESSION_QUERIES, FAILED, Query, QueryResult, TracingReader

_SAMPLES = 3
_SEED = 20220

ExpressionPair = tuple[Expression, Expression]


def writes_agree(
    one: Mapping[Cell, Any],
    other: Mapping[Cell, Any],
    affordable: Callable[[list[ExpressionPair]], bool] = lambda _: True,
) -> bool:
    """Return whether writes agree, in order; expressions are compared at a few states.

    A number equals a constant expression. Expressions that are not structurally equal are compared only if
    they are ``affordable``.
    """
    if list(one) != list(other):
        return False
    pairs: list[ExpressionPair] = []
    for cell in one:
        found = _pairs(cell[0], one[cell], other[cell])
        if found is None:
            return False
        pairs += found
    different = [(a, b) for a, b in pairs if a is not b and a != b]
    return not affordable(different) or _close(different)


def _pairs(kind: str, a: Any, b: Any) -> list[ExpressionPair] | None:
    if a is b:
        return []
    if kind == FRAMES:
        return [(a.transform, b.transform)] if a.parent == b.parent else None
    a, b = _without_numbers(kind, a), _without_numbers(kind, b)
    one, other = find_expressions(kind, a), find_expressions(kind, b)
    if len(one) != len(other) or map_expressions(kind, a, _nothing) != map_expressions(kind, b, _nothing):
        return None
    return list(zip(one, other, strict=True))


def _nothing(_: Expression) -> float:
    return 0.0


def _without_numbers(kind: str, value: Any) -> Any:
    if kind == ARTICULATIONS:
        return replace(value, dynamics=_without_numbers(DATA, value.dynamics))
    if kind != DATA:
        return value
    if isinstance(value, tuple):
        return tuple(_without_numbers(DATA, item) for item in value)
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
    return as_expression(value) if is_number else value


def _close(pairs: list[ExpressionPair]) -> bool:
    values: list[ExpressionPair] = []
    for a, b in pairs:
        if a.shape != b.shape:
            return False
        values.append((a, b))
        for heuristic in (True, False):
            x, y = a.gradient(heuristic), b.gradient(heuristic)
            if set(x) != set(y):
                return False
            values += [(x[key], y[key]) for key in x]
    if not values:
        return True
    flat = [e for pair in values for e in pair]
    symbols = sorted({s for e in flat for s in e.symbols}, key=lambda s: s.sort_key)
    inputs = ca.vertcat(*(s.sx for s in symbols)) if symbols else ca.SX(0, 1)
    columns = lower(flat)
    both = ca.Function("both", [inputs], [ca.vertcat(*columns[::2]), ca.vertcat(*columns[1::2])])
    random = np.random.default_rng(_SEED)
    for _ in range(_SAMPLES):
        left, right = both(random.uniform(-1, 1, len(symbols)))
        if not np.allclose(np.array(left), np.array(right), 1e-9, 1e-12, equal_nan=True):
            return False
    return True


_STRANGER = "∂/stranger"
_PERTURBATION_SEED = 20221

Perturbation = Callable[[Query, int, "Expression | float"], "Expression | float"]


def replay_agrees(
    trace: Trace,
    operation: Operation,
    model: ReadRecorder,
    results: Sequence[QueryResult],
    free: Collection[int],
) -> bool:
    """Return whether a trace agrees with the code while the results of some queries are perturbed."""
    for change in (_perturb_value, partial(_perturb_motion, symbol=_symbol_of(trace))):
        others: list[QueryResult] = []
        try:
            for place, (step, reply) in enumerate(zip(trace.steps, results, strict=True)):
                if step.query.kind in EXPRESSION_QUERIES:
                    others.append(substitute_results(step.query, others).ask(model))
                else:
                    changed = (change(step.query, i, part) for i, part in enumerate(reply.parts))
                    others.append(QueryResult(reply.rest, tuple(changed)) if place in free else reply)
            traced = trace.compute_writes(others).writes()
        except KineverseError:
            continue  # the perturbation is not valid for the trace
        reader = _ReplayReader(model, trace, others)
        try:
            effects = operation.apply(reader)
            reader.done = True
            written = effects.writes()
        except UntraceableError:
            return False
        except Exception:  # user code, which may not accept perturbed results
            continue
        if not writes_agree(traced, written):
            return False
    return True


def _perturb_value(query: Query, place: int, part: Expression | float) -> Expression | float:
    """Replace a number by another one, and a moving expression by a constant."""
    if isinstance(part, float):
        return math.floor(part) + 2 if query.kind == "datum" else 1.25 * part + 0.5
    if query.kind == "constraint" and place == 1:
        return 2 * part  # the expression of a constraint is never constant
    random = np.random.default_rng(_PERTURBATION_SEED)
    try:
        value = part({s: random.uniform(0.1, 0.9) for s in part.symbols if s.value is None})
    except KineverseError:
        return part
    if not np.isfinite(value).all():
        return part
    return as_expression(value if part.shape else 1.25 * value + 0.5)


def _perturb_motion(query: Query, place: int, part: Expression | float, symbol: Symbol) -> Expression | float:
    """Replace a part by an expression in one symbol."""
    symbol = symbol if isinstance(part, float) or not part.symbols else part.symbols[0]
    if isinstance(part, float) or not part.shape:
        return symbol
    if part.shape == (3, 4):
        return translation(symbol, symbol, symbol)[:3]
    return part + symbol


def _symbol_of(trace: Trace) -> Symbol:
    """Return a symbol that the code uses itself, because it may compare reads with that symbol."""
    written = (e for (kind, _), value in trace.writes for e in find_expressions(kind, value))
    symbols = (s for e in written for s in leaves(e)[0] if not s.order and s.has_derivative)
    return next(symbols, position(_STRANGER))


class _ReplayReader(TracingReader):
    """Reader with given results for the queries of a trace; it refuses other queries."""

    def __init__(self, model: ReadRecorder, trace: Trace, results: Sequence[QueryResult]) -> None:
        super().__init__(model)
        self._replies = {
            substitute_results(step.query, results).key: reply
            for step, reply in zip(trace.steps, results, strict=True)
        }

    def ask(self, kind: str, *arguments: Any) -> Any:
        query = Query(kind, arguments)
        reply = self._replies.get(query.key)
        if reply is None:
            raise UntraceableError("it asks for other things then")
        if reply.rest is FAILED:
            query.ask(self.model)
        return query.answer(reply.rest, reply.parts)
