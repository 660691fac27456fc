"""Disk cache of sphere covers, by the content of the solid and the settings.

The files lie in a folder of the cache of compiled functions; only this user can write to the folder and its
files. A file ends in the SHA-256 of its content; a damaged file counts as absent. Files are renamed into
place, so any number of processes can share the folder.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import logging
import os
import tempfile
import threading
import time
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kineverse.compile.cache import private_subfolder
from kineverse.compile.private_folder import NotPrivateError, PrivateFolder
from kineverse.errors import FormatError
from kineverse.geometry.mesh_files import Floats
from kineverse.geometry.shapes import Hull, Solid

from .sphere_cover import SphereCover

logger = logging.getLogger("kineverse.planning")

MAXIMUM_BYTES = 64 * 2**20
"""Largest size of the cache [bytes]; beyond it, the least recently used files are removed."""

_VERSION = 2
_ENDING, _UNFINISHED = ".spheres", ".making-"
_STALE_SECONDS = 3600.0
_LAST_USE_RESOLUTION = 3600.0
_DIGEST = 32
_MOST_IN_MEMORY = 4096

_in_memory: OrderedDict[str, SphereCover] = OrderedDict()
_lock = threading.Lock()


@dataclass(frozen=True, slots=True)
class CachedCover:
    """Cover in the cache, with what it covers and the size of its file [bytes]."""

    name: str
    cover: SphereCover
    bytes: int


def cover_key(solids: Sequence[tuple[Solid, Floats]], protrusion: float | None, most: int) -> str:
    """Return the key of the cover of solids at poses with a protrusion [m] and a number of spheres."""
    digest = hashlib.sha256(f"{_VERSION} {protrusion} {most}".encode())
    for solid, pose in solids:
        digest.update(f" {type(solid.surface).__name__} ".encode() + pose.tobytes())
        if isinstance(solid.surface, Hull):
            assert solid.core is not None
            digest.update(np.ascontiguousarray(solid.core.corners).tobytes())
        else:
            digest.update(repr(solid.surface).encode())
    return digest.hexdigest()[:40]


def find_cover(key: str) -> SphereCover | None:
    """Return the cover of a key, see :func:`cover_key`, from memory or the disk; None if there is none."""
    with _lock:
        if key in _in_memory:
            _in_memory.move_to_end(key)
            return _in_memory[key]
    found = _read(_folder(), key + _ENDING)
    if found is None:
        return None
    _remember(key, found[1])
    return found[1]


def keep_cover(key: str, name: str, cover: SphereCover) -> None:
    """Keep a cover in memory, and atomically on the disk, with the name of what it covers."""
    _remember(key, cover)
    folder = _folder()
    buffer = io.BytesIO()
    np.savez(
        buffer,
        name=np.frombuffer(name.encode(), dtype=np.uint8),
        spheres=np.column_stack([cover.centres, cover.radii]),
        quality=np.array([cover.protrusion, cover.excess]),
    )
    content = buffer.getvalue()
    handle, path = tempfile.mkstemp(prefix=_UNFINISHED, dir=folder.path)
    try:
        with open(handle, "wb") as file:
            file.write(content)
        folder.adopt(path, key + _ENDING, hashlib.sha256(content).digest())
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(path)
        raise
    _make_room(folder)


def list_covers() -> list[CachedCover]:
    """Return all covers on the disk, sorted by the name of what they cover."""
    folder = _folder()
    found = [(_read(folder, name, used=False), size) for _, size, name in _files(folder)]
    kept = [CachedCover(entry[0], entry[1], size) for entry, size in found if entry]
    return sorted(kept, key=lambda one: (one.name, len(one.cover), one.cover.protrusion))


def clear_covers() -> int:
    """Remove all covers from memory and from the disk, and return the number of files."""
    with _lock:
        _in_memory.clear()
    folder = _folder()
    return sum(folder.remove(name) for _, _, name in list(_files(folder)))


def cover_folder() -> Path:
    """Return the path of the cache folder."""
    return _folder().path


def _folder() -> PrivateFolder:
    return private_subfolder("spheres")


def _remember(key: str, cover: SphereCover) -> None:
    with _lock:
        _in_memory[key] = cover
        _in_memory.move_to_end(key)
        while len(_in_memory) > _MOST_IN_MEMORY:
            _in_memory.popitem(last=False)


def _read(folder: PrivateFolder, name: str, used: bool = True) -> tuple[str, SphereCover] | None:
    """Return the name of the solid and the cover of a file; None if there is none, or it is damaged."""
    try:
        with open(folder.open(name), "rb") as file:
            content, last_use = file.read(), os.fstat(file.fileno()).st_mtime
            if used and time.time() - last_use > _LAST_USE_RESOLUTION:
                with contextlib.suppress(OSError):
                    os.utime(file.fileno())
        if hashlib.sha256(content[:-_DIGEST]).digest() != content[-_DIGEST:]:
            raise FormatError("It does not end in its digest.")
        return _parse(content[:-_DIGEST])
    except OSError:
        return None
    except NotPrivateError as error:
        reason = str(error)
    except FormatError:
        reason = "is damaged"
    logger.warning("The sphere cover %s %s and counts as absent.", folder.path / name, reason)
    folder.remove(name)
    return None


def _parse(content: bytes) -> tuple[str, SphereCover]:
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
            name = arrays["name"].tobytes().decode()
            spheres, (protrusion, excess) = arrays["spheres"], arrays["quality"].tolist()
    except Exception as error:  # zip and numpy raise all kinds of errors for a damaged archive.
        raise FormatError("This is no sphere cover.") from error
    spheres.flags.writeable = False
    return name, SphereCover(spheres[:, :3], spheres[:, 3], protrusion, excess)


def _files(folder: PrivateFolder) -> Iterator[tuple[float, int, str]]:
    """Yield the time of the last use, the size and the name of every cover."""
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
