"""Canonical JSON text of a document, its hash, and its binary form (msgpack).

The text of a document is canonical. Its hash is SHA-256 over that text, in UTF-8, without the hash itself and
without line breaks. Another layout of the same JSON keeps the content, so the reader then computes the hash
from the parsed values. The order of names (of frames in the writes of an operation, say) is part of the
content.
"""

from __future__ import annotations

import hashlib
import json
from typing import Any

from kineverse._extras import install_command
from kineverse.errors import MissingDependencyError
from kineverse.model.operation import KINDS

from .budget import MAX_LISTS
from .json_values import InvalidDocumentError

HASH = "sha256"
_LEAD, _TAIL = f',\n"{HASH}":"', '"}\n'
_DIGITS = 64

# Members of the format in the order in which they are written, for all objects.
_ORDER = (
    *("format", "version", "nodes", "operations"),
    *("tag", "kind", "parameters", "reads", "existence", "value", "listing", "questions", "writes"),
    *("trace", "frozen", *KINDS, "record", "fields"),
    *("parent", "child", "factors", "coordinates", "home", "speeds", "dynamics", "follows"),
    *("visuals", "collisions", "inertia", "mass", "tensor", "geometry", "origin", "name", "color", "texture"),
    *("size", "radius", "length", "radii", "uri", "scale", "folder"),
)
_RANK = {name: i for i, name in enumerate(_ORDER)}
# Objects whose members have names of the model.
_NAMED = frozenset(("parameters", "fields", *KINDS))
_WITHOUT_OBJECTS = frozenset(("nodes", "factors"))

dump_json = json.JSONEncoder(ensure_ascii=False, allow_nan=False, separators=(",", ":")).encode


def append_hash(body: str) -> str:
    """Return the text of a document from its text without hash and closing brace."""
    return f"{body}{_LEAD}{_digest(body.encode())}{_TAIL}"


def read_hash(text: str) -> str:
    """Return the hash in a canonical text."""
    return text[-len(_TAIL) - _DIGITS : -len(_TAIL)]


def check_hash(claim: Any, content: bytes, given: dict[str, Any]) -> None:
    """Check the hash of a document."""
    if type(claim) is not str or len(claim) != _DIGITS or set(claim) - set("0123456789abcdef"):
        raise InvalidDocumentError(f"{HASH!r} is {_DIGITS} digits from 0 to f")
    end = f"{_LEAD}{claim}{_TAIL}".encode()
    if content.endswith(end) and _digest(content[: -len(end)]) == claim:
        return
    rest = {key: value for key, value in given.items() if key != HASH}
    try:
        same = claim in (_digest_of(rest), _digest_of(_order_members(rest)))
    except (TypeError, ValueError):
        raise InvalidDocumentError("it contains what JSON has no place for") from None
    if not same:
        raise InvalidDocumentError(
            f"its content is not what {HASH!r} says; it was changed or damaged since it was written. Get "
            f"another copy, or, if the change is intended, delete the member {HASH!r}: it is written again "
            "when the model is saved, for instance by 'kineverse convert'"
        )


def _digest(body: bytes) -> str:
    digest = hashlib.sha256(body.replace(b"\n", b""))
    digest.update(b"}")
    return digest.hexdigest()


def _digest_of(tree: Any) -> str:
    return hashlib.sha256(dump_json(tree).encode("utf-8", "surrogatepass")).hexdigest()


def _order_members(value: Any) -> Any:
    """Return a JSON value with the members of the format in canonical order."""
    if type(value) is list:
        return [_order_members(item) for item in value]
    if type(value) is not dict:
        return value
    result = {}
    for key in sorted(value, key=lambda key: _RANK.get(key, len(_RANK))):
        if key in _NAMED:
            result[key] = _order_named(value[key])
        else:
            result[key] = value[key] if key in _WITHOUT_OBJECTS else _order_members(value[key])
    return result


def _order_named(value: Any) -> Any:
    return {key: _order_members(item) for key, item in value.items()} if type(value) is dict else value


# First bytes of lists and maps; they also occur inside of numbers and texts, so the count is an upper bound.
_LISTS = bytes((*range(0x80, 0xA0), 0xDC, 0xDD, 0xDE, 0xDF))


def pack_document(text: str) -> bytes:
    """Return the text of a document as msgpack."""
    data: bytes = _msgpack().encode(json.loads(text))
    return data


def unpack_document(data: bytes) -> Any:
    """Return the JSON value of a packed document."""
    msgpack = _msgpack()
    if len(data) - len(data.translate(None, _LISTS)) > MAX_LISTS:
        raise InvalidDocumentError(
            f"it may have more than {MAX_LISTS:,} lists and maps, the most a document has"
        )
    try:
        tree = msgpack.decode(data)
    except (ValueError, OverflowError) as error:
        raise InvalidDocumentError(f"it is not msgpack: {error}") from None
    # A duplicate key is lost on decoding, so the text encoded again is shorter.
    if not isinstance(tree, dict) or msgpack.encode(tree) != data:
        raise InvalidDocumentError(
            "it is no map, or has a key twice, or numbers and lengths are not in their shortest form, or "
            "numbers that are not whole have less than 64 bits"
        )
    return tree


def _msgpack() -> Any:
    try:
        import msgspec.msgpack
    except ImportError as error:
        raise MissingDependencyError(
            f"Documents as msgpack need msgspec: {install_command('exchange')}"
        ) from error
    return msgspec.msgpack
