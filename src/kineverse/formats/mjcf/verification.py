"""Whether MuJoCo opens what was written, and which mesh it stumbles over if it does not."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

from kineverse.errors import MissingExtraError
from kineverse.formats.export.markup import Tag, document

from .engine import listening, mujoco, reason_of

_NAMED = re.compile(r"\bmesh_\d+\b")


def complaint_about(root: Tag, folder: Path, converted: Mapping[Path, bytes]) -> str | None:
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
    except MissingExtraError:
        return None
    with TemporaryDirectory(prefix="kineverse-") as temporary:
        there = {}
        for k, (path, content) in enumerate(converted.items()):
            there[path] = Path(temporary, f"{k}{path.suffix}")
            there[path].write_bytes(content)
        text = document(_with_absolute_files(root, folder, there)).decode()
        with listening():
            try:
                engine.MjModel.from_xml_string(text)
            except (ValueError, RuntimeError, engine.FatalError, engine.UnexpectedError) as error:
                return reason_of(str(error), whole=True)
    return None


def mesh_in(complaint: str, root: Tag) -> str | None:
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
            part = Tag(part.name, part.attributes, [_absolute(tag, folder, there) for tag in part.inside])
        inside.append(part)
    return Tag(root.name, root.attributes, inside)


def _absolute(tag: Tag, folder: Path, there: Mapping[Path, Path]) -> Tag:
    if "file" not in tag.attributes:
        return tag
    path = folder / tag.attributes["file"]
    return Tag(tag.name, {**tag.attributes, "file": str(there.get(path, path))}, tag.inside)
