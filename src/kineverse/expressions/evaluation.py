"""Values of expressions at numbers, through CasADi's interpreter.

For single evaluations; for many, see :mod:`kineverse.compile`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

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

if TYPE_CHECKING:
    from kineverse.symbols import Symbol


def evaluate(
    expression: Expression, values: Mapping[Any, Any], by_name: Mapping[str, Any] | None = None
) -> npt.NDArray[Any]:
    """Return the value at numbers, see :meth:`Expression.__call__`."""
    symbols = expression.symbols
    if by_name and isinstance(values, Mapping):
        values = {**values, **by_name}
    return _compute([expression], symbols, symbol_values(symbols, values, derived=True))[0]


def evaluate_mapping(
    entries: Mapping[Symbol, Expression],
    about: tuple[Symbol, ...],
    values: Mapping[Any, Any],
    by_name: Mapping[str, Any],
) -> dict[str, Any]:
    """Return the numbers of some entries by the names of their keys, see :meth:`Gradient.__call__`.

    Values of symbols that the entries are ``about`` are allowed if none of the entries contains them.
    """
    from kineverse.state import State

    symbols = tuple(dict.fromkeys(s for entry in entries.values() for s in entry.symbols))
    if isinstance(values, Mapping) and not isinstance(values, State):
        values = {**values, **by_name}
        silent = {*map(str, about)}.difference(map(str, symbols))
        values = {key: value for key, value in values.items() if str(key) not in silent}
    numbers = _compute([*entries.values()], symbols, symbol_values(symbols, values, derived=True))
    return {str(key): n if n.shape else float(n) for key, n in zip(entries, numbers, strict=True)}


def _compute(
    expressions: Sequence[Expression], symbols: tuple[Any, ...], vector: npt.NDArray[np.float64]
) -> list[npt.NDArray[Any]]:
    # Finding common subexpressions takes longer than computing them twice in one evaluation.
    columns = [dense_column(e) for e in expressions]
    inputs = ca.vertcat(*(s._sx for s in symbols)) if symbols else ca.SX(0, 1)
    computed = ca.Function("e", [inputs], columns).call([vector])
    results = [np.array(one).reshape(e.shape) for one, e in zip(computed, expressions, strict=True)]
    if any(np.isnan(result).any() for result in results):
        from .implicit import explain_no_solution, implicit_nodes

        error = explain_no_solution(implicit_nodes(expressions), symbols, vector)
        if error is not None:
            raise error
    return [result[()] for result in results]


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
        raise UnknownNameError(
            f"Unknown symbol {unknown[0]!r:.80}. {suggest(unknown[0], names, 'symbol')}{more}"
        )
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
