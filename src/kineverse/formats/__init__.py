"""Readers and writers of robot and scene descriptions."""

from typing import TYPE_CHECKING

from kineverse._lazy import lazy_face

if TYPE_CHECKING:
    from kineverse.formats import urdf as urdf

    from .conversion_check import ConversionCheck as ConversionCheck, check_conversion as check_conversion
    from .document import (
        document_hash as document_hash,
        entries_from_bytes as entries_from_bytes,
        entry_to_bytes as entry_to_bytes,
        from_bytes as from_bytes,
        operation_digest as operation_digest,
        operation_from_bytes as operation_from_bytes,
        operation_to_bytes as operation_to_bytes,
        to_bytes as to_bytes,
    )
    from .resources import (
        FolderResolver as FolderResolver,
        Resolver as Resolver,
        add_resolver as add_resolver,
        remove_resolver as remove_resolver,
    )
    from .loader import load as load
    from .locate import locate_model as locate_model, shipped_models as shipped_models
    from .reader_warnings import collect_warnings as collect_warnings
    from .srdf import read_srdf as read_srdf
    from .validate import ValidationResult as ValidationResult, validate_file as validate_file

lazy_face(__name__)
