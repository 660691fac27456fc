"""Numbers as robot descriptions write them: decimal text, one or several, finite.

Those that come several at a time are coordinates, and no larger than ``LARGEST``: products of larger ones
overflow, and a pose would not be finite. A single one may be a limit, and 1.8e308 says that there is none.

Descriptions repeat themselves ("0 0 0" by the hundred), so the results are remembered.
"""

from __future__ import annotations

import math
from functools import lru_cache

from .markup import abbreviate

LARGEST = 1e50
"""The largest magnitude of what poses are made of: coordinates, positions, and factors between positions."""

SMALLEST = 1e-50
"""The smallest factor between positions but 0: by a smaller one, limits of a follower are out of reach."""

_MAX_LENGTH = 1000


@lru_cache(maxsize=8192)
def number(text: str) -> float:
    """Return the one finite number that the text spells.

    Raises
    ------
    ValueError
        With the reason, if the text is anything else.
    """
    return _read(text, 1)[0]


@lru_cache(maxsize=8192)
def directions(text: str, count: int) -> tuple[float, ...]:
    """Return ``count`` numbers of which no pose gets large: angles, or those of an axis or a quaternion.

    Raises
    ------
    ValueError
        With the reason, if the text is anything else.
    """
    return _read(text, count)


def unit(values: tuple[float, ...]) -> tuple[float, ...]:
    """Return a vector, made shorter where its length would overflow."""
    largest = max(map(abs, values))
    return values if largest <= LARGEST else tuple(value / largest for value in values)


@lru_cache(maxsize=8192)
def numbers(text: str, count: int) -> tuple[float, ...]:
    """Return the ``count`` coordinates that the text spells, separated by white space.

    Raises
    ------
    ValueError
        With the reason, if the text is anything else.
    """
    values = _read(text, count)
    if values and max(map(abs, values)) > LARGEST:
        raise ValueError(f"has a number beyond {LARGEST:g}, where {_expected(count)}")
    return values


def _read(text: str, count: int) -> tuple[float, ...]:
    if len(text) > _MAX_LENGTH:
        raise ValueError(f"is {len(text)} characters long, where {_expected(count)}")
    words = text.split()
    if len(words) != count:
        found = {0: "is empty", 1: "is one word"}.get(len(words), f"has {len(words)} words")
        raise ValueError(f"{found}, where {_expected(count)}{_hint(text)}")
    return tuple([_number(word, count) for word in words])


def _number(word: str, count: int) -> float:
    # Python reads more than a description may say: digits grouped by underscores and those of other scripts.
    if "_" in word or not word.isascii():
        raise ValueError(f"has '{abbreviate(word)}', where {_expected(count)}")
    try:
        value = float.fromhex(word) if "0x" in word[:3].lower() else float(word)
    except OverflowError:
        value = math.inf
    except ValueError:
        raise ValueError(f"has '{abbreviate(word)}', where {_expected(count)}{_hint(word)}") from None
    if not math.isfinite(value):
        raise ValueError(f"has '{word}', where {_expected(count)}; leave a limit out if there is none")
    return value


def _expected(count: int) -> str:
    return "a finite number is expected" if count == 1 else f"{count} finite numbers are expected"


def _hint(text: str) -> str:
    if "${" in text or "$(" in text:
        return "; this is xacro, expand it first: xacro robot.urdf.xacro > robot.urdf"
    if "," in text:
        return "; numbers are separated by spaces and have a decimal point"
    return ""
