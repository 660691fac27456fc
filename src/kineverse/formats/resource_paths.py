"""Resolution of package://, model:// and file URIs to paths below the root folder.

Files are located and not opened. The folders to search are few, listed in :func:`locate_resource`, and
recursive searches end at ``MAX_DEPTH`` and ``MAX_FOLDERS``. :mod:`.root_folder` defines the folder below
which a description may open files. References in written files are relative to the folder of the file.
"""

from __future__ import annotations

import os
import re
import sys
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import TypeAlias
from urllib.parse import unquote, urlsplit

from msgspec import Struct, field

from kineverse.errors import FormatError
from kineverse.model.body import Mesh

from .reader_warnings import warn
from .root_folder import (
    NOWHERE,
    Folder,
    declared_roots,
    find_root,
    is_below,
    is_common,
    mesh_folders,
    outside_root_error,
    split_path_variable,
)
from .xml_reader import quote

RealPath: TypeAlias = Callable[[Folder], str]

MAX_DEPTH = 4  # depth of the search for packages below a folder of a workspace variable
MAX_FOLDERS = 20_000  # most folders to visit below one such folder

_WORKSPACES = ("KINEVERSE_PACKAGE_PATH", "ROS_PACKAGE_PATH")
_PREFIXES = ("AMENT_PREFIX_PATH", "COLCON_PREFIX_PATH", "CMAKE_PREFIX_PATH")
_MODELS = ("GZ_SIM_RESOURCE_PATH", "IGN_GAZEBO_RESOURCE_PATH", "GAZEBO_MODEL_PATH", "SDF_PATH")
_MANIFESTS = ("package.xml", "manifest.xml")
_MARKS = (*_MANIFESTS, "model.config", "model.sdf")
_IGNORED = ("CATKIN_IGNORE", "COLCON_IGNORE", "AMENT_IGNORE")
_LISTED = 3


def locate_mesh(mesh: Mesh) -> Path:
    """Return the path of a mesh file, within the root of its description; see :func:`locate_resource`."""
    return locate_resource(mesh.uri, mesh.folder, root=mesh.root)


def locate_resource(
    uri: str, folder: Folder = "", search: Sequence[Folder] = (), root: str | None = None
) -> Path:
    """Return the path of a file from its URI in a description.

    ``package://name/rest`` and ``model://name/rest`` are the file ``rest`` of the first folder for ``name``
    that has it, among

    1. the folders of ``search``: each is the package, or contains it;
    2. those of ``KINEVERSE_PACKAGE_PATH`` and ``ROS_PACKAGE_PATH``: each is the package, or contains it at
       most ``MAX_DEPTH`` deep;
    3. ``share/name`` below those of ``AMENT_PREFIX_PATH``, ``COLCON_PREFIX_PATH`` and ``CMAKE_PREFIX_PATH``;
       models of ``GZ_SIM_RESOURCE_PATH``, ``IGN_GAZEBO_RESOURCE_PATH``, ``GAZEBO_MODEL_PATH``, ``SDF_PATH``;
    4. ``folder`` and its parents: each is the package, or contains it;
    5. packages of robots that are installed for this Python (example-robot-data, the cache of
       robot_descriptions);
    6. ``folder`` and its parents, whatever their names, where the file may be opened; a warning names the
       folder.

    A folder is the package ``name`` if that is its name or the name in its ``package.xml``. Other paths are
    relative to ``folder``, then to the folders of ``search``.

    With a root, paths have to lie below it, below ``../meshes`` of ``folder``, below ``search``, or below a
    folder in one of these variables or ``KINEVERSE_ROOT``. Parents of a description's folder that lie outside
    of the root count if they have a manifest, or if they are neither the home folder nor above it.
    """
    scheme, colon, rest = uri.partition("://")
    if not colon:
        return _locate_plain(uri, uri, folder, search, root)
    scheme = scheme.lower()
    if scheme in ("package", "model"):
        return _locate_packaged(uri, rest, folder, search, root)
    if scheme == "file":
        return _locate_file(uri, folder, search, root)
    raise FormatError(
        f"{quote(uri)}: {scheme}:// is not fetched. Download the file and name it by package:// or a path."
    )


def find_package(name: str, folder: Folder, root: str, inside: str = "") -> tuple[Path, bool]:
    """Return the folder of a package, searched as for ``package://``, and whether it is a substitute.

    Without such a package, the nearest folder above ``folder`` that has ``inside`` is the substitute, else
    the parent of ``folder``.
    """
    if not name or name in (".", "..") or "/" in name or "\\" in name:
        raise FormatError(f"{quote(name)} is no name of a package.")
    log = _SearchLog()
    for package in _folders_of(name, Path(folder), (), log, root):
        if log.trusted or may_open(package, root, package=package):
            return package, False
    here = Path(folder).absolute()
    for place in (here, *here.parents) if inside and not log.outside else ():
        if is_common(os.path.realpath(place)) or not may_open(place / inside, root, folder):
            continue
        if os.path.exists(place / inside):
            return place, True
    if not log.outside and may_open(here.parent, root, folder):
        return here.parent, True
    if log.outside:
        raise outside_root_error(name, root)
    raise FormatError(_not_found_message(f"$(find {name})", name, "", log))


def model_paths() -> Iterator[tuple[str, Path]]:
    """Yield the folders of models in environment variables, each with its variable."""
    for variable in _MODELS:
        for place in split_path_variable(variable):
            yield variable, Path(place).absolute()


class _SearchLog(Struct):
    """Log of the search for a package, for the error message."""

    places: list[str] = field(default_factory=list)  # folders searched, as text
    without_file: list[Path] = field(default_factory=list)  # folders of the package that lack the file
    outside: bool = False
    trusted: bool = True  # True while the folders come from the user rather than the description


def _locate_packaged(uri: str, rest: str, folder: Folder, search: Sequence[Folder], root: str | None) -> Path:
    name, _, inside = rest.partition("/")
    if not name or name in (".", "..") or "\\" in name:
        raise FormatError(f"{quote(uri)}: names no package; expected package://name/path/in/the/package.")
    # The literal path comes first: "50%25.stl" is a valid file name.
    insides = [_inside(uri, text) for text in dict.fromkeys((inside, unquote(inside)))]
    for fresh in (False, True):
        if fresh:
            # A package may be newer than the last listing of its workspace.
            _packages_below.cache_clear()
            _manifest_name.cache_clear()
        log = _SearchLog()
        for package in _folders_of(name, Path(folder), search, log, root):
            for parts in insides:
                path = package.joinpath(*parts)
                if not os.path.isfile(path):
                    continue
                if log.trusted or root is None or may_open(path, root, package=package):
                    return path
                raise outside_root_error(uri, root)
            log.without_file.append(package)
    if not log.without_file and not log.outside:
        substitute = _find_substitute(name, insides, Path(folder), root)
        if substitute is not None:
            return substitute
    if log.outside and root is not None and not log.without_file:
        raise outside_root_error(uri, root)
    raise FormatError(_not_found_message(uri, name, inside, log))


_said: set[tuple[str, str]] = set()


def _find_substitute(name: str, insides: list[list[str]], folder: Path, root: str | None) -> Path | None:
    """Return a file of a package that is not there, below the folder of the description or one above it."""
    if not os.fspath(folder) or root == NOWHERE:
        return None
    here = folder.absolute()
    for place in (here, *here.parents):
        if is_common(os.path.realpath(place)):
            break
        for parts in insides:
            path = place.joinpath(*parts)
            if parts and os.path.isfile(path) and (root is None or may_open(path, root, folder)):
                if (name, str(place)) not in _said:
                    _said.add((name, str(place)))
                    warn(
                        [f"there is no package {quote(name)}; {place}, which has its files, is taken for it."]
                    )
                return path
    return None


class RealPaths(dict[str, str]):
    """Real paths of the folders that one description names, each found once."""

    def __missing__(self, folder: str) -> str:
        return self.setdefault(folder, os.path.realpath(folder))

    def __call__(self, path: Folder) -> str:
        """Return the real path of a file or folder."""
        folder, name = os.path.split(path)
        if name in ("", ".", ".."):
            return os.path.realpath(path)
        file = os.path.join(self[folder], name)
        return os.path.realpath(file) if os.path.islink(file) else file


def may_open(
    path: Folder,
    root: str,
    folder: Folder = "",
    package: Path | None = None,
    real: RealPath = os.path.realpath,
) -> bool:
    """Return whether a path leads into the root, the package, or a folder that is allowed for all.

    Those are ``../meshes`` of the description's folder, and the folders in environment variables.
    """
    place = real(path)
    return any(is_below(place, allowed) for allowed in _allowed_folders(root, package, folder))


def _allowed_folders(root: str, package: Path | None, folder: Folder) -> Iterator[str]:
    # Most meshes lie below the root, and each further real path costs system calls.
    yield root
    if package is not None:
        yield os.path.realpath(package)
    yield from mesh_folders(folder, root)
    yield from declared_roots()
    yield from map(os.path.realpath, named_folders())


def find_root_violation(
    uri: str, folder: Folder, root: str | None, real: RealPath = os.path.realpath
) -> FormatError | None:
    """Return the error for a path or a package outside of the root; None for any other."""
    scheme, colon, rest = uri.partition("://")
    if root is None:
        return None
    if colon and scheme.lower() != "file":
        return _outside_package(uri, folder, root, real) if scheme.lower() in ("package", "model") else None
    if root == NOWHERE and not colon and not os.path.isabs(uri):
        return None  # a text without a folder: relative paths lead nowhere
    path = Path(folder).absolute() / (unquote(rest.removeprefix("localhost")) if colon else uri)
    if "\0" in uri or may_open(path, root, folder, real=real):
        return None
    return outside_root_error(uri, root)


def _outside_package(uri: str, folder: Folder, root: str, real: RealPath) -> FormatError | None:
    if root == NOWHERE or may_open(folder, root, real=real):
        return None
    for bound in (root, None):
        with suppress(FormatError):
            locate_resource(uri, folder, root=bound)
            return None if bound is not None else outside_root_error(uri, root)
    return None  # there is no such package


def named_folders() -> Iterator[str]:
    """Yield the folders of packages and models in environment variables."""
    for variables, inside in ((_WORKSPACES, ""), (_PREFIXES, "share"), (_MODELS, "")):
        for variable in variables:
            for place in split_path_variable(variable):
                yield os.path.abspath(os.path.join(place, inside))


def _inside(uri: str, text: str) -> list[str]:
    parts = [part for part in re.split(r"[/\\]", text) if part not in ("", ".")]
    depth = 0
    for part in parts:
        depth += -1 if part == ".." else 1
        if depth < 0 or Path(part).drive:
            raise FormatError(
                f"{quote(uri)}: leads out of its package, which is refused. Name the other package."
            )
    return parts


def _not_found_message(uri: str, name: str, inside: str, log: _SearchLog) -> str:
    if log.without_file:
        places = [str(path) for path in dict.fromkeys(log.without_file)]
        return f"{quote(uri)}: package {quote(name)} has no file {quote(inside)}. It is at:{_lines(places)}"
    places = list(dict.fromkeys(log.places))
    return (
        f"{quote(uri)}: there is no package {quote(name)}. "
        "Set KINEVERSE_PACKAGE_PATH or ROS_PACKAGE_PATH to the folder that holds it."
        + (f" Looked in:{_lines(places)}" if places else "")
    )


def _lines(places: Sequence[str]) -> str:
    more = [f"and {len(places) - _LISTED + 1} more"] if len(places) > _LISTED else []
    return "".join(f"\n  {place}" for place in [*places[: _LISTED - len(more)], *more])


def _folders_of(
    name: str, folder: Path, search: Sequence[Folder], log: _SearchLog, root: str | None
) -> Iterator[Path]:
    log.places.append(f"{folder.absolute()} and the folders above it")
    for place in search:
        log.places.append(str(place))
        yield from _at_or_in(Path(place), name)
    for variable in _WORKSPACES:
        for place in _paths_in(variable, log):
            yield from _packages_below(place).get(name, ())
    for variable in _PREFIXES:
        for place in _paths_in(variable, log):
            yield from filter(os.path.isdir, (place / "share" / name, place / name / "share" / name))
    for variable in _MODELS:
        for place in _paths_in(variable, log):
            yield from _at_or_in(place, name)
    here = folder.absolute()
    log.trusted = False
    for place in (here, *here.parents):
        for package in _at_or_in(place, name):
            if root is None or counts_as_package(package, here, root):
                yield package
            else:
                log.outside = True
    log.trusted = True
    for place in _installed():
        log.places.append(str(place))
        yield from _at_or_in(place, name)


def counts_as_package(package: Path, folder: Path, root: str) -> bool:
    """Return True if a folder that was found above a description may count as a package.

    Otherwise ``package://etc/passwd`` would be a file of the package ``etc``. A document states the folder of
    its meshes itself, so its parents count only if files may be opened in that folder anyway.
    """
    real, here = os.path.realpath(package), os.path.realpath(folder)
    if is_below(real, root):
        return True
    if not may_open(here, root):
        return False
    if any(os.path.isfile(os.path.join(real, mark)) for mark in _MARKS):
        return True
    above = real if is_below(here, real) else os.path.dirname(real)
    return is_below(here, root) and not is_common(above)


def _paths_in(variable: str, log: _SearchLog) -> Iterator[Path]:
    for place in split_path_variable(variable):
        log.places.append(f"{place} (${variable})")
        yield Path(place).absolute()


def _at_or_in(place: Path, name: str) -> Iterator[Path]:
    """Yield the folder ``place`` if it is the package, and the package directly inside of it."""
    if place.name == name or _manifest_name(place) == name:
        yield place
    if os.path.isdir(place / name):  # False, and no error, for a name that is too long
        yield place / name


@lru_cache(maxsize=4096)
def _manifest_name(folder: Path) -> str | None:
    try:
        with (folder / "package.xml").open(encoding="utf-8", errors="replace") as manifest:
            match = re.search(r"<name>\s*([^<\s]+)\s*</name>", manifest.read(1 << 16))
    except OSError:
        return None
    return match[1] if match else None


@lru_cache(maxsize=64)
def _packages_below(top: Path) -> dict[str, tuple[Path, ...]]:
    """Return the packages at and below a folder, by the name of the folder and that of the manifest."""
    result: dict[str, tuple[Path, ...]] = {}
    ahead = deque([(top, 0)])
    for _ in range(MAX_FOLDERS):
        if not ahead:
            break
        folder, depth = ahead.popleft()
        try:
            entries = {entry.name: entry.is_dir() for entry in os.scandir(folder)}
        except OSError:
            continue
        is_package = any(manifest in entries for manifest in _MANIFESTS)
        # A folder without manifest counts if it lies directly in a workspace.
        if is_package or depth <= 1:
            for name in {folder.name, _manifest_name(folder) or folder.name}:
                result[name] = (*result.get(name, ()), folder)
        if is_package or depth == MAX_DEPTH or not entries.keys().isdisjoint(_IGNORED):
            continue
        below = sorted(name for name, is_folder in entries.items() if is_folder and not name.startswith("."))
        ahead.extend((folder / name, depth + 1) for name in below)
    return result


def _installed() -> Iterator[Path]:
    """Yield the folders of robot packages of this Python, without importing them."""
    for entry in dict.fromkeys(sys.path):
        share = Path(entry) / "cmeel.prefix" / "share"
        if entry and share.is_dir():
            yield share
    cache = os.environ.get("ROBOT_DESCRIPTIONS_CACHE") or os.path.expanduser("~/.cache/robot_descriptions")
    try:
        repositories = sorted(entry.path for entry in os.scandir(cache) if entry.is_dir())
    except OSError:
        return
    yield Path(cache)
    yield from map(Path, repositories)


def _locate_file(uri: str, folder: Folder, search: Sequence[Folder], root: str | None) -> Path:
    parts = urlsplit(uri)
    if parts.netloc not in ("", "localhost"):
        raise FormatError(
            f"{quote(uri)}: file:// takes an absolute path, with three slashes: file:///folder/file. "
            "For a path relative to the description, leave file:// out."
        )
    literal = uri.partition("://")[2].removeprefix("localhost")
    path = literal if os.path.isfile(literal) else unquote(literal)
    return _locate_plain(uri, path, folder, search, root)


def _locate_plain(uri: str, text: str, folder: Folder, search: Sequence[Folder], root: str | None) -> Path:
    path = Path(text)
    tried = [Path(folder).absolute() / path, *(Path(place).absolute() / path for place in search)]
    left = False
    for candidate in tried:
        # No file outside is touched, not even to see if it exists.
        restricted = root if candidate is tried[0] and "\0" not in text else None
        if restricted is not None and not may_open(candidate, restricted, folder):
            left = True
        elif os.path.isfile(candidate):  # False, and no error, for a name that is too long
            return candidate
    if left and root is not None:
        raise outside_root_error(uri, root)
    where = [str(candidate) for candidate in dict.fromkeys(tried)]
    hint = "" if path.is_absolute() else " Paths are relative to the folder of the description."
    raise FormatError(f"{quote(text)}: there is no such file.{hint} Looked for:{_lines(where)}")


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
