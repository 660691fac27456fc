"""Pose graph of an SDF: elements with a pose, by name and scope, and the references between them.

Everything here is iterative and linear in the number of nodes.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Literal, NoReturn, TypeAlias

from kineverse.errors import FormatError, suggest
from kineverse.formats.poses import IDENTITY, compose_poses, invert_pose
from kineverse.formats.reader_warnings import ReaderWarnings
from kineverse.formats.root_folder import NOWHERE
from kineverse.formats.xml_reader import (
    TEXT,
    Element,
    ElementError,
    find_child,
    label,
    quote,
)
from kineverse.formats.xml_values import (
    read_element_pose,
    read_text,
)
from kineverse.model.body import Pose

NodeKind: TypeAlias = Literal["world", "model", "link", "joint", "frame"]
MODEL_FRAME = "__model__"
SdfVersion: TypeAlias = tuple[int, int]


@dataclass(slots=True, eq=False)
class SdfDocument:
    """A file that is being read: what the messages about its elements begin with."""

    source: str
    folder: str
    version: SdfVersion
    remarks: ReaderWarnings
    root: str = NOWHERE

    @contextmanager
    def about(self, owner: Element) -> Iterator[None]:
        """Turn mistakes in an element into the errors that people see."""
        try:
            yield
        except ElementError as mistake:
            of = "" if mistake.element is owner else f"{label(mistake.element)} "
            where = f"{self.source}, line {mistake.element[3]}, {label(owner)}"
            raise FormatError(f"{where}: {of}{mistake.message}") from None

    def refuse(self, element: Element, message: str) -> NoReturn:
        """Raise the error that an element is to blame for."""
        raise FormatError(f"{self.source}, line {element[3]}, {label(element)}: {message}")


@dataclass(slots=True, eq=False)
class PoseNode:
    """Something with a pose: the world, a model, a link, a joint or a frame.

    ``said`` is its ``<pose>``, whose references are names in ``said_in``. ``pose`` is where it is in
    ``relative``; it moves with ``attached``. ``place`` is where it is in the world, ``depth`` how many steps
    that is away, both known once :func:`.pose_graph.compute_world_poses` has been there.
    """

    sort: NodeKind
    path: str
    scope: SdfScope
    element: Element
    said: Element | None = None
    said_in: SdfScope | None = None
    pose: Pose = IDENTITY
    relative: PoseNode | None = None
    attached: PoseNode | None = None
    place: Pose | None = None
    depth: int = 0
    shown: bool = True

    @property
    def document(self) -> SdfDocument:
        """The file that it is in."""
        return self.scope.document

    def refuse(self, message: str) -> NoReturn:
        """Raise the error that this is to blame for."""
        self.document.refuse(self.element, message)


@dataclass(slots=True, eq=False)
class SdfScope:
    """What names mean inside of a model, or of the world."""

    path: str
    document: SdfDocument
    outer: SdfScope | None = None
    static: bool = False
    model: PoseNode = None  # type: ignore[assignment]  # set as soon as there is one
    names: dict[str, PoseNode] = field(default_factory=dict)
    inner: dict[str, SdfScope] = field(default_factory=dict)
    links: list[PoseNode] = field(default_factory=list)
    models: list[PoseNode] = field(default_factory=list)

    def below(self, name: str) -> str:
        """Return the path of a name in here."""
        parts = [part for piece in name.split("::") for part in piece.split("/") if part]
        return "/".join([self.path, *parts] if self.path else parts)

    def find(self, name: str, element: Element, owner: Element) -> PoseNode:
        """Return what a reference means.

        Raises
        ------
        FormatError
            If there is nothing of that name here.
        """
        found = self._find(name)
        if found is None:
            available = [*self.names, *(f"{m}::{n}" for m, inner in self.inner.items() for n in inner.names)]
            reserved = name != MODEL_FRAME and _is_reserved(name)
            with self.document.about(owner):
                raise ElementError(
                    element,
                    f"refers to {quote(name)}, "
                    + (
                        "a reserved name that means nothing here."
                        if reserved
                        else f"which does not exist in this scope. {suggest(name, available, 'name')}"
                    ),
                )
        return found

    def _find(self, name: str) -> PoseNode | None:
        if name == MODEL_FRAME:
            return None if self.model.sort == "world" else self.model
        if name == "world" and self.model.sort == "world":
            return self.model
        if name in self.names:
            return self.names[name]
        scope = self
        parts = name.split("::")
        for at, part in enumerate(parts[:-1]):
            rest = "::".join(parts[at:])
            if rest in scope.names:
                return scope.names[rest]
            inner = scope.inner.get(part)
            if inner is None:
                return None
            scope = inner
        return scope.model if parts[-1] == MODEL_FRAME else scope.names.get(parts[-1])


def check_sdf_name(name: str, element: Element, version: SdfVersion) -> None:
    """Look whether something may be called so.

    Raises
    ------
    ElementError
        If the name is reserved, or cannot be told from a scope.
    """
    # Before frames had names of their own, joints could be called anything.
    free = version < (1, 7) and element[0] == "joint"
    if (name == "world" and not free) or _is_reserved(name):
        raise ElementError(element, "has a reserved name: 'world' and names like __this__ are. Rename it.")
    if "::" in name and version >= (1, 8):
        raise ElementError(element, "has '::' in its name, which separates scopes. Rename it.")
    if not name.strip("/:") or not name.isprintable():
        raise ElementError(element, "has a name of nothing but separators, or with a control character.")


def _is_reserved(name: str) -> bool:
    return len(name) >= 4 and name.startswith("__") and name.endswith("__")


_NEAR = 64


def check_cycles(nodes: Iterable[PoseNode]) -> None:
    """Look whether all poses lead to the world, and all that moves with something else to a link.

    Raises
    ------
    FormatError
        If a chain of references leads in a circle.
    """
    nodes = list(nodes)
    for word, key in (("attached_to", "attached"), ("relative_to", "relative")):
        done: set[PoseNode] = set()
        for node in nodes:
            chain: dict[PoseNode, None] = {}
            at: PoseNode | None = node
            while at is not None and at not in done:
                if at in chain:
                    circle = " -> ".join(quote(n.path) for n in list(chain)[list(chain).index(at) :][:8])
                    at.refuse(
                        f"its pose depends on itself: {word} leads in a circle, {circle}."
                        if word == "relative_to"
                        else f"it moves with itself: attached_to leads in a circle, {circle}."
                    )
                chain[at] = None
                at = getattr(at, key)
            done.update(chain)


def compute_world_poses(nodes: Iterable[PoseNode]) -> None:
    """Find where all nodes are in the world."""
    for node in nodes:
        chain = []
        at = node
        while at.place is None and at.relative is not None:
            chain.append(at)
            at = at.relative
        if at.place is None:
            at.place = IDENTITY
        for inner in reversed(chain):
            outer = inner.relative
            assert outer is not None
            assert outer.place is not None
            inner.place = compose_poses(outer.place, inner.pose)
            inner.depth = outer.depth + 1


def pose_in_model(model: PoseNode, frame: PoseNode) -> Pose:
    """Return model_T_frame for a frame whose pose is known by way of the model."""
    chain: list[Pose] = []
    at = frame
    while at is not model:
        if at.relative is None:
            model.refuse(f"its placement_frame {quote(frame.path)} is no frame inside of it.")
        chain.append(at.pose)
        at = at.relative
    pose = IDENTITY
    for step in reversed(chain):
        pose = compose_poses(pose, step)
    return pose


def pose_between(a: PoseNode, b: PoseNode) -> Pose:
    """Return a_T_b: by the shortest way if it is short, so that no rounding comes from elsewhere."""
    assert a.place is not None
    assert b.place is not None
    a_up, b_up = IDENTITY, IDENTITY
    at_a, at_b = a, b
    for _ in range(_NEAR):
        if at_a is at_b:
            return compose_poses(invert_pose(a_up), b_up)
        if at_a.depth > at_b.depth:
            a_up = compose_poses(at_a.pose, a_up)
            assert at_a.relative is not None
            at_a = at_a.relative
        else:
            b_up = compose_poses(at_b.pose, b_up)
            if at_b.relative is None:
                break
            at_b = at_b.relative
    return compose_poses(invert_pose(a.place), b.place)


def find_carriers(nodes: Sequence[PoseNode], world: PoseNode) -> dict[PoseNode, PoseNode]:
    """Return for each node the link that it moves with, or the world."""
    known = {world: world}
    for node in nodes:
        chain = []
        at = node
        while at not in known and at.attached is not None:
            chain.append(at)
            at = at.attached
        end = known.get(at, at)
        known.update(dict.fromkeys(chain, end))
        known[node] = end
    return known


def resolve_pose_graph(parts: PoseGraph) -> None:
    """Follow the references of all nodes, and find where they are in the world.

    Raises
    ------
    FormatError
        For references to what does not exist or in a circle, and poses that are none.
    """
    for node in parts.nodes:
        _attach(node)
    for node, scope, canonical, element in reversed(parts.canonical):
        _attach_model(node, scope, canonical, element)
    for node in parts.nodes:
        _relate(node)
    check_cycles(parts.nodes)
    # Models inside of models come later in the list, and have to be placed first.
    for model, scope, frame, element in reversed(parts.placements):
        model.pose = compose_poses(
            model.pose, invert_pose(pose_in_model(model, scope.find(frame, element, element)))
        )
    compute_world_poses(parts.nodes)


def find_joint_end(joint: PoseNode, role: str) -> PoseNode:
    """Return the parent or the child of a joint, whatever it is."""
    element, document, scope = joint.element, joint.document, joint.scope
    part = find_child(element, role)
    if part is None or not read_text(part):
        document.refuse(element, f"has no <{role}>; the specification requires it.")
    name = _reference(part)
    if name == "world":
        if role == "child":
            document.refuse(element, "has the world as its child. Exchange parent and child.")
        while scope.outer is not None:
            scope = scope.outer
        return scope.model
    found = scope.find(name, part, element)
    if found is joint:
        document.refuse(element, f"is its own {role}.")
    return found


def _reference(part: Element) -> str:
    return part[1].get(TEXT, "").strip()


def _attach(node: PoseNode) -> None:
    """Find what a joint or a frame moves with."""
    if node.sort == "joint":
        node.attached = find_joint_end(node, "child")
    elif node.sort == "frame" and node.shown:
        name = node.element[1].get("attached_to", "")
        target = node.scope.find(name, node.element, node.element) if name else node.scope.model
        node.attached = target
        node.relative = target


def _attach_model(node: PoseNode, scope: SdfScope, canonical: str, element: Element) -> None:
    """Find what a model moves with: the world, its canonical link, or the first model in it."""
    if scope.static:
        while scope.outer is not None:
            scope = scope.outer
        node.attached = scope.model
    elif canonical:
        node.attached = scope.find(canonical, element, element)
        if node.attached.sort != "link":
            scope.document.refuse(element, f"its canonical_link {quote(canonical)} is no link.")
    elif scope.links or scope.models:
        node.attached = (scope.links or scope.models)[0]
    else:
        scope.document.refuse(element, "has no link; a model has at least one, unless it is static.")


def _relate(node: PoseNode) -> None:
    """Read the pose of a node and find what it is relative to."""
    scope = node.said_in or node.scope
    said = node.said
    default = node.relative
    if default is None:
        default = node.attached if node.sort == "joint" else scope.model
    node.relative = default
    if said is None:
        return
    with scope.document.about(node.element):
        node.pose = read_element_pose(said, scope.document.remarks)
    key = "frame" if scope.document.version < (1, 7) else "relative_to"
    name = said[1].get(key, "")
    if name:
        node.relative = scope.find(name, said, node.element)


@dataclass
class PoseGraph:
    """Everything that was found, in the order in which it was."""

    nodes: list[PoseNode] = field(default_factory=list)
    placements: list[tuple[PoseNode, SdfScope, str, Element]] = field(default_factory=list)
    canonical: list[tuple[PoseNode, SdfScope, str, Element]] = field(default_factory=list)

    def of(self, sort: str) -> Iterator[PoseNode]:
        """Yield the nodes of one sort."""
        return (node for node in self.nodes if node.sort == sort)
