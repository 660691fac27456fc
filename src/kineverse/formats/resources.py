"""Files that bodies refer to: their folders and digests in documents, and resolvers that fetch them.

A document may state the SHA-256 and the size of each mesh and texture beside its address. Where the file is
not found, a registered resolver fetches the content by its digest. The content is checked, so a resolver need
not be trusted. Fetched files are kept until the process ends.
"""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Protocol
from urllib.parse import quote_plus

from msgspec.structs import replace

from kineverse.errors import FormatError
from kineverse.model.body import Body, Mesh, Shape
from kineverse.model.history import HistoryEntry
from kineverse.model.operation import BODIES

from .files import replace_file
from .reader_warnings import warn
from .resource_paths import find_root_violation, locate_mesh
from .root_folder import NOWHERE


class Resolver(Protocol):
    """Source of files by the digest of their content.

    See Also
    --------
    kineverse.formats.FolderResolver
    """

    def fetch(self, sha256: str, size: int) -> bytes | None:
        """Return the content with this SHA-256 (64 hexadecimal digits) and size [byte]; None without it."""


class FolderResolver:
    """Resolver of a folder in which the name of each file is the SHA-256 of its content.

    Examples
    --------
    >>> from pathlib import Path
    >>> Path("meshes").mkdir()
    >>> resolver = kv.formats.FolderResolver("meshes")
    >>> kv.formats.add_resolver(resolver)  # meshes of documents are now looked for there, too
    >>> kv.formats.remove_resolver(resolver)
    """

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
_LONGEST_SUFFIX = 20


def add_resolver(resolver: Resolver) -> None:
    """Register a resolver for this process; the latest is asked first.

    See Also
    --------
    kineverse.formats.FolderResolver
    """
    _RESOLVERS.insert(0, resolver)


def remove_resolver(resolver: Resolver) -> None:
    """Remove a resolver; nothing happens if it is not registered.

    See Also
    --------
    kineverse.formats.FolderResolver
    """
    if resolver in _RESOLVERS:
        _RESOLVERS.remove(resolver)


def measure_content(mesh: Mesh) -> tuple[str, int] | None:
    """Return SHA-256 and size of the file of a mesh or texture; None if it is not found."""
    if mesh.content is not None:
        return mesh.content
    try:
        with locate_mesh(mesh).open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest(), file.tell()
    except (FormatError, OSError):
        return None


def meshes_of(body: Body) -> list[Mesh]:
    """Return the meshes of a body, in order."""
    return [s.geometry for s in (*body.visuals, *body.collisions) if type(s.geometry) is Mesh]


def map_meshes(body: Body, change: Callable[[Mesh], Mesh]) -> Body:
    """Return a body with other meshes; they are changed in the order of :func:`meshes_of`."""

    def shapes(given: tuple[Shape, ...]) -> tuple[Shape, ...]:
        return tuple(
            replace(s, geometry=change(s.geometry)) if type(s.geometry) is Mesh else s for s in given
        )

    visuals = shapes(body.visuals)
    return replace(body, visuals=visuals, collisions=shapes(body.collisions))


def restrict_meshes(body: Body, root: str, where: str) -> Body:
    """Return a body whose meshes are restricted to a root; warn about meshes outside of it."""

    def restrict(mesh: Mesh) -> Mesh:
        wrong = find_root_violation(mesh.uri, mesh.folder, root)
        if wrong is not None:
            warn([f"{where}: names the mesh {wrong}"])
        return replace(mesh, root=root)

    return map_meshes(body, restrict) if meshes_of(body) else body


def without_places(body: Body) -> Body:
    """Return a body whose meshes know nothing of the folders of this machine."""
    return map_meshes(body, lambda mesh: Mesh(mesh.uri, mesh.scale)) if meshes_of(body) else body


def find_mesh_folders(entries: Iterable[HistoryEntry]) -> dict[str, dict[str, tuple[int, ...]]]:
    """Return the operations with meshes below a folder, by folder, each with those meshes if not all are."""
    result: dict[str, dict[str, tuple[int, ...]]] = {}
    for entry in entries:
        found = [mesh.folder for body in _bodies_of(entry) for mesh in meshes_of(body)]
        for folder in dict.fromkeys(found):
            if folder:
                places = tuple(i for i, other in enumerate(found) if other == folder)
                result.setdefault(folder, {})[entry.tag] = () if len(places) == len(found) else places
    return result


def folders_by_tag(folders: Mapping[str, Mapping[str, tuple[int, ...]]]) -> dict[str, dict[int, str]]:
    """Return the folders of the meshes of operations, by tag and place of the mesh; -1 is all of them."""
    result: dict[str, dict[int, str]] = {}
    for folder, tags in folders.items():
        for tag, places in tags.items():
            result.setdefault(tag, {}).update(dict.fromkeys(places or (-1,), folder))
    return result


def find_contents(entries: Iterable[HistoryEntry], measured: bool) -> dict[tuple[str, str], tuple[str, int]]:
    """Return SHA-256 and size of files that are known, or measured, by folder and address."""
    result: dict[tuple[str, str], tuple[str, int]] = {}
    for entry in entries:
        for file in (file for body in _bodies_of(entry) for file in _files_of(body)):
            known = measure_content(file) if measured else file.content
            if known is not None:
                result.setdefault((file.folder, file.uri), known)
    return result


def _bodies_of(entry: HistoryEntry) -> Iterator[Body]:
    return (value for (kind, _), value in entry.writes.items() if kind == BODIES)


def _files_of(body: Body) -> Iterator[Mesh]:
    """Yield the meshes and textures of a body; a texture as a mesh in the folder of its shape."""
    for shape in (*body.visuals, *body.collisions):
        mesh = shape.geometry if isinstance(shape.geometry, Mesh) else None
        if mesh is not None:
            yield mesh
        if shape.texture:
            # A shape knows neither the folder nor the root of its description.
            folder, root = ("", NOWHERE) if mesh is None else (mesh.folder, mesh.root)
            yield Mesh(shape.texture, folder=folder, root=root)


def fetch_mesh(mesh: Mesh) -> Path | None:
    """Return a file with the content of a mesh, fetched by its digest; None if no resolver has it."""
    if mesh.content is None:
        return None
    sha256, size = mesh.content
    # The suffix says how the file is read; none is longer.
    path = Path(
        _folder().name, sha256 + quote_plus(Path(mesh.uri).suffix.lower(), errors="replace")[:_LONGEST_SUFFIX]
    )
    if path.is_file():
        return path
    wrong = ""
    for resolver in _RESOLVERS:
        try:
            content = resolver.fetch(sha256, size)
        except Exception as error:
            wrong = f"a resolver failed with {type(error).__name__}: {error}"
            continue
        if isinstance(content, bytes) and hashlib.sha256(content).hexdigest() == sha256:
            replace_file(path, content)
            return path
        if content is not None:
            wrong = f"what was fetched is not the file with SHA-256 {sha256} and {size} bytes"
    if wrong:
        raise FormatError(f"{mesh.uri!r}: {wrong}. Get another copy of the file, or mend the resolver.")
    return None


@cache
def _folder() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="kineverse-files-")
