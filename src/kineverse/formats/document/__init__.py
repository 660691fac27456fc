"""The native document ``.kv.json``: a model as the list of its operations, exact to the last bit.

A document is one JSON object::

    {"format": "kineverse", "version": 1, "nodes": [...], "operations": [...], "sha256": "..."}

``nodes`` holds all expressions of the model in one table, each node made of earlier ones
(:mod:`.table` says which nodes there are); ``operations`` what every operation read and wrote;
``sha256`` is the hash of all that (:mod:`.canonical`), and may be missing.
Reading one runs no code and imports no name. In a ``.kv.msgpack`` file the same is packed (:mod:`.wire`).
"""

from .opaque_operation import OpaqueOperation
from .reader import from_bytes, read_operations, read_packed_operations, to_bytes
from .schema import schema
from .writer import document_hash, to_json, write_document

__all__ = [
    "OpaqueOperation",
    "document_hash",
    "from_bytes",
    "read_operations",
    "read_packed_operations",
    "schema",
    "to_bytes",
    "to_json",
    "write_document",
]
