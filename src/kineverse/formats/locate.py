"""Search for the file of a model by its name."""

from __future__ import annotations

import os
import sysconfig
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

from kineverse import shipped
from kineverse.errors import FormatError, UnknownNameError, list_some, suggest
from kineverse.model import registry

from .root_folder import split_path_variable

MODEL_PATH = "KINEVERSE_MODEL_PATH"
_DEPTH = 6
_LISTED = 6
_LONGEST = 200

GALLERY = "articulations"  # first part of the names of the scenes that ship, one for each articulation


@dataclass(frozen=True, slots=True)
class Source:
    """File of a model, with its name if it ships; or a model that a collection builds, without a file.

    ``shipped`` is its prefix by default.
    """

    path: Path
    shipped: str | None = None
    collection: str = ""
    """Name of the collection."""
    folder: Path | None = field(default=None, compare=False)
    """Folder of models that was searched by name."""


def shipped_models() -> tuple[str, ...]:
    """Return the names of the models that ship with the package.

    Examples
    --------
    >>> kv.shipped_models()
    ('fetch', 'hsr', 'kitchen', 'pr2', 'shelf_door', 'shelf_drawers')
    """
    return tuple(sorted(file.stem for file in shipped.FOLDER.glob("*.urdf")))


def locate_model(name: str | os.PathLike[str]) -> Source:
    """Return the file of a model given by path or by name.

    Shipped models and scenes of the gallery (``articulations/screw``) have priority over files of the same
    name; such a file is ``./kitchen``. A path to a file is used as it is. Any other name is searched below
    the folders of ``KINEVERSE_MODEL_PATH``, then in installed packages with robots. The first folder that has
    it counts, and in it the file closest to the top. The name may include folders (``urdf_obj/kitchen``) to
    select among files of the same name, and its suffix is optional.

    Raises
    ------
    UnknownNameError
        If there is no such model, with similar names and the folders searched; or if there are several.
    FormatError
        If the name is no text or path, or no regular file.

    Examples
    --------
    >>> kv.formats.locate_model("kitchen").path.name
    'kitchen.urdf'
    """
    if not isinstance(name, (str, os.PathLike)):
        are_bytes = isinstance(name, (bytes, bytearray, memoryview))
        hint = " Bytes are read by kv.formats.from_bytes." if are_bytes else ""
        raise FormatError(
            "A model is loaded by its name or from the path of a file, "
            f"not from {_shown(repr(name))[1:-1]}.{hint}"
        )
    text = os.fspath(name)
    if text in shipped_models():
        return Source(shipped.FOLDER / f"{text}.urdf", text)
    group, _, member = text.partition("/")
    collection = registry.COLLECTIONS.get(group)
    if collection is not None and collection.has(member):
        document = collection.document(member)
        prefix = collection.prefix or member
        return Source(Path(text), prefix, group) if document is None else Source(document, prefix)
    if text.lstrip().startswith(("<", "{")):
        is_document = text.lstrip().startswith("{")
        advice = ", model.kv.json." if is_document else "; 'kineverse.formats.urdf.parse_urdf' reads text."
        raise UnknownNameError(
            f"This looks like the text of a {'document' if is_document else 'description'}, where the name "
            f"or path of a model is expected. Write it to a file{advice}"
        )
    path = _expanded(text)
    if _is(path, Path.is_file):
        return Source(path.resolve())
    if _is(path, Path.is_dir):
        inside = registry.find_folder_file(path)
        if inside is not None:
            return Source(inside.resolve())
    explicit = path.is_absolute() or text.startswith(".") or text.endswith(registry.readable_suffixes())
    if explicit and not _is(path, Path.is_dir) and _is(path, os.path.lexists):
        raise FormatError(
            f"{_shown(text)} is no regular file, but a pipe, a device, or a link that leads nowhere."
        )
    if path.is_absolute() or text.startswith("."):
        raise UnknownNameError(f"There is no file {_shown(text)}.{_path_hint(path)}")
    searched: list[str] = []
    seen: list[str] = []
    for place, folder in model_folders():
        files = [p.relative_to(folder).as_posix() for p in _files(folder)]
        found = [f for f in files if _is_called(f, text)]
        if found:
            return Source((folder / _only(found, text, folder)).resolve(), folder=folder)
        searched.append(f"{place} ({folder})")
        seen += files
    if collection is not None:
        raise UnknownNameError(_no_member(group, collection, member))
    raise UnknownNameError(
        f"There is no model {_shown(text)}.{_path_hint(path) if text else ''} {_similar(text, seen)} "
        f"Searched after the shipped ones: {'; '.join(searched) or 'nothing else'}.{_missing_places()} "
        f"Give the path of a file, or add its folder to the environment variable {MODEL_PATH}"
        f"{_more_robots(searched)}."
    )


def _no_member(group: str, collection: registry.ModelCollection, name: str) -> str:
    names = collection.names()
    shown = ", ".join(names) + (", …" if collection.accept else "")
    if not name:
        return f"'{group}' is many models, {collection.summary}: {shown}. Load one as '{group}/{names[0]}'."
    from difflib import get_close_matches  # for start-up time

    alike = [f"{group}/{one}" for one in get_close_matches(name, names, n=_LISTED, cutoff=0.7)]
    found = alike if collection.accept else _alike(name, [])
    meant = f"Did you mean {' or '.join(map(repr, found))}?" if found else f"Available: {shown}."
    return f"There is no model {_shown(f'{group}/{name}')}. {meant}"


def model_folders() -> Iterator[tuple[str, Path]]:
    """Yield the folders in which models are searched by name, each with its origin."""
    for entry in split_path_variable(MODEL_PATH):
        if Path(entry).is_dir():
            yield MODEL_PATH, Path(entry)
    site = Path(sysconfig.get_paths()["purelib"])
    for package in ("cmeel.prefix/share/example-robot-data/robots", "example_robot_data/robots"):
        if (site / package).is_dir():
            yield "example-robot-data", site / package
    cache = Path(os.environ.get("ROBOT_DESCRIPTIONS_CACHE", "~/.cache/robot_descriptions")).expanduser()
    if cache.is_dir():
        yield "robot_descriptions", cache


def _files(folder: Path, depth: int = _DEPTH) -> Iterator[Path]:
    base, suffixes = len(folder.parts), registry.readable_suffixes()
    for root, folders, files in os.walk(folder):
        if len(Path(root).parts) - base >= depth:
            folders.clear()
        folders[:] = sorted(f for f in folders if not f.startswith("."))
        for file in sorted(files):
            # A template next to the file that it expands to does not make its name ambiguous.
            if file.endswith(suffixes) and not file.endswith(".xacro"):
                yield Path(root, file)


def _is_called(file: str, name: str) -> bool:
    return any(f"/{file}".endswith(f"/{name}{suffix}") for suffix in ("", *registry.readable_suffixes()))


def _only(found: list[str], name: str, folder: Path) -> str:
    """Return the file closest to the top."""
    top = min(f.count("/") for f in found)
    found = sorted(f for f in found if f.count("/") == top)
    if len(found) > 1:
        choices = list_some(map(repr, found), _LISTED)
        raise UnknownNameError(f"{name!r} is ambiguous in {folder}: {choices}. Give one of these paths.")
    return found[0]


def _similar(name: str, files: list[str]) -> str:
    found = _alike(name, files)
    if not found:
        return f"Models that ship: {', '.join(shipped_models())}."
    return f"Did you mean {' or '.join(map(repr, found))}?"


def _alike(name: str, files: list[str]) -> list[str]:
    wanted = name.casefold().strip("/ ")
    paths = sorted({_stem(f) for f in files})
    ends = Counter(_end(p) for p in paths)
    # Folders are left out if the last part of the path is unique.
    shown = {p: _end(p) if ends[_end(p)] == 1 else p for p in paths} | {s: s for s in shipped_models()}
    for group, collection in registry.COLLECTIONS.items():
        if not collection.accept:
            shown |= {f"{group}/{member}": f"{group}/{member}" for member in collection.names()}
    last = {_end(p).casefold() for p in shown}
    alike = sorted(end for end in last if sorted(end) == sorted(wanted))  # 'hrs', too short to be alike
    from difflib import get_close_matches  # for start-up time

    alike += get_close_matches(wanted, last, n=_LISTED, cutoff=0.7)
    close = [n for end in alike for p, n in shown.items() if _end(p).casefold() == end]
    within = [n for p, n in shown.items() if wanted in p.casefold()]
    found = list(dict.fromkeys(close + sorted(within, key=lambda n: (len(n), n))))[:_LISTED]
    return found if wanted else []


def _end(path: str) -> str:
    return path.rsplit("/", 1)[-1]


def _stem(file: str) -> str:
    return next((file.removesuffix(s) for s in registry.readable_suffixes() if file.endswith(s)), file)


def _missing_places() -> str:
    missing = [entry for entry in split_path_variable(MODEL_PATH) if not Path(entry).is_dir()]
    return f" {MODEL_PATH} names folders that do not exist: {', '.join(missing)}." if missing else ""


def _more_robots(searched: list[str]) -> str:
    ways = {
        "example-robot-data": "install robots with 'pip install example-robot-data'",
        "robot_descriptions": "fetch one by 'robot_descriptions pull NAME' (pip install robot_descriptions)",
    }
    left = [way for place, way in ways.items() if not any(entry.startswith(place) for entry in searched)]
    return "".join(f", or {way}" for way in left)


def _path_hint(path: Path) -> str:
    if _is(path, Path.is_dir):
        inside = [p.relative_to(path).as_posix() for p in islice(_files(path, 2), _LISTED)]
        return f" It is a folder; models in it: {', '.join(inside) or 'none'}."
    if not path.name.endswith(registry.readable_suffixes()):
        return ""
    if not _is(path.parent, Path.is_dir):
        return f" The folder {_shown(str(path.parent))} does not exist."
    neighbours = [p.name for p in _files(path.parent, 0)]
    return f" {suggest(path.name, neighbours, 'model file in its folder')}"


def _expanded(text: str) -> Path:
    try:
        return Path(text).expanduser()
    except RuntimeError:  # "~name" of an unknown user
        return Path(text)


def _is(path: Path, kind: Callable[[Path], bool]) -> bool:
    try:
        return kind(path)
    except OSError:  # a name that is too long, or a folder without permission
        return False


def _shown(text: str) -> str:
    return repr(text) if len(text) <= _LONGEST else f"{text[:_LONGEST]!r}..."
