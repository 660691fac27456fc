"""Files of meshes for other processes: a server reads those that its root allows, by their digests.

A client asks for a file when its triangles are needed, and keeps it on disk.
"""

from __future__ import annotations

import hashlib
import logging
import os
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from itertools import count

from msgspec.structs import replace

from kineverse.compilation.cache_kinds import KINDS
from kineverse.errors import FormatError
from kineverse.formats.resource_paths import locate_mesh
from kineverse.formats.resources import map_meshes, measure_content, meshes_of
from kineverse.model.body import Mesh
from kineverse.model.history import HistoryEntry
from kineverse.model.operation import BODIES

from .protocol import MeshContent
from .store import Store

_MESHES = KINDS["meshes"].make_cache(
    logging.getLogger("kineverse.exchange"), "The mesh file %s %s and is fetched again."
)

MAX_PART = 1 << 20  # largest part of a file in one message [byte]


class ServedFiles:
    """Files of the meshes of a server's model, by the digest of their content, as its store knows them."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._paths = store.paths()
        self._checked: dict[str, tuple[int, ...]] = {}  # state of a file in which it had its digest

    def measure(self, entries: Iterable[HistoryEntry]) -> tuple[MeshContent, ...]:
        """Look for the files of meshes on disk, serve them from now on, and return their digests.

        The entries are those of models that the server is started with: an edit never makes it open a file.
        """
        result = []
        for tag, index, mesh in _meshes(entries):
            known = measure_content(mesh) if mesh.content is None else None
            if known is not None:
                result.append(MeshContent(tag, index, *known))
                if known[0] not in self._paths:
                    self._paths[known[0]] = os.fspath(locate_mesh(mesh))
                    self._store.add_path(known[0], self._paths[known[0]])
        return tuple(result)

    def find(self, entries: Iterable[HistoryEntry]) -> tuple[MeshContent, ...]:
        """Return the digests of the meshes whose files are served."""
        return tuple(file for file in find_known_files(entries) if file.sha256 in self._paths)

    def read(self, sha256: str, offset: int) -> bytes | None:
        """Return a part of a file; None if there is none with this digest any more."""
        path = self._paths.get(sha256)
        if path is None:
            return None
        try:
            with open(path, "rb") as file:
                status = os.fstat(file.fileno())
                state = status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns
                if self._checked.get(sha256) != state:
                    if hashlib.file_digest(file, "sha256").hexdigest() != sha256:
                        return None
                    self._checked[sha256] = state
                file.seek(offset)
                return file.read(MAX_PART)
        except (OSError, OverflowError):
            return None


class FetchedFiles:
    """Resolver that asks a server for files, and keeps them in the cache of this user."""

    def __init__(self, fetch_part: Callable[[str, int], bytes | None]) -> None:
        self._fetch_part = fetch_part

    def fetch(self, sha256: str, size: int) -> bytes | None:
        """Return the content with this SHA-256 and size [byte]; None if the server does not have it."""
        kept = _MESHES.open(sha256)
        if kept is not None:
            os.close(kept[0])
            if hashlib.sha256(kept[1]).hexdigest() == sha256:
                return kept[1]
        parts = bytearray()
        while len(parts) < size or not parts:
            part = self._fetch_part(sha256, len(parts))
            if part is None:
                return None
            if not part:
                break
            parts += part
        content = bytes(parts)
        if hashlib.sha256(content).hexdigest() != sha256:
            raise FormatError(f"the server sent another file than that with SHA-256 {sha256}")
        _MESHES.write(sha256, content)
        return content


def find_known_files(entries: Iterable[HistoryEntry]) -> tuple[MeshContent, ...]:
    """Return the digests of meshes that are known in some operations."""
    return tuple(
        MeshContent(tag, index, *mesh.content)
        for tag, index, mesh in _meshes(entries)
        if mesh.content is not None
    )


def put_contents(entries: Iterable[HistoryEntry], files: Iterable[MeshContent]) -> None:
    """Put the digests of meshes into the operations that they belong to."""
    by_tag: dict[str, dict[int, tuple[str, int]]] = {}
    for file in files:
        by_tag.setdefault(file.tag, {})[file.index] = file.sha256, file.size
    for entry in entries:
        if entry.tag in by_tag:
            contents = map(by_tag[entry.tag].get, count())
            for cell, value in entry.writes.items():
                if cell[0] == BODIES and meshes_of(value):
                    entry.writes[cell] = map_meshes(value, partial(_with_content, contents))


def _with_content(contents: Iterator[tuple[str, int] | None], mesh: Mesh) -> Mesh:
    return replace(mesh, content=next(contents) or mesh.content)


def _meshes(entries: Iterable[HistoryEntry]) -> Iterator[tuple[str, int, Mesh]]:
    """Yield the meshes of operations, with the tag and the place of each."""
    for entry in entries:
        bodies = [value for (kind, _), value in entry.writes.items() if kind == BODIES]
        for index, mesh in enumerate(mesh for body in bodies for mesh in meshes_of(body)):
            yield entry.tag, index, mesh
