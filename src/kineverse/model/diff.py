"""What a committed edit changed, or what two models differ in."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from .constraint import Constraint, coordinates


@dataclass(frozen=True, slots=True)
class Change:
    """One value that is structurally different; ``before`` or ``after`` is None where there is nothing."""

    kind: str
    name: str
    before: Any
    after: Any

    @property
    def path(self) -> str:
        """Kind and name, such as ``frames/kitchen/door``."""
        return f"{self.kind}/{self.name}"

    @property
    def coordinates(self) -> frozenset[str]:
        """The coordinates that a changed constraint is or was about; empty for everything else."""
        sides = [v for v in (self.before, self.after) if isinstance(v, Constraint)]
        return frozenset().union(*(coordinates(c.lower, c.expression, c.upper) for c in sides))


@dataclass(frozen=True, slots=True)
class Diff:
    """The difference between two versions of a model.

    Attributes
    ----------
    version
        The version this leads to; that of a commit comes from ``version - 1``.
    changes
        Values that changed, in no particular order.
    added, removed, replaced
        Tags of operations, in the order of the edit.
    moved
        Tags of operations that come earlier or later than before, relative to the others: between models
        (:func:`kineverse.difference`), as no edit moves one.
    runs
        How many times operations were applied to get there.
    """

    version: int
    changes: tuple[Change, ...]
    added: tuple[str, ...] = ()
    removed: tuple[str, ...] = ()
    replaced: tuple[str, ...] = ()
    runs: int = 0
    moved: tuple[str, ...] = ()

    @property
    def is_empty(self) -> bool:
        """Whether nothing differs."""
        return not (self.changes or self.tags)

    @property
    def paths(self) -> tuple[str, ...]:
        """The paths of all changes, sorted."""
        return tuple(sorted(c.path for c in self.changes))

    @property
    def tags(self) -> frozenset[str]:
        """Every tag that was added, removed, replaced or moved."""
        return frozenset((*self.added, *self.removed, *self.replaced, *self.moved))
