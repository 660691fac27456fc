"""SDF files and text as checked descriptions.

Specification: http://sdformat.org/spec, and its pages on poses, frames and the composition of models;
``docs/sdf.md`` lists what is read how.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NoReturn

from kineverse.errors import FormatError
from kineverse.formats.files import read_file
from kineverse.formats.mimic import MimicRelation, resolve_mimic_chains
from kineverse.formats.reader_warnings import ReaderWarnings
from kineverse.formats.root_folder import find_text_root
from kineverse.formats.xml_reader import Element, ElementError, find_child, parse_xml, quote, read_name
from kineverse.formats.xml_values import read_attribute_bool, read_child_bool, read_child_text, read_text

from .bodies import read_sdf_body
from .description import WORLD, SdfFrame, SdfJoint, SdfLink, SdfScene
from .gearbox import resolve_gearboxes
from .include import find_included
from .joints import read_sdf_joint
from .pose_graph import (
    PoseGraph,
    PoseNode,
    SdfDocument,
    SdfScope,
    check_sdf_name,
    find_carriers,
    pose_between,
    resolve_pose_graph,
)
from .tree import build_spanning_tree

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


def open_document(
    data: str | bytes, source: str, folder: str, remarks: list[str], below: str, strict: bool
) -> tuple[SdfDocument, Element]:
    """Return a document and its root element.

    Raises
    ------
    FormatError
        If it is no SDF, or of a version that is not read.
    """
    notes = ReaderWarnings(source, remarks, strict)
    try:
        root = parse_xml(data, source, texts=True, mend=None if strict else notes.fault)
    except FormatError as error:
        raise FormatError(f"{error}{_template(data)}") from None
    document = SdfDocument(source, folder, _LATEST, notes, below)
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


class SdfModelReader:
    """Reads models into nodes, and those that they include."""

    def __init__(self, parts: PoseGraph, remarks: list[str], below: str, strict: bool):
        self._parts = parts
        self._remarks = remarks
        self._below, self._strict = below, strict
        self._open: list[Path] = []

    def world(self, element: Element, scope: SdfScope) -> None:
        """Read what is in a world."""
        self._inside(element, scope)

    def included(self, element: Element, scope: SdfScope) -> None:
        """Read a model that the file only includes."""
        self._include(element, scope)

    def model(self, element: Element, outer: SdfScope, alone: bool = False) -> PoseNode:
        """Read a model into the scope around it; one that is alone in its file gives its names no prefix."""
        document = outer.document
        with document.about(element):
            name = read_name(element)
            check_sdf_name(name, element, document.version)
        return self._model(element, outer, document, name, None if not alone else outer.path)

    def _model(
        self,
        element: Element,
        outer: SdfScope,
        document: SdfDocument,
        name: str,
        path: str | None = None,
        include: Element | None = None,
    ) -> PoseNode:
        node = self._add("model", element, outer, name)
        node.shown = path is None
        scope = SdfScope(node.path if path is None else path, document, outer, outer.static, node)
        outer.inner[name] = scope
        outer.models.append(node)
        self._fill(node, scope, element, outer, include)
        return node

    def _fill(
        self, node: PoseNode, scope: SdfScope, element: Element, outer: SdfScope, include: Element | None
    ) -> None:
        """Read the inside of a model, of which an include may say where it stands and whether it moves."""
        if scope.path.count("/") > _MOST_NESTED:
            scope.document.refuse(element, f"models are nested more than {_MOST_NESTED} deep.")
        said = element if include is None or find_child(include, "static") is None else include
        with (scope.document if said is element else outer.document).about(said):
            static = outer.static or read_child_bool(said, "static")
        scope.static = static
        placed_by = element if include is None or find_child(include, "pose") is None else include
        frame = read_child_text(include, "placement_frame") if include is not None else ""
        if frame and placed_by is element:
            assert include is not None
            outer.document.refuse(include, "has a <placement_frame> but no <pose> that it would be for.")
        frame = frame or element[1].get("placement_frame", "")
        node.said, node.said_in = find_child(placed_by, "pose"), outer
        if frame:
            self._parts.placements.append((node, scope, frame, element))
        self._inside(element, scope)
        self._parts.canonical.append((node, scope, element[1].get("canonical_link", ""), element))

    def _inside(self, element: Element, scope: SdfScope) -> None:
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

    def _note(self, part: Element, owner: Element, document: SdfDocument, kind: str) -> None:
        tag = part[0]
        if tag.startswith("xacro:"):
            document.refuse(part, "is xacro that was not expanded; expand it first: xacro in.sdf > out.sdf")
        if kind == "world" and tag in _LEFT_OUT:
            document.remarks.add(part, "is left out.", owner)
        elif tag not in _KNOWN[kind]:
            document.remarks.add(part, "is left out: the specification does not know it.", owner)

    def _name(self, element: Element, document: SdfDocument) -> str:
        with document.about(element):
            name = read_name(element)
            check_sdf_name(name, element, document.version)
        return name

    def _add(self, sort: str, element: Element, scope: SdfScope, name: str) -> PoseNode:
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
        said = find_child(element, "pose")
        node = PoseNode(sort, scope.below(name), scope, element, said, scope)  # type: ignore[arg-type]  # a sort
        scope.names[name] = node
        self._parts.nodes.append(node)
        return node

    def _include(self, include: Element, scope: SdfScope) -> None:
        document = scope.document
        part = find_child(include, "uri")
        with document.about(include):
            if part is None or not read_text(part):
                raise ElementError(include, "has no <uri>; the specification requires it.")
            merge = read_attribute_bool(include, "merge")
            try:
                path = find_included(read_text(part), document.folder, self._below).resolve()
            except FormatError as error:
                raise ElementError(part, str(error)) from None
            if path in self._open or len(self._open) >= _MOST_NESTED:
                raise ElementError(
                    part, f"{quote(read_text(part))} includes itself, directly or through others."
                )
            if path.suffix == ".urdf":
                raise ElementError(part, f"{quote(read_text(part))} is a URDF; load it by itself.")
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
            own = read_name(models[0])
        name = read_child_text(include, "name") or own
        with document.about(include):
            check_sdf_name(name, include, document.version)
        self._open.append(path)
        if merge and scope.model.sort == "world" and any(part[0] == "link" for part in models[0][2]):
            with document.about(include):
                mistake = ElementError(include, "has merge, and a world has no links as that model has.")
                document.remarks.mend(mistake, "it is a model of its own")
            merge = False
        if merge:
            proxy = self._add("frame", models[0], scope, f"_merged__{name}__model__")
            shared = SdfScope(scope.path, inner, scope.outer, scope.static, proxy)
            shared.names, shared.inner = scope.names, scope.inner
            proxy.shown = False
            self._fill(proxy, shared, models[0], scope, include)
            scope.links += shared.links
            scope.models += shared.models
        else:
            self._model(models[0], scope, inner, name, include=include)
        self._open.pop()


def make_root_scope(document: SdfDocument, element: Element) -> SdfScope:
    """Return the scope of the world."""
    scope = SdfScope("", document)
    scope.model = PoseNode("world", "", scope, element)
    return scope


def read_sdf(
    path: str | os.PathLike[str], root: str | os.PathLike[str] | None = None, strict: bool = False
) -> SdfScene:
    """Read an SDF file, and the files that it includes; see :func:`parse_sdf`.

    Raises
    ------
    FormatError
        If a file cannot be read or is not a valid SDF; the message names file, line, element and reason.
    """
    path = Path(path)
    return parse_sdf(read_file(path), path.name, str(path.absolute().parent), root, strict)


def parse_sdf(
    text: str | bytes,
    source: str = "<sdf>",
    folder: str = "",
    root: str | os.PathLike[str] | None = None,
    strict: bool = False,
) -> SdfScene:
    """Read an SDF from text.

    Parameters
    ----------
    text
        The document.
    source
        Its name in error messages.
    folder
        The folder from which meshes and included models are found.
    root
        The folder that they do not leave; None for that which :func:`kineverse.formats.root_folder.find_root` finds.
    strict
        Whether mistakes that others read past are refused, rather than remarked on.

    Raises
    ------
    FormatError
        If it is not a valid SDF; the message names source, line, element and reason.
    """
    remarks: list[str] = []
    below = find_text_root(folder, root)
    document, top = open_document(text, source, folder, remarks, below, strict)
    parts = PoseGraph()
    scope = make_root_scope(document, top)
    standing = _read(document, top, SdfModelReader(parts, remarks, below, strict), scope)
    resolve_pose_graph(parts)
    over = find_carriers(parts.nodes, scope.model)
    return _scene(parts, over, standing, document, remarks)


def _read(document: SdfDocument, root: Element, reader: SdfModelReader, scope: SdfScope) -> list[PoseNode]:
    """Read everything into nodes; return the models that stand where they are although nothing holds them."""
    worlds = [element for element in root[2] if element[0] == "world"]
    models = [element for element in root[2] if element[0] in ("model", "include")]
    for element in root[2]:
        if element[0].startswith("xacro:"):
            document.refuse(
                element, "is xacro that was not expanded; expand it first: xacro in.sdf > out.sdf"
            )
        if element[0] not in ("world", "model", "include"):
            document.remarks.add(element, "is left out.")
    if worlds:
        for element in (*worlds[1:], *models):
            document.remarks.add(element, "is left out: the first world of the file is the one that is read.")
        reader.world(worlds[0], scope)
        return []
    if not models:
        document.refuse(root, "has neither a model nor a world.")
    for element in models:
        if element[0] == "include":
            reader.included(element, scope)
        else:
            reader.model(element, scope, alone=len(models) == 1)
    return scope.models


def _scene(
    parts: PoseGraph,
    over: dict[PoseNode, PoseNode],
    standing: Sequence[PoseNode],
    document: SdfDocument,
    remarks: list[str],
) -> SdfScene:
    links = tuple(_link(node) for node in parts.of("link"))
    hinges = resolve_gearboxes([read_sdf_joint(node, over) for node in parts.of("joint")], over)
    nodes = {hinge.joint.name: hinge.node for hinge in hinges}

    def note(joint: SdfJoint, text: str) -> None:
        node = nodes[joint.name]
        node.document.remarks.add(node.element, text)

    joints = _resolve_mimic_chains([hinge.joint for hinge in hinges], nodes)
    roots, ordered, loops = build_spanning_tree(links, joints, [over[model].path for model in standing], note)
    _check_leaders((*ordered, *loops), nodes)
    frames = tuple(
        SdfFrame(
            node.path,
            over[node].path or WORLD,
            pose_between(over[node], node),
            node.element[3],
            node.document.source,
        )
        for node in parts.nodes
        if node.shown and node.sort in ("frame", "model")
    )
    return SdfScene(links, frames, roots, ordered, loops, document.source, tuple(remarks))


def _check_leaders(joints: Sequence[SdfJoint], nodes: dict[str, PoseNode]) -> None:
    """Look whether what joints follow is there: not among those that were left out."""
    moving = {joint.name + axis.suffix for joint in joints for axis in joint.axes}
    for joint in joints:
        for following in (joint.gear, *(axis.following for axis in joint.axes)):
            if following is not None and following.leader not in moving:
                nodes[joint.name].refuse(
                    f"it follows {quote(following.leader)}, which cannot move: the links that it connects "
                    "are held together anyway."
                )


def _link(node: PoseNode) -> SdfLink:
    assert node.place is not None
    static, document = node.scope.static, node.document
    return SdfLink(node.path, read_sdf_body(node), node.place, static, node.element[3], document.source)


def _resolve_mimic_chains(joints: list[SdfJoint], nodes: dict[str, PoseNode]) -> list[SdfJoint]:
    """Return the joints with what they follow at the ends of the chains."""
    following: dict[str, MimicRelation[str]] = {}
    owner: dict[str, str] = {}
    for joint in joints:
        for axis in joint.axes:
            owner[joint.name + axis.suffix] = joint.name
            if axis.following is not None:
                following[joint.name + axis.suffix] = axis.following
        if joint.gear is not None:
            following[joint.name] = joint.gear
    if not following:
        return joints

    def refuse(coordinate: str, reason: str) -> NoReturn:
        node = nodes[owner[coordinate]]
        node.refuse(reason)

    ends = resolve_mimic_chains(following, refuse)
    result = []
    for joint in joints:
        if any(joint.name + axis.suffix in following for axis in joint.axes):
            axes = tuple(replace(axis, following=ends.get(joint.name + axis.suffix)) for axis in joint.axes)
            gear = joint.gear and ends[joint.name]
            joint = replace(joint, axes=axes, gear=gear)
        result.append(joint)
    return result
