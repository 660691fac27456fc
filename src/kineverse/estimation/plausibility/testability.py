"""Joints that the observed frames can test.

Rigidly connected frames form a part. An observed part is compared with the nearest observed part above it. If
one operation wrote everything that moves between both, this operation is tested. Further frames of a part are
compared with the first one, which tests whether they are rigid.
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
    """Pair of observed frames with one operation between them."""

    tag: str  # tag of the tested operation
    parent: str  # observed frames
    child: str
    base: str  # frame to which the operation attaches
    frame: str  # the frame that it places there. Between them are only frames of the same operation
    moves: bool  # True if the child moves relative to the parent


@dataclass(frozen=True)
class TestableJoints:
    """Testable joints of a model, with the reasons for other frames."""

    joints: tuple[TestableJoint, ...]  # parents first
    untested: Mapping[str, str]  # observed frames that test no single operation, with the reason in words


def find_testable_joints(model: Model, observed: Iterable[str], relative_to: str | None) -> TestableJoints:
    """Find the joints that observed frames can test."""
    frames = list(dict.fromkeys(observed))
    for name in frames if relative_to is None else [*frames, relative_to]:
        if name != WORLD and name not in model.frames:
            raise UnknownNameError(
                f"There is no frame {name!r}. {suggest(name, [*model.frames, WORLD], 'frame')}"
            )
    return _Finder(model, [f for f in frames if f != relative_to], relative_to).find()


class _Finder:
    """Search for testable pairs of observed frames."""

    def __init__(self, model: Model, frames: list[str], exact: str | None) -> None:
        self.model = model
        self.exact = exact
        self.chains = {f: self._chain(f) for f in (*frames, *([] if exact is None else [exact]))}
        self.frames = sorted(frames, key=lambda f: len(self.chains[f]))
        # Observed frames of each part. The observer's frame comes last, because others are preferred.
        self.parts: dict[str, list[str]] = {}
        for name in (*self.frames, *([] if exact is None else [exact])):
            self.parts.setdefault(self._root(name), []).append(name)

    def find(self) -> TestableJoints:
        joints: list[TestableJoint] = []
        untested: dict[str, str] = {}
        for name in self.frames:
            result = self._find_rigid_pair(name) or self._find_moving_pair(name)
            if isinstance(result, TestableJoint):
                joints.append(result)
            elif result:
                untested[name] = result
        return TestableJoints(tuple(joints), untested)

    def _find_rigid_pair(self, name: str) -> TestableJoint | None:
        """Return the pair with the first observed frame of the same part; None for that frame itself."""
        part = self.parts[self._root(name)]
        first = self.exact if self.exact in part else part[0]
        if first is None or first == name or name == WORLD:
            return None
        nearest = self._nearest(self.chains[name][1:], part, first)
        return TestableJoint(self._writer(name), nearest, name, self.model.frames[name].parent, name, False)

    def _find_moving_pair(self, name: str) -> TestableJoint | str:
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
        """Return the root frame of a part."""
        while name != WORLD and not self._moves(name):
            name = self.model.frames[name].parent
        return name

    def _moves(self, name: str) -> bool:
        return any(
            isinstance(factor, Expression) and any(s.has_derivative for s in factor.symbols)
            for factor in self.model.frames[name].factors
        )

    def _chain(self, name: str) -> list[str]:
        """Return the frame and all its ancestors, the world last."""
        return [*ancestors(name, self.model.frames.__getitem__), WORLD]
