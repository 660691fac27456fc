"""Models to files, by the ending of their name."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from kineverse.errors import FormatError, KineverseError
from kineverse.formats.files import replace_file
from kineverse.formats.remarks import tell
from kineverse.model.view import ModelView

ENDINGS = (".kv.json", ".urdf", ".xml")


@dataclass(frozen=True, slots=True)
class Saved:
    """What has become of a model that was saved.

    Attributes
    ----------
    path
        Of the file.
    remarks
        What the file says other than the model, or not at all, though nothing was refused.
    """

    path: Path
    remarks: tuple[str, ...] = ()


def save(model: ModelView, path: str | os.PathLike[str], leave_out: Iterable[str] = ()) -> Saved:
    """Write a model to a file, whose ending says what it becomes.

    The file is there whole or not at all; if it cannot be written, it is what it was before.

    Parameters
    ----------
    model
        The model.
    path
        A name that ends in ``.kv.json`` for a document, which says all of the model, ``.urdf`` for URDF or
        ``.xml`` for MJCF.
    leave_out
        Names of constraints that URDF or MJCF need not say, and of articulations that have speeds other than
        those of their coordinates, which it need not say either.

    Raises
    ------
    FormatError
        If the name has another ending, the file cannot be written, or naming everything that the format
        cannot say, with the reason.
    UnknownNameError
        If something that is to be left out does not exist.
    """
    target = _target(path)
    if target.name.endswith(".kv.json"):
        if tuple(leave_out):
            raise FormatError(f"{target.name}: a document says all of a model, so nothing can be left out.")
        from .document import write_document

        write_document(model, target)
        return Saved(target)
    content, remarks = _content(model, target, leave_out)
    replace_file(target, content)
    tell(f"{target.name}: {remark}" for remark in remarks)
    return Saved(target, tuple(remarks))


def _content(model: ModelView, target: Path, leave_out: Iterable[str]) -> tuple[bytes, list[str]]:
    try:
        if target.name.endswith(".urdf"):
            from .urdf.writing import urdf_of

            return urdf_of(model, target, leave_out)
        if target.name.endswith(".xml"):
            from .mjcf.writing import mjcf_of

            return mjcf_of(model, target, leave_out)
    except FormatError as error:
        raise _named(target, error) from None
    raise FormatError(
        f"{target}: a model is saved to a name that ends in {', '.join(ENDINGS[:-1])} or {ENDINGS[-1]}, "
        f"as in {target.stem + ENDINGS[0]!r}."
    )


def _named(target: Path, error: KineverseError) -> FormatError:
    """Return an error with the name of the file in front, once."""
    text = str(error)
    return FormatError(text if target.name in text else f"{target.name} is not written. {text}")


def _target(path: Any) -> Path:
    try:
        return Path(os.fsdecode(path)).expanduser()
    except (TypeError, RuntimeError):  # "~name", and nobody has that name
        raise FormatError(f"A model is saved to the path of a file, not to {path!r}.") from None
