"""Saving of models, in the format of the file name's ending."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from msgspec.structs import replace

from kineverse._checks import finite_number
from kineverse.errors import FormatError, InvalidValueError
from kineverse.model import registry
from kineverse.model.model_view import ModelView
from kineverse.model.operation import Operation
from kineverse.model.registry import FileFormat, SaveResult

from .description import WrittenFile
from .files import replace_file
from .reader_warnings import warn


def save(
    model: ModelView,
    path: str | os.PathLike[str],
    *,
    tolerance: float | None = None,
    leave_out: Iterable[str] = (),
    strict: bool = False,
) -> SaveResult:
    """Write a model to a file in the format of its ending.

    The file is replaced atomically; after an error, the old file is unchanged. URDF, MJCF and SDF are read
    again before that, MJCF by MuJoCo if it is installed. Meshes that MuJoCo cannot read are converted, into a
    folder next to the file.
    """
    target = _target(path)
    file_format = _check(target)
    if file_format.exact:
        if tuple(leave_out) or tolerance is not None:
            what = "nothing can be left out" if tolerance is None else "it has no tolerance"
            raise FormatError(f"{target.name}: a document holds all of a model exactly, so {what}.")
        registry.import_entry(file_format.write)(model, target)
        return SaveResult(target)
    try:
        write = registry.import_entry(file_format.write)
        written: WrittenFile = write(model, target, leave_out, _checked(tolerance), strict)
    except FormatError as error:
        if str(error).startswith(f"{target.name} "):
            raise
        raise FormatError(f"{target.name} is not written. {error}") from None
    _put(target, written)
    warn(f"{target.name}: {remark}" for remark in written.remarks)
    return SaveResult(target, written.remarks, written.errors, dict(written.left_out))


def save_corrections(
    model: ModelView,
    before: Mapping[str, Operation],
    corrected: Mapping[str, Operation],
    path: str | os.PathLike[str],
    source: str | os.PathLike[str] | None = None,
) -> SaveResult:
    """Write a corrected model, given its operations before and after the correction, by tag.

    A URDF is the file that the model was loaded from, or ``source``, in which only the corrected numbers are
    other ones. Any other file is written as by :func:`save`.
    """
    from .urdf.patch import find_source, patch_urdf  # imported when used, as it imports the articulations

    target = _target(path)
    file_format = _check(target)
    is_urdf = "urdf" in file_format.write
    file = find_source(model.sources, corrected, source) if is_urdf else None
    if file is None:
        if source is not None:
            raise FormatError(f"{target.name} is written whole, so it has no source. Leave source= out.")
        saved = save(model, target)
        if file_format.exact:
            return saved
        remark = "written whole, as no URDF is known that the model was loaded from"
        return replace(saved, remarks=(remark, *saved.remarks))
    written = patch_urdf(file, before, corrected, target.absolute().parent)
    _put(target, written)
    warn(f"{target.name}: {remark}" for remark in written.remarks)
    return SaveResult(target, written.remarks)


def _put(target: Path, written: WrittenFile) -> None:
    """Write a file and those that belong to it: all of them, or none."""
    new = [path for path in written.companion_files if not path.exists()]
    folders = [folder for folder in dict.fromkeys(path.parent for path in new) if not folder.exists()]
    try:
        for folder in folders:
            folder.mkdir()
        for path in new:
            replace_file(path, written.companion_files[path])
        replace_file(target, written.content)
    except (FormatError, OSError) as error:
        for path in new:
            path.unlink(missing_ok=True)
        for folder in folders:
            with contextlib.suppress(OSError):
                folder.rmdir()
        if isinstance(error, OSError):
            raise FormatError(f"{error.filename} cannot be made: {error.strerror}.") from None
        raise


def _check(target: Path) -> FileFormat:
    """Check the name of a file before the file is made, which may take long; return its format."""
    file_format = registry.find_writer(target.name)
    endings = registry.writable_suffixes()
    if file_format is None:
        raise FormatError(
            f"{target}: a model is saved to a name that ends in {', '.join(endings[:-1])} or {endings[-1]}, "
            f"as in {target.stem + endings[0]!r}."
        )
    if target.is_dir():
        raise FormatError(
            f"{target} is a folder; name a file in it, such as {target / f'model{endings[0]}'}."
        )
    if not target.parent.is_dir():
        raise FormatError(f"{target} cannot be written: the folder {target.parent} does not exist.")
    return file_format


def _checked(tolerance: object) -> float | None:
    number = finite_number(tolerance)
    if tolerance is None or (number is not None and number > 0):
        return number
    raise InvalidValueError(f"A tolerance is a positive number [m] and [rad], or None, not {tolerance!r}.")


def _target(path: Any) -> Path:
    try:
        return Path(os.fsdecode(path)).expanduser()
    except (TypeError, RuntimeError):  # no path, or "~name" of an unknown user
        raise FormatError(f"A model is saved to the path of a file, not to {path!r}.") from None
