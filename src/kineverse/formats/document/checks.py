"""Small checks on what a JSON text contains; all of them raise :class:`RefusedError`."""

from __future__ import annotations

import math
from collections.abc import Collection
from typing import Any, TypeVar

T = TypeVar("T")


class RefusedError(Exception):
    """Why something in a document is not accepted; whoever knows the place makes a FormatError of it."""


def the(kind: type[T], value: Any, what: str) -> T:
    """Return a value of exactly this type."""
    if type(value) is not kind:
        raise RefusedError(f"{what} is expected, not {_kind(value)}")
    return value


def listed(value: Any, what: str) -> list[Any]:
    """Return a list."""
    if type(value) is not list:
        raise RefusedError(f"{what}: a list is expected, not {_kind(value)}")
    return value


def exactly(items: list[Any], length: int) -> list[Any]:
    """Return a list of this length."""
    if len(items) != length:
        raise RefusedError(f"{length} items are expected, not {len(items)}")
    return items


def fields(value: Any, required: Collection[str], optional: Collection[str] = ()) -> dict[str, Any]:
    """Return an object that has the required and perhaps the optional keys, and no others."""
    if type(value) is not dict:
        raise RefusedError(f"an object is expected, not {_kind(value)}")
    for key in required:
        if key not in value:
            raise RefusedError(f"{key!r} is missing")
    for key in value:
        if key not in required and key not in optional:
            known = ", ".join((*required, *optional))
            raise RefusedError(f"unknown key {str(key)[:60]!r}; keys are {known}")
    return value


def number(value: Any) -> float:
    """Return a number; ``"inf"`` and ``"-inf"`` stand for the infinite ones."""
    if type(value) is float:
        if not -math.inf < value < math.inf:
            raise RefusedError("a number is too large for a 64-bit float")
        return value
    if type(value) is int:
        try:
            float(value)
        except OverflowError:
            raise RefusedError("a number is too large for a 64-bit float") from None
        return value
    if value == "inf":
        return math.inf
    if value == "-inf":
        return -math.inf
    raise RefusedError(f"a number is expected, not {_kind(value)}")


def numbers(value: Any, length: int | None = None) -> tuple[float, ...]:
    """Return so many numbers."""
    items = listed(value, "numbers")
    if length is not None:
        exactly(items, length)
    for item in items:
        if type(item) is not float or not -math.inf < item < math.inf:
            return tuple(map(number, items))
    return tuple(items)


def whole(value: Any, most: int) -> int:
    """Return a whole number from 0 to ``most``."""
    if type(value) is not int or not 0 <= value <= most:
        raise RefusedError(f"a whole number from 0 to {most} is expected, not {_kind(value)}")
    return value


def name(value: Any) -> str:
    """Return a name: text, no part of which is empty."""
    if type(value) is not str or not all(value.split("/")):
        raise RefusedError(f"a name is expected, whose parts are not empty, not {_kind(value)}")
    return string(value)


def string(value: Any) -> str:
    """Return text that can be written again."""
    try:
        the(str, value, "text").encode()
    except UnicodeEncodeError:
        raise RefusedError("half a surrogate pair is no text") from None
    return str(value)


def shown(value: Any) -> str:
    """Return what an error shows of a value."""
    text = repr(value) if isinstance(value, (str, int, float, bool, type(None))) else type(value).__name__
    return text if len(text) <= 60 else f"{text[:57]}..."


def _kind(value: Any) -> str:
    if isinstance(value, str):
        return repr(value if len(value) <= 40 else f"{value[:37]}...")
    if isinstance(value, (bool, type(None))):
        return {True: "true", False: "false", None: "null"}[value]
    if isinstance(value, (int, float)):
        return repr(value) if abs(value) < 1e30 else "such a large number"
    return "a list" if isinstance(value, list) else "an object"
