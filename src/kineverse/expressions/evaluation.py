"""Values of expressions at numbers, through CasADi's interpreter.

For a few evaluations by hand; whoever evaluates often compiles (:mod:`kineverse.compile`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt

from kineverse.errors import ExpressionError, UnknownNameError, ValueRejectedError, suggest

from .expression import Expression
from .lowering import lower


def evaluate(expression: Expression, values: Mapping[Any, Any]) -> npt.NDArray[Any]:
    """Return the value at numbers, see :meth:`Expression.__call__`."""
    symbols = expression.symbols
    vector = assign(symbols, values, exact=False)
    (column,) = lower([expression])
    inputs = ca.vertcat(*(s._sx for s in symbols)) if symbols else ca.SX(0, 1)
    result = np.array(ca.Function("e", [inputs], [column])(vector)).reshape(expression.shape)
    return result[()]


def assign(
    symbols: tuple[Any, ...], values: Mapping[Any, Any], exact: bool = True
) -> npt.NDArray[np.float64]:
    """Return the numbers of ``symbols`` in their order, from a mapping by symbol or by name.

    If ``exact``, names that are not among the symbols are an error, unless ``values`` is a
    :class:`~kineverse.State`, which describes a whole world.

    Raises
    ------
    UnknownNameError
        For symbols without a value and values without a symbol.
    ValueRejectedError
        For NaN.
    """
    from kineverse.state import State

    if not isinstance(values, Mapping):
        raise ExpressionError(
            f"Values are given as a mapping {{name: number}}, not as {type(values).__name__}."
        )
    given = {str(k): v for k, v in values.items()}
    names = [str(s) for s in symbols]
    unknown = [n for n in given if n not in names] if exact and not isinstance(values, State) else []
    if unknown:
        raise UnknownNameError(f"Unknown symbol {unknown[0]!r}. {suggest(unknown[0], names, 'symbol')}")
    missing = [n for n, s in zip(names, symbols, strict=True) if n not in given and s.value is None]
    if missing:
        raise UnknownNameError(
            f"No value for {', '.join(map(repr, missing[:10]))}{' ...' if len(missing) > 10 else ''}."
        )
    vector = np.empty(len(names))
    for i, (name, symbol) in enumerate(zip(names, symbols, strict=True)):
        value = given.get(name, symbol.value)
        if isinstance(value, Expression):
            raise ExpressionError(
                f"The value of '{name}' is an expression; use substitute({{symbol: expression}})."
            )
        try:
            vector[i] = value
        except (TypeError, ValueError):
            raise ValueRejectedError(f"The value of '{name}' is not a number: {value!r}.") from None
        if vector[i] != vector[i]:
            raise ValueRejectedError(f"The value of '{name}' is NaN.")
    return vector
