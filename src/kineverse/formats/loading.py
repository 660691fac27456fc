"""Models from files and names."""

from __future__ import annotations

import os
from collections.abc import Iterator

from kineverse.errors import FormatError
from kineverse.model.model import Model
from kineverse.model.operation import Operation
from kineverse.shipped.bases import base_of

from .sources import Source, locate_model


def load(source: str | os.PathLike[str], prefix: str | None = None) -> Model:
    """Load a model from a file or by name.

    Parameters
    ----------
    source
        The path of a ``.urdf`` or ``.kv.json`` file, or a name such as ``kitchen`` or ``pr2``, see
        :func:`kineverse.formats.sources.locate_model`.
    prefix
        Put in front of the names of all frames and degrees of freedom, with a slash. A model that ships has
        its own name as prefix unless another is given; ``""`` means none.

    Raises
    ------
    UnknownNameError
        If there is no such model.
    FormatError
        If the file is not what it should be, with file, line, element and reason.
    """
    model = Model()
    model.include(source, prefix)
    return model


def operations_of(
    source: str | os.PathLike[str], prefix: str | None = None
) -> Iterator[tuple[str, Operation]]:
    """Yield the operations of a file or shipped model, each with its tag."""
    found = locate_model(source)
    if prefix is None:
        prefix = found.shipped
    if found.path.name.endswith(".kv.json"):
        from .document import read_document

        yield from read_document(found.path, prefix or None)
        return
    for operation in _read(found, prefix or None):
        yield operation.default_tag(), operation


def _read(source: Source, prefix: str | None) -> Iterator[Operation]:
    name = source.path.name
    if name.endswith((".urdf", ".xml")):
        from .urdf.operations import robot_operations
        from .urdf.reader import read_urdf

        robot = read_urdf(source.path)
        base = base_of(source.shipped, prefix) if source.shipped else None
        if base is None:
            yield from robot_operations(robot, prefix)
        else:
            yield base
            yield from robot_operations(robot, prefix, parent=base.child)
        return
    raise FormatError(
        f"{source.path}: this version reads URDF (.urdf, .xml) and documents (.kv.json), "
        f"not '{''.join(source.path.suffixes) or name}'."
    )
