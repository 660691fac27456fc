"""Published JSON Schema of documents, and checks of JSON values."""

from __future__ import annotations

import json
import math
from collections.abc import Collection
from importlib.resources import files
from typing import Any, TypeVar

T = TypeVar("T")


class InvalidDocumentError(Exception):
    """Reason why a document is refused, without its place; the reader raises a FormatError with both."""


def check_type(kind: type[T], value: Any, what: str) -> T:
    """Return a value after checking that it is of exactly one type."""
    if type(value) is not kind:
        raise InvalidDocumentError(f"{what} is expected, not {_describe_type(value)}")
    return value


def check_list(value: Any, what: str) -> list[Any]:
    """Return a value after checking that it is a list."""
    if type(value) is not list:
        raise InvalidDocumentError(f"{what}: a list is expected, not {_describe_type(value)}")
    return value


def check_length(items: list[Any], length: int) -> list[Any]:
    """Return a list after checking its length."""
    if len(items) != length:
        raise InvalidDocumentError(f"{length} items are expected, not {len(items)}")
    return items


def check_keys(value: Any, required: Collection[str], optional: Collection[str] = ()) -> dict[str, Any]:
    """Return an object after checking that it has all required keys, and else only optional ones."""
    if type(value) is not dict:
        raise InvalidDocumentError(f"an object is expected, not {_describe_type(value)}")
    for key in required:
        if key not in value:
            raise InvalidDocumentError(f"{key!r} is missing")
    for key in value:
        if key not in required and key not in optional:
            known = ", ".join((*required, *optional))
            raise InvalidDocumentError(f"unknown key {str(key)[:60]!r}; keys are {known}")
    return value


def check_number(value: Any) -> float:
    """Return a number after checking that it is one; ``"inf"`` and ``"-inf"`` are the infinities."""
    if type(value) is float:
        if not -math.inf < value < math.inf:
            raise InvalidDocumentError("a number is too large for a 64-bit float")
        return value
    if type(value) is int:
        try:
            float(value)
        except OverflowError:
            raise InvalidDocumentError("a number is too large for a 64-bit float") from None
        return value
    if value == "inf":
        return math.inf
    if value == "-inf":
        return -math.inf
    raise InvalidDocumentError(f"a number is expected, not {_describe_type(value)}")


def check_numbers(value: Any, length: int | None = None) -> tuple[float, ...]:
    """Return numbers after checking each, and their count if it is given."""
    items = check_list(value, "numbers")
    if length is not None:
        check_length(items, length)
    for item in items:
        if type(item) is not float or not -math.inf < item < math.inf:
            return tuple(map(check_number, items))
    return tuple(items)


def check_integer(value: Any, most: int) -> int:
    """Return a whole number after checking that it is from 0 to ``most``."""
    if type(value) is not int or not 0 <= value <= most:
        raise InvalidDocumentError(
            f"a whole number from 0 to {most} is expected, not {_describe_type(value)}"
        )
    return value


def check_entity_name(value: Any) -> str:
    """Return a name after checking that none of its parts is empty."""
    if type(value) is not str or not all(value.split("/")):
        raise InvalidDocumentError(
            f"a name is expected, whose parts are not empty, not {_describe_type(value)}"
        )
    return check_text(value)


def check_text(value: Any) -> str:
    """Return a text after checking that it can be encoded in UTF-8."""
    try:
        check_type(str, value, "text").encode()
    except UnicodeEncodeError:
        raise InvalidDocumentError("half a surrogate pair is no text") from None
    return str(value)


def describe_value(value: Any) -> str:
    """Return a value as text of limited length for an error."""
    text = repr(value) if isinstance(value, (str, int, float, bool, type(None))) else type(value).__name__
    return text if len(text) <= 60 else f"{text[:57]}..."


def _describe_type(value: Any) -> str:
    """Return a JSON value, or the type of a compound one, as text for an error."""
    if isinstance(value, str):
        return repr(value if len(value) <= 40 else f"{value[:37]}...")
    if isinstance(value, (bool, type(None))):
        return {True: "true", False: "false", None: "null"}[value]
    if isinstance(value, (int, float)):
        return repr(value) if abs(value) < 1e30 else "such a large number"
    return "a list" if isinstance(value, list) else "an object"


def schema() -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of documents, the content of ``schema.json``.

    It defines the parts of a document. Only the reader checks that references are to earlier nodes, shapes,
    limits on size and work, and the hash.
    """
    content: dict[str, Any] = json.loads(files(__package__).joinpath("schema.json").read_text("utf-8"))
    return content
