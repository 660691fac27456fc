"""Reading a whole file, up to a size."""

from __future__ import annotations

from pathlib import Path

from kineverse.errors import FormatError

MAX_BYTES = 1 << 28
"""The largest file that is read [byte]: 256 MiB, some hundred times the largest robot we have met."""


def read_file(path: Path) -> bytes:
    """Return the bytes of a file.

    Raises
    ------
    FormatError
        If there is no such file, it cannot be read, or it is larger than ``MAX_BYTES``.
    """
    try:
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    except FileNotFoundError:
        near = sorted(p.name for p in path.parent.glob(f"*{path.suffix}"))[:8] if path.parent.is_dir() else []
        hint = f"The folder has: {', '.join(near)}." if near else "Check the path."
        raise FormatError(f"{path}: there is no such file. {hint}") from None
    except OSError as error:
        reason = "it is a folder" if path.is_dir() else error.strerror or str(error)
        raise FormatError(f"{path}: cannot be read: {reason}.") from error
    if len(data) > MAX_BYTES:
        raise FormatError(f"{path}: larger than {MAX_BYTES} bytes, the most that is read of one file.")
    return data
