"""Disk cache of decompositions, by mesh content and settings.

The files lie in a folder of the cache of compiled functions; only this user can write to the folder and its
files. A file ends in the SHA-256 of its content; a damaged file counts as absent. Files are renamed into
place, so any number of processes can share the folder, and an interruption loses only the unfinished file.
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

from kineverse.compile.cache import private_subfolder
from kineverse.compile.private_folder import NotPrivateError, PrivateFolder
from kineverse.errors import FormatError

from .result import Decomposition

logger = logging.getLogger("kineverse.geometry")

MAXIMUM_BYTES = 256 * 2**20
"""Largest size of the cache [bytes]; beyond it, the least recently used files are removed."""

_ENDING = ".hulls"
_UNFINISHED = ".making-"
_STALE_SECONDS = 3600.0
_LAST_USE_RESOLUTION = 3600.0
_DIGEST = 32


@dataclass(frozen=True, slots=True)
class CacheEntry:
    """Cached decomposition, and the size of its file [bytes]."""

    decomposition: Decomposition
    bytes: int


def find_entry(mesh: str, settings: str | None = None) -> Decomposition | None:
    """Return the cached decomposition of a mesh, or None.

    Parameters
    ----------
    mesh
        Digest of the cleaned mesh.
    settings
        Key of the settings; None selects the latest decomposition.
    """
    folder = _folder()
    if settings is not None:
        return _read(folder, _name(mesh, settings))
    beginning = _name(mesh, "").removesuffix(_ENDING)
    found = [_read(folder, name) for _, _, name in _files(folder) if name.startswith(beginning)]
    return max((some for some in found if some), key=lambda some: some.made, default=None)


def add_entry(mesh: str, settings: str, decomposition: Decomposition) -> None:
    """Write a decomposition atomically; see :func:`find_entry`."""
    folder = _folder()
    content = decomposition.to_bytes()
    handle, name = tempfile.mkstemp(prefix=_UNFINISHED, dir=folder.path)
    try:
        with open(handle, "wb") as file:
            file.write(content)
        folder.adopt(name, _name(mesh, settings), hashlib.sha256(content).digest())
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(name)
        raise
    _make_room(folder)


def list_entries() -> list[CacheEntry]:
    """Return all entries of the cache, sorted by the name of the mesh file."""
    folder = _folder()
    found = [(_read(folder, name, used=False), size) for _, size, name in _files(folder)]
    kept = [CacheEntry(decomposition, size) for decomposition, size in found if decomposition]
    return sorted(kept, key=lambda one: (one.decomposition.name, one.decomposition.made))


def clear() -> int:
    """Remove all entries, and return their number."""
    folder = _folder()
    return sum(folder.remove(name) for _, _, name in list(_files(folder)))


def folder() -> Path:
    """Return the path of the cache folder."""
    return _folder().path


def _folder() -> PrivateFolder:
    return private_subfolder("decompositions")


def _name(mesh: str, settings: str) -> str:
    return f"{mesh[:40]}-{settings}{_ENDING}"


def _read(folder: PrivateFolder, name: str, used: bool = True) -> Decomposition | None:
    try:
        with open(folder.open(name), "rb") as file:
            content, last_use = file.read(), os.fstat(file.fileno()).st_mtime
            if used and time.time() - last_use > _LAST_USE_RESOLUTION:
                with contextlib.suppress(OSError):
                    os.utime(file.fileno())
        if hashlib.sha256(content[:-_DIGEST]).digest() != content[-_DIGEST:]:
            raise FormatError("It does not end in its digest.")
        return Decomposition.from_bytes(content[:-_DIGEST])
    except OSError:
        return None
    except NotPrivateError as error:
        reason = str(error)
    except FormatError:
        reason = "is damaged"
    logger.warning("The decomposition %s %s and counts as absent.", folder.path / name, reason)
    folder.remove(name)
    return None


def _files(folder: PrivateFolder) -> Iterator[tuple[float, int, str]]:
    """Yield the time of the last use, the size and the name of every decomposition."""
    for name, status in folder.entries():
        if name.endswith(_ENDING):
            yield status.st_mtime, status.st_size, name
        elif name.startswith(_UNFINISHED) and time.time() - status.st_mtime > _STALE_SECONDS:
            folder.remove(name)


def _make_room(folder: PrivateFolder) -> None:
    files = sorted(_files(folder))
    excess = sum(size for _, size, _ in files) - MAXIMUM_BYTES
    for _, size, name in files:
        if excess <= 0:
            break
        folder.remove(name)
        excess -= size
