"""Documents ``.kv.json`` and ``.kv.msgpack``: a model as the list of its operations, exact to the last bit.

A document is one object::

    {"format": "kineverse", "version": 2, "operations": [...], "sha256": "..."}

Each operation stands for itself: it has its tag, its kind, its reads and writes, and a table of the
expressions in them (:mod:`.structs` has the layout). Its msgpack is its *blob* (:mod:`.encoding`). Reading
runs no code and imports no name.
"""

from typing import TYPE_CHECKING

from kineverse._lazy import lazy_face

if TYPE_CHECKING:
    from .opaque_operation import OpaqueOperation as OpaqueOperation
    from .reader import (
        entries_from_bytes as entries_from_bytes,
        from_bytes as from_bytes,
        operation_from_bytes as operation_from_bytes,
        read_operations as read_operations,
    )
    from .structs import schema as schema
    from .writer import (
        document_hash as document_hash,
        entry_to_bytes as entry_to_bytes,
        operation_digest as operation_digest,
        operation_to_bytes as operation_to_bytes,
        to_bytes as to_bytes,
        to_json as to_json,
        write_document as write_document,
    )

lazy_face(__name__)
