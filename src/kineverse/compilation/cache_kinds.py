"""Kinds of cached files: where each lies below the cache folder, how large it may grow, how to clear it.

All kinds but that of zig, which zig keeps itself, are a :class:`.cache.ContentCache`: if a new file makes a
kind larger than its limit, the files that were not used for the longest time are removed.
"""

from __future__ import annotations

import contextlib
import logging
import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import MappingProxyType

from .cache import MAXIMUM_BYTES, ContentCache, cache_folder, describe_failure, private_subfolder
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
    folder = _open(name)
    return _sum(name, [status for _, status in _files(name, folder)] if folder else [])


def clear_kind(name: str) -> CacheUsage:
    """Remove all files of a kind, and return what has been removed.

    Processes that have loaded a file keep it.
    """
    folder = _open(name)
    if folder is None:
        return _sum(name, [])
    removed = [status for path, status in _files(name, folder) if folder.remove(path)]
    if not KINDS[name].ending:
        shutil.rmtree(folder.path, ignore_errors=True)
    return _sum(name, removed)


def _sum(name: str, files: list[os.stat_result]) -> CacheUsage:
    times, size = [status.st_mtime for status in files], sum(status.st_size for status in files)
    folder = cache_folder() / KINDS[name].folder
    return CacheUsage(
        KINDS[name], folder, len(files), size, min(times, default=None), max(times, default=None)
    )


def _files(name: str, folder: PrivateFolder) -> list[tuple[str, os.stat_result]]:
    """Return the names and the status of the files of a kind; links are not followed."""
    if ending := KINDS[name].ending:
        return [(name, status) for name, status in folder.entries() if name.endswith(ending)]
    paths = [os.path.join(place, name) for place, _, names in os.walk(folder.path) for name in names]
    result = []
    for path in paths:
        with contextlib.suppress(OSError):  # removed meanwhile
            result.append((path, os.lstat(path)))
    return result


def _open(name: str) -> PrivateFolder | None:
    """Return the folder of a kind; None if there is none."""
    folder = cache_folder() / KINDS[name].folder
    if not os.path.lexists(folder):
        return None
    try:
        return PrivateFolder(folder)
    except (NotPrivateError, OSError) as error:
        raise PermissionError(None, f"the cache folder {describe_failure(folder, error)}") from None
