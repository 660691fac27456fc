"""Models as bytes and back, to send them."""

from __future__ import annotations

import os

from kineverse.collection import no_collection
from kineverse.errors import FormatError, KineverseError
from kineverse.formats.prefixes import check_prefix
from kineverse.formats.roots import NOWHERE, text_root
from kineverse.model.model import Model
from kineverse.model.view import ModelView

from .packing import packed
from .reading import operations_unpacked
from .writing import document_of


def to_bytes(model: ModelView) -> bytes:
    """Return a model as a document in msgpack, as in ``.kv.msgpack`` files; equal for equal models.

    Parameters
    ----------
    model
        A model or a snapshot.

    Raises
    ------
    FormatError
        Naming what a document cannot carry.
    MissingExtraError
        If msgspec is not installed, which the extra ``exchange`` brings.
    """
    return packed(document_of(model))


def from_bytes(
    data: bytes, prefix: str | None = None, *, root: str | os.PathLike[str] | None = None
) -> Model:
    """Return the model that :func:`to_bytes` made bytes of. No code is run and no name imported.

    Parameters
    ----------
    data
        The bytes, from anywhere.
    prefix
        Put in front of all names, tags included, with a slash; the world stays the world.
    root
        The folder below which meshes that it names by path may be opened. By default none is: those of
        packages are.

    Raises
    ------
    FormatError
        If they are no such document, with the place and the reason.
    MissingExtraError
        If msgspec is not installed, which the extra ``exchange`` brings.
    """
    if not isinstance(data, (bytes, bytearray, memoryview)):
        raise FormatError(f"A packed document is bytes, not a {type(data).__name__}.")
    check_prefix(prefix)
    operations = operations_unpacked(bytes(data), "the document", prefix or None, text_root(NOWHERE, root))
    model = Model()
    try:
        with model.edit() as edit, no_collection():
            for tag, operation in operations:
                edit.apply(operation, tag)
    except KineverseError as error:
        raise FormatError(f"The operations of the document cannot be applied: {error}") from error
    return model
