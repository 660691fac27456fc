"""Preprocessing of MJCF: attached models gathered, files, plugins and unsupported elements removed.

Where bodies are does not depend on any of it. Mesh files are replaced by boxes, see :mod:`.meshes`.
"""

from __future__ import annotations

import math
import os
import posixpath
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from kineverse.formats.files import read_file
from kineverse.formats.xml_reader import quote
from kineverse.formats.xml_values import LARGEST

from .custom_elements import CustomElements, read_custom_elements
from .elements import MjcfElement, find_below_root, read_tree, serialize_elements

MAX_ELEMENTS = 30_000
"""The most elements that a file may be once <replicate> and <attach> have copied them."""

BOX_MESH = {
    "vertex": "-1 -2 -3  1 -2 -3  -1 2 -3  1 2 -3  -1 -2 3  1 -2 3  -1 2 3  1 2 3",
    "face": "0 2 1 1 2 3 4 5 6 5 7 6 0 1 4 1 5 4 2 6 3 3 6 7 0 4 2 2 4 6 1 3 5 3 7 5",
}
"""The triangles that stand for those of files."""

_SECTIONS = frozenset(
    ("size", "visual", "statistic", "custom", "sensor", "extension", "contact", "deformable")
)
_ELEMENTS = frozenset(("plugin", "flexcomp", "skin", "texture", "hfield", "light", "camera", "layer"))
_FLEXIBLE = frozenset(("flex", "flexvert", "flexstrain"))
_TOLD = {
    "deformable": "is left out: what bends has no frames here.",
    "flexcomp": "is left out: what bends has no frames here.",
    "flex": "is left out: what bends has no frames here.",
    "flexvert": "is left out: what bends has no frames here.",
    "flexstrain": "is left out: what bends has no frames here.",
    "plugin": "is left out: plugins are not loaded.",
    "contact": "is left out: which pairs are allowed to touch is not read.",
}
_ATTRIBUTES = {
    "compiler": ("meshdir", "texturedir", "assetdir", "strippath", "fusestatic", "discardvisual"),
    "material": ("texture",),
    "body": ("fuse",),
    "mesh": ("file", "builtin", "params", "content_type"),
}
_INLINE = ("vertex", "normal", "texcoord", "face")
_NAMES = frozenset(
    (
        *(
            "name",
            "class",
            "childclass",
            "prefix",
            "file",
            "model",
            "mesh",
            "material",
            "body",
            "body1",
            "body2",
        ),
        *("joint", "joint1", "joint2", "jointinparent", "tendon", "tendon1", "tendon2", "geom", "actuator"),
        *("site", "site1", "site2", "sidesite", "refsite", "cranksite", "slidersite", "target"),
    )
)
_NOT_NUMBERS = frozenset(("nan", "+nan", "-nan"))
_LARGE = re.compile(r"e\+?\d\d|\d{40}|0x|inf", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class MeshReference:
    """The file of a mesh as the description names it; empty for shapes that MuJoCo generates."""

    uri: str


def remove_unsupported(
    root: MjcfElement, note: Callable[[MjcfElement, str], None]
) -> dict[MjcfElement, MeshReference]:
    """Take out of a tree what MuJoCo is not given; return the files of meshes.

    Raises
    ------
    FormatError
        For numbers that are none, and models without file.
    """
    meshdir, strips = _directory(root)
    root.children = [child for child in root.children if not _is_left_out(child, _SECTIONS, note)]
    files: dict[MjcfElement, MeshReference] = {}
    for node in root.walk():
        unwanted = _ELEMENTS | _FLEXIBLE if node.tag == "equality" else _ELEMENTS
        node.children = [child for child in node.children if not _is_left_out(child, unwanted, note)]
        if node.tag == "model" and not node.attributes.get("file"):
            node.refuse("names no file.")
        if node.tag == "mesh" and ("file" in node.attributes or "builtin" in node.attributes):
            files[node] = _without_file(node, meshdir, strips)
        for key in _ATTRIBUTES.get(node.tag, ()):
            node.attributes.pop(key, None)
        for key, value in node.attributes.items():
            if key not in _NAMES:
                _check_numbers(node, key, value)
    return files


def _check_numbers(node: MjcfElement, key: str, value: str) -> None:
    if not _NOT_NUMBERS.isdisjoint(value.lower().split()):
        node.refuse(f"{key}={quote(value)} has a NaN, where a number is expected.")
    if key == "count" or not _LARGE.search(value):
        return
    words = value.split()
    if key.endswith("range"):  # the largest numbers may say that there is no limit
        above = not words[0].startswith("-") and _is_large(words[0])
        if above or (words[-1].startswith("-") and _is_large(words[-1])):
            node.refuse(f"{key}={quote(value)} has all of its numbers beyond {LARGEST:g}.")
    # Squares of larger ones overflow inside of MuJoCo.
    elif any(map(_is_large, words)):
        node.refuse(f"{key}={quote(value)} has a number beyond {LARGEST:g}.")


def _is_large(word: str) -> bool:
    try:
        number = float.fromhex(word) if "x" in word.lower() else float(word)
    except OverflowError:
        return True
    except ValueError:  # MuJoCo says so
        return False
    # What is only too long a number MuJoCo refuses itself.
    return abs(number) > LARGEST and (number < math.inf or "inf" in word.lower())


def _is_left_out(
    node: MjcfElement, unwanted: frozenset[str], note: Callable[[MjcfElement, str], None]
) -> bool:
    if node.tag not in unwanted:
        return False
    if node.tag in _TOLD:
        note(node, _TOLD[node.tag])
    return True


def _directory(root: MjcfElement) -> tuple[str, bool]:
    """Return the folder of meshes as the compiler settings say, and whether paths of files do not count."""
    meshdir, strips = "", False
    for node in root.children:
        if node.tag == "compiler":
            meshdir = node.attributes.get("assetdir", meshdir)
            meshdir = node.attributes.get("meshdir", meshdir)
            strips = node.attributes.get("strippath", str(strips)).lower() == "true"
    return meshdir, strips


def _without_file(node: MjcfElement, meshdir: str, strips: bool) -> MeshReference:
    """Put a box in place of what a mesh gets from elsewhere, under the name that the mesh would have."""
    file = node.attributes.get("file", "")
    if strips:
        file = posixpath.basename(file)
    if not node.attributes.get("name") and file:
        node.attributes["name"] = posixpath.splitext(posixpath.basename(file))[0]
    for key in _INLINE:
        node.attributes.pop(key, None)
    node.attributes |= BOX_MESH
    return MeshReference(posixpath.join(meshdir, file) if file else "")


def check_element_count(root: MjcfElement, attached: Mapping[str, int]) -> int:
    """Return how many elements a document has once all is copied that is to be copied.

    Parameters
    ----------
    root
        The document.
    attached
        How many elements its models have, by name.

    Raises
    ------
    FormatError
        If they are more than ``MAX_ELEMENTS``.
    """
    total = 0
    ahead = [(root, 1)]
    while ahead:
        node, copies = ahead.pop()
        if node.tag in ("replicate", "composite"):
            copies *= _count(node)
        total += copies * (1 + attached.get(node.attributes.get("model", ""), 0) * (node.tag == "attach"))
        if total > MAX_ELEMENTS:
            node.refuse(f"makes the model larger than {MAX_ELEMENTS} elements, the most that is read.")
        ahead.extend((child, copies) for child in node.children)
    return total


def _count(node: MjcfElement) -> int:
    product = 1
    for word in node.attributes.get("count", "1").split():
        try:
            product *= max(1, int(float(word[:20])))
        except (ValueError, OverflowError):
            node.refuse(f"count={quote(word)} is no number.")
    return product


MAX_ATTACH_DEPTH = 20
"""How many models may be inside of each other."""


@dataclass(slots=True)
class PreprocessedMjcf:
    """What MuJoCo is given.

    ``models`` are the texts of attached models, by the names that ``text`` and they know each other by. Line
    n of all of them together is ``nodes[n - 1]``. ``files`` are the files of the meshes.
    ``custom`` is what the file says beside that, if it was written here.
    """

    text: str = ""
    models: dict[str, bytes] = field(default_factory=dict)
    nodes: list[MjcfElement] = field(default_factory=list)
    files: dict[MjcfElement, MeshReference] = field(default_factory=dict)
    custom: CustomElements = field(default_factory=CustomElements)

    def node(self, info: str) -> MjcfElement | None:
        """Return the element that MuJoCo says something about, as ``line 5``."""
        number = info.rpartition("line ")[2]
        return self.nodes[int(number) - 1] if number.isdecimal() and int(number) <= len(self.nodes) else None


@dataclass(slots=True)
class _AttachedModel:
    """A file that is attached: its name for MuJoCo, its own name, and how many elements it makes."""

    name: str
    title: str
    size: int


class MjcfPreprocessor:
    """Reads a file and those that it attaches, each of them once."""

    def __init__(
        self,
        top: str,
        root: str,
        note: Callable[[MjcfElement | None, str], None],
        mend: Callable[[str, int, str], None] | None,
    ) -> None:
        self._top, self._root = top, root
        self._note, self._mend = note, mend
        self._known: dict[Path, _AttachedModel] = {}
        self._open: list[Path] = []
        self.prepared = PreprocessedMjcf()

    def run(self, data: str | bytes, source: str) -> PreprocessedMjcf:
        """Return what MuJoCo is given for a document.

        Raises
        ------
        FormatError
            For what is no MJCF, leaves its folder, holds itself, or is too large.
        """
        root = self._read(data, source, self._top)
        self.prepared.custom = read_custom_elements(root, self._note)
        self.prepared.text = self._document(root, self._top)[0]
        return self.prepared

    def _document(self, root: MjcfElement, folder: str) -> tuple[str, _AttachedModel]:
        models: dict[str, int] = {}
        for node in root.walk():
            if node.tag == "model" and "file" in node.attributes:
                model = self._attached(node, folder)
                node.attributes |= {"file": model.name}
                node.attributes.pop("content_type", None)
                models[node.attributes.get("name") or model.title] = model.size
        files = remove_unsupported(root, self._note)
        for node, file in files.items():
            below = Path(os.path.relpath(folder, self._top)) if folder != self._top else Path()
            self.prepared.files[node] = MeshReference((below / file.uri).as_posix() if file.uri else "")
        size = check_element_count(root, models)
        text, nodes = serialize_elements(root, len(self.prepared.nodes) + 1)
        self.prepared.nodes += nodes
        return text, _AttachedModel("", root.attributes.get("model", ""), size)

    def _read(self, data: str | bytes, source: str, folder: str) -> MjcfElement:
        return read_tree(data, source, folder, self._root, self._mend)

    def _attached(self, node: MjcfElement, folder: str) -> _AttachedModel:
        path = find_below_root(node, node.attributes["file"], self._root, folder)
        if path in self._open or len(self._open) >= MAX_ATTACH_DEPTH:
            node.refuse("attaches itself, directly or through others.")
        if path not in self._known:
            self._open.append(path)
            folder = str(path.parent)
            text, model = self._document(self._read(read_file(path), path.name, folder), folder)
            self._open.pop()
            model.name = f"{len(self._known)}.xml"
            self._known[path] = model
            self.prepared.models[model.name] = text.encode()
        return self._known[path]
