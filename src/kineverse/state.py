"""Values of symbols at one time, and their conversion from mappings."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from kineverse._checks import as_number, real_number
from kineverse._synonyms import STATE_SYNONYMS
from kineverse.errors import (
    DuplicateNameError,
    ExpressionError,
    InvalidValueError,
    KineverseError,
    UnknownAttributeError,
    UnknownNameError,
    duplicate_value_error,
    list_some,
    suggest,
    unknown_attribute_error,
)
from kineverse.lie import Array
from kineverse.symbols import Symbol, parse_symbol_name

__all__ = ["State", "StateLike"]

StateLike: TypeAlias = "State | Mapping[Symbol, float] | Mapping[str, float] | Mapping[Symbol | str, float]"
"""A state, or a plain mapping from symbols or their names to numbers."""


class State(Mapping[Symbol, float]):
    """An immutable mapping from symbols to numbers, with time stamp and source.

    Functions that take values take a state. Unlike a plain mapping, it may contain more symbols than needed.
    It can be indexed by symbols and by their names. :meth:`updated` changes values of its symbols,
    :meth:`extended` adds symbols; ``state | {...}`` is ``state.updated({...})``, and ``state | other`` has
    the symbols of both states.

    Parameters
    ----------
    values
        From symbols, or names of degrees of freedom, to numbers: [m], [rad] and their rates by time.
    stamp
        Time [s] by the clock of the source; None if there is none.
    source
        The name of the sensor or computation.

    Raises
    ------
    InvalidValueError
        For NaN or values that are not numbers.
    DuplicateNameError
        If values are given for a symbol and for its name; likewise, later, for access by a name that several
        of the symbols have.

    Examples
    --------
    >>> state = kv.State({"door": 0.5, "drawer": 0.1}, stamp=12.0)
    >>> state["door"]
    0.5
    >>> state | {"door": 0.7}
    State({door: 0.7, drawer: 0.1}, stamp=12)
    >>> state.updated({"dor": 0.7})
    Traceback (most recent call last):
        ...
    kineverse.errors.UnknownNameError: The state has no value of 'dor', so there is nothing to ...
    """

    __slots__ = ("_names", "_values", "source", "stamp")

    _names: dict[str, Symbol | None] | None
    _values: dict[Symbol, float]
    source: str
    stamp: float | None

    def __init__(
        self, values: StateLike | None = None, *, stamp: float | None = None, source: str = ""
    ) -> None:
        known: dict[Symbol, float] = {}
        for key, value in _items({} if values is None else values):
            symbol = key if type(key) is Symbol else _symbol(key)
            if symbol in known:
                raise duplicate_value_error(symbol)
            # Worlds and beliefs make a state a step, of doubles.
            known[symbol] = value if type(value) is float and value == value else _number(symbol, value)
        self._set(known, None, stamp, source)

    def _set(
        self,
        values: dict[Symbol, float],
        names: dict[str, Symbol | None] | None,
        stamp: float | None,
        source: str,
    ) -> None:
        if stamp is not None and as_number(stamp) is None:
            raise InvalidValueError(f"The stamp of a state is a time in seconds, not {stamp!r}.")
        write = object.__setattr__
        write(self, "_values", values)
        write(self, "_names", names)
        write(self, "stamp", stamp)
        write(self, "source", source)

    @property
    def _by_name(self) -> dict[str, Symbol | None]:
        """Symbol of each name, None where several have it; found when it is asked for first."""
        if self._names is None:
            object.__setattr__(self, "_names", _symbols_by_name(self._values))
        return self._names  # type: ignore[return-value]

    def __setattr__(self, name: str, value: Any) -> None:
        raise ExpressionError("States are immutable; use updated({symbol: number}, stamp=...).")

    if not TYPE_CHECKING:  # a type checker reports unknown attributes itself

        def __getattr__(self, name):
            if name in State.__slots__:  # not set yet
                raise AttributeError(name)
            if name in self._by_name:
                raise UnknownAttributeError(f"A state has no {name!r}. Its value is state[{name!r}].")
            raise unknown_attribute_error("A state", name, dir(type(self)), STATE_SYNONYMS)

        def __setitem__(self, key: object, value: object) -> None:
            raise ExpressionError(
                f"States are immutable; state.updated({{'{key}': {value!r}}}) returns another one."
            )

        def __delitem__(self, key: object) -> None:
            raise ExpressionError(
                f"States are immutable, and '{key}' stays; "
                "state.updated({symbol: number}) returns one with other values."
            )

    def __getitem__(self, key: Symbol | str) -> float:
        try:
            return self._values[self._known(key)]
        except KeyError:
            raise UnknownNameError(
                f"The state has no value of '{key}'. {suggest(str(key), self._by_name, 'symbol')}"
            ) from None

    def _known(self, key: object) -> Symbol:
        if not isinstance(key, str):
            if key in self._values:
                return key  # type: ignore[return-value]
            raise KeyError(key)
        symbol = self._by_name[key]
        if symbol is None:
            raise DuplicateNameError(
                f"Several symbols have the name '{key}'; ask for one by symbol, not by name."
            )
        return symbol

    def given(self, symbol: Symbol) -> float | None:
        """Return the value of a symbol, else the value that was given by its name, else None.

        A name in a state is that of a degree of freedom, or else of the parameter of that name.

        Examples
        --------
        >>> door = kv.position("door")
        >>> kv.State({"door": 0.5}).given(door)
        0.5
        >>> kv.State({"drawer": 0.5}).given(door) is None
        True
        """
        value = self._values.get(symbol)
        if value is None and symbol.role != "dof":
            return self._values.get(Symbol(symbol.path, symbol.order))
        return value

    def vector(self, symbols: Sequence[Symbol]) -> Array:
        """Return the values of symbols in their order, shape (n,).

        The fast way from a state to the input of a compiled function, ``state.vector(function.inputs)``.
        The state may have more symbols. Parameters without a value in the state have their own.

        Raises
        ------
        UnknownNameError
            For symbols without a value.

        Examples
        --------
        >>> model = kv.load("kitchen")
        >>> f = kv.compile(model.fk("kitchen/fridge_door_handle")[:3, 3])
        >>> state = model.default_state()
        >>> f(state.vector(f.inputs)).round(3)
        array([ 1.137, -1.312,  1.184])
        """
        try:
            return np.fromiter(map(self._values.__getitem__, symbols), np.float64, len(symbols))
        except KeyError:
            pass
        held = [self.given(s) for s in symbols]
        values = [s.value if v is None else v for s, v in zip(symbols, held, strict=True)]
        missing = [str(s) for s, value in zip(symbols, values, strict=True) if value is None]
        if missing:
            raise UnknownNameError(f"No value is given for {list_some(map(repr, missing), 12)}.")
        return np.array(values, dtype=np.float64)

    def __contains__(self, key: object) -> bool:
        return key in self._by_name if isinstance(key, str) else key in self._values

    def __iter__(self) -> Iterator[Symbol]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    def updated(self, values: StateLike, *, stamp: float | None = None, source: str | None = None) -> State:
        """Return a state with other values for some of its symbols; stamp and source are kept unless given.

        Raises
        ------
        UnknownNameError
            For a symbol or name without a value in the state, with similar ones.

        Examples
        --------
        >>> kv.State({"door": 0.5, "drawer": 0.1}, stamp=1.0).updated({"door": 0.7}, stamp=2.0).stamp
        2.0
        """
        changed: dict[Symbol, float] = {}
        for key, value in _items(values):
            try:
                symbol = self._known(key)
            except (KeyError, TypeError):  # TypeError for unhashable keys
                raise self._unknown(key) from None
            if symbol in changed:
                raise duplicate_value_error(symbol)
            changed[symbol] = _number(symbol, value)
        return self._with(changed, stamp, source)

    def extended(self, values: StateLike, *, stamp: float | None = None, source: str | None = None) -> State:
        """Return a state with further symbols; stamp and source are kept unless given.

        Raises
        ------
        DuplicateNameError
            For a symbol of the state; :meth:`updated` changes its value.

        Examples
        --------
        >>> kv.State({"door": 0.5}).extended({"drawer": 0.1})
        State({door: 0.5, drawer: 0.1})
        """
        added = State(values)._values
        for symbol in added:
            if symbol in self._values:
                raise DuplicateNameError(
                    f"The state has a value for '{symbol}' already; updated({{'{symbol}': ...}}) changes it."
                )
        return self._with(added, stamp, source)

    def __or__(self, other: StateLike) -> State:
        if isinstance(other, State):
            return self._with(other._values, None, None)
        return self.updated(other) if isinstance(other, Mapping) else NotImplemented

    def __ror__(self, other: object) -> State:
        raise ExpressionError(
            "A state stands on the left of |: state | {...} changes values, and "
            "State({...}) | state joins two states."
        )

    def _with(self, values: Mapping[Symbol, float], stamp: float | None, source: str | None) -> State:
        # All values have been checked already.
        every = {**self._values, **values}
        result = State.__new__(State)
        result._set(
            every,
            self._names if len(every) == len(self._values) else None,
            self.stamp if stamp is None else stamp,
            self.source if source is None else source,
        )
        return result

    def _unknown(self, key: object) -> KineverseError:
        symbol = _symbol(key)
        about = f"The state has no value of '{symbol}', so there is nothing to update."
        if str(symbol) in self._by_name:
            return UnknownNameError(
                f"{about} It knows another symbol of that name, of another role or value; "
                "give the value by name."
            )
        return UnknownNameError(
            f"{about} {suggest(str(symbol), self._by_name, 'symbol')} "
            f"extended({{'{symbol}': ...}}) adds what is new."
        )

    def __eq__(self, other: object) -> bool:
        if isinstance(other, State):
            return (self._values, self.stamp, self.source) == (other._values, other.stamp, other.source)
        return NotImplemented

    def __hash__(self) -> int:
        return hash((frozenset(self._values.items()), self.stamp, self.source))

    def __reduce__(self) -> Any:
        return partial(State, stamp=self.stamp, source=self.source), (self._values,)

    def __repr__(self) -> str:
        shown = ", ".join(f"{s}: {v:g}" for s, v in list(self._values.items())[:8])
        more = f", ... {len(self) - 8} more" if len(self) > 8 else ""
        when = "" if self.stamp is None else f", stamp={self.stamp:g}"
        return f"State({{{shown}{more}}}{when})"

    def _repr_html_(self) -> str:
        from kineverse._rich_display import html_table  # for start-up time

        about = [f"{len(self)} value{'' if len(self) == 1 else 's'}"]
        about += [] if self.stamp is None else [f"at {self.stamp:g} s"]
        about += [f"from {self.source}"] if self.source else []
        return html_table(
            ", ".join(about), ("symbol", "value"), [(str(s), f"{v:g}") for s, v in self.items()]
        )


def _symbols_by_name(symbols: Collection[Symbol]) -> dict[str, Symbol | None]:
    result: dict[str, Symbol | None] = {str(s): s for s in symbols}
    if len(result) < len(symbols):
        # A parameter may have the name of another symbol; then the name is ambiguous.
        counts = Counter(map(str, symbols))
        result = {name: s if counts[name] == 1 else None for name, s in result.items()}
    return result


def _items(values: object) -> Iterable[tuple[Any, Any]]:
    if not isinstance(values, Mapping):
        raise ExpressionError(f"A state is made from a mapping {{name: number}}, not {values!r}.")
    return values.items()


def _symbol(key: object) -> Symbol:
    if isinstance(key, Symbol):
        return key
    if not isinstance(key, str):
        raise ExpressionError(f"A state has symbols or their names as keys, not {key!r}.")
    return Symbol(*parse_symbol_name(key))


def _number(symbol: Symbol, value: Any) -> float:
    try:
        number = real_number(value)
    except (TypeError, ValueError, OverflowError):
        raise InvalidValueError(f"The value of '{symbol}' is not a number: {value!r}.") from None
    if number != number:
        raise InvalidValueError(f"The value of '{symbol}' is NaN.")
    return number


def as_state(values: StateLike, known: Iterable[Symbol]) -> State:
    """Return values as a state; a plain mapping with unknown symbols or two values for one is refused."""
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
        matching = by_name.get(name, set())
        if isinstance(key, Symbol):
            matching = matching & {key}
        if not matching:
            raise UnknownNameError(f"Unknown symbol {name!r}. {suggest(name, by_name, 'symbol')}")
        if len(matching) > 1:
            raise DuplicateNameError(
                f"Several symbols have the name {name!r}; give their values by symbol, not by name."
            )
        (symbol,) = matching
        if symbol in result:
            raise duplicate_value_error(symbol)
        result[symbol] = value
    return State(result)


def check_meant(state: State, known: Iterable[Symbol]) -> None:
    """Raise for a state without a value for any symbol of a model: it belongs to another model."""
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
