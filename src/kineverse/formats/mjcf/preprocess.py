"""Preprocessing of MJCF: attached models gathered, files, plugins and unsupported elements removed.

None of these affects the poses of bodies. Meshes of files and of plugins are replaced by boxes, see
:mod:`.meshes`, and height fields by flat ones, which have the same mass.
"""

from __future__ import annotations

import math
import os
import posixpath
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from kineverse.formats.files import read_file
from kineverse.formats.xml_reader import quote
from kineverse.formats.xml_values import LARGEST

from .custom_elements import CustomElements, read_custom_elements
from .elements import MjcfElement, find_below_root, read_tree, serialize_elements

MAX_ELEMENTS = 30_000  # largest number of elements of a document after <replicate> and <attach>

BOX_MESH = {
    "vertex": "-1 -2 -3  1 -2 -3  -1 2 -3  1 2 -3  -1 -2 3  1 -2 3  -1 2 3  1 2 3",
    "face": "0 2 1 1 2 3 4 5 6 5 7 6 0 1 4 1 5 4 2 6 3 3 6 7 0 4 2 2 4 6 1 3 5 3 7 5",
}
"""Box in place of the triangles of mesh files."""

_SECTIONS = frozenset(
    ("size", "visual", "statistic", "custom", "sensor", "extension", "contact", "deformable")
)
_ELEMENTS = frozenset(("plugin", "flexcomp", "skin", "texture", "light", "camera", "layer"))
_FLEXIBLE = frozenset(("flex", "flexvert", "flexstrain"))
_REMARKS = {
    **dict.fromkeys(("deformable", "flexcomp", *_FLEXIBLE), "is left out: what bends has no frames here."),
    "plugin": "is left out: plugins are not loaded.",
    "contact": "is left out: which pairs are allowed to touch is not read.",
}
_ATTRIBUTES = {
    "compiler": ("meshdir", "texturedir", "assetdir", "strippath", "fusestatic", "discardvisual"),
    "material": ("texture",),
    "body": ("fuse",),
    "mesh": ("file", "content_type"),
    "hfield": ("file", "content_type", "elevation"),
}
_CONTROL = frozenset(("actuator", "keyframe"))
_MAX_RESOLUTION = 200  # largest parameter of a mesh of MuJoCo, which has its square of triangles

_INLINE = ("vertex", "normal", "texcoord", "face")
_NAMES = frozenset(
    (
        *("name", "class", "childclass", "prefix", "file", "model", "mesh", "material"),
        *("body", "body1", "body2"),
        *("joint", "joint1", "joint2", "jointinparent", "tendon", "tendon1", "tendon2", "geom", "actuator"),
        *("site", "site1", "site2", "sidesite", "refsite", "cranksite", "slidersite", "target"),
    )
)
_NOT_NUMBERS = frozenset(("nan", "+nan", "-nan"))
_LARGE = re.compile(r"e\+?\d\d|\d{40}|0x|inf", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class MeshReference:
    """Reference of a mesh to its file, or to the plugin that makes it: its name and its settings."""

    uri: str = ""
    plugin: str = ""
    settings: tuple[tuple[str, str], ...] = ()


def remove_unsupported(
    root: MjcfElement, remark: Callable[[MjcfElement, str], None]
) -> dict[MjcfElement, MeshReference]:
    """Remove unsupported elements and attributes from a tree; return the files of its meshes."""
    meshdir, strip_paths = _mesh_directory(root)
    plugins = _plugin_instances(root)
    root.children = [child for child in root.children if not _is_removed(child, _SECTIONS, remark)]
    files: dict[MjcfElement, MeshReference] = {}
    for node in root.walk():
        if node.tag == "mesh":
            _replace_mesh(node, meshdir, strip_paths, plugins, files)
        elif node.tag == "hfield":
            _flatten(node)
        unwanted = _ELEMENTS | _FLEXIBLE if node.tag == "equality" else _ELEMENTS
        if node.tag in ("mesh", "geom"):  # what a plugin makes of these is in the files of the meshes
            node.children = [child for child in node.children if child.tag != "plugin"]
        node.children = [child for child in node.children if not _is_removed(child, unwanted, remark)]
        if node.tag == "model" and not node.attributes.get("file"):
            node.refuse("names no file.")
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
    if key.endswith("range"):  # very large numbers at one end mean no limit
        above = not words[0].startswith("-") and _is_large(words[0])
        if above or (words[-1].startswith("-") and _is_large(words[-1])):
            node.refuse(f"{key}={quote(value)} has all of its numbers beyond {LARGEST:g}.")
    # Squares of larger numbers overflow in MuJoCo.
    elif any(map(_is_large, words)):
        node.refuse(f"{key}={quote(value)} has a number beyond {LARGEST:g}.")


def _is_large(word: str) -> bool:
    try:
        number = float.fromhex(word) if "x" in word.lower() else float(word)
    except OverflowError:
        return True
    except ValueError:  # MuJoCo reports it
        return False
    # MuJoCo itself refuses numbers with too many digits.
    return abs(number) > LARGEST and (number < math.inf or "inf" in word.lower())


def _is_removed(
    node: MjcfElement, unwanted: frozenset[str], remark: Callable[[MjcfElement, str], None]
) -> bool:
    if node.tag not in unwanted:
        return False
    if node.tag in _REMARKS:
        remark(node, _REMARKS[node.tag])
    return True


def _mesh_directory(root: MjcfElement) -> tuple[str, bool]:
    meshdir, strip_paths = "", False
    for node in root.children:
        if node.tag == "compiler":
            meshdir = node.attributes.get("meshdir", node.attributes.get("assetdir", meshdir))
            strip_paths = node.attributes.get("strippath", str(strip_paths)).lower() == "true"
    return meshdir, strip_paths


def _plugin_instances(root: MjcfElement) -> dict[str, MeshReference]:
    plugins = [plugin for part in root.children if part.tag == "extension" for plugin in part.children]
    return {
        instance.attributes.get("name", ""): _plugin_reference(plugin.attributes.get("plugin", ""), instance)
        for plugin in plugins
        for instance in plugin.children
    }


def _plugin_reference(plugin: str, owner: MjcfElement) -> MeshReference:
    settings = [(c.attributes.get("key", ""), c.attributes.get("value", "")) for c in owner.children]
    return MeshReference("", plugin, tuple(settings))


def _replace_mesh(
    node: MjcfElement,
    meshdir: str,
    strip_paths: bool,
    plugins: Mapping[str, MeshReference],
    files: dict[MjcfElement, MeshReference],
) -> None:
    """Replace a mesh by a box under the same name if it is in a file or made by a plugin."""
    file = node.attributes.get("file", "")
    made_by = next((child for child in node.children if child.tag == "plugin"), None)
    if file:
        if strip_paths:
            file = posixpath.basename(file)
        if not node.attributes.get("name"):
            node.attributes["name"] = posixpath.splitext(posixpath.basename(file))[0]
        files[node] = MeshReference(posixpath.join(meshdir, file))
    elif made_by is not None:
        plugin = _plugin_reference(made_by.attributes.get("plugin", ""), made_by)
        files[node] = plugins.get(made_by.attributes.get("instance", ""), plugin)
    elif "builtin" not in node.attributes or _is_small(node.attributes.get("params", "")):
        return
    else:
        files[node] = MeshReference()
    for key in (*_INLINE, "builtin", "params"):
        node.attributes.pop(key, None)
    node.attributes |= BOX_MESH


def _is_small(params: str) -> bool:
    try:
        return all(float(word) <= _MAX_RESOLUTION for word in params.split())
    except ValueError:  # MuJoCo reports it
        return True


def _flatten(node: MjcfElement) -> None:
    """Replace the heights of a height field, which do not affect its mass, by zeros."""
    if not node.attributes.get("name") and node.attributes.get("file"):
        node.attributes["name"] = posixpath.splitext(posixpath.basename(node.attributes["file"]))[0]
    node.attributes |= {"nrow": "2", "ncol": "2"}


def check_element_count(root: MjcfElement, attached: Mapping[str, int]) -> int:
    """Return the number of elements of a document after all replications and attachments."""
    total = 0
    stack = [(root, 1)]
    while stack:
        node, copies = stack.pop()
        if node.tag in ("replicate", "composite"):
            copies *= _count(node)
        total += copies * (1 + attached.get(node.attributes.get("model", ""), 0) * (node.tag == "attach"))
        if total > MAX_ELEMENTS:
            node.refuse(f"makes the model larger than {MAX_ELEMENTS} elements, the most that is read.")
        stack.extend((child, copies) for child in node.children)
    return total


def _count(node: MjcfElement) -> int:
    product = 1
    for word in node.attributes.get("count", "1").split():
        try:
            product *= max(1, int(float(word[:20])))
        except (ValueError, OverflowError):
            node.refuse(f"count={quote(word)} is no number.")
    return product


MAX_ATTACH_DEPTH = 20  # deepest nesting of attached models


@dataclass(slots=True)
class PreprocessedMjcf:
    """Input of MuJoCo's parser."""

    text: str = ""
    models: dict[str, bytes] = field(default_factory=dict)
    passive_text: str = ""  # same without actuators and keys, with all elements on the same lines
    passive_models: dict[str, bytes] = field(default_factory=dict)
    nodes: list[MjcfElement] = field(default_factory=list)  # elements by line
    files: dict[MjcfElement, MeshReference] = field(default_factory=dict)  # files of the meshes
    custom: CustomElements = field(default_factory=CustomElements)  # data of the custom elements

    def node(self, info: str) -> MjcfElement | None:
        """Return the element of a line in a message of MuJoCo, such as ``line 5``; None if there is none."""
        number = info.rpartition("line ")[2]
        return self.nodes[int(number) - 1] if number.isdecimal() and int(number) <= len(self.nodes) else None


@dataclass(slots=True)
class _AttachedModel:
    """Attached file: its name in the texts for MuJoCo, its model's name, and its number of elements."""

    name: str
    title: str
    size: int


class MjcfPreprocessor:
    """Preprocessor of a file and of those that it attaches, each read once."""

    def __init__(
        self,
        top: str,
        root: str,
        remark: Callable[[MjcfElement | None, str], None],
        on_recoverable_error: Callable[[str, int, str], None] | None,
    ) -> None:
        self._top, self._root = top, root
        self._remark, self._on_recoverable_error = remark, on_recoverable_error
        self._models: dict[Path, _AttachedModel] = {}
        self._open_files: list[Path] = []
        self.prepared = PreprocessedMjcf()

    def run(self, data: str | bytes, source: str) -> PreprocessedMjcf:
        """Preprocess a document."""
        root = self._read(data, source, self._top)
        self.prepared.custom = read_custom_elements(root, self._remark)
        self.prepared.text, self.prepared.passive_text, _ = self._preprocess(root, self._top)
        return self.prepared

    def _preprocess(self, root: MjcfElement, folder: str) -> tuple[str, str, _AttachedModel]:
        """Return the texts of a document for MuJoCo, and its size; attached models come first."""
        models: dict[str, int] = {}
        for node in root.walk():
            if node.tag == "model" and "file" in node.attributes:
                model = self._attached_model(node, folder)
                node.attributes |= {"file": model.name}
                node.attributes.pop("content_type", None)
                models[node.attributes.get("name") or model.title] = model.size
        files = remove_unsupported(root, self._remark)
        for node, file in files.items():
            below = Path(os.path.relpath(folder, self._top)) if folder != self._top else Path()
            self.prepared.files[node] = replace(file, uri=(below / file.uri).as_posix() if file.uri else "")
        size = check_element_count(root, models)
        first = len(self.prepared.nodes) + 1
        text, nodes = serialize_elements(root, first)
        passive_text, _ = serialize_elements(root, first, _CONTROL)
        self.prepared.nodes += nodes
        return text, passive_text, _AttachedModel("", root.attributes.get("model", ""), size)

    def _read(self, data: str | bytes, source: str, folder: str) -> MjcfElement:
        return read_tree(data, source, folder, self._root, self._on_recoverable_error)

    def _attached_model(self, node: MjcfElement, folder: str) -> _AttachedModel:
        path = find_below_root(node, node.attributes["file"], self._root, folder)
        if path in self._open_files or len(self._open_files) >= MAX_ATTACH_DEPTH:
            node.refuse("attaches itself, directly or through others.")
        if path not in self._models:
            self._open_files.append(path)
            folder = str(path.parent)
            tree = self._read(read_file(path), path.name, folder)
            text, passive_text, model = self._preprocess(tree, folder)
            self._open_files.pop()
            model.name = f"{len(self._models)}.xml"
            self._models[path] = model
            self.prepared.models[model.name] = text.encode()
            self.prepared.passive_models[model.name] = passive_text.encode()
        return self._models[path]
