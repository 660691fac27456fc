"""Elements to nodes: the models of a document, their parts, and what they include."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from kineverse.errors import FormatError
from kineverse.formats.files import read_file
from kineverse.formats.markup import Element, ElementError, child, name_of, parse, quote
from kineverse.formats.remarks import Remarks

from .inclusion import find_included
from .nodes import Document, Node, Scope, check_name
from .values import attribute_truth, text, text_of, truth

_MOST_NESTED = 100
_OLDEST, _LATEST = (1, 2), (1, 12)
_LEFT_OUT = ("actor", "population", "road", "plugin")


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


_KNOWN = {
    "model": _words(
        "static self_collide allow_auto_disable frame pose link joint plugin gripper include model "
        "model_state enable_wind"
    ),
    "world": _words(
        "name audio wind gravity magnetic_field atmosphere physics scene light frame model actor plugin "
        "joint road spherical_coordinates state population gui include"
    ),
    "link": _words(
        "gravity enable_wind self_collide kinematic must_be_base_link velocity_decay frame pose inertial "
        "collision visual sensor projector audio_sink audio_source battery light particle_emitter"
    ),
    "joint": _words(
        "parent child gearbox_ratio gearbox_reference_body thread_pitch screw_thread_pitch axis axis2 "
        "physics frame pose sensor"
    ),
}


@dataclass
class Parts:
    """Everything that was found, in the order in which it was."""

    nodes: list[Node] = field(default_factory=list)
    placements: list[tuple[Node, Scope, str, Element]] = field(default_factory=list)
    canonical: list[tuple[Node, Scope, str, Element]] = field(default_factory=list)

    def of(self, sort: str) -> Iterator[Node]:
        """Yield the nodes of one sort."""
        return (node for node in self.nodes if node.sort == sort)


def open_document(
    data: str | bytes, source: str, folder: str, remarks: list[str], below: str, strict: bool
) -> tuple[Document, Element]:
    """Return a document and its root element.

    Raises
    ------
    FormatError
        If it is no SDF, or of a version that is not read.
    """
    notes = Remarks(source, remarks, strict)
    try:
        root = parse(data, source, texts=True, mend=None if strict else notes.fault)
    except FormatError as error:
        raise FormatError(f"{error}{_template(data)}") from None
    document = Document(source, folder, _LATEST, notes, below)
    # Up to 1.2, <gazebo> was what it was called.
    if root[0] not in ("sdf", "gazebo"):
        known = {"robot": "a URDF", "mujoco": "an MJCF"}
        guess = f" This is {known[root[0]]}." if root[0] in known else ""
        document.refuse(root, f"is not <sdf>, the root element of an SDF.{guess}")
    said = root[1].get("version")
    match = re.fullmatch(r"(\d{1,3})\.(\d{1,3})(\.\d{1,3})?", (said or "").strip())
    if match is None:
        document.refuse(root, 'does not say its version, as <sdf version="1.10"> does.')
    document.version = int(match[1]), int(match[2])
    if not _OLDEST <= document.version <= _LATEST:
        document.refuse(root, f"version={quote(said or '')} is not one that is read; 1.2 to 1.12 are.")
    return document, root


def _template(data: str | bytes) -> str:
    marks = ("<%", "{%") if isinstance(data, str) else (b"<%", b"{%")
    if any(mark in data for mark in marks):  # type: ignore[operator]  # of the same type
        return " This is a template that was not expanded: erb model.sdf.erb > model.sdf"
    return ""


class Reader:
    """Reads models into nodes, and those that they include."""

    def __init__(self, parts: Parts, remarks: list[str], below: str, strict: bool):
        self._parts = parts
        self._remarks = remarks
        self._below, self._strict = below, strict
        self._open: list[Path] = []

    def world(self, element: Element, scope: Scope) -> None:
        """Read what is in a world."""
        self._inside(element, scope)

    def included(self, element: Element, scope: Scope) -> None:
        """Read a model that the file only includes."""
        self._include(element, scope)

    def model(self, element: Element, outer: Scope, alone: bool = False) -> Node:
        """Read a model into the scope around it; one that is alone in its file gives its names no prefix."""
        document = outer.document
        with document.about(element):
            name = name_of(element)
            check_name(name, element, document.version)
        return self._model(element, outer, document, name, None if not alone else outer.path)

    def _model(
        self,
        element: Element,
        outer: Scope,
        document: Document,
        name: str,
        path: str | None = None,
        include: Element | None = None,
    ) -> Node:
        node = self._add("model", element, outer, name)
        node.shown = path is None
        scope = Scope(node.path if path is None else path, document, outer, outer.static, node)
        outer.inner[name] = scope
        outer.models.append(node)
        self._fill(node, scope, element, outer, include)
        return node

    def _fill(
        self, node: Node, scope: Scope, element: Element, outer: Scope, include: Element | None
    ) -> None:
        """Read the inside of a model, of which an include may say where it stands and whether it moves."""
        if scope.path.count("/") > _MOST_NESTED:
            scope.document.refuse(element, f"models are nested more than {_MOST_NESTED} deep.")
        said = element if include is None or child(include, "static") is None else include
        with (scope.document if said is element else outer.document).about(said):
            static = outer.static or truth(said, "static")
        scope.static = static
        placed_by = element if include is None or child(include, "pose") is None else include
        frame = text(include, "placement_frame") if include is not None else ""
        if frame and placed_by is element:
            assert include is not None
            outer.document.refuse(include, "has a <placement_frame> but no <pose> that it would be for.")
        frame = frame or element[1].get("placement_frame", "")
        node.said, node.said_in = child(placed_by, "pose"), outer
        if frame:
            self._parts.placements.append((node, scope, frame, element))
        self._inside(element, scope)
        self._parts.canonical.append((node, scope, element[1].get("canonical_link", ""), element))

    def _inside(self, element: Element, scope: Scope) -> None:
        document = scope.document
        kind = "world" if element[0] == "world" else "model"
        parts: dict[str, list[Element]] = {tag: [] for tag in ("link", "model", "include", "joint", "frame")}
        for part in element[2]:
            tag = part[0]
            if tag in parts:
                parts[tag].append(part)
            else:
                self._note(part, element, document, kind)
        if scope.model.sort == "world" and parts["link"]:
            document.refuse(parts["link"][0], "is in no model; links are parts of models.")
        for part in parts["link"]:
            node = self._add("link", part, scope, self._name(part, document))
            scope.links.append(node)
            for inner in part[2]:
                self._note(inner, part, document, "link")
        for part in parts["model"]:
            self.model(part, scope)
        for part in parts["include"]:
            self._include(part, scope)
        for part in parts["joint"]:
            node = self._add("joint", part, scope, self._name(part, document))
            for inner in part[2]:
                self._note(inner, part, document, "joint")
        for part in parts["frame"]:
            self._add("frame", part, scope, self._name(part, document))

    def _note(self, part: Element, owner: Element, document: Document, kind: str) -> None:
        tag = part[0]
        if tag.startswith("xacro:"):
            document.refuse(part, "is xacro that was not expanded; expand it first: xacro in.sdf > out.sdf")
        if kind == "world" and tag in _LEFT_OUT:
            document.remarks.add(part, "is left out.", owner)
        elif tag not in _KNOWN[kind]:
            document.remarks.add(part, "is left out: the specification does not know it.", owner)

    def _name(self, element: Element, document: Document) -> str:
        with document.about(element):
            name = name_of(element)
            check_name(name, element, document.version)
        return name

    def _add(self, sort: str, element: Element, scope: Scope, name: str) -> Node:
        other = scope.names.get(name)
        if other is not None:
            again = f"has the name of the <{other.element[0]}> on line {other.element[3]} again"
            if other.sort == sort or scope.document.version >= (1, 7):
                scope.document.refuse(
                    element, f"{again}; names are unique in their scope. Rename one of them."
                )
            old, name = name, f"{name}_{sort}"
            while name in scope.names:
                name += "_"
            scope.document.remarks.add(element, f"{again}; {quote(old)} is called {quote(name)} here.")
        said = child(element, "pose")
        node = Node(sort, scope.below(name), scope, element, said, scope)  # type: ignore[arg-type]  # a sort
        scope.names[name] = node
        self._parts.nodes.append(node)
        return node

    def _include(self, include: Element, scope: Scope) -> None:
        document = scope.document
        part = child(include, "uri")
        with document.about(include):
            if part is None or not text_of(part):
                raise ElementError(include, "has no <uri>; the specification requires it.")
            merge = attribute_truth(include, "merge")
            try:
                path = find_included(text_of(part), document.folder, self._below).resolve()
            except FormatError as error:
                raise ElementError(part, str(error)) from None
            if path in self._open or len(self._open) >= _MOST_NESTED:
                raise ElementError(
                    part, f"{quote(text_of(part))} includes itself, directly or through others."
                )
            if path.suffix == ".urdf":
                raise ElementError(part, f"{quote(text_of(part))} is a URDF; load it by itself.")
        content, folder = read_file(path), str(path.parent)
        inner, root = open_document(content, path.name, folder, self._remarks, self._below, self._strict)
        models = [element for element in root[2] if element[0] == "model"]
        if len(models) != 1 and not models:
            strangers = [element for element in root[2] if element[0] in ("light", "actor")]
            if strangers:
                document.remarks.add(include, f"is left out: it is a <{strangers[0][0]}>.")
                return
        if len(models) != 1:
            inner.refuse(root, f"is included, and has {len(models)} models where one is expected.")
        with inner.about(models[0]):
            own = name_of(models[0])
        name = text(include, "name") or own
        with document.about(include):
            check_name(name, include, document.version)
        self._open.append(path)
        if merge and scope.model.sort == "world" and any(part[0] == "link" for part in models[0][2]):
            with document.about(include):
                mistake = ElementError(include, "has merge, and a world has no links as that model has.")
                document.remarks.mend(mistake, "it is a model of its own")
            merge = False
        if merge:
            proxy = self._add("frame", models[0], scope, f"_merged__{name}__model__")
            shared = Scope(scope.path, inner, scope.outer, scope.static, proxy)
            shared.names, shared.inner = scope.names, scope.inner
            proxy.shown = False
            self._fill(proxy, shared, models[0], scope, include)
            scope.links += shared.links
            scope.models += shared.models
        else:
            self._model(models[0], scope, inner, name, include=include)
        self._open.pop()


def root_scope(document: Document, element: Element) -> Scope:
    """Return the scope of the world."""
    scope = Scope("", document)
    scope.model = Node("world", "", scope, element)
    return scope
