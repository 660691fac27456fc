"""Conversion of scalar arguments to floats."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from kineverse.errors import InvalidValueError


def real_number(value: Any) -> float:
    """Return a real number as a float, NaN and infinities included.

    Unlike ``float``, it raises for text, complex numbers, arrays of one or more elements, and masked values.

    Raises
    ------
    TypeError, ValueError, OverflowError
        For values that are not real numbers.
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


def finite_number(value: Any) -> float | None:
    """Return a finite number as a float; None for infinities, NaN and other values."""
    try:
        number = real_number(value)
    except (TypeError, ValueError, OverflowError):
        return None
    return number if math.isfinite(number) else None


def as_tolerance(given: float) -> float:
    """Return a tolerance as a float.

    Raises
    ------
    InvalidValueError
        For negative numbers and values that are not finite numbers.
    """
    tolerance = finite_number(given)
    if tolerance is None or tolerance < 0:
        raise InvalidValueError(f"A tolerance is a finite number from 0, not {given!r}.")
    return tolerance


def check_flag(name: str, given: object) -> None:
    """Check that a keyword argument is True or False, since a text such as 'no' counts as true.

    Raises
    ------
    InvalidValueError
        For other values.
    """
    if not isinstance(given, bool | np.bool_):
        raise InvalidValueError(f"{name}= is True or False, not {given!r}.")
