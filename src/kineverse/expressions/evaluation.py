"""Values of expressions at numbers, through CasADi's interpreter.

For single evaluations; for many, see :mod:`kineverse.compile`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt

from kineverse._checks import real_number
from kineverse.errors import (
    DuplicateNameError,
    ExpressionError,
    InvalidValueError,
    UnknownNameError,
    duplicate_value_error,
    suggest,
)

from .expression import Expression
from .graph import dense_column


def evaluate(
    expression: Expression, values: Mapping[Any, Any], by_name: Mapping[str, Any] | None = None
) -> npt.NDArray[Any]:
    """Return the value at numbers, see :meth:`Expression.__call__`."""
    symbols = expression.symbols
    if by_name and isinstance(values, Mapping):
        values = {**values, **by_name}
    vector = symbol_values(symbols, values, derived=True)
    # Finding common subexpressions takes longer than computing them twice in one evaluation.
    column = dense_column(expression)
    inputs = ca.vertcat(*(s._sx for s in symbols)) if symbols else ca.SX(0, 1)
    result = np.array(ca.Function("e", [inputs], [column])(vector)).reshape(expression.shape)
    if np.isnan(result).any():
        from .implicit import explain_no_solution, implicit_nodes

        error = explain_no_solution(implicit_nodes([expression]), symbols, vector)
        if error is not None:
            raise error
    return result[()]


def symbol_values(
    symbols: tuple[Any, ...], values: Mapping[Any, Any], derived: bool = False
) -> npt.NDArray[np.float64]:
    """Return the numbers of ``symbols`` in their order, from a mapping by symbol or by name.

    A value by name is for the symbol of that name, of any role. Unknown names are an error, unless ``values``
    is a :class:`~kineverse.State`, which may describe more than the symbols. If ``derived``, values may be
    given by other symbols too: a derivative depends on fewer symbols than its function.
    """
    from kineverse.state import State

    if not isinstance(values, Mapping):
        kind = type(values).__name__
        raise ExpressionError(f"Values are given as a mapping {{name: number}}, not as {kind}.")
    names = [str(s) for s in symbols]
    asked = {*names, *symbols}
    given, unknown = {}, []
    for key, value in values.items():
        place = key if key in asked else str(key)
        given[place] = value
        if place not in asked and not (derived and isinstance(key, Expression)):
            unknown.append(place)
    # A constant has the same value at any values: the Jacobian of a drawer, for example.
    if unknown and not isinstance(values, State) and (names or not derived):
        more = " Values that know more than is asked for go into kv.State({...})." if derived else ""
        raise UnknownNameError(f"Unknown symbol {unknown[0]!r}. {suggest(unknown[0], names, 'symbol')}{more}")
    twice = [s for s in symbols if s in given and str(s) in given]
    if twice:
        raise duplicate_value_error(twice[0])
    ambiguous = [n for n, count in Counter(names).items() if count > 1 and n in given]
    if ambiguous:
        raise DuplicateNameError(
            f"Several symbols have the name '{ambiguous[0]}'; give their values by symbol, not by name."
        )
    pairs = list(zip(names, symbols, strict=True))
    missing = [n for n, s in pairs if n not in given and s not in given and s.value is None]
    if missing:
        listed = ", ".join(map(repr, missing[:10]))
        others = [repr(str(k)) for k in given if k not in asked][:10]
        raise UnknownNameError(
            f"No value for {listed}{' ...' if len(missing) > 10 else ''}."
            + (f" Values were given for {', '.join(others)}, which do not occur here." if others else "")
        )
    vector = np.empty(len(names))
    for i, (name, symbol) in enumerate(pairs):
        value = given[symbol] if symbol in given else given.get(name, symbol.value)
        if isinstance(value, Expression):
            hint = "use substitute({symbol: expression})"
            raise ExpressionError(f"The value of '{name}' is an expression; {hint}.")
        try:
            vector[i] = real_number(value)
        except (TypeError, ValueError, OverflowError):
            raise InvalidValueError(f"The value of '{name}' is not a number: {value!r}.") from None
        if vector[i] != vector[i]:
            raise InvalidValueError(f"The value of '{name}' is NaN.")
    return vector
