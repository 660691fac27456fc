"""States: what is known about the values of symbols at one moment."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any

from .errors import ExpressionError, NameTakenError, UnknownNameError, ValueRejectedError, suggest
from .number import real_number
from .symbols import Symbol, parse_symbol_name


class State(Mapping[Symbol, float]):
    """An immutable mapping from symbols to numbers, with the time it was true at and who said so.

    Whatever takes values takes a state; other than a plain mapping it may know more symbols than are asked
    for. It can be indexed by symbols and by their names.

    Parameters
    ----------
    values
        From symbols, or names of degrees of freedom, to numbers: [m], [rad] and their rates by time.
    stamp
        Time in seconds, of whatever clock the source uses; None if there is none.
    source
        Who measured or computed it.

    Raises
    ------
    ValueRejectedError
        For NaN or values that are not numbers.
    NameTakenError
        If a symbol is given a value and its name another one; likewise, later, if a value is asked for by a
        name that several of the symbols have.
    """

    __slots__ = ("_by_name", "_values", "source", "stamp")

    def __init__(
        self, values: Mapping[Any, float] | None = None, *, stamp: float | None = None, source: str = ""
    ) -> None:
        if not isinstance(values, Mapping | None):
            raise ExpressionError(f"A state is made from a mapping {{name: number}}, not {values!r}.")
        known: dict[Symbol, float] = {}
        for key, value in (values or {}).items():
            symbol = _symbol(key)
            if symbol in known:
                raise NameTakenError(f"There are two values for '{symbol}'.")
            known[symbol] = _number(symbol, value)
        self._values = known
        self._by_name: dict[str, Symbol | None] = {str(s): s for s in known}
        if len(self._by_name) < len(known):
            # A parameter may have the name of something else; then the name alone says nothing.
            counts = Counter(map(str, known))
            self._by_name = {name: s if counts[name] == 1 else None for name, s in self._by_name.items()}
        if stamp is not None and not _is_number(stamp):
            raise ValueRejectedError(f"The stamp of a state is a time in seconds, not {stamp!r}.")
        self.stamp = stamp
        self.source = source  # from here on immutable

    def __setattr__(self, name: str, value: Any) -> None:
        if hasattr(self, "source"):
            raise ExpressionError("States are immutable; use updated({symbol: number}, stamp=...).")
        object.__setattr__(self, name, value)

    def __getitem__(self, key: Symbol | str) -> float:
        symbol = self._by_name.get(key) if isinstance(key, str) else key
        if symbol is None and key in self._by_name:
            raise NameTakenError(
                f"Several symbols have the name '{key}'; ask for one by symbol, not by name."
            )
        try:
            return self._values[symbol]  # type: ignore[index]
        except KeyError:
            raise UnknownNameError(
                f"The state says nothing about '{key}'. {suggest(str(key), self._by_name, 'symbol')}"
            ) from None

    def __contains__(self, key: object) -> bool:
        return key in self._by_name if isinstance(key, str) else key in self._values

    def __iter__(self) -> Iterator[Symbol]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    def updated(
        self, values: Mapping[Any, float], *, stamp: float | None = None, source: str | None = None
    ) -> State:
        """Return a state with some values changed or added; stamp and source are kept unless given."""
        other = State(values)
        return State(
            {**self._values, **other._values},
            stamp=self.stamp if stamp is None else stamp,
            source=self.source if source is None else source,
        )

    def __eq__(self, other: object) -> bool:
        if isinstance(other, State):
            return (self._values, self.stamp, self.source) == (other._values, other.stamp, other.source)
        return NotImplemented

    def __hash__(self) -> int:
        return hash((frozenset(self._values.items()), self.stamp, self.source))

    def __reduce__(self) -> Any:
        return _restore, (self._values, self.stamp, self.source)

    def __repr__(self) -> str:
        shown = ", ".join(f"{s}: {v:g}" for s, v in list(self._values.items())[:8])
        more = f", ... {len(self) - 8} more" if len(self) > 8 else ""
        when = "" if self.stamp is None else f", stamp={self.stamp:g}"
        return f"State({{{shown}{more}}}{when})"


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
        raise ValueRejectedError(f"The value of '{symbol}' is not a number: {value!r}.") from None
    if number != number:
        raise ValueRejectedError(f"The value of '{symbol}' is NaN.")
    return number


def _is_number(value: object) -> bool:
    try:
        return not math.isnan(real_number(value))
    except (TypeError, ValueError, OverflowError):
        return False


def _restore(values: dict[Symbol, float], stamp: float | None, source: str) -> State:
    return State(values, stamp=stamp, source=source)
