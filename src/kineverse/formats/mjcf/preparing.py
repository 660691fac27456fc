"""All documents of a model as text for MuJoCo: the file, and the models that it attaches."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from kineverse.formats.files import read_file

from .custom import Custom, custom_of
from .rewriting import written
from .screening import MeshFile, check_size, screen
from .tree import Node, find_below, read_tree

DEEPEST = 20
"""How many models may be inside of each other."""


@dataclass(slots=True)
class Prepared:
    """What MuJoCo is given.

    ``models`` are the texts of attached models, by the names that ``text`` and they know each other by. Line
    n of all of them together is ``nodes[n - 1]``. ``files`` are the files of the meshes.
    ``custom`` is what the file says beside that, if it was written here.
    """

    text: str = ""
    models: dict[str, bytes] = field(default_factory=dict)
    nodes: list[Node] = field(default_factory=list)
    files: dict[Node, MeshFile] = field(default_factory=dict)
    custom: Custom = field(default_factory=Custom)

    def node(self, info: str) -> Node | None:
        """Return the element that MuJoCo says something about, as ``line 5``."""
        number = info.rpartition("line ")[2]
        return self.nodes[int(number) - 1] if number.isdecimal() and int(number) <= len(self.nodes) else None


@dataclass(slots=True)
class _Model:
    """A file that is attached: its name for MuJoCo, its own name, and how many elements it makes."""

    name: str
    title: str
    size: int


class Preparation:
    """Reads a file and those that it attaches, each of them once."""

    def __init__(
        self,
        top: str,
        root: str,
        note: Callable[[Node | None, str], None],
        mend: Callable[[str, int, str], None] | None,
    ) -> None:
        self._top, self._root = top, root
        self._note, self._mend = note, mend
        self._known: dict[Path, _Model] = {}
        self._open: list[Path] = []
        self.prepared = Prepared()

    def run(self, data: str | bytes, source: str) -> Prepared:
        """Return what MuJoCo is given for a document.

        Raises
        ------
        FormatError
            For what is no MJCF, leaves its folder, holds itself, or is too large.
        """
        root = self._read(data, source, self._top)
        self.prepared.custom = custom_of(root, self._note)
        self.prepared.text = self._document(root, self._top)[0]
        return self.prepared

    def _document(self, root: Node, folder: str) -> tuple[str, _Model]:
        models: dict[str, int] = {}
        for node in root.walk():
            if node.tag == "model" and "file" in node.attributes:
                model = self._attached(node, folder)
                node.attributes |= {"file": model.name}
                node.attributes.pop("content_type", None)
                models[node.attributes.get("name") or model.title] = model.size
        files = screen(root, self._note)
        for node, file in files.items():
            below = Path(os.path.relpath(folder, self._top)) if folder != self._top else Path()
            self.prepared.files[node] = MeshFile((below / file.uri).as_posix() if file.uri else "")
        size = check_size(root, models)
        text, nodes = written(root, len(self.prepared.nodes) + 1)
        self.prepared.nodes += nodes
        return text, _Model("", root.attributes.get("model", ""), size)

    def _read(self, data: str | bytes, source: str, folder: str) -> Node:
        return read_tree(data, source, folder, self._root, self._mend)

    def _attached(self, node: Node, folder: str) -> _Model:
        path = find_below(node, node.attributes["file"], self._root, folder)
        if path in self._open or len(self._open) >= DEEPEST:
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
