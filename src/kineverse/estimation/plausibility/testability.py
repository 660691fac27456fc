"""Joints that the observed frames can test.

Frames that are rigidly connected are one part. A part that is seen is compared with the nearest part above
it that is seen too; if everything that moves between them was written by one operation, that is the one
which is judged. Of several frames of one part, the others are compared with the first: whether they are as
rigid as the model says.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from kineverse.errors import UnknownNameError, suggest
from kineverse.expressions.expression import Expression
from kineverse.model.frame import WORLD
from kineverse.model.kinematics import ancestors
from kineverse.model.model import Model


@dataclass(frozen=True)
class TestableJoint:
    """Two frames that are seen, and the operation between them.

    Attributes
    ----------
    tag
        Of the operation that is judged.
    parent, child
        The frames that are seen.
    base, frame
        The frame that the operation hangs on, and the one it places there; between them are at most other
        frames of the same operation.
    moves
        Whether the model says that the child moves against the parent.
    """

    tag: str
    parent: str
    child: str
    base: str
    frame: str
    moves: bool


@dataclass(frozen=True)
class TestableJoints:
    """What can be judged, and why the rest cannot.

    Attributes
    ----------
    links
        Parents first.
    left_out
        Frames that are seen but tell nothing about a single operation, with the reason in words.
    """

    links: tuple[TestableJoint, ...]
    left_out: Mapping[str, str]


def find_testable_joints(model: Model, seen: Iterable[str], relative_to: str | None) -> TestableJoints:
    """Return what can be judged.

    Parameters
    ----------
    model
        The model that is served.
    seen
        Names of the frames whose poses are observed.
    relative_to
        The frame in which they are observed, whose place is exactly known; None for an observer that is no
        part of the model.

    Raises
    ------
    UnknownNameError
        For a frame that does not exist.
    """
    frames = list(dict.fromkeys(seen))
    for name in frames if relative_to is None else [*frames, relative_to]:
        if name != WORLD and name not in model.frames:
            raise UnknownNameError(
                f"There is no frame {name!r}. {suggest(name, [*model.frames, WORLD], 'frame')}"
            )
    return _Finder(model, [f for f in frames if f != relative_to], relative_to).find()


class _Finder:
    def __init__(self, model: Model, frames: list[str], exact: str | None) -> None:
        self.model = model
        self.exact = exact
        self.chains = {f: self._chain(f) for f in (*frames, *([] if exact is None else [exact]))}
        self.frames = sorted(frames, key=lambda f: len(self.chains[f]))
        # What is seen of each part. The observer is one of it, but what is seen is preferred.
        self.parts: dict[str, list[str]] = {}
        for name in (*self.frames, *([] if exact is None else [exact])):
            self.parts.setdefault(self._root(name), []).append(name)

    def find(self) -> TestableJoints:
        links: list[TestableJoint] = []
        left_out: dict[str, str] = {}
        for name in self.frames:
            found = self._rigid(name) or self._moving(name)
            if isinstance(found, TestableJoint):
                links.append(found)
            elif found:
                left_out[name] = found
        return TestableJoints(tuple(links), left_out)

    def _rigid(self, name: str) -> TestableJoint | None:
        """Return the link to another frame of the same part, if this is not the first that is seen of it."""
        part = self.parts[self._root(name)]
        first = self.exact if self.exact in part else part[0]
        if first is None or first == name or name == WORLD:
            return None
        nearest = self._nearest(self.chains[name][1:], part, first)
        return TestableJoint(self._writer(name), nearest, name, self.model.frames[name].parent, name, False)

    def _moving(self, name: str) -> TestableJoint | str:
        frame = top = self._root(name)
        tags: list[str] = []
        while top != WORLD:
            if (tag := self._writer(top)) not in tags:
                tags.append(tag)
            base = self.model.frames[top].parent
            top = self._root(base)
            if top in self.parts:
                break
        else:
            return "nothing that it could be compared with is seen"
        part = self.parts[top]
        parent = self._nearest(self._chain(base), part, part[0])
        if len(tags) > 1:
            between = ", ".join(f"'{tag}'" for tag in tags)
            return f"several operations are between it and '{parent}': {between}; see what is in between, too"
        return TestableJoint(tags[0], parent, name, base, frame, True)

    def _nearest(self, chain: list[str], part: list[str], otherwise: str) -> str:
        return next((f for f in chain if f in part), otherwise)

    def _writer(self, frame: str) -> str:
        return self.model.history.writers(f"frames/{frame}")[-1]

    def _root(self, name: str) -> str:
        """Return the frame at the root of a part."""
        while name != WORLD and not self._moves(name):
            name = self.model.frames[name].parent
        return name

    def _moves(self, name: str) -> bool:
        return any(
            isinstance(factor, Expression) and any(s.has_derivative for s in factor.symbols)
            for factor in self.model.frames[name].factors
        )

    def _chain(self, name: str) -> list[str]:
        """Return the frame and all above it, the world last."""
        return [*ancestors(name, self.model.frames.__getitem__), WORLD]
