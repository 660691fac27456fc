"""Disk cache of decompositions, by mesh content and settings."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from kineverse.compile.cache import private_subfolder
from kineverse.compile.content_cache import ContentCache

from .result import Decomposition

DECOMPOSITIONS = ContentCache(
    partial(private_subfolder, "decompositions"),
    ".hulls",
    256 * 2**20,
    logging.getLogger("kineverse.geometry"),
    "The decomposition %s %s and counts as absent.",
)
"""The cache."""


@dataclass(frozen=True, slots=True)
class CacheEntry:
    """Cached decomposition, and the size of its file [bytes]."""

    decomposition: Decomposition
    bytes: int


def find_entry(mesh: str, settings: str | None = None) -> Decomposition | None:
    """Return the cached decomposition of a mesh, or None."""
    if settings is not None:
        return DECOMPOSITIONS.read(_key(mesh, settings), Decomposition.from_bytes)
    keys = [key for key in DECOMPOSITIONS.list_keys() if key.startswith(_key(mesh, ""))]
    found = [DECOMPOSITIONS.read(key, Decomposition.from_bytes) for key in keys]
    return max((some for some in found if some), key=lambda some: some.made, default=None)


def add_entry(mesh: str, settings: str, decomposition: Decomposition) -> None:
    """Write a decomposition atomically; see :func:`find_entry`."""
    DECOMPOSITIONS.write(_key(mesh, settings), decomposition.to_bytes())


def list_entries() -> list[CacheEntry]:
    """Return all entries of the cache, sorted by the name of the mesh file."""
    kept = [CacheEntry(*entry) for entry in DECOMPOSITIONS.read_all(Decomposition.from_bytes)]
    return sorted(kept, key=lambda one: (one.decomposition.name, one.decomposition.made))


def clear() -> int:
    """Remove all entries, and return their number."""
    return DECOMPOSITIONS.clear()


def folder() -> Path:
    """Return the path of the cache folder."""
    return DECOMPOSITIONS.folder.path


def _key(mesh: str, settings: str) -> str:
    return f"{mesh[:40]}-{settings}"
