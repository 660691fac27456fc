"""Pose graph of an SDF: elements with a pose, by name and scope, and the references between them.

All functions are iterative and linear in the number of nodes.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Literal, NoReturn, TypeAlias

from kineverse.errors import suggest
from kineverse.formats.names import drop_empty_parts
from kineverse.formats.poses import IDENTITY, compose_poses, invert_pose
from kineverse.formats.reader_warnings import ReaderWarnings
from kineverse.formats.root_folder import NOWHERE
from kineverse.formats.xml_reader import TEXT, Element, ElementError, find_child, quote
from kineverse.formats.xml_values import read_element_pose, read_text
from kineverse.model.body import Pose

NodeKind: TypeAlias = Literal["world", "model", "link", "joint", "frame"]
MODEL_FRAME = "__model__"
SdfVersion: TypeAlias = tuple[int, int]


@dataclass(slots=True, eq=False)
class SdfDocument:
    """File that is being read, with its version and its warnings."""

    source: str
    folder: str
    version: SdfVersion
    remarks: ReaderWarnings
    root: str = NOWHERE
    _early: set[str] = field(default_factory=set)

    def early_attribute(self, element: Element, key: str) -> str:
        """Return an attribute of SDF 1.7, with a remark on the first one in a file of an earlier version.

        libsdformat converts such files to its own version first, and obeys it.
        """
        value = element[1].get(key, "")
        if value and self.version < (1, 7) and key not in self._early:
            self._early.add(key)
            self.remarks.add(
                element,
                f"has {key}, which SDF does not define before 1.7; it is obeyed in this file, "
                "as libsdformat does.",
            )
        return value

    @contextmanager
    def locate_errors(self, owner: Element) -> Iterator[None]:
        """Raise mistakes inside of an element as errors with file, line and element."""
        try:
            yield
        except ElementError as mistake:
            raise mistake.located(self.source, owner) from None

    def refuse(self, element: Element, message: str) -> NoReturn:
        """Raise an error about an element."""
        raise ElementError(element, message).located(self.source)


@dataclass(slots=True, eq=False)
class PoseNode:
    """Element with a pose: the world, a model, a link, a joint or a frame."""

    kind: NodeKind
    path: str
    scope: SdfScope
    element: Element
    pose_element: Element | None = None
    pose_scope: SdfScope | None = None  # scope of the name that it refers to
    pose: Pose = IDENTITY  # pose in another node
    relative_to: PoseNode | None = None  # that node
    attached_to: PoseNode | None = None  # node to which it is fixed
    world_pose: Pose | None = None
    depth: int = 0
    is_named_frame: bool = True  # True if the element becomes a frame of the model
    is_renamed: bool = False  # True if the element states its name in the model

    @property
    def document(self) -> SdfDocument:
        """File of the element."""
        return self.scope.document

    def refuse(self, message: str) -> NoReturn:
        """Raise an error about the element."""
        self.document.refuse(self.element, message)


@dataclass(slots=True, eq=False)
class SdfScope:
    """Scope of names: the inside of a model, or of the world."""

    path: str
    document: SdfDocument
    outer: SdfScope | None = None
    static: bool = False
    model: PoseNode = None  # type: ignore[assignment]  # set when the node of the model is made
    names: dict[str, PoseNode] = field(default_factory=dict)
    inner: dict[str, SdfScope] = field(default_factory=dict)
    links: list[PoseNode] = field(default_factory=list)
    models: list[PoseNode] = field(default_factory=list)

    @property
    def world(self) -> PoseNode:
        """Node of the world."""
        scope = self
        while scope.outer is not None:
            scope = scope.outer
        return scope.model

    def path_of(self, name: str) -> str:
        """Return the path of a name of this scope."""
        return self.path_of_model_name("/".join(name.split("::")))

    def path_of_model_name(self, name: str) -> str:
        """Return the path of a name as it is in the model, where colons do not separate scopes."""
        return drop_empty_parts(f"{self.path}/{name}")

    def find(self, name: str, element: Element, owner: Element) -> PoseNode:
        """Return the node that a name refers to."""
        result = self._find(name)
        if result is None:
            available = [*self.names, *(f"{m}::{n}" for m, inner in self.inner.items() for n in inner.names)]
            problem = f"which does not exist in this scope. {suggest(name, available, 'name')}"
            if name != MODEL_FRAME and _is_reserved(name):
                problem = "a reserved name that means nothing here."
            with self.document.locate_errors(owner):
                raise ElementError(element, f"refers to {quote(name)}, {problem}")
        return result

    def has(self, name: str) -> bool:
        """Return True if a name exists in this scope."""
        return self._find(name) is not None

    def _find(self, name: str) -> PoseNode | None:
        if name == MODEL_FRAME:
            return None if self.model.kind == "world" else self.model
        if name == "world" and self.model.kind == "world":
            return self.model
        if name in self.names:
            return self.names[name]
        scope = self
        parts = name.split("::")
        for k, part in enumerate(parts[:-1]):
            rest = "::".join(parts[k:])
            if rest in scope.names:
                return scope.names[rest]
            inner = scope.inner.get(part)
            if inner is None:
                return None
            scope = inner
        return scope.model if parts[-1] == MODEL_FRAME else scope.names.get(parts[-1])


@dataclass
class PoseGraph:
    """Nodes of all documents in reading order.

    ``placements`` are models with a ``placement_frame``, ``canonical`` models with the name of their
    canonical link, each with its scope and element.
    """

    nodes: list[PoseNode] = field(default_factory=list)
    placements: list[tuple[PoseNode, SdfScope, str, Element]] = field(default_factory=list)
    canonical: list[tuple[PoseNode, SdfScope, str, Element]] = field(default_factory=list)

    def by_kind(self, kind: str) -> Iterator[PoseNode]:
        """Yield the nodes of one kind."""
        return (node for node in self.nodes if node.kind == kind)


def find_pose_reference(pose: Element, scope: SdfScope, owner: Element) -> PoseNode | None:
    """Return the node that a ``<pose>`` says it is relative to; None if it says nothing.

    Before SDF 1.7 the attribute was ``frame``, which libsdformat renames to ``relative_to``.
    """
    document = scope.document
    name = document.early_attribute(pose, "relative_to")
    if "frame" in pose[1]:
        if document.version < (1, 7):
            name = pose[1]["frame"]
            return scope.find(name, pose, owner) if name else None
        document.remarks.add(pose, "has frame, which is relative_to since SDF 1.7; it is ignored.", owner)
    return find_early(name, pose, scope, owner)


def find_early(name: str, element: Element, scope: SdfScope, owner: Element) -> PoseNode | None:
    """Return the node that an attribute of SDF 1.7 names; None for no name.

    In files of earlier versions, which do not define it, an unknown name is passed over with a remark.
    """
    if not name:
        return None
    document = scope.document
    if document.version < (1, 7) and not scope.has(name):
        with document.locate_errors(owner):
            mistake = ElementError(element, f"refers to {quote(name)}, which does not exist in this scope.")
            document.remarks.repair(mistake, "it is passed over", owner)
        return None
    return scope.find(name, element, owner)


def check_sdf_name(name: str, element: Element, version: SdfVersion) -> None:
    """Check that an element may have a name."""
    # Up to version 1.6, joints were in no scope with frames, and could have any name.
    free = version < (1, 7) and element[0] == "joint"
    if (name == "world" and not free) or _is_reserved(name):
        raise ElementError(element, "has a reserved name: 'world' and names like __this__ are. Rename it.")
    if "::" in name and version >= (1, 8):
        raise ElementError(element, "has '::' in its name, which separates scopes. Rename it.")
    if not name.strip("/:") or not name.isprintable():
        raise ElementError(element, "has a name of nothing but separators, or with a control character.")


def _is_reserved(name: str) -> bool:
    return len(name) >= 4 and name.startswith("__") and name.endswith("__")


def resolve_pose_graph(graph: PoseGraph) -> None:
    """Resolve the references of all nodes, and compute their poses in the world."""
    for node in graph.nodes:
        _attach(node)
    for node, scope, canonical, element in reversed(graph.canonical):
        _attach_model(node, scope, canonical, element)
    for node in graph.nodes:
        _relate(node)
    check_cycles(graph.nodes)
    # Nested models come later in the list than their outer ones, and have to be placed first.
    for model, scope, frame, element in reversed(graph.placements):
        model.pose = compose_poses(
            model.pose, invert_pose(pose_in_model(model, scope.find(frame, element, element)))
        )
    compute_world_poses(graph.nodes)


def find_joint_end(joint: PoseNode, role: str) -> PoseNode:
    """Return the node that the ``<parent>`` or ``<child>`` of a joint names."""
    element, document = joint.element, joint.document
    part = find_child(element, role)
    if part is None or not read_text(part):
        document.refuse(element, f"has no <{role}>; the specification requires it.")
    name = part[1].get(TEXT, "").strip()
    if name == "world":
        if role == "child":
            document.refuse(element, "has the world as its child. Exchange parent and child.")
        return joint.scope.world
    result = joint.scope.find(name, part, element)
    if result is joint:
        document.refuse(element, f"is its own {role}.")
    return result


def _attach(node: PoseNode) -> None:
    if node.kind == "joint":
        node.attached_to = find_joint_end(node, "child")
    elif node.kind == "frame" and node.is_named_frame:
        name = node.document.early_attribute(node.element, "attached_to")
        target = node.scope.find(name, node.element, node.element) if name else node.scope.model
        node.attached_to = node.relative_to = target


def _attach_model(node: PoseNode, scope: SdfScope, canonical: str, element: Element) -> None:
    """Set the node to which a model is attached: the world, its canonical link, or its first element."""
    if scope.static:
        node.attached_to = scope.world
    elif canonical:
        node.attached_to = scope.find(canonical, element, element)
        if node.attached_to.kind != "link":
            scope.document.refuse(element, f"its canonical_link {quote(canonical)} is no link.")
    elif scope.links or scope.models:
        node.attached_to = (scope.links or scope.models)[0]
    else:
        scope.document.refuse(element, "has no link; a model has at least one, unless it is static.")


def _relate(node: PoseNode) -> None:
    scope = node.pose_scope or node.scope
    element = node.pose_element
    if node.relative_to is None:
        node.relative_to = node.attached_to if node.kind == "joint" else scope.model
    if element is None:
        return
    with scope.document.locate_errors(node.element):
        node.pose = read_element_pose(element, scope.document.remarks)
    reference = find_pose_reference(element, scope, node.element)
    if reference is not None:
        node.relative_to = reference


def check_cycles(nodes: Sequence[PoseNode]) -> None:
    """Check that no node refers to itself by ``attached_to`` or ``relative_to``."""
    for key in ("attached_to", "relative_to"):
        done: set[PoseNode] = set()
        for node in nodes:
            chain: dict[PoseNode, None] = {}
            at: PoseNode | None = node
            while at is not None and at not in done:
                if at in chain:
                    cycle = " -> ".join(quote(n.path) for n in list(chain)[list(chain).index(at) :][:8])
                    problem = "its pose depends on" if key == "relative_to" else "it moves with"
                    at.refuse(f"{problem} itself: {key} leads in a circle, {cycle}.")
                chain[at] = None
                at = getattr(at, key)
            done.update(chain)


def compute_world_poses(nodes: Iterable[PoseNode]) -> None:
    """Compute the poses of all nodes in the world."""
    for node in nodes:
        chain = []
        at = node
        while at.world_pose is None and at.relative_to is not None:
            chain.append(at)
            at = at.relative_to
        if at.world_pose is None:
            at.world_pose = IDENTITY
        for inner in reversed(chain):
            outer = inner.relative_to
            assert outer is not None
            assert outer.world_pose is not None
            inner.world_pose = compose_poses(outer.world_pose, inner.pose)
            inner.depth = outer.depth + 1


def pose_in_model(model: PoseNode, frame: PoseNode) -> Pose:
    """Return model_T_frame for a frame whose pose is defined relative to the model."""
    chain: list[Pose] = []
    at = frame
    while at is not model:
        if at.relative_to is None:
            model.refuse(f"its placement_frame {quote(frame.path)} is no frame inside of it.")
        chain.append(at.pose)
        at = at.relative_to
    pose = IDENTITY
    for step in reversed(chain):
        pose = compose_poses(pose, step)
    return pose


_MAX_PATH = 64  # steps of the path between two nodes up to which their relative pose is composed along it


def pose_between(a: PoseNode, b: PoseNode) -> Pose:
    """Return a_T_b, composed along the path between the nodes if that is short, which rounds the least."""
    assert a.world_pose is not None
    assert b.world_pose is not None
    a_up, b_up = IDENTITY, IDENTITY
    at_a, at_b = a, b
    for _ in range(_MAX_PATH):
        if at_a is at_b:
            return compose_poses(invert_pose(a_up), b_up)
        if at_a.depth > at_b.depth:
            a_up = compose_poses(at_a.pose, a_up)
            assert at_a.relative_to is not None
            at_a = at_a.relative_to
        else:
            b_up = compose_poses(at_b.pose, b_up)
            if at_b.relative_to is None:
                break
            at_b = at_b.relative_to
    return compose_poses(invert_pose(a.world_pose), b.world_pose)


def resolve_attachments(nodes: Sequence[PoseNode], world: PoseNode) -> dict[PoseNode, PoseNode]:
    """Return for each node the link to which it is attached, or the world."""
    known = {world: world}
    for node in nodes:
        chain = []
        at = node
        while at not in known and at.attached_to is not None:
            chain.append(at)
            at = at.attached_to
        end = known.get(at, at)
        known.update(dict.fromkeys(chain, end))
        known[node] = end
    return known
