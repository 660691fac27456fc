"""Kinds of cached files: where each lies below the cache folder, how large it may grow, how to clear it.

All kinds but that of zig, which zig keeps itself, are a :class:`.cache.ContentCache`: if a new file makes a
kind larger than its limit, the files that were not used for the longest time are removed.
"""

from __future__ import annotations

import logging
import os
import shutil
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import MappingProxyType

from .cache import MAXIMUM_BYTES, ContentCache, library_cache, private_subfolder
from .private_folder import NotPrivateError, PrivateFolder

MIB = 2**20


@dataclass(frozen=True, slots=True)
class CacheKind:
    """Kind of cached files.

    It has a folder below that of the cache, "" for that itself, an ending of the names, "" for a tree of any
    files, and the largest size of all its files together [bytes], None for no limit.
    """

    contents: str
    folder: str
    ending: str
    most_bytes: int | None

    def make_cache(self, logger: logging.Logger, complaint: str) -> ContentCache:
        """Return the cache of this kind; it is opened when it is used, see :class:`.cache.ContentCache`."""
        assert self.most_bytes is not None
        return ContentCache(
            partial(private_subfolder, self.folder), self.ending, self.most_bytes, logger, complaint
        )


KINDS: Mapping[str, CacheKind] = MappingProxyType(
    {
        "libraries": CacheKind("compiled functions", "", ".so", MAXIMUM_BYTES),
        "decompositions": CacheKind("hulls of kineverse decompose", "decompositions", ".hulls", 256 * MIB),
        "mesh_hulls": CacheKind("corners of the hulls of meshes", "mesh_hulls", ".corners", 64 * MIB),
        "sphere_covers": CacheKind("sphere covers for planning", "spheres", ".spheres", 64 * MIB),
        "sphere_trees": CacheKind("sphere trees for planning", "spheres", ".tree", 64 * MIB),
        "meshes": CacheKind("mesh files of model servers", "files", ".mesh", 1024 * MIB),
        "zig": CacheKind("zig's runtime, if zig is the compiler", "zig", "", None),
    }
)
"""All kinds, by name."""


@dataclass(frozen=True, slots=True)
class CacheUsage:
    """Files of a kind: their folder, number and size [bytes], and the times of the last use [s since 1970].

    Both times are None if there is no file. A last use is known to the hour.
    """

    kind: CacheKind
    folder: Path
    files: int
    bytes: int
    oldest: float | None
    newest: float | None


def measure_kind(name: str) -> CacheUsage:
    """Return what the cache has of a kind; nothing is made or removed."""
    kind, folder = KINDS[name], library_cache().folder / KINDS[name].folder
    found = [status for _, status in _files(kind, folder)]
    times = [status.st_mtime for status in found] or [None]
    return CacheUsage(
        kind,
        folder,
        len(found),
        sum(status.st_size for status in found),
        min(times, key=_age),
        max(times, key=_age),
    )


def clear_kind(name: str) -> CacheUsage:
    """Remove all files of a kind, and return what has been removed.

    Processes that have loaded a file keep it.
    """
    kind, before = KINDS[name], measure_kind(name)
    if not before.files:
        return before
    folder = _open(before.folder)
    if not kind.ending:
        for entry, _ in list(folder.entries()):
            if not folder.remove(entry):
                shutil.rmtree(folder.path / entry, ignore_errors=True)
    else:
        for file, _ in _files(kind, before.folder):
            folder.remove(file)
    after = measure_kind(name)
    return CacheUsage(
        kind,
        before.folder,
        before.files - after.files,
        before.bytes - after.bytes,
        before.oldest,
        before.newest,
    )


def _files(kind: CacheKind, folder: Path) -> Iterator[tuple[str, os.stat_result]]:
    """Yield the names and the status of the files of a kind."""
    if not folder.is_dir():
        return
    if kind.ending:
        opened = _open(folder)
        yield from ((name, status) for name, status in list(opened.entries()) if name.endswith(kind.ending))
        return
    for place, _, names in os.walk(folder):
        for name in names:
            path = os.path.join(place, name)
            try:
                yield path, os.lstat(path)
            except OSError:
                continue  # removed meanwhile


def _open(folder: Path) -> PrivateFolder:
    """Return a folder of the cache that is there."""
    try:
        return PrivateFolder(folder)
    except NotPrivateError as error:
        raise PermissionError(None, f"{error}", str(folder)) from None


def _age(moment: float | None) -> float:
    return time.time() if moment is None else moment
