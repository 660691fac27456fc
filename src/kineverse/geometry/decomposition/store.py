"""Decompositions on disk, by the content of the mesh and the settings.

They lie in a folder of the cache that compiled functions are kept in, which only this user can write to. A
file ends in the SHA-256 of what is before it; a broken one counts as absent. Files arrive by renaming, so any
number of processes can share the folder, and what was done before an interruption is there.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from kineverse.compile.cache import library_cache
from kineverse.errors import FormatError

from .result import Decomposition

logger = logging.getLogger("kineverse.geometry")

MAXIMUM_BYTES = 256 * 2**20
"""When there is more, what was used longest ago is removed."""

_ENDING = ".hulls"
_UNFINISHED = ".making-"
_STALE_SECONDS = 3600.0
_LAST_USE_RESOLUTION = 3600.0
_DIGEST = 32


@dataclass(frozen=True, slots=True)
class Kept:
    """A decomposition in the cache, and the size of its file [bytes]."""

    decomposition: Decomposition
    bytes: int


def find(mesh: str, settings: str | None = None) -> Decomposition | None:
    """Return the decomposition of a mesh, else None.

    Parameters
    ----------
    mesh
        The digest of its surface.
    settings
        The key of the settings; those with which it was decomposed last if None.
    """
    if settings is not None:
        return _read(folder() / _name(mesh, settings))
    found = [_read(path) for path in folder().glob(_name(mesh, "*"))]
    return max((some for some in found if some), key=lambda some: some.made, default=None)


def keep(mesh: str, settings: str, decomposition: Decomposition) -> None:
    """Write a decomposition, whole or not at all; see :func:`find`."""
    content = decomposition.to_bytes()
    handle, name = tempfile.mkstemp(prefix=_UNFINISHED, dir=folder())
    try:
        with open(handle, "wb") as file:
            file.write(content + hashlib.sha256(content).digest())
        os.replace(name, folder() / _name(mesh, settings))
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(name)
        raise
    _make_room()


def listing() -> list[Kept]:
    """Return what is in the cache, by name of the file it was made from."""
    found = [(_read(path, used=False), size) for _, size, path in _files()]
    kept = [Kept(decomposition, size) for decomposition, size in found if decomposition]
    return sorted(kept, key=lambda one: (one.decomposition.name, one.decomposition.made))


def clear() -> int:
    """Remove everything, and return how many decompositions there were."""
    count = 0
    for _, _, path in _files():
        with contextlib.suppress(OSError):
            path.unlink()
            count += 1
    return count


def folder() -> Path:
    """Return where decompositions are kept."""
    path = library_cache().folder / "decompositions"
    with contextlib.suppress(FileExistsError):
        path.mkdir(mode=0o700)
    return path


def _name(mesh: str, settings: str) -> str:
    return f"{mesh[:40]}-{settings}{_ENDING}"


def _read(path: Path, used: bool = True) -> Decomposition | None:
    try:
        content = path.read_bytes()
        last_use = path.stat().st_mtime
    except OSError:
        return None
    try:
        if hashlib.sha256(content[:-_DIGEST]).digest() != content[-_DIGEST:]:
            raise FormatError("It does not end in its digest.")
        decomposition = Decomposition.from_bytes(content[:-_DIGEST])
    except FormatError:
        logger.warning("The decomposition %s is damaged and counts as absent.", path)
        with contextlib.suppress(OSError):
            path.unlink()
        return None
    if used and time.time() - last_use > _LAST_USE_RESOLUTION:
        with contextlib.suppress(OSError):
            os.utime(path)
    return decomposition


def _files() -> Iterator[tuple[float, int, Path]]:
    """Yield the time of the last use, the size and the path of every decomposition."""
    for entry in list(os.scandir(folder())):
        with contextlib.suppress(OSError):
            status = entry.stat(follow_symlinks=False)
            if entry.name.endswith(_ENDING):
                yield status.st_mtime, status.st_size, Path(entry.path)
            elif entry.name.startswith(_UNFINISHED) and time.time() - status.st_mtime > _STALE_SECONDS:
                os.unlink(entry.path)


def _make_room() -> None:
    files = sorted(_files())
    excess = sum(size for _, size, _ in files) - MAXIMUM_BYTES
    for _, size, path in files:
        if excess <= 0:
            break
        with contextlib.suppress(OSError):
            path.unlink()
        excess -= size
