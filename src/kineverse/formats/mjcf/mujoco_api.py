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
    """Import MuJoCo when it is first needed."""
    try:
        import mujoco as package
    except ImportError as error:
        raise MissingDependencyError(
            f"MJCF and worlds with physics need MuJoCo: {install_command('mjcf')}"
        ) from error
    return package


@contextmanager
def capture_mujoco_warnings() -> Iterator[list[str]]:
    """Capture MuJoCo's warnings in a list; otherwise they go to the terminal and a file."""
    engine = mujoco()
    captured: list[str] = []
    with _MUJOCO_LOCK, warnings.catch_warnings(record=True) as warned:  # both are global to the process
        warnings.simplefilter("always")
        before = engine.get_mju_user_warning()
        engine.set_mju_user_warning(captured.append)
        try:
            yield captured
        finally:
            engine.set_mju_user_warning(before)
            captured += [str(warning.message) for warning in warned]


def parse_spec(prepared: PreprocessedMjcf, source: str, passive: bool = False) -> Any:
    """Parse a document to an ``MjSpec``, without actuators and keys if it is ``passive``."""
    engine = mujoco()
    try:
        if passive:
            return engine.MjSpec.from_string(prepared.passive_text, include=prepared.passive_models)
        return engine.MjSpec.from_string(prepared.text, include=prepared.models)
    except (ValueError, RuntimeError, engine.FatalError, engine.UnexpectedError) as error:
        raise mujoco_error(error, prepared, source) from None


def compile_spec(spec: Any, prepared: PreprocessedMjcf, source: str) -> Any:
    """Compile a specification to an ``MjModel``."""
    engine = mujoco()
    try:
        return spec.compile()
    except (ValueError, RuntimeError, engine.FatalError, engine.UnexpectedError) as error:
        raise mujoco_error(error, prepared, source) from None


def mujoco_error(error: Exception, prepared: PreprocessedMjcf, source: str) -> FormatError:
    """Return an error of MuJoCo as one with the place in the file."""
    text = str(error)
    reason = extract_reason(text)
    lines = [int(number) for number in _LINE.findall(text)]
    # The innermost line comes first, before those of the elements that attach the model.
    node = prepared.node(f"line {lines[0]}") if lines else None
    where = source if node is None else node.where
    return FormatError(f"{where}: MuJoCo refuses it: {reason or 'it gives no reason'}.")


def extract_reason(text: str, whole: bool = False) -> str:
    """Return the first line of a message of MuJoCo, or all lines joined, without the preamble."""
    lines = _NOISE.sub("", text.strip()).splitlines() or [""]
    return ", ".join(line.strip() for line in (lines if whole else lines[:1])).rstrip(".")


_MESH_NAME = re.compile(r"\bmesh_\d+\b")


def find_load_error(root: Tag, folder: Path, converted: Mapping[Path, bytes]) -> str | None:
    """Return error with which MuJoCo loads a document; None if there is none or MuJoCo is not installed."""
    try:
        engine = mujoco()
    except MissingDependencyError:
        return None
    with TemporaryDirectory(prefix="kineverse-") as temporary:
        copies = {}
        for k, (path, content) in enumerate(converted.items()):
            copies[path] = Path(temporary, f"{k}{path.suffix}")
            copies[path].write_bytes(content)
        text = format_xml(_with_absolute_files(root, folder, copies)).decode()
        with capture_mujoco_warnings():
            try:
                engine.MjModel.from_xml_string(text)
            except (ValueError, RuntimeError, engine.FatalError, engine.UnexpectedError) as error:
                return extract_reason(str(error), whole=True)
    return None


def find_blamed_mesh(error: str, root: Tag) -> str | None:
    """Return the file of the mesh that an error is about; None for other errors."""
    names = {name.lower() for name in _MESH_NAME.findall(error)}
    assets = [tag for part in root.inside if part.name == "asset" for tag in part.inside]
    for tag in assets:
        file = tag.attributes.get("file", "")
        if tag.name == "mesh" and (tag.attributes["name"] in names or Path(file).name in error):
            return file
    return None


def _with_absolute_files(root: Tag, folder: Path, copies: Mapping[Path, Path]) -> Tag:
    inside = []
    for part in root.inside:
        if part.name == "asset":
            part = Tag(
                part.name, part.attributes, [_with_absolute_file(tag, folder, copies) for tag in part.inside]
            )
        inside.append(part)
    return Tag(root.name, root.attributes, inside)


def _with_absolute_file(tag: Tag, folder: Path, copies: Mapping[Path, Path]) -> Tag:
    if "file" not in tag.attributes:
        return tag
    path = folder / tag.attributes["file"]
    return Tag(tag.name, {**tag.attributes, "file": str(copies.get(path, path))}, tag.inside)
