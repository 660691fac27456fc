"""Two models side by side: which differences count, and which are rounding."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from kineverse.model.articulation import Articulation
from kineverse.model.delta import Delta, deltas, poses_apart
from kineverse.model.diff import Change, Diff
from kineverse.model.difference import difference
from kineverse.model.frame import Frame
from kineverse.model.history import History
from kineverse.model.model import Model
from kineverse.model.samples import Samples

SIGNS = {"+": "added", "-": "removed", "~": "changed"}


@dataclass(frozen=True)
class Difference:
    """A value that counts as different: ``sign`` is one of ``+ - ~``, ``parts`` what of a changed one is."""

    change: Change
    parts: tuple[Delta, ...] = ()

    @property
    def sign(self) -> str:
        """How it differs."""
        if self.change.before is None:
            return "+"
        return "-" if self.change.after is None else "~"


class Comparison:
    """What two models differ in, by more than a tolerance.

    Attributes
    ----------
    before, after
        The models.
    diff
        All that differs structurally.
    differences
        Of the values in it, those that count.
    alike
        The paths of the others: the same but for rounding, or for how it is written.
    """

    def __init__(self, before: Model, after: Model, tolerance: float, operations: str = "auto") -> None:
        self.before, self.after, self.tolerance = before, after, tolerance
        self.diff: Diff = difference(before, after)
        self.differences: list[Difference] = []
        self.alike: list[str] = []
        self._asked = operations
        samples = Samples(before, after)
        parts = deltas(self.diff.changes, samples)
        elsewhere = self._reparented(samples)
        for change, found in zip(self.diff.changes, parts, strict=True):
            if change.path in elsewhere:
                found = (found[0], elsewhere[change.path])
            counting = tuple(delta for delta in found if not delta.is_within(tolerance))
            alone = (change.before is None or change.after is None) and not self._says_nothing(change)
            if counting or alone:
                self.differences.append(Difference(change, counting))
            else:
                self.alike.append(change.path)

    def _reparented(self, samples: Samples) -> dict[str, Delta]:
        """Return how far apart frames are in the world that have another parent, as theirs says nothing."""
        changes = [
            c
            for c in self.diff.changes
            if isinstance(c.before, Frame)
            and isinstance(c.after, Frame)
            and c.before.parent != c.after.parent
        ]
        poses = samples.values([model.fk(c.name) for c in changes for model in (self.before, self.after)])
        found = {}
        for change, one, other in zip(changes, poses[::2], poses[1::2], strict=True):
            distances, angles = poses_apart(one, other)
            found[change.path] = Delta(
                "place",
                change.before.parent,
                change.after.parent,
                float(distances.max()),
                float(angles.max()),
                (float(distances[0]), float(angles[0])),
            )
        return found

    def _says_nothing(self, change: Change) -> bool:
        """Return whether it is the record of a fixed joint between frames that both have."""
        record = change.after if change.before is None else change.before
        return (
            isinstance(record, Articulation)
            and record.kind == "fixed"
            and record.child in self.before.frames
            and record.child in self.after.frames
        )

    @property
    def equal(self) -> bool:
        """Whether nothing that counts differs."""
        return not (self.differences or any(self.operations.values()))

    def of(self, kind: str) -> list[Difference]:
        """Return the differences of one kind of data."""
        return [found for found in self.differences if found.change.kind == kind]

    @cached_property
    def operations(self) -> dict[str, tuple[str, ...]]:
        """The tags of operations by sign: ``>`` for those that moved. Empty if they are not compared."""
        if not self.operations_compared:
            return {}
        diff = self.diff
        return {
            "-": diff.removed,
            "~": tuple(filter(self._counts, diff.replaced)),
            "+": diff.added,
            ">": diff.moved,
        }

    @cached_property
    def operations_compared(self) -> bool:
        """Whether operations are compared: as asked for, or if most of them have a counterpart.

        Descriptions in different formats become different operations, and that is no difference in the robot.
        """
        if self._asked != "auto":
            return self._asked == "yes"
        tags, others = set(self.before.history.tags), set(self.after.history.tags)
        return 2 * len(tags & others) >= max(len(tags), len(others))

    def _counts(self, tag: str) -> bool:
        """Return whether an operation that writes otherwise does so by more than rounding."""
        old, new = (model.history.entry(tag).writes for model in (self.before, self.after))
        different = [cell for cell in {*old, *new} if old.get(cell) != new.get(cell)]
        return any(
            path in self._counting or not _is_last(self.after.history, tag, path)
            for path in (f"{kind}/{name}" for kind, name in different)
        )

    @cached_property
    def _counting(self) -> frozenset[str]:
        return frozenset(found.change.path for found in self.differences)

    @property
    def counts(self) -> dict[str, int]:
        """How many values were added, removed and changed."""
        signs = [found.sign for found in self.differences]
        return {word: signs.count(sign) for sign, word in SIGNS.items()}


def _is_last(history: History, tag: str, path: str) -> bool:
    """Return whether what an operation writes there is what the model has."""
    return history.writers(path)[-1:] in ([tag], [])
