"""Documents as msgpack, for the wire: the same tree as in JSON, and so the same hash, in less time."""

from __future__ import annotations

import json
from typing import Any

from kineverse.errors import MissingExtraError
from kineverse.installation import install_command

from .checks import RefusedError
from .limits import MAX_LISTS

# The first bytes of lists and maps; they also occur inside of numbers and texts, so this counts too many.
_LISTS = bytes((*range(0x80, 0xA0), 0xDC, 0xDD, 0xDE, 0xDF))


def packed(text: str) -> bytes:
    """Return the text of a document as msgpack.

    Raises
    ------
    MissingExtraError
        If the package for it is not installed.
    """
    data: bytes = _msgpack().encode(json.loads(text))
    return data


def unpacked(data: bytes) -> Any:
    """Return the tree of a packed document.

    Raises
    ------
    RefusedError
        If it is no msgpack, has too many parts, or is not packed as it should be.
    MissingExtraError
        If the package for it is not installed.
    """
    msgpack = _msgpack()
    if len(data) - len(data.translate(None, _LISTS)) > MAX_LISTS:
        raise RefusedError(f"it may have more than {MAX_LISTS:,} lists and maps, the most a document has")
    try:
        tree = msgpack.decode(data)
    except (ValueError, OverflowError) as error:
        raise RefusedError(f"it is not msgpack: {error}") from None
    # A key that occurs twice is lost when it is read, so there is less then.
    if not isinstance(tree, dict) or msgpack.encode(tree) != data:
        raise RefusedError(
            "it is no map, or has a key twice, or numbers and lengths are not in their shortest form, or "
            "numbers that are not whole have less than 64 bits"
        )
    return tree


def _msgpack() -> Any:
    try:
        import msgspec.msgpack
    except ImportError as error:
        raise MissingExtraError(
            f"Documents as msgpack need msgspec: {install_command('exchange')}"
        ) from error
    return msgspec.msgpack
