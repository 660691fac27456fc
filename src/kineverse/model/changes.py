"""Changes of a model between two versions."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any, TypeVar

from kineverse.expressions.expression import Expression

from .constraint import Constraint, coordinates
from .operation import RATES


@dataclass(frozen=True, slots=True)
class Change:
    """Structural change of one value; ``before`` is None for an added value, ``after`` for a removed one.

    See Also
    --------
    kineverse.model.Diff
    """

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
        """Coordinates of a constraint or a rate before and after the change; empty for other kinds."""
        found: set[str] = set()
        for side in (self.before, self.after):
            if isinstance(side, Constraint):
                found |= coordinates(side.lower, side.expression, side.upper)
            elif self.kind == RATES and side is not None:
                coordinate, entry = side
                parts = (entry,) if isinstance(entry, Expression) else chain.from_iterable(entry)
                found |= coordinates(coordinate, *parts)
        return frozenset(found)


@dataclass(frozen=True, slots=True)
class Diff:
    """Difference between two versions of a model.

    Attributes
    ----------
    version
        Version after the change. A commit starts from ``version - 1``.
    changes
        Values that changed, in no particular order.
    added, removed, replaced
        Tags of operations, in the order of the edit.
    reruns
        Number of times that an operation was applied.
    moved
        Tags of operations with a new position relative to the others. In a commit, these were removed and
        added again elsewhere, and are in ``replaced`` as well.
    rerun
        Tags of operations that were applied again because a value that they read had changed, in order.
        ``changes`` shows if their writes changed. Empty in comparisons of models.
    poses
        Frames with other forward kinematics, among those that a listener follows by ``frames=``.

    Examples
    --------
    >>> model = kv.load("kitchen")
    >>> before = model.snapshot()
    >>> with model.edit() as edit:
    ...     edit.constrain("ajar", 0, kv.position("kitchen/fridge_door"), 0.3)
    'constraint ajar'
    >>> diff = kv.model.compare_models(before, model)
    >>> diff.paths, diff.added
    (('constraints/ajar',), ('constraint ajar',))
    """

    version: int
    changes: tuple[Change, ...]
    added: tuple[str, ...] = ()
    removed: tuple[str, ...] = ()
    replaced: tuple[str, ...] = ()
    reruns: int = 0
    moved: tuple[str, ...] = ()
    rerun: tuple[str, ...] = ()
    poses: tuple[str, ...] = ()

    @property
    def is_empty(self) -> bool:
        """True if there are no differences."""
        return not (self.changes or self.tags)

    @property
    def paths(self) -> tuple[str, ...]:
        """The paths of all changes, sorted."""
        return tuple(sorted(c.path for c in self.changes))

    def _repr_html_(self) -> str:
        from kineverse._rich_display import html_table  # for start-up time

        from .display import count_values, format_line

        def line(value: Any) -> str:
            return "" if value is None else format_line(value)

        rows = [(c.path, line(c.before), line(c.after)) for c in sorted(self.changes, key=lambda c: c.path)]
        kinds = ("added", "removed", "replaced", "moved", "rerun")
        rows += [(f"operation {tag}", "", kind) for kind in kinds for tag in getattr(self, kind)]
        caption = f"{count_values(len(self.changes), 'changes')}, version {self.version}"
        return html_table(caption, ("what", "before", "after"), rows)

    @property
    def tags(self) -> frozenset[str]:
        """Tags that were added, removed, replaced, moved or run again."""
        return frozenset((*self.added, *self.removed, *self.replaced, *self.moved, *self.rerun))


Tag = TypeVar("Tag", bound=Hashable)


def find_moved_tags(before: Sequence[Tag], after: Sequence[Tag]) -> tuple[Tag, ...]:
    """Return a smallest set of tags whose removal makes both orders equal, in the new order."""
    place = {tag: i for i, tag in enumerate(before)}
    common = [tag for tag in after if tag in place]
    kept = _longest([place[tag] for tag in common])
    return tuple(tag for i, tag in enumerate(common) if i not in kept)


def _longest(places: Sequence[int]) -> set[int]:
    """Return the indices of a longest increasing part."""
    ends: list[int] = []  # ends[k]: the least end of an increasing part of k + 1 places
    lengths: list[int] = []
    for place in places:
        length = bisect_left(ends, place)
        lengths.append(length)
        ends[length : length + 1] = [place]
    kept: set[int] = set()
    length, last = len(ends) - 1, math.inf
    for i in range(len(places) - 1, -1, -1):
        if lengths[i] == length and places[i] < last:
            kept.add(i)
            length, last = length - 1, places[i]
    return kept
