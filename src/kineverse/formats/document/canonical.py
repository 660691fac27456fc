"""The canonical form of a document, and the hash of its content.

A document is written in one way only. Its hash is SHA-256 over that text, in UTF-8, without the hash itself
and without line breaks. Who lays the JSON out anew does not change what it says: then the hash is made of
what was read. The order of names (of frames in what an operation writes, say) is part of the content.
"""

from __future__ import annotations

import hashlib
import json
from typing import Any

from kineverse.model.operation import KINDS

from .checks import RefusedError

HASH = "sha256"
_LEAD, _TAIL = f',\n"{HASH}":"', '"}\n'
_DIGITS = 64

# The members that the format names, in the order in which they are written, whichever object they are in.
_ORDER = (
    *("format", "version", "nodes", "operations"),
    *("tag", "kind", "parameters", "reads", "existence", "value", "listing", "questions", "writes"),
    *("trace", "frozen", *KINDS, "record", "fields"),
    *("parent", "child", "factors", "coordinates", "home", "speeds", "dynamics", "follows"),
    *("visuals", "collisions", "inertia", "mass", "tensor", "geometry", "origin", "name", "color", "texture"),
    *("size", "radius", "length", "radii", "uri", "scale", "folder"),
)
_RANK = {name: i for i, name in enumerate(_ORDER)}
# Their members are names that somebody gave.
_NAMED = frozenset(("parameters", "fields", *KINDS))
_WITHOUT_OBJECTS = frozenset(("nodes", "factors"))

dump = json.JSONEncoder(ensure_ascii=False, allow_nan=False, separators=(",", ":")).encode


def sealed(body: str) -> str:
    """Return the text of a document, given all of it but the hash and the closing brace."""
    return f"{body}{_LEAD}{_digest(body.encode())}{_TAIL}"


def hash_of(text: str) -> str:
    """Return the hash that stands in a text that was written here."""
    return text[-len(_TAIL) - _DIGITS : -len(_TAIL)]


def check_hash(claim: Any, content: bytes, given: dict[str, Any]) -> None:
    """Check the hash of a document.

    Parameters
    ----------
    claim
        What stands in the document.
    content
        All of its text, or nothing if it was none.
    given
        What was read from it, an object.

    Raises
    ------
    RefusedError
        If its content is not what it was when the hash was made.
    """
    if type(claim) is not str or len(claim) != _DIGITS or set(claim) - set("0123456789abcdef"):
        raise RefusedError(f"{HASH!r} is {_DIGITS} digits from 0 to f")
    end = f"{_LEAD}{claim}{_TAIL}".encode()
    if content.endswith(end) and _digest(content[: -len(end)]) == claim:
        return
    rest = {key: value for key, value in given.items() if key != HASH}
    try:
        same = claim in (_digest_of(rest), _digest_of(_in_order(rest)))
    except (TypeError, ValueError):
        raise RefusedError("it contains what JSON has no place for") from None
    if not same:
        raise RefusedError(
            f"its content is not what {HASH!r} says; it was changed or damaged since it was written. Get it "
            f"anew, or, if the change is meant, delete the member {HASH!r}: it comes again when the model "
            "is saved, for instance by 'kineverse convert'"
        )


def _digest(body: bytes) -> str:
    digest = hashlib.sha256(body.replace(b"\n", b""))
    digest.update(b"}")
    return digest.hexdigest()


def _digest_of(tree: Any) -> str:
    return hashlib.sha256(dump(tree).encode("utf-8", "surrogatepass")).hexdigest()


def _in_order(value: Any) -> Any:
    """Return a value of JSON with the members that the format names in the order of the writer."""
    if type(value) is list:
        return [_in_order(item) for item in value]
    if type(value) is not dict:
        return value
    result = {}
    for key in sorted(value, key=lambda key: _RANK.get(key, len(_RANK))):
        if key in _NAMED:
            result[key] = _named(value[key])
        else:
            result[key] = value[key] if key in _WITHOUT_OBJECTS else _in_order(value[key])
    return result


def _named(value: Any) -> Any:
    return {key: _in_order(item) for key, item in value.items()} if type(value) is dict else value
