"""Where the files are that a description names: ``package://``, ``model://``, ``file://`` and plain paths.

Nothing here opens a file it finds, and nothing searches the whole disk: the places are few, listed in
:func:`locate`, and the two kinds of folders that are searched in depth are searched within ``MAX_DEPTH`` and
``MAX_FOLDERS``.
"""

from __future__ import annotations

import os
import re
import sys
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import TypeAlias
from urllib.parse import unquote, urlsplit

from kineverse.errors import FormatError
from kineverse.formats.markup import quote

MAX_DEPTH = 4
"""How deep below a folder of a workspace variable packages are looked for."""

MAX_FOLDERS = 20_000
"""How many folders below one such folder are visited at most."""

_WORKSPACES = ("KINEVERSE_PACKAGE_PATH", "ROS_PACKAGE_PATH")
_PREFIXES = ("AMENT_PREFIX_PATH", "COLCON_PREFIX_PATH", "CMAKE_PREFIX_PATH")
_MODELS = ("GZ_SIM_RESOURCE_PATH", "IGN_GAZEBO_RESOURCE_PATH", "GAZEBO_MODEL_PATH", "SDF_PATH")
_MANIFESTS = ("package.xml", "manifest.xml")
_IGNORED = ("CATKIN_IGNORE", "COLCON_IGNORE", "AMENT_IGNORE")
_LISTED = 12

Folder: TypeAlias = "str | os.PathLike[str]"


def locate(uri: str, folder: Folder = "", search: Sequence[Folder] = ()) -> Path:
    """Return the path of the file that a description names.

    ``package://name/rest`` and ``model://name/rest`` are the file ``rest`` of the first folder for ``name``
    that has it, among

    1. the folders of ``search``: each is the package, or holds it;
    2. those of ``KINEVERSE_PACKAGE_PATH`` and ``ROS_PACKAGE_PATH``: each is the package, or holds it at most
       ``MAX_DEPTH`` deep;
    3. ``share/name`` below those of ``AMENT_PREFIX_PATH``, ``COLCON_PREFIX_PATH`` and ``CMAKE_PREFIX_PATH``;
       models of ``GZ_SIM_RESOURCE_PATH``, ``IGN_GAZEBO_RESOURCE_PATH``, ``GAZEBO_MODEL_PATH``, ``SDF_PATH``;
    4. ``folder`` and those above it: each is the package, or holds it;
    5. packages of robots that are installed for this Python (example-robot-data, the cache of
       robot_descriptions).

    A folder is the package ``name`` if it is called so or has a ``package.xml`` with that name. Other paths
    are relative to ``folder``, then to the folders of ``search``.

    Parameters
    ----------
    uri
        What the description says.
    folder
        The folder of the description.
    search
        Folders to try first.

    Raises
    ------
    FormatError
        If there is no such file (the message lists where it was looked for and which variable to set), if the
        path leaves its package, or if it is to be fetched from a network.
    """
    scheme, colon, rest = uri.partition("://")
    if not colon:
        return _plain(uri, folder, search)
    scheme = scheme.lower()
    if scheme in ("package", "model"):
        return _packaged(uri, rest, folder, search)
    if scheme == "file":
        return _file(uri, folder, search)
    raise FormatError(
        f"{quote(uri)}: {scheme}:// is not fetched. Download the file and name it by package:// or a path."
    )


def model_paths() -> Iterator[tuple[str, Path]]:
    """Yield the folders of models that environment variables name, each with its variable."""
    for variable in _MODELS:
        for place in os.environ.get(variable, "").split(os.pathsep):
            if place:
                yield variable, Path(place).absolute()


@dataclass
class _Trail:
    """Where a package was looked for, for the message when it is not there."""

    places: list[str] = field(default_factory=list)
    without_file: list[Path] = field(default_factory=list)


def _packaged(uri: str, rest: str, folder: Folder, search: Sequence[Folder]) -> Path:
    name, _, inside = rest.partition("/")
    if not name or name in (".", "..") or "\\" in name:
        raise FormatError(f"{quote(uri)}: names no package; expected package://name/path/in/the/package.")
    # The literal path comes first: a file may well be called "50%25.stl".
    insides = [_inside(uri, text) for text in dict.fromkeys((inside, unquote(inside)))]
    for fresh in (False, True):
        if fresh:
            # A package may have been made since its workspace was last listed.
            _packages_below.cache_clear()
            _manifest_name.cache_clear()
        trail = _Trail()
        for package in _folders_of(name, Path(folder), search, trail):
            for parts in insides:
                path = package.joinpath(*parts)
                if os.path.isfile(path):
                    return path
            trail.without_file.append(package)
    raise FormatError(_miss(uri, name, inside, trail))


def _inside(uri: str, text: str) -> list[str]:
    """Return the parts of a path in a package, which has to stay in there."""
    parts = [part for part in re.split(r"[/\\]", text) if part not in ("", ".")]
    depth = 0
    for part in parts:
        depth += -1 if part == ".." else 1
        if depth < 0 or Path(part).drive:
            raise FormatError(
                f"{quote(uri)}: leads out of its package, which is refused. Name the other package."
            )
    return parts


def _miss(uri: str, name: str, inside: str, trail: _Trail) -> str:
    if trail.without_file:
        found = ", ".join(str(path) for path in dict.fromkeys(trail.without_file))
        return f"{quote(uri)}: package {quote(name)} is at {found}, which has no file {quote(inside)}."
    places = list(dict.fromkeys(trail.places))
    more = f" and {len(places) - _LISTED} more" if len(places) > _LISTED else ""
    return (
        f"{quote(uri)}: there is no package {quote(name)}. Looked in: {', '.join(places[:_LISTED])}{more}. "
        f"Set KINEVERSE_PACKAGE_PATH or ROS_PACKAGE_PATH to the folder that holds {quote(name)}."
    )


def _folders_of(name: str, folder: Path, search: Sequence[Folder], trail: _Trail) -> Iterator[Path]:
    """Yield the folders that are the package, in the order in which they count."""
    for place in search:
        trail.places.append(str(place))
        yield from _at_or_in(Path(place), name)
    for variable in _WORKSPACES:
        for place in _paths_in(variable, trail):
            yield from _packages_below(place).get(name, ())
    for variable in _PREFIXES:
        for place in _paths_in(variable, trail):
            yield from _existing((place / "share" / name, place / name / "share" / name))
    for variable in _MODELS:
        for place in _paths_in(variable, trail):
            yield from _at_or_in(place, name)
    here = folder.absolute()
    trail.places.append(f"{here} and the folders above it")
    for place in (here, *here.parents):
        yield from _at_or_in(place, name)
    for place in _installed():
        trail.places.append(str(place))
        yield from _at_or_in(place, name)


def _paths_in(variable: str, trail: _Trail) -> Iterator[Path]:
    value = os.environ.get(variable, "")
    if not value:
        trail.places.append(f"${variable} (not set)")
    for place in value.split(os.pathsep):
        if place:
            trail.places.append(f"{place} (${variable})")
            yield Path(place).absolute()


def _at_or_in(place: Path, name: str) -> Iterator[Path]:
    """Yield ``place`` if it is the package, and the package directly inside of it."""
    if place.name == name or _manifest_name(place) == name:
        yield place
    yield from _existing((place / name,))


def _existing(places: Iterable[Path]) -> Iterator[Path]:
    for place in places:
        if place.is_dir():
            yield place


@lru_cache(maxsize=4096)
def _manifest_name(folder: Path) -> str | None:
    """Return the name a folder's ROS manifest gives it, or None."""
    try:
        with (folder / "package.xml").open(encoding="utf-8", errors="replace") as manifest:
            match = re.search(r"<name>\s*([^<\s]+)\s*</name>", manifest.read(1 << 16))
    except OSError:
        return None
    return match[1] if match else None


@lru_cache(maxsize=64)
def _packages_below(top: Path) -> dict[str, tuple[Path, ...]]:
    """Return the packages at and below a folder, by the names they go by."""
    found: dict[str, tuple[Path, ...]] = {}
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
        # A folder without manifest counts where it lies directly in a workspace: somebody copied it there.
        if is_package or depth <= 1:
            for name in {folder.name, _manifest_name(folder) or folder.name}:
                found[name] = (*found.get(name, ()), folder)
        if is_package or depth == MAX_DEPTH or not entries.keys().isdisjoint(_IGNORED):
            continue
        below = sorted(name for name, is_folder in entries.items() if is_folder and not name.startswith("."))
        ahead.extend((folder / name, depth + 1) for name in below)
    return found


def _installed() -> Iterator[Path]:
    """Yield folders of this Python that hold packages of robots; nothing is imported for it."""
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


def _file(uri: str, folder: Folder, search: Sequence[Folder]) -> Path:
    parts = urlsplit(uri)
    if parts.netloc not in ("", "localhost"):
        raise FormatError(
            f"{quote(uri)}: file:// takes an absolute path, with three slashes: file:///folder/file. "
            "For a path relative to the description, leave file:// out."
        )
    literal = uri.partition("://")[2].removeprefix("localhost")
    path = Path(literal)
    return path if os.path.isfile(path) else _plain(unquote(literal), folder, search)


def _plain(text: str, folder: Folder, search: Sequence[Folder]) -> Path:
    path = Path(text)
    tried = [Path(folder).absolute() / path, *(Path(place).absolute() / path for place in search)]
    for candidate in tried:
        if os.path.isfile(candidate):  # which is no for a name that is too long, and no error
            return candidate
    where = ", ".join(str(candidate) for candidate in dict.fromkeys(tried))
    hint = "" if path.is_absolute() else " Paths are relative to the folder of the description."
    raise FormatError(f"{quote(text)}: there is no such file. Looked for: {where}.{hint}")
