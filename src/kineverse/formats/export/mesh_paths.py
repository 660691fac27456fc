"""References to mesh and texture files, relative to the folder of the written file."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from kineverse.errors import FormatError
from kineverse.formats.resource_paths import find_root_violation, locate_mesh
from kineverse.formats.root_folder import find_root, is_common
from kineverse.model.body import Mesh

RemarkCallback = Callable[[str], None]
_TOP = 2
"""Folders that have no more than so many parts, as ``/home``, have nothing in common but the machine."""


def mesh_reference(mesh: Mesh, folder: Path, note: RemarkCallback) -> str:
    """Return the reference to a mesh from a file in ``folder``: the same file, wherever that is known.

    Addresses as ``package://`` stay where they are found from there, too. A mesh that is nowhere is called
    what it was called.

    Parameters
    ----------
    mesh
        The mesh.
    folder
        Where the file will lie.
    note
        Called with a remark where a reference is another one than it was.
    """
    if not mesh.folder or Path(mesh.folder) == folder or os.path.isabs(mesh.uri):
        return mesh.uri
    there = find_file(mesh)
    if "://" not in mesh.uri:
        return path_to(there, folder, note) if there else path_from(Path(mesh.folder, mesh.uri), folder)
    if there is None or there == find_file(Mesh(mesh.uri, folder=str(folder), root=find_root(folder))):
        return mesh.uri
    note(f"{mesh.uri} is written as a path, since that package is not found from {folder}")
    return path_to(there, folder, note)


def path_to(path: Path, folder: Path, note: RemarkCallback) -> str:
    """Return a path as :func:`path_from`, with a remark if whoever reads it here has to give a root."""
    there, root = path_from(path, folder), find_root(folder)
    if find_root_violation(there, folder, root) is not None:
        real = os.path.dirname(os.path.realpath(path))
        common = os.path.commonpath((real, os.path.realpath(folder)))
        wide = real if is_common(common) else common
        note(f"the files in {path.parent} are outside of {root}: give root={wide!r} to open them from there")
    return there


def find_file(file: Mesh) -> Path | None:
    """Return the file of a mesh, or of a texture; None if there is none that its description may open."""
    try:
        return Path(os.path.abspath(locate_mesh(file)))
    except FormatError:
        return None


def path_from(path: Path, folder: Path) -> str:
    """Return a path as seen from a folder: relative, unless they have nothing in common."""
    path, folder = Path(os.path.abspath(path)), Path(os.path.abspath(folder))
    try:
        common = Path(os.path.commonpath((path, folder)))
    except ValueError:  # two drives
        return path.as_posix()
    if len(common.parts) <= _TOP and common != folder:
        return path.as_posix()
    return Path(os.path.relpath(path, folder)).as_posix()
