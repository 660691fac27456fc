"""Root folder below which a description may open files.

Descriptions are not trusted: included files, and meshes given by path, are opened below the *root* only. Real
paths are compared, so a link does not lead out.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import TypeAlias

from kineverse.errors import FormatError

from .xml_reader import quote

Folder: TypeAlias = "str | os.PathLike[str]"

ROOT = "KINEVERSE_ROOT"  # environment variable with folders whose files any description may open
MESH_FOLDERS = ("meshes", "mesh", "assets")  # folders of meshes that may lie next to that of a description
NOWHERE = ""  # root of a text without a folder; no path lies below it

_REPOSITORY = (".git", ".hg")
_PACKAGE = ("package.xml", "manifest.xml", "model.config")
_PYTHON = "__init__.py"


def find_root(folder: Folder, root: Folder | None = None, models: Folder | None = None) -> str:
    """Return the real path of the root for a description in a folder."""
    if root is not None:
        try:
            given = os.fsdecode(root)
        except TypeError:
            given = ""
        # An empty one is a variable that is not set, rather than the current folder.
        if not given or not os.path.isdir(os.path.expanduser(given)):
            shown = given if isinstance(root, os.PathLike) else root
            raise FormatError(f"root={shown!r} is no folder; give one below which files may be opened.")
        return os.path.realpath(os.path.expanduser(given))
    here = os.path.realpath(folder)
    declared = [place for place in declared_roots() if is_below(here, place)]
    if declared:
        return max(declared, key=len)
    return _enclosing(here) or (os.path.realpath(models) if models else here)


def find_text_root(folder: Folder, root: Folder | None = None) -> str:
    """Return the root of a description given as text: ``NOWHERE`` without a folder and a requested root."""
    return find_root(folder, root) if os.fspath(folder) or root is not None else NOWHERE


def declared_roots() -> Iterator[str]:
    """Yield the real paths of the folders of ``KINEVERSE_ROOT``."""
    for place in split_path_variable(ROOT):
        yield os.path.realpath(os.path.expanduser(place))


def mesh_folders(folder: Folder, root: str) -> Iterator[str]:
    """Yield the folders of meshes next to the folder of a description, ``../meshes``, if it is in the root.

    Robots that are no package have them there, as those of ROS: ``robot/urdf`` next to ``robot/meshes``. A
    link to another place is no such folder. A document states its folder itself, which may be outside.
    """
    here = os.path.realpath(folder) if os.fspath(folder) else ""
    if here and is_below(here, root):
        for name in MESH_FOLDERS:
            path = os.path.join(os.path.dirname(here), name)
            if os.path.realpath(path) == path and os.path.isdir(path):
                yield path


def split_path_variable(variable: str) -> Iterator[str]:
    """Return the paths in an environment variable."""
    return filter(None, os.environ.get(variable, "").split(os.pathsep))


def is_below(path: str, folder: str) -> bool:
    """Return True if a real path is a folder or lies in it. Nothing lies below ``NOWHERE``."""
    if not folder:
        return False
    return path == folder or path.startswith(folder if folder.endswith(os.sep) else folder + os.sep)


def is_common(folder: str) -> bool:
    """Return True if a real path is the home folder or above it, and so no folder of one project."""
    return os.path.dirname(folder) == folder or is_below(os.path.realpath(os.path.expanduser("~")), folder)


def outside_root_error(uri: str, root: str) -> FormatError:
    """Return the error for a file outside of a root, with the root and how to give a wider one."""
    what = f"the root {root}" if root else "the text, which lies in no folder and so has no root"
    return FormatError(
        f"{quote(uri)}: leads out of {what}, and so is not opened. Give a wider root, if you trust the file: "
        f"kv.load(..., root=FOLDER), --root FOLDER or the environment variable {ROOT}."
    )


def _enclosing(folder: str) -> str:
    """Return the nearest repository around a folder, else the nearest package; empty if there is none."""
    package, path = "", folder
    while not is_common(path):
        if any(os.path.lexists(os.path.join(path, name)) for name in _REPOSITORY):
            return path
        if not package and any(os.path.isfile(os.path.join(path, name)) for name in _PACKAGE):
            package = path
        if not package or path == os.path.dirname(package):
            if os.path.isfile(os.path.join(path, _PYTHON)):
                package = path  # that of the outermost folder: those below it are its parts
        path = os.path.dirname(path)
    return package
