"""Reading of files up to a size, and atomic replacement."""

from __future__ import annotations

import contextlib
import os
import shutil
import uuid
from pathlib import Path

from kineverse.errors import FormatError

MAX_BYTES = 1 << 28
"""Largest size of a file to read [byte]: 256 MiB, some hundred times the largest known robot."""


def read_file(path: Path) -> bytes:
    """Return the bytes of a file."""
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


def replace_file(path: Path, content: bytes) -> None:
    """Replace a file atomically: after an error, the old file is unchanged."""
    try:
        target = Path(os.path.realpath(path))
        if target.exists() and not target.is_file():  # a device or a pipe, which has to stay what it is
            target.write_bytes(content)
            return
        # In the folder of the target, because replacement is atomic only within one file system.
        temporary = target.with_name(f".{target.name[:100]}.{uuid.uuid4().hex}")
        try:
            with open(temporary, "xb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            with contextlib.suppress(FileNotFoundError):
                shutil.copymode(target, temporary)
            os.replace(temporary, target)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
    except (OSError, ValueError) as error:  # a name with a zero byte raises a ValueError
        reason = getattr(error, "strerror", None) or error
        raise FormatError(f"{path} cannot be written: {reason}.") from None
