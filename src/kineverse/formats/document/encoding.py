"""Bytes of documents: canonical blobs of operations, digests, and the text of the same content.

A blob is the msgpack of an :class:`.structs.OperationValue`, in the one form that msgspec writes. Texts are
decoded to the same structs, and so have the same blobs. A digest is SHA-256 of a blob; the hash of a model is
SHA-256 of its operations' digests, one after the other.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterable
from typing import Any, NoReturn

import msgspec
import numpy as np

from .budget import InvalidDocumentError, check_counts
from .structs import FORMAT, VERSION, Envelope, Header, OperationValue

HASH = "sha256"


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, (str, float, int)):  # instances of a subclass
        return next(kind(value) for kind in (str, float, int) if isinstance(value, kind))
    raise TypeError(f"a {type(value).__name__} has no place in a document")


_PACK = msgspec.msgpack.Encoder(enc_hook=_plain).encode
_UNPACK = msgspec.msgpack.Decoder(OperationValue).decode
_UNPACK_ENVELOPE = msgspec.msgpack.Decoder(Envelope).decode
_PRINT = msgspec.json.Encoder().encode
_PARSE = msgspec.json.Decoder(OperationValue).decode
_PARSE_ENVELOPE = msgspec.json.Decoder(Envelope).decode


def make_blob(operation: dict[str, Any]) -> bytes:
    """Return the blob of an encoded operation, in canonical form."""
    try:
        return _PACK(_UNPACK(_PACK(operation)))
    except (TypeError, ValueError, OverflowError, RecursionError) as error:
        raise InvalidDocumentError(_explain(error)) from None


def digest(blob: bytes) -> bytes:
    """Return the digest of a blob."""
    return hashlib.sha256(blob).digest()


def hash_blobs(blobs: Iterable[bytes]) -> str:
    """Return the hash of a model from the blobs of its operations, in order."""
    return hashlib.sha256(b"".join(map(digest, blobs))).hexdigest()


# -- documents -----------------------------------------------------------------------------------------------


def pack_document(blobs: list[bytes], **others: Any) -> bytes:
    """Return a document in msgpack from the blobs of its operations, and other members of the envelope."""
    raw = [msgspec.Raw(blob) for blob in blobs]
    return _PACK(Envelope(format=FORMAT, version=VERSION, operations=raw, sha256=hash_blobs(blobs), **others))


def print_document(blobs: list[bytes], **others: Any) -> str:
    """Return a document as text, an operation a line."""
    lines = [_PRINT(_UNPACK(blob)) for blob in blobs]
    empty = Envelope(format=FORMAT, version=VERSION, operations=[], sha256=hash_blobs(blobs), **others)
    return _lay_out(lines, empty).decode()


def _lay_out(lines: list[bytes], empty: Envelope) -> bytes:
    """Return the text of a document from the texts of its operations and an envelope without them."""
    head, _, tail = _PRINT(empty).partition(b'"operations":[]')
    body = b"\n" + b",\n".join(lines) + b"\n" if lines else b""
    return head + b'\n"operations":[' + body + b"]" + tail.replace(b',"sha256"', b',\n"sha256"') + b"\n"


def read_envelope(content: bytes, is_text: bool) -> Envelope:
    """Return the envelope of a document, with operations that are not decoded yet."""
    check_counts(content, is_text)
    try:
        envelope: Envelope = (_PARSE_ENVELOPE if is_text else _UNPACK_ENVELOPE)(content)
    except (msgspec.MsgspecError, UnicodeError, OverflowError) as error:
        _refuse_envelope(content, is_text, error)
    if not is_text and _PACK(envelope) != content:
        _refuse_form()
    return envelope


def _refuse_envelope(content: bytes, is_text: bool, error: Exception) -> NoReturn:
    try:
        header = (msgspec.json if is_text else msgspec.msgpack).decode(content, type=Header)
    except msgspec.ValidationError:
        header = Header()
    except (msgspec.MsgspecError, UnicodeError, OverflowError) as problem:
        what = "JSON in UTF-8" if is_text else "msgpack"
        raise InvalidDocumentError(f"it is not {what}: {_explain(problem)}") from None
    if header.format != FORMAT:
        raise InvalidDocumentError(
            f'it does not begin with {{"format": "{FORMAT}", and so is not one of Kineverse'
        ) from None
    version = header.version
    if type(version) is not int or version < 1:
        raise InvalidDocumentError("its version is not a whole number from 1 on") from None
    if version != VERSION:
        advice = "update Kineverse" if version > VERSION else "save the model again, from what it was made of"
        raise InvalidDocumentError(
            f"it is of version {min(version, 1_000_000)}, and this Kineverse reads version {VERSION} alone; "
            f"{advice}"
        ) from None
    raise InvalidDocumentError(_explain(error)) from None


def read_operation(raw: bytes, is_text: bool) -> tuple[OperationValue, bytes]:
    """Return an operation and its blob, from its part of a document."""
    try:
        operation: OperationValue = (_PARSE if is_text else _UNPACK)(raw)
        blob = _PACK(operation)
    except (msgspec.MsgspecError, ValueError, TypeError, OverflowError) as error:
        raise InvalidDocumentError(_explain(error)) from None
    if not is_text and blob != raw:
        _refuse_form()
    return operation, blob


def check_text(content: bytes, envelope: Envelope, operations: list[OperationValue]) -> None:
    """Check that no object of a text has a key twice, which decoding does not notice."""
    empty = msgspec.structs.replace(envelope, operations=[])
    if _lay_out([_PRINT(operation) for operation in operations], empty) == content:
        return
    try:
        json.loads(content, object_pairs_hook=_object, parse_int=str, parse_float=str)
    except ValueError as error:
        raise InvalidDocumentError(f"it is not JSON: {error}") from None


def _object(pairs: list[tuple[str, Any]]) -> None:
    seen: set[str] = set()
    for key, _ in pairs:
        if key in seen:
            raise InvalidDocumentError(f"the key {key[:60]!r} occurs twice in one object")
        seen.add(key)


def _refuse_form() -> NoReturn:
    raise InvalidDocumentError(
        "an object has a key twice or members in another order, or numbers and lengths are not in their "
        "shortest form, or numbers that are not whole have less than 64 bits"
    )


_QUOTED = re.compile("`([^`]*)`")
_MARKS = re.compile(r"^(key` in `)?\$?\.?|`$|\[\.\.\.\]")  # of msgspec in a place
_TYPES = {
    "str": "a text",
    "int": "a whole number",
    "float": "a number",
    "bool": "true or false",
    "null": "null",
    "object": "an object",
    "array": "a list",
    "bytes": "bytes",
    "ext": "an extension",
    "datetime": "a date",
}


def _explain(error: Exception) -> str:
    """Return the message of an error of msgspec with its place first, in words of JSON."""
    if isinstance(error, OverflowError):
        return 'an integer of more than 64 bits is {"integer": "digits"}'
    text, _, place = str(error).partition(" - at `")
    text = _QUOTED.sub(_name_type, text)
    text = text if text[1:2].isupper() else text[:1].lower() + text[1:]
    place = _MARKS.sub("", place)
    return f"{place}: {text}" if place else text


def _name_type(quoted: re.Match[str]) -> str:
    names = quoted[1].split(" | ")
    return " or ".join(_TYPES[name] for name in names) if set(names) <= _TYPES.keys() else f"'{quoted[1]}'"
