"""The native document ``.kv.json``: a model as the list of its operations, exact to the last bit.

A document is one JSON object::

    {"format": "kineverse", "version": 1, "nodes": [...], "operations": [...]}

``nodes`` holds all expressions of the model in one table, each node made of earlier ones
(:mod:`.table` says which nodes there are); ``operations`` what every operation read and wrote.
Reading one runs no code and imports no name.
"""

from .reading import operations_from
from .recorded import Recorded
from .writing import document_of, write_document

__all__ = ["Recorded", "document_of", "operations_from", "write_document"]
