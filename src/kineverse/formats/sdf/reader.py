"""SDF files and text as checked descriptions.

Specification: http://sdformat.org/spec, and its pages on poses, frames and the composition of models.
``docs/sdf.md`` lists the supported elements.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from kineverse.errors import FormatError
from kineverse.formats.files import MAX_BYTES, read_file
from kineverse.formats.mimic import MimicRelation, resolve_mimic_chains
from kineverse.formats.reader_warnings import ReaderWarnings
from kineverse.formats.root_folder import find_text_root
from kineverse.formats.xml_reader import Element, ElementError, find_child, parse_xml, quote, read_name
from kineverse.formats.xml_values import read_attribute_bool, read_child_bool, read_child_text, read_text

from .bodies import read_sdf_body
from .custom_attributes import FREE, HOME, NAME, read_given_name, read_values
from .description import WORLD, SdfFrame, SdfJoint, SdfLink, SdfScene
from .include import find_included, read_urdf_as_sdf
from .joints import build_spanning_tree, read_sdf_joint, resolve_gearboxes
from .pose_graph import (
    NodeKind,
    PoseGraph,
    PoseNode,
    SdfDocument,
    SdfScope,
    check_sdf_name,
    pose_between,
    resolve_attachments,
    resolve_pose_graph,
)

_MAX_DEPTH = 100
MAX_INCLUDED = 100_000  # largest number of links, joints, frames and models with those of included files

_OLDEST, _LATEST = (1, 2), (1, 12)
_IGNORED = ("actor", "population", "road", "plugin")


_ELEMENTS = {
    "model": """static self_collide allow_auto_disable frame pose link joint plugin gripper include model
        model_state enable_wind""",
    "world": """name audio wind gravity magnetic_field atmosphere physics scene light frame model actor plugin
        joint road spherical_coordinates state population gui include""",
    "link": """gravity enable_wind self_collide kinematic must_be_base_link velocity_decay frame pose inertial
        collision visual sensor projector audio_sink audio_source battery light particle_emitter""",
    "joint": """parent child gearbox_ratio gearbox_reference_body thread_pitch screw_thread_pitch axis axis2
        physics frame pose sensor""",
}
_KNOWN_ELEMENTS = {kind: frozenset(tags.split()) for kind, tags in _ELEMENTS.items()}


def open_document(
    data: str | bytes, source: str, folder: str, remarks: list[str], root_folder: str, strict: bool
) -> tuple[SdfDocument, Element]:
    """Return a document and its root element."""
    reader_warnings = ReaderWarnings(source, remarks, strict)
    try:
        root = parse_xml(
            data, source, texts=True, on_recoverable_error=None if strict else reader_warnings.fault
        )
    except FormatError as error:
        marks = ("<%", "{%") if isinstance(data, str) else (b"<%", b"{%")
        is_template = any(mark in data for mark in marks)  # type: ignore[operator]  # of the same type
        hint = " This is a template that was not expanded: erb model.sdf.erb > model.sdf"
        raise FormatError(f"{error}{hint if is_template else ''}") from None
    document = SdfDocument(source, folder, _LATEST, reader_warnings, root_folder)
    # Up to version 1.2, the root element was <gazebo>.
    if root[0] not in ("sdf", "gazebo"):
        known = {"robot": "a URDF", "mujoco": "an MJCF"}
        guess = f" This is {known[root[0]]}." if root[0] in known else ""
        document.refuse(root, f"is not <sdf>, the root element of an SDF.{guess}")
    version = root[1].get("version", "")
    match = re.fullmatch(r"(\d{1,3})\.(\d{1,3})(\.\d{1,3})?", version.strip())
    if match is None:
        document.refuse(root, 'has no version, such as <sdf version="1.10"> does.')
    document.version = int(match[1]), int(match[2])
    if not _OLDEST <= document.version <= _LATEST:
        document.refuse(root, f"version={quote(version)} is not one that is read; 1.2 to 1.12 are.")
    return document, root


class SdfModelReader:
    """Reader of models, and of those that they include, into a pose graph."""

    def __init__(self, graph: PoseGraph, remarks: list[str], root: str, strict: bool):
        self._graph = graph
        self._remarks = remarks
        self._root, self._strict = root, strict
        self._open_files: list[Path] = []
        self._included_bytes = 0

    def read_model(self, element: Element, outer: SdfScope, alone: bool = False) -> PoseNode:
        """Read a model into a scope; the names of a model that is alone in its file get no prefix."""
        document = outer.document
        path = outer.path if alone else None
        return self._model(element, outer, document, self._name(element, document), path)

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
        node.is_named_frame = path is None
        scope = SdfScope(node.path if path is None else path, document, outer, outer.static, node)
        outer.inner[name] = scope
        outer.models.append(node)
        self._fill(node, scope, element, outer, include)
        return node

    def _fill(
        self, node: PoseNode, scope: SdfScope, element: Element, outer: SdfScope, include: Element | None
    ) -> None:
        """Read the elements of a model; an include overrides its pose and whether it is static."""
        if scope.path.count("/") > _MAX_DEPTH:
            scope.document.refuse(element, f"models are nested more than {_MAX_DEPTH} deep.")
        static_owner = element if include is None or find_child(include, "static") is None else include
        with (scope.document if static_owner is element else outer.document).locate_errors(static_owner):
            static = outer.static or read_child_bool(static_owner, "static")
        scope.static = static
        pose_owner = element if include is None or find_child(include, "pose") is None else include
        frame = read_child_text(include, "placement_frame") if include is not None else ""
        if frame and pose_owner is element:
            assert include is not None
            outer.document.refuse(include, "has a <placement_frame> but no <pose> that it would be for.")
        frame = frame or element[1].get("placement_frame", "")
        node.pose_element, node.pose_scope = find_child(pose_owner, "pose"), outer
        if frame:
            self._graph.placements.append((node, scope, frame, element))
        self.read_elements(element, scope)
        self._graph.canonical.append((node, scope, element[1].get("canonical_link", ""), element))

    def read_elements(self, element: Element, scope: SdfScope) -> None:
        """Read the elements of a model or a world: links, models, includes, joints, then frames."""
        document = scope.document
        kind = "world" if element[0] == "world" else "model"
        parts: dict[str, list[Element]] = {tag: [] for tag in ("link", "model", "include", "joint", "frame")}
        for part in element[2]:
            tag = part[0]
            if tag in parts:
                parts[tag].append(part)
            else:
                self._warn_unknown(part, element, document, kind)
        if scope.model.kind == "world" and parts["link"]:
            document.refuse(parts["link"][0], "is in no model; links are parts of models.")
        for part in parts["link"]:
            node = self._add("link", part, scope, self._name(part, document))
            scope.links.append(node)
            for inner in part[2]:
                self._warn_unknown(inner, part, document, "link")
        for part in parts["model"]:
            self.read_model(part, scope)
        for part in parts["include"]:
            self.include(part, scope)
        for part in parts["joint"]:
            node = self._add("joint", part, scope, self._name(part, document))
            for inner in part[2]:
                self._warn_unknown(inner, part, document, "joint")
        for part in parts["frame"]:
            self._add("frame", part, scope, self._name(part, document))

    def _warn_unknown(self, part: Element, owner: Element, document: SdfDocument, kind: str) -> None:
        tag = part[0]
        _refuse_xacro(part, document)
        if kind == "world" and tag in _IGNORED:
            document.remarks.add(part, "is left out.", owner)
        elif tag not in _KNOWN_ELEMENTS[kind]:
            document.remarks.add(part, "is left out: the specification does not know it.", owner)

    def _name(self, element: Element, document: SdfDocument) -> str:
        with document.locate_errors(element):
            name = read_name(element)
            check_sdf_name(name, element, document.version)
        return name

    def _add(self, kind: NodeKind, element: Element, scope: SdfScope, name: str) -> PoseNode:
        """Add a node under its name; up to version 1.6, a repeated name of another kind is replaced."""
        if self._open_files and len(self._graph.nodes) >= MAX_INCLUDED:
            scope.document.refuse(
                element, f"with the models that are included, there are more than {MAX_INCLUDED} elements."
            )
        other = scope.names.get(name)
        if other is not None:
            again = f"has the name of the <{other.element[0]}> on line {other.element[3]} again"
            if other.kind == kind or scope.document.version >= (1, 7):
                scope.document.refuse(
                    element, f"{again}; names are unique in their scope. Rename one of them."
                )
            old, name = name, f"{name}_{kind}"
            while name in scope.names:
                name += "_"
            scope.document.remarks.add(element, f"{again}; {quote(old)} is called {quote(name)} here.")
        given = read_given_name(element, NAME, scope.document.remarks)
        path = scope.path_of_model_name(given) if given else scope.path_of(name)
        node = PoseNode(kind, path, scope, element, find_child(element, "pose"), scope)
        node.is_renamed = bool(given)
        scope.names[name] = node
        self._graph.nodes.append(node)
        return node

    def include(self, include: Element, scope: SdfScope) -> None:
        """Read the file of an include as a model, or merge its model into the scope."""
        document = scope.document
        part = find_child(include, "uri")
        with document.locate_errors(include):
            if part is None or not read_text(part):
                raise ElementError(include, "has no <uri>; the specification requires it.")
            merge = read_attribute_bool(include, "merge")
            try:
                path = find_included(read_text(part), document.folder, self._root).resolve()
            except FormatError as error:
                raise ElementError(part, str(error)) from None
            if path in self._open_files or len(self._open_files) >= _MAX_DEPTH:
                raise ElementError(
                    part, f"{quote(read_text(part))} includes itself, directly or through others."
                )
        content, folder = read_file(path), str(path.parent)
        self._included_bytes += len(content)
        if self._included_bytes > MAX_BYTES:
            document.refuse(
                include, f"with it, more than {MAX_BYTES} bytes are included, the most that is read."
            )
        if path.suffix == ".urdf":
            warnings = ReaderWarnings(path.name, self._remarks, self._strict)
            inner = SdfDocument(path.name, folder, _LATEST, warnings, self._root)
            model = read_urdf_as_sdf(content, path.name, folder, self._root, self._strict)
            root: Element = ("sdf", {}, [model], 1)
        else:
            inner, root = open_document(content, path.name, folder, self._remarks, self._root, self._strict)
        models = [element for element in root[2] if element[0] == "model"]
        others = [element for element in root[2] if element[0] in ("light", "actor")]
        if others and not models:
            document.remarks.add(include, f"is left out: it is a <{others[0][0]}>.")
            return
        if len(models) != 1:
            inner.refuse(root, f"is included, and has {len(models)} models where one is expected.")
        with inner.locate_errors(models[0]):
            own = read_name(models[0])
        name = read_child_text(include, "name") or own
        with document.locate_errors(include):
            check_sdf_name(name, include, document.version)
        self._open_files.append(path)
        if merge and scope.model.kind == "world" and any(part[0] == "link" for part in models[0][2]):
            with document.locate_errors(include):
                mistake = ElementError(include, "has merge, and a world has no links as that model has.")
                document.remarks.repair(mistake, "it is a model of its own")
            merge = False
        if merge:
            proxy = self._add("frame", models[0], scope, f"_merged__{name}__model__")
            shared = SdfScope(scope.path, inner, scope.outer, scope.static, proxy)
            shared.names, shared.inner = scope.names, scope.inner
            proxy.is_named_frame = False
            self._fill(proxy, shared, models[0], scope, include)
            scope.links += shared.links
            scope.models += shared.models
        else:
            self._model(models[0], scope, inner, name, include=include)
        self._open_files.pop()


def _refuse_xacro(element: Element, document: SdfDocument) -> None:
    if element[0].startswith("xacro:"):
        document.refuse(element, "is xacro that was not expanded; expand it first: xacro in.sdf > out.sdf")


def read_sdf(
    path: str | os.PathLike[str], root: str | os.PathLike[str] | None = None, strict: bool = False
) -> SdfScene:
    """Read an SDF file, and the files that it includes; see :func:`parse_sdf`.

    Raises
    ------
    FormatError
        If a file cannot be read or is not a valid SDF; the message names file, line, element and reason.

    Examples
    --------
    >>> result = kv.load("shelf_door").save("shelf.sdf")
    >>> scene = kv.formats.sdf.read_sdf("shelf.sdf")
    >>> [joint.name for joint in scene.joints]
    ['shelf_door/shelf', 'shelf_door/body_joint', 'shelf_door/door', 'shelf_door/door_handle_joint']
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
    source
        Name of the document in error messages.
    folder
        Folder relative to which meshes and included models are found.
    root
        Folder that contains all of them; None for that of :func:`kineverse.formats.root_folder.find_root`.
    strict
        If True, mistakes that other parsers accept are errors. Otherwise they are warnings.

    Raises
    ------
    FormatError
        If the text is no valid SDF; the message names source, line, element and reason.

    Examples
    --------
    >>> text = '''
    ... <sdf version="1.9">
    ...   <model name="cupboard">
    ...     <link name="body"/>
    ...     <link name="door"/>
    ...     <joint name="hinge" type="revolute">
    ...       <parent>body</parent>
    ...       <child>door</child>
    ...       <axis><xyz>0 0 1</xyz><limit><lower>0</lower><upper>1.5</upper></limit></axis>
    ...     </joint>
    ...   </model>
    ... </sdf>
    ... '''
    >>> (joint,) = kv.formats.sdf.parse_sdf(text).joints
    >>> joint.name, joint.kind, joint.axes[0].upper
    ('hinge', 'revolute', 1.5)
    """
    remarks: list[str] = []
    root_folder = find_text_root(folder, root)
    document, top = open_document(text, source, folder, remarks, root_folder, strict)
    graph = PoseGraph()
    scope = SdfScope("", document)
    scope.model = PoseNode("world", "", scope, top)
    static_models = _read(document, top, SdfModelReader(graph, remarks, root_folder, strict), scope)
    resolve_pose_graph(graph)
    attachments = resolve_attachments(graph.nodes, scope.model)
    return _scene(graph, attachments, static_models, document, remarks)


def _read(document: SdfDocument, root: Element, reader: SdfModelReader, scope: SdfScope) -> list[PoseNode]:
    """Read all elements into the pose graph; return the models that are fixed without a joint."""
    worlds = [element for element in root[2] if element[0] == "world"]
    models = [element for element in root[2] if element[0] in ("model", "include")]
    for element in root[2]:
        _refuse_xacro(element, document)
        if element[0] not in ("world", "model", "include"):
            document.remarks.add(element, "is left out.")
    if worlds:
        for element in (*worlds[1:], *models):
            document.remarks.add(element, "is left out: the first world of the file is the one that is read.")
        reader.read_elements(worlds[0], scope)
        return []
    if not models:
        document.refuse(root, "has neither a model nor a world.")
    for element in models:
        if element[0] == "include":
            reader.include(element, scope)
        else:
            reader.read_model(element, scope, alone=len(models) == 1)
    return scope.models


def _scene(
    graph: PoseGraph,
    attachments: dict[PoseNode, PoseNode],
    static_models: Sequence[PoseNode],
    document: SdfDocument,
    remarks: list[str],
) -> SdfScene:
    links = tuple(_link(node) for node in graph.by_kind("link"))
    resolved = [read_sdf_joint(node, attachments) for node in graph.by_kind("joint")]
    resolved = resolve_gearboxes(resolved, attachments)
    nodes = {part.joint.name: part.node for part in resolved}

    def remark(joint: SdfJoint, text: str) -> None:
        node = nodes[joint.name]
        node.document.remarks.add(node.element, text)

    joints = _resolve_mimic_chains([part.joint for part in resolved], nodes)
    static = [attachments[model].path for model in static_models]
    roots, ordered, loops = build_spanning_tree(links, joints, static, remark)
    _check_leaders((*ordered, *loops), nodes)
    frames = []
    for node in (node for node in graph.nodes if node.is_named_frame and node.kind in ("frame", "model")):
        link, place = attachments[node], (node.element[3], node.document.source)
        frames.append(SdfFrame(node.path, link.path or WORLD, pose_between(link, node), *place))
    return SdfScene(links, tuple(frames), roots, ordered, loops, document.source, tuple(remarks))


def _check_leaders(joints: Sequence[SdfJoint], nodes: dict[str, PoseNode]) -> None:
    coordinates = {joint.name + axis.suffix for joint in joints for axis in joint.axes}
    for joint in joints:
        for relation in (joint.gear, *(axis.mimic for axis in joint.axes)):
            if relation is not None and relation.leader not in coordinates:
                nodes[joint.name].refuse(
                    f"it follows {quote(relation.leader)}, which cannot move: the links that it connects "
                    "are held together anyway."
                )


def _link(node: PoseNode) -> SdfLink:
    assert node.world_pose is not None
    document, element = node.document, node.element
    free = read_given_name(element, FREE, document.remarks)
    return SdfLink(
        node.path,
        read_sdf_body(node),
        node.world_pose,
        node.scope.static,
        node.scope.path_of_model_name(free) if free else "",
        read_values(element, HOME, 7, document.remarks) if free else (),
        element[3],
        document.source,
    )


def _resolve_mimic_chains(joints: list[SdfJoint], nodes: dict[str, PoseNode]) -> list[SdfJoint]:
    relations: dict[str, MimicRelation[str]] = {}
    owner: dict[str, str] = {}
    for joint in joints:
        for axis in joint.axes:
            owner[joint.name + axis.suffix] = joint.name
            if axis.mimic is not None:
                relations[joint.name + axis.suffix] = axis.mimic
        if joint.gear is not None:
            relations[joint.name] = joint.gear
    if not relations:
        return joints

    ends = resolve_mimic_chains(relations, lambda name, reason: nodes[owner[name]].refuse(reason))
    result = []
    for joint in joints:
        if any(joint.name + axis.suffix in relations for axis in joint.axes):
            axes = tuple(replace(axis, mimic=ends.get(joint.name + axis.suffix)) for axis in joint.axes)
            gear = joint.gear and ends[joint.name]
            joint = replace(joint, axes=axes, gear=gear)
        result.append(joint)
    return result
