"""Calls of MuJoCo's parser and compiler, with its warnings and errors captured."""

from __future__ import annotations

import re
import threading
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from kineverse._extras import install_command
from kineverse.errors import FormatError, MissingDependencyError
from kineverse.formats.xml_writer import Tag, format_xml

from .preprocess import PreprocessedMjcf

_MUJOCO_LOCK = threading.Lock()
_LINE = re.compile(r"line (\d+)")
_NOISE = re.compile(r"^(XML Error: |Error: |could not parse model file with error: )+")


def mujoco() -> Any:
    """Return the package, which is imported when it is first needed.

    Raises
    ------
    MissingDependencyError
        If it is not installed.
    """
    try:
        import mujoco as package
    except ImportError as error:
        raise MissingDependencyError(
            f"Reading MJCF needs MuJoCo's parser: {install_command('mjcf')}"
        ) from error
    return package


@contextmanager
def capture_mujoco_warnings() -> Iterator[list[str]]:
    """Yield a list that takes MuJoCo's warnings, which would go to the terminal and a file otherwise."""
    engine = mujoco()
    heard: list[str] = []
    with _MUJOCO_LOCK, warnings.catch_warnings(record=True) as warned:  # both are one for all of the process
        warnings.simplefilter("always")
        before = engine.get_mju_user_warning()
        engine.set_mju_user_warning(heard.append)
        try:
            yield heard
        finally:
            engine.set_mju_user_warning(before)
            heard += [str(warning.message) for warning in warned]


def parse_spec(prepared: PreprocessedMjcf, source: str) -> Any:
    """Return the ``MjSpec`` of a document.

    Raises
    ------
    FormatError
        With what MuJoCo says about which element.
    """
    engine = mujoco()
    try:
        return engine.MjSpec.from_string(prepared.text, include=prepared.models)
    except (ValueError, RuntimeError, engine.FatalError, engine.UnexpectedError) as error:
        raise mujoco_error(error, prepared, source) from None


def compile_spec(spec: Any, prepared: PreprocessedMjcf, source: str) -> Any:
    """Return the ``MjModel`` of a specification.

    Raises
    ------
    FormatError
        With what MuJoCo says about which element.
    """
    engine = mujoco()
    try:
        return spec.compile()
    except (ValueError, RuntimeError, engine.FatalError, engine.UnexpectedError) as error:
        raise mujoco_error(error, prepared, source) from None


def mujoco_error(error: Exception, prepared: PreprocessedMjcf, source: str) -> FormatError:
    """Return the error that people see for one of MuJoCo's."""
    text = str(error)
    reason = extract_reason(text)
    lines = [int(number) for number in _LINE.findall(text)]
    # The innermost comes first: an attached model is complained about at the element that attaches it, too.
    node = prepared.node(f"line {lines[0]}") if lines else None
    where = source if node is None else node.where
    return FormatError(f"{where}: MuJoCo refuses it: {reason or 'it gives no reason'}.")


def extract_reason(text: str, whole: bool = False) -> str:
    """Return the first line of what MuJoCo says, or all of its lines in one, without its own preamble."""
    lines = _NOISE.sub("", text.strip()).splitlines() or [""]
    return ", ".join(line.strip() for line in (lines if whole else lines[:1])).rstrip(".")


_NAMED = re.compile(r"\bmesh_\d+\b")


def find_load_error(root: Tag, folder: Path, converted: Mapping[Path, bytes]) -> str | None:
    """Return what MuJoCo says against a document; None if it opens it, or is not installed.

    Parameters
    ----------
    root
        The document.
    folder
        Where it will lie.
    converted
        Files that are going to be written with it.
    """
    try:
        engine = mujoco()
    except MissingDependencyError:
        return None
    with TemporaryDirectory(prefix="kineverse-") as temporary:
        there = {}
        for k, (path, content) in enumerate(converted.items()):
            there[path] = Path(temporary, f"{k}{path.suffix}")
            there[path].write_bytes(content)
        text = format_xml(_with_absolute_files(root, folder, there)).decode()
        with capture_mujoco_warnings():
            try:
                engine.MjModel.from_xml_string(text)
            except (ValueError, RuntimeError, engine.FatalError, engine.UnexpectedError) as error:
                return extract_reason(str(error), whole=True)
    return None


def find_blamed_mesh(complaint: str, root: Tag) -> str | None:
    """Return the file of the mesh that a complaint is about; None if it is about something else."""
    names = {name.lower() for name in _NAMED.findall(complaint)}
    for tag in _assets(root):
        file = tag.attributes.get("file", "")
        if tag.name == "mesh" and (tag.attributes["name"] in names or Path(file).name in complaint):
            return file
    return None


def _assets(root: Tag) -> list[Tag]:
    return [tag for part in root.inside if part.name == "asset" for tag in part.inside]


def _with_absolute_files(root: Tag, folder: Path, there: Mapping[Path, Path]) -> Tag:
    inside = []
    for part in root.inside:
        if part.name == "asset":
            part = Tag(
                part.name, part.attributes, [_with_absolute_file(tag, folder, there) for tag in part.inside]
            )
        inside.append(part)
    return Tag(root.name, root.attributes, inside)


def _with_absolute_file(tag: Tag, folder: Path, there: Mapping[Path, Path]) -> Tag:
    if "file" not in tag.attributes:
        return tag
    path = folder / tag.attributes["file"]
    return Tag(tag.name, {**tag.attributes, "file": str(there.get(path, path))}, tag.inside)
