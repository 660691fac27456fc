"""Files that bodies refer to, by content: their digests in documents, and resolvers that fetch them.

A document may state the SHA-256 and the size of each mesh and texture beside its address. Where the file is
not found, a registered resolver fetches the content by its digest. The content is checked, so a resolver need
not be trusted. Fetched files are kept until the process ends.
"""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import Protocol

from kineverse.errors import FormatError
from kineverse.model.body import Body, Mesh, Shape

from .resource_paths import locate_mesh


class Resolver(Protocol):
    """Source of files by the digest of their content."""

    def fetch(self, sha256: str, size: int) -> bytes | None:
        """Return the content with this SHA-256 (64 hexadecimal digits) and size [byte]; None without it."""


class FolderResolver:
    """Resolver of a folder in which the name of each file is the SHA-256 of its content."""

    def __init__(self, folder: str | Path) -> None:
        self._folder = Path(folder)

    def fetch(self, sha256: str, size: int) -> bytes | None:
        """Return the content of the file with this name; None if there is none, or none of this size."""
        try:
            with (self._folder / sha256).open("rb") as file:
                return file.read(size + 1)
        except OSError:
            return None


_RESOLVERS: list[Resolver] = []


def add_resolver(resolver: Resolver) -> None:
    """Register a resolver for this process; the latest is asked first."""
    _RESOLVERS.insert(0, resolver)


def remove_resolver(resolver: Resolver) -> None:
    """Remove a resolver; nothing happens if it is not registered."""
    if resolver in _RESOLVERS:
        _RESOLVERS.remove(resolver)


def measure_content(mesh: Mesh) -> tuple[str, int] | None:
    """Return SHA-256 and size of the file of a mesh or texture; None if it is not found."""
    if mesh.content is not None:
        return mesh.content
    try:
        content = locate_mesh(mesh).read_bytes()
    except (FormatError, OSError):
        return None
    return hashlib.sha256(content).hexdigest(), len(content)


def files_of(body: Body) -> Iterator[Mesh]:
    """Yield the meshes and textures of a body; a texture as a mesh in the folder of its shape."""
    for shape in (*body.visuals, *body.collisions):
        yield from _files_of(shape)


def _files_of(shape: Shape) -> Iterator[Mesh]:
    mesh = shape.geometry if isinstance(shape.geometry, Mesh) else None
    if mesh is not None:
        yield mesh
    if shape.texture:
        folder, root = ("", None) if mesh is None else (mesh.folder, mesh.root)
        yield Mesh(shape.texture, folder=folder, root=root)


def fetch_mesh(mesh: Mesh) -> Path | None:
    """Return a file with the content of a mesh, fetched by its digest; None if no resolver has it."""
    if mesh.content is None:
        return None
    sha256, size = mesh.content
    path = Path(_folder().name, sha256 + Path(mesh.uri).suffix.lower())
    if path.is_file():
        return path
    for content in _fetched(_RESOLVERS, sha256, size):
        if len(content) != size or hashlib.sha256(content).hexdigest() != sha256:
            raise FormatError(
                f"{mesh.uri!r}: what was fetched is not the file with SHA-256 {sha256} and {size} bytes. "
                "It was changed or damaged; get another copy."
            )
        path.write_bytes(content)
        return path
    return None


def _fetched(resolvers: Iterable[Resolver], sha256: str, size: int) -> Iterator[bytes]:
    for resolver in resolvers:
        content = resolver.fetch(sha256, size)
        if content is not None:
            yield content


@cache
def _folder() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="kineverse-files-")
