"""The native document ``.kv.json``: a model as the list of its operations, exact to the last bit.

A document is one JSON object::

    {"format": "kineverse", "version": 1, "nodes": [...], "operations": [...], "sha256": "..."}

``nodes`` holds all expressions of the model in one table, each node made of earlier ones
(:mod:`.table` says which nodes there are); ``operations`` what every operation read and wrote;
``sha256`` is the hash of all that (:mod:`.canonical`), and may be missing.
Reading one runs no code and imports no name. In a ``.kv.msgpack`` file the same is packed (:mod:`.wire`).
"""

from .reading import operations_from, operations_unpacked
from .recorded import Recorded
from .schema import schema
from .wire import from_bytes, to_bytes
from .writing import document_hash, document_of, write_document

__all__ = [
    "Recorded",
    "document_hash",
    "document_of",
    "from_bytes",
    "operations_from",
    "operations_unpacked",
    "schema",
    "to_bytes",
    "write_document",
]
