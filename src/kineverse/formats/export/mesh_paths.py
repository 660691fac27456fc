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
_COMMON_PARTS = 2  # parts of a common folder, such as /home, above which a path is written as an absolute one


def mesh_reference(mesh: Mesh, folder: Path, remark: RemarkCallback) -> str:
    """Return the reference to a mesh from a description file in another folder.

    Addresses such as ``package://`` stay if they lead to the same file from there. A mesh that is not found
    keeps its reference.
    """
    if not mesh.folder or Path(mesh.folder) == folder or os.path.isabs(mesh.uri):
        return mesh.uri
    path = find_file(mesh)
    if "://" not in mesh.uri:
        if path is None:
            return relative_path(Path(mesh.folder, mesh.uri), folder)
        return file_reference(path, folder, remark)
    if path is None or path == find_file(Mesh(mesh.uri, folder=str(folder), root=find_root(folder))):
        return mesh.uri
    remark(f"{mesh.uri} is written as a path, since that package is not found from {folder}")
    return file_reference(path, folder, remark)


def file_reference(path: Path, folder: Path, remark: RemarkCallback) -> str:
    """Return a path as :func:`relative_path`, with a remark if it can only be read with a root folder."""
    reference, root = relative_path(path, folder), find_root(folder)
    if find_root_violation(reference, folder, root) is not None:
        real = os.path.dirname(os.path.realpath(path))
        common = os.path.commonpath((real, os.path.realpath(folder)))
        wide = real if is_common(common) else common
        remark(
            f"the files in {path.parent} are outside of {root}: give root={wide!r} to open them from there"
        )
    return reference


def find_file(file: Mesh) -> Path | None:
    """Return the file of a mesh or texture; None if it does not exist or is outside of the root folder."""
    try:
        return Path(os.path.abspath(locate_mesh(file)))
    except FormatError:
        return None


def relative_path(path: Path, folder: Path) -> str:
    """Return a path relative to a folder, or the absolute path if they have nothing in common."""
    path, folder = Path(os.path.abspath(path)), Path(os.path.abspath(folder))
    try:
        common = Path(os.path.commonpath((path, folder)))
    except ValueError:  # two drives
        return path.as_posix()
    if len(common.parts) <= _COMMON_PARTS and common != folder:
        return path.as_posix()
    return Path(os.path.relpath(path, folder)).as_posix()
