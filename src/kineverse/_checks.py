"""Conversion of scalar arguments to floats."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from kineverse.errors import (
    InvalidValueError,
)


def real_number(value: Any) -> float:
    """Return a value as a float, NaN and infinities included.

    Text is none, though ``float`` reads it, and nothing is cut off: no imaginary parts, no further elements,
    no mask.

    Raises
    ------
    TypeError, ValueError, OverflowError
        For what is no number.
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
    """Return a finite number as a float; None for infinities, NaN and whatever is no number."""
    try:
        number = real_number(value)
    except (TypeError, ValueError, OverflowError):
        return None
    return number if math.isfinite(number) else None


def as_tolerance(given: float) -> float:
    """Return by how much something may be off.

    Raises
    ------
    InvalidValueError
        If that is no finite number from 0.
    """
    tolerance = finite_number(given)
    if tolerance is None or tolerance < 0:
        raise InvalidValueError(f"A tolerance is a finite number from 0, not {given!r}.")
    return tolerance


def check_flag(name: str, given: object) -> None:
    """Look whether a keyword that switches something is True or False: the text 'no' would be taken for yes.

    Raises
    ------
    InvalidValueError
        If it is neither.
    """
    if not isinstance(given, bool | np.bool_):
        raise InvalidValueError(f"{name}= is True or False, not {given!r}.")
