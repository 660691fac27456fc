"""Values of a model's symbols, as they are given: by symbol, by name, as a state."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from kineverse.errors import (
    ExpressionError,
    NameTakenError,
    UnknownNameError,
    ValueRejectedError,
    given_twice,
    suggest,
)
from kineverse.number import finite_number
from kineverse.state import State
from kineverse.symbols import Symbol


def as_state(values: Mapping[Any, float], known: Iterable[Symbol]) -> State:
    """Return values as a state, refusing what a plain mapping says about symbols that are not known.

    Parameters
    ----------
    values
        A state, which may know more, or a mapping from symbols or names to numbers, which may not.
    known
        The symbols that there are.

    Raises
    ------
    UnknownNameError
        For other symbols and names.
    NameTakenError
        If a symbol has two values, by name and as such, or a name is that of several symbols.
    """
    if isinstance(values, State):
        return values
    if not isinstance(values, Mapping):
        raise ExpressionError(
            f"Values are given as a mapping {{name: number}} or a state, not as {type(values).__name__}."
        )
    by_name: dict[str, set[Symbol]] = {}
    for symbol in known:
        by_name.setdefault(str(symbol), set()).add(symbol)
    result: dict[Symbol, float] = {}
    for key, value in values.items():
        name = str(key)
        meant = by_name.get(name, set())
        if isinstance(key, Symbol):
            meant = meant & {key}
        if not meant:
            raise UnknownNameError(f"Unknown symbol {name!r}. {suggest(name, by_name, 'symbol')}")
        if len(meant) > 1:
            raise NameTakenError(
                f"Several symbols have the name {name!r}; give their values by symbol, not by name."
            )
        (symbol,) = meant
        if symbol in result:
            raise given_twice(symbol)
        result[symbol] = value
    return State(result)


def check_meant(state: State, known: Iterable[Symbol]) -> None:
    """Refuse a state that has no value for anything in a model: it is one of another model.

    Raises
    ------
    UnknownNameError
        With a name like its first one.
    """
    symbols = list(known)
    if any(state.given(symbol) is not None for symbol in symbols):
        return
    names = list(map(str, state))
    about = f"It knows {', '.join(map(repr, names[:3]))}{', ...' if names[3:] else ''}. " if names else ""
    hint = f"{suggest(names[0], map(str, symbols), 'symbol')} " if names else ""
    raise UnknownNameError(
        f"The state has no value for anything in this model. {about}{hint}"
        "model.default_state() has one for everything."
    )


def as_tolerance(given: float) -> float:
    """Return by how much something may be off.

    Raises
    ------
    ValueRejectedError
        If that is no finite number from 0.
    """
    tolerance = finite_number(given)
    if tolerance is None or tolerance < 0:
        raise ValueRejectedError(f"A tolerance is a finite number from 0, not {given!r}.")
    return tolerance
