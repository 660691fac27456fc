"""The native document ``.kv.json``: a model as the list of its operations, exact to the last bit.

A document is one JSON object::

    {"format": "kineverse", "version": 1, "nodes": [...], "operations": [...], "sha256": "..."}

``nodes`` is the table of all expressions of the model, each node made of earlier ones (:mod:`.node_table`
lists the types); ``operations`` has the reads and writes of every operation; ``sha256`` is the hash of the
content (:mod:`.encoding`), and is optional. Reading a document runs no code and imports no name. A
``.kv.msgpack`` file is the same in binary form.
"""

from .json_values import schema
from .opaque_operation import OpaqueOperation
from .reader import from_bytes, read_operations, read_packed_operations
from .writer import document_hash, to_bytes, to_json, write_document

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
