"""From what a user calls a model to the file that holds it."""

from __future__ import annotations

import os
import sysconfig
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

from kineverse.errors import UnknownNameError, suggest

SUFFIXES = (".urdf", ".sdf", ".xml", ".kv.json")
MODEL_PATH = "KINEVERSE_MODEL_PATH"
_DEPTH = 6


@dataclass(frozen=True, slots=True)
class Source:
    """A file, and the name it ships under if it does."""

    path: Path
    shipped: str | None = None


def shipped_models() -> tuple[str, ...]:
    """Return the names of the models that come with the package."""
    folder = resources.files("kineverse.shipped")
    return tuple(sorted(f.name.removesuffix(".urdf") for f in folder.iterdir() if f.name.endswith(".urdf")))


def locate_model(name: str | os.PathLike[str]) -> Source:
    """Return the file of a model given by path or by name.

    A path to a file is taken as it is. A name is looked for among the shipped models, then below the folders
    of ``KINEVERSE_MODEL_PATH``, then in installed packages that carry robots. It may have folders in front
    (``urdf_obj/kitchen``) to tell files of the same name apart.

    Raises
    ------
    UnknownNameError
        Listing what was searched and how to get more.
    """
    text = os.fspath(name)
    path = Path(text).expanduser()
    if path.is_file():
        return Source(path.resolve())
    if path.name.endswith(SUFFIXES) and (path.is_absolute() or text.startswith(".")):
        raise UnknownNameError(f"There is no file {text!r}.{_beside(path)}")
    if text in shipped_models():
        return Source(Path(str(resources.files("kineverse.shipped").joinpath(f"{text}.urdf"))), text)
    searched = []
    for place, folder in model_folders():
        found = [p for p in _files(folder) if _matches(p, folder, text)]
        searched.append(f"{place} ({folder})")
        if found:
            shallowest = min(len(p.parts) for p in found)
            found = sorted(p for p in found if len(p.parts) == shallowest)
            if len(found) > 1:
                choices = ", ".join(repr(p.relative_to(folder).as_posix()) for p in found[:6])
                raise UnknownNameError(
                    f"{text!r} is ambiguous in {folder}: {choices}. Give one of these paths."
                )
            return Source(found[0].resolve())
    raise UnknownNameError(
        f"There is no model {text!r}.{_beside(path)} {suggest(text, shipped_models(), 'shipped model')} "
        f"Searched after the shipped ones: {'; '.join(searched) or 'nothing else'}. Give the path of a file, "
        f"or add its folder to the environment variable {MODEL_PATH}, or install robots with "
        "'pip install example-robot-data'."
    )


def model_folders() -> Iterator[tuple[str, Path]]:
    """Yield the folders in which names are looked for, with what each is."""
    for entry in os.environ.get(MODEL_PATH, "").split(os.pathsep):
        if entry and Path(entry).is_dir():
            yield MODEL_PATH, Path(entry)
    site = Path(sysconfig.get_paths()["purelib"])
    for package in ("cmeel.prefix/share/example-robot-data/robots", "example_robot_data/robots"):
        if (site / package).is_dir():
            yield "example-robot-data", site / package
    cache = Path(os.environ.get("ROBOT_DESCRIPTIONS_CACHE", "~/.cache/robot_descriptions")).expanduser()
    if cache.is_dir():
        yield "robot_descriptions", cache


def _files(folder: Path) -> Iterator[Path]:
    base = len(folder.parts)
    for root, folders, files in os.walk(folder):
        if len(Path(root).parts) - base >= _DEPTH:
            folders.clear()
        folders[:] = sorted(f for f in folders if not f.startswith("."))
        for file in sorted(files):
            if file.endswith(SUFFIXES):
                yield Path(root, file)


def _matches(path: Path, folder: Path, name: str) -> bool:
    relative = path.relative_to(folder).as_posix()
    for suffix in ("", *SUFFIXES):
        wanted = f"{name}{suffix}"
        if relative == wanted or relative.endswith(f"/{wanted}"):
            return True
    return False


def _beside(path: Path) -> str:
    if not path.name.endswith(SUFFIXES):
        return ""
    if not path.parent.is_dir():
        return f" The folder {str(path.parent)!r} does not exist."
    return " " + suggest(path.name, (f.name for f in path.parent.iterdir()), "file")
