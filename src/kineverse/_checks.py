"""Conversion of scalar arguments to floats and integers."""

from __future__ import annotations

import math
from collections.abc import Iterable
from operator import index
from typing import Any

import numpy as np

from kineverse.errors import InvalidValueError


def real_number(value: Any) -> float:
    """Return a real number as a float, NaN and infinities included.

    Unlike ``float``, it raises for text, complex numbers, arrays of one or more elements, and masked values.
    """
    if type(value) is float:
        return value
    dtype = getattr(value, "dtype", None)
    if isinstance(value, (str, bytes, bytearray, complex)) or (
        dtype is not None
        and (getattr(dtype, "kind", "") not in "fiub" or value.ndim or getattr(value, "mask", False))
    ):
        raise TypeError(f"{value!r} is not a real number")
    return float(value)


def as_number(value: Any) -> float | None:
    """Return a real number as a float, infinities included; None for NaN and other values."""
    try:
        number = real_number(value)
    except (TypeError, ValueError, OverflowError):
        return None
    return None if math.isnan(number) else number


def finite_number(value: Any) -> float | None:
    """Return a finite number as a float; None for infinities, NaN and other values."""
    number = as_number(value)
    return number if number is not None and math.isfinite(number) else None


def as_tolerance(given: float, subject: str = "A tolerance") -> float:
    """Return a tolerance as a float; messages begin with the subject."""
    tolerance = finite_number(given)
    if tolerance is None or tolerance < 0:
        raise InvalidValueError(f"{subject} is a finite number from 0, not {given!r}.")
    return tolerance


def as_positive(given: Any, subject: str, kind: str = "finite number") -> float:
    """Return a positive finite number as a float; messages begin with the subject and name the kind."""
    number = finite_number(given)
    if number is None or number <= 0:
        raise InvalidValueError(f"{subject} is a positive {kind}, not {given!r:.60}.")
    return number


def as_count(name: str, given: int, least: int) -> int:
    """Return a keyword argument as an integer."""
    count = None if isinstance(given, bool) or not hasattr(given, "__index__") else index(given)
    if count is None or count < least:
        raise InvalidValueError(f"{name}= is an integer of at least {least}, not {given!r}.")
    return count


def as_entries(argument: str, given: Any, kinds: type | tuple[type, ...], wanted: str) -> tuple[Any, ...]:
    """Return the entries of an argument that takes one value or several."""
    if isinstance(given, kinds):
        return (given,)
    if isinstance(given, Iterable) and not isinstance(given, str | bytes):
        result = tuple(given)
        if all(isinstance(entry, kinds) for entry in result):
            return result
    raise InvalidValueError(f"{argument} takes {wanted}, not {given!r:.80}.")


def check_flag(name: str, given: object) -> None:
    """Check that a keyword argument is True or False, since a text such as 'no' counts as true."""
    if not isinstance(given, (bool, np.bool_)):
        raise InvalidValueError(f"{name}= is True or False, not {given!r}.")
