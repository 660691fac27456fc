"""The native document ``.kv.json``: a model as the list of its operations, exact to the last bit.

A document is one JSON object::

    {"format": "kineverse", "version": 1, "nodes": [...], "operations": [...], "sha256": "..."}

``nodes`` is the table of all expressions of the model, each node made of earlier ones (:mod:`.node_table`
lists the types); ``operations`` has the reads and writes of every operation; ``sha256`` is the hash of the
content (:mod:`.encoding`), and is optional. Reading a document runs no code and imports no name. A
``.kv.msgpack`` file is the same in binary form.
"""

from typing import TYPE_CHECKING

from kineverse._lazy import lazy_face

if TYPE_CHECKING:
    from .json_values import schema as schema
    from .opaque_operation import OpaqueOperation as OpaqueOperation
    from .reader import (
        from_bytes as from_bytes,
        read_operations as read_operations,
        read_packed_operations as read_packed_operations,
    )
    from .writer import (
        document_hash as document_hash,
        to_bytes as to_bytes,
        to_json as to_json,
        write_document as write_document,
    )

lazy_face(__name__)
