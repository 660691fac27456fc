"""Readers and writers of robot and scene descriptions."""

from typing import TYPE_CHECKING

from kineverse._synonyms import MODULE_SYNONYMS
from kineverse.errors import unknown_attribute_error
from kineverse.formats import urdf

from .file_formats import register_file_formats
from .loader import load
from .locate import locate_model, shipped_models

if TYPE_CHECKING:
    from .document import document_hash, from_bytes, to_bytes
    from .srdf import read_srdf

__all__ = [
    "document_hash",
    "from_bytes",
    "load",
    "locate_model",
    "read_srdf",
    "shipped_models",
    "to_bytes",
    "urdf",
]

register_file_formats()


def __getattr__(name: str) -> object:
    # The document reader is heavy at start-up.
    import importlib

    if name in ("document_hash", "from_bytes", "to_bytes"):
        return getattr(importlib.import_module("kineverse.formats.document"), name)
    if name == "read_srdf":
        return importlib.import_module("kineverse.formats.srdf").read_srdf
    raise unknown_attribute_error("The package kineverse.formats", name, __all__, MODULE_SYNONYMS)
