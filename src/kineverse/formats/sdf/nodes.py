"""Everything in a file that has a pose, by name and scope."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Literal, NoReturn, TypeAlias

from kineverse.errors import FormatError, suggest
from kineverse.formats.markup import Element, ElementError, label, quote
from kineverse.formats.poses import IDENTITY
from kineverse.formats.remarks import Remarks
from kineverse.formats.roots import NOWHERE
from kineverse.model.body import Pose

Sort: TypeAlias = Literal["world", "model", "link", "joint", "frame"]
MODEL = "__model__"
Version: TypeAlias = tuple[int, int]


@dataclass(slots=True, eq=False)
class Document:
    """A file that is being read: what the messages about its elements begin with."""

    source: str
    folder: str
    version: Version
    remarks: Remarks
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
class Node:
    """Something with a pose: the world, a model, a link, a joint or a frame.

    ``said`` is its ``<pose>``, whose references are names in ``said_in``. ``pose`` is where it is in
    ``relative``; it moves with ``attached``. ``place`` is where it is in the world, ``depth`` how many steps
    that is away, both known once :func:`.placing.place` has been there.
    """

    sort: Sort
    path: str
    scope: Scope
    element: Element
    said: Element | None = None
    said_in: Scope | None = None
    pose: Pose = IDENTITY
    relative: Node | None = None
    attached: Node | None = None
    place: Pose | None = None
    depth: int = 0
    shown: bool = True

    @property
    def document(self) -> Document:
        """The file that it is in."""
        return self.scope.document

    def refuse(self, message: str) -> NoReturn:
        """Raise the error that this is to blame for."""
        self.document.refuse(self.element, message)


@dataclass(slots=True, eq=False)
class Scope:
    """What names mean inside of a model, or of the world."""

    path: str
    document: Document
    outer: Scope | None = None
    static: bool = False
    model: Node = None  # type: ignore[assignment]  # set as soon as there is one
    names: dict[str, Node] = field(default_factory=dict)
    inner: dict[str, Scope] = field(default_factory=dict)
    links: list[Node] = field(default_factory=list)
    models: list[Node] = field(default_factory=list)

    def below(self, name: str) -> str:
        """Return the path of a name in here."""
        parts = [part for piece in name.split("::") for part in piece.split("/") if part]
        return "/".join([self.path, *parts] if self.path else parts)

    def find(self, name: str, element: Element, owner: Element) -> Node:
        """Return what a reference means.

        Raises
        ------
        FormatError
            If there is nothing of that name here.
        """
        found = self._find(name)
        if found is None:
            available = [*self.names, *(f"{m}::{n}" for m, inner in self.inner.items() for n in inner.names)]
            reserved = name != MODEL and _is_reserved(name)
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

    def _find(self, name: str) -> Node | None:
        if name == MODEL:
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
        return scope.model if parts[-1] == MODEL else scope.names.get(parts[-1])


def check_name(name: str, element: Element, version: Version) -> None:
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
