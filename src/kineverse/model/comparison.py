"""Comparison of two models by operations, by values, and by distance of values at sampled states."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, is_dataclass
from functools import cached_property, reduce
from math import inf, isnan
from typing import Any

import numpy as np
from msgspec import Struct

from kineverse.expressions.expression import Expression, as_expression
from kineverse.lie import Array

from .articulation import Articulation
from .body import Mesh, Pose
from .changes import Change, Diff, find_moved_tags
from .display import count_values
from .frame import Frame
from .model import Model, Snapshot
from .model_view import ModelView
from .operation import KINDS, RATES
from .sampling import StateSamples


@dataclass(frozen=True, slots=True)
class Delta:
    """Difference in one part of a value."""

    what: str  # path of the part within the value
    before: Any  # content of the part; None if there is none
    after: Any
    distance: float = inf  # of origins [m]; of numbers relative to the larger one above one; inf for texts
    angle: float = 0.0  # of the rotation from one transform to the other [rad]
    at_default: tuple[float, float] = (inf, 0.0)  # distance and angle at the default state

    def is_within(self, tolerance: float) -> bool:
        """Return whether distance and angle are within a tolerance; False for a tolerance of 0."""
        return tolerance > 0.0 and max(self.distance, self.angle) <= tolerance


def measure_deltas(changes: Sequence[Change], samples: StateSamples) -> list[tuple[Delta, ...]]:
    """Return the differing parts of each change; none for a value that was added or removed.

    Meshes are compared by file name. The folder, and the form of the path, make no difference.
    """
    parts = [_differing_parts(change) for change in changes]
    pairs = [(a, b) for found in parts for _, a, b in found if _is_symbolic(a, b)]
    measured = iter(_measure_distance(pairs, samples))
    return [
        tuple(
            Delta(what, a, b, *(next(measured) if _is_symbolic(a, b) else _measure(a, b)))
            for what, a, b in found
        )
        for found in parts
    ]


# -- finding -----------------------------------------------------------------------------------------------


def _differing_parts(change: Change) -> list[tuple[str, Any, Any]]:
    before, after = change.before, change.after
    if before is None or after is None:
        return []
    if change.kind == RATES:  # each a pair of the coordinate and what moves it
        before, after = before[1], after[1]
    return list(_walk("", before, after))


def _walk(what: str, a: Any, b: Any) -> Iterator[tuple[str, Any, Any]]:
    """Yield the innermost differing parts of two values: path, old and new content."""
    if a is b or (_is_number(a) and _is_number(b) and isnan(a) and isnan(b)):
        return
    if type(a) is not type(b) or isinstance(a, (Expression, Pose)):
        if a != b:
            yield what, _number(a), _number(b)
    elif isinstance(a, Frame):
        if a.parent != b.parent:
            yield "parent", a.parent, b.parent
        if a.factors != b.factors:
            yield "transform", transform_of(a), transform_of(b)
    elif names := field_names(a):
        alike: tuple[str, ...] = ()
        if isinstance(a, Mesh):
            alike = ("folder", "root", "uri") if _file(a) == _file(b) else ("folder", "root")
        for field in names:
            if field not in alike:
                name = f"{what}.{field}" if what else field
                yield from _walk(name, getattr(a, field), getattr(b, field))
    elif isinstance(a, tuple) and (a or b) and _are_named(a) and _are_named(b):
        one, other = ({str(name): value for name, value in pairs} for pairs in (a, b))
        for name in dict.fromkeys((*one, *other)):
            yield from _walk(f"{what}[{name}]" if what else name, one.get(name), other.get(name))
    elif isinstance(a, tuple) and not _are_numbers(a):
        for i in range(max(len(a), len(b))):
            yield from _walk(f"{what}[{i}]", *(side[i] if i < len(side) else None for side in (a, b)))
    elif a != b:
        yield what, a, b


def field_names(value: Any) -> tuple[str, ...]:
    """Return the names of the parts of a record; none for any other value."""
    if isinstance(value, Struct):
        return value.__struct_fields__
    return tuple(field.name for field in fields(value)) if is_dataclass(value) else ()


def _file(mesh: Mesh) -> str:
    """Return the path of a mesh file, without access to the disk."""
    return mesh.uri if "://" in mesh.uri else os.path.normpath(os.path.join(mesh.folder, mesh.uri))


def _are_named(value: Any) -> bool:
    """Return whether a value is a table, possibly empty: pairs with unique names as first elements."""
    if not all(isinstance(pair, tuple) and len(pair) == 2 for pair in value):
        return False
    names = [str(name) for name, _ in value if isinstance(name, (str, Expression))]
    return len(set(names)) == len(value)


def _are_numbers(value: Any) -> bool:
    return isinstance(value, tuple) and bool(value) and all(map(_is_number, value))


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _number(value: Any) -> Any:
    is_scalar = isinstance(value, Expression) and not value.shape
    return float(value) if is_scalar and value.is_constant else value


def _is_symbolic(a: Any, b: Any) -> bool:
    if not any(isinstance(v, Expression) for v in (a, b)):
        return False
    return _shape(a) == _shape(b) is not None


def _shape(value: Any) -> tuple[int, ...] | None:
    if isinstance(value, Expression):
        return value.shape
    if isinstance(value, Pose):
        return (4, 4)
    return () if _is_number(value) else None


def transform_of(frame: Frame) -> Pose | Expression:
    """Return parent_T_frame as numbers if it is constant, else as an expression."""
    poses = [factor for factor in frame.factors if isinstance(factor, Pose)]
    if len(poses) < len(frame.factors):
        return frame.transform
    if len(poses) == 1:
        return poses[0]
    return Pose.from_matrix(reduce(np.matmul, (p.matrix for p in poses), np.eye(4)))


# -- measuring ---------------------------------------------------------------------------------------------


def _measure(a: Any, b: Any) -> tuple[float, float, tuple[float, float]]:
    if isinstance(a, Pose) and isinstance(b, Pose):
        return _summarize(*measure_pose_distances(a.matrix[None], b.matrix[None]))
    if (_is_number(a) and _is_number(b)) or (_are_numbers(a) and _are_numbers(b) and len(a) == len(b)):
        one, other = (np.array([side], dtype=float) for side in (a, b))
        return _summarize(_measure_number_distance(one, other), np.zeros(1))
    return inf, 0.0, (inf, 0.0)


def _measure_distance(
    pairs: Sequence[tuple[Any, Any]], samples: StateSamples
) -> Iterator[tuple[float, float, tuple[float, float]]]:
    sides = [tuple(as_expression(v.matrix if isinstance(v, Pose) else v) for v in (a, b)) for a, b in pairs]
    trends = [_trends(a, b) for a, b in sides]
    everything = [e for (a, b), trend in zip(sides, trends, strict=True) for e in (a, b, *trend)]
    numbers = iter(samples.values(everything))
    for (a, _), trend in zip(sides, trends, strict=True):
        one, other = next(numbers), next(numbers)
        if a.shape == (4, 4):
            distances, angles = measure_pose_distances(one, other)
        else:
            distances, angles = _measure_number_distance(one, other), np.zeros(len(one))
        for _ in trend[::2]:
            # Expressions with equal values differ if a gradient is overridden, so gradients are compared too.
            distances = np.maximum(distances, _measure_number_distance(next(numbers), next(numbers)))
        yield _summarize(distances, angles)


def _summarize(distances: Array, angles: Array) -> tuple[float, float, tuple[float, float]]:
    return float(distances.max()), float(angles.max()), (float(distances[0]), float(angles[0]))


def _trends(a: Expression, b: Expression) -> list[Expression]:
    """Return the gradients of two expressions, alternating by key; empty if none is overridden."""
    if not (a.nodes or b.nodes):
        return []
    one, other = a.gradient(), b.gradient()
    nothing = as_expression(np.zeros(a.shape))
    keys = sorted({*one, *other}, key=lambda symbol: symbol.sort_key)
    return [side.get(key, nothing) for key in keys for side in (one, other)]


def _measure_number_distance(a: Array, b: Array) -> Array:
    """Return the largest difference in each row, relative where numbers are above one."""
    with np.errstate(invalid="ignore", over="ignore"):
        off = np.abs(a - b) / np.maximum(1.0, np.maximum(np.abs(a), np.abs(b)))
    off[(a == b) | (np.isnan(a) & np.isnan(b))] = 0.0
    off[np.isnan(off)] = inf
    result: Array = off.reshape(len(a), -1).max(axis=1, initial=0.0)
    return result


def measure_pose_distances(a: Array, b: Array) -> tuple[Array, Array]:
    """Return distances of origins [m] and angles of rotations [rad] between poses (N, 4, 4)."""
    both = np.isnan(a).any(axis=(1, 2)) & np.isnan(b).any(axis=(1, 2))
    with np.errstate(invalid="ignore"):
        distances = np.linalg.norm(a[:, :3, 3] - b[:, :3, 3], axis=1)
        # The chord |R₁ - R₂| is accurate for small angles, where the trace of R₁ᵀR₂ is not.
        chords = np.linalg.norm(a[:, :3, :3] - b[:, :3, :3], axis=(1, 2)) / np.sqrt(8.0)
        angles = 2.0 * np.arcsin(np.minimum(chords, 1.0))
    return tuple(  # type: ignore[return-value]
        np.where(both, 0.0, np.where(np.isnan(part), inf, part)) for part in (distances, angles)
    )


def compare_models(before: Model | Snapshot, after: Model | Snapshot) -> Diff:
    """Compare two models structurally.

    The result is the diff of a commit that turns the first model into the second. Values are compared name by
    name. Operations are compared by tag and by their writes, so operations read from a document equal the
    original ones. ``moved`` is a smallest set of tags: the others have the same order in both models.

    Parameters
    ----------
    before, after
        The models. They need no common history.

    Examples
    --------
    >>> model = kv.load("kitchen")
    >>> other = model.copy()
    >>> with other.edit() as edit:
    ...     edit.write("owner", "Ada")
    'data owner'
    >>> kv.model.compare_models(model, other).paths
    ('data/owner',)
    """
    old, new = (model.snapshot() if isinstance(model, Model) else model for model in (before, after))
    entries = {entry.tag: entry for entry in old.entries}
    later = {entry.tag: entry for entry in new.entries}
    common = [tag for tag in entries if tag in later]
    return Diff(
        version=new.version,
        changes=tuple(_changes(old, new)),
        added=tuple(tag for tag in later if tag not in entries),
        removed=tuple(tag for tag in entries if tag not in later),
        replaced=tuple(tag for tag in common if entries[tag].writes != later[tag].writes),
        moved=find_moved_tags(common, list(later)),
    )


def _changes(old: Snapshot, new: Snapshot) -> Iterator[Change]:
    """Yield the changes by kind: removed and changed values in the old order, then added ones in the new."""
    for kind in KINDS:
        before, after = old._ordered(kind), new._ordered(kind)
        for name, value in before.items():
            if name not in after:
                yield Change(kind, name, value, None)
            elif after[name] is not value and after[name] != value:
                yield Change(kind, name, value, after[name])
        for name, value in after.items():
            if name not in before:
                yield Change(kind, name, None, value)


SIGNS = {"+": "added", "-": "removed", "~": "changed"}


@dataclass(frozen=True)
class ValueDifference:
    """Difference between two values beyond the tolerance, with the differing parts of a changed value."""

    change: Change
    parts: tuple[Delta, ...] = ()

    @property
    def sign(self) -> str:
        """``+`` for an added value, ``-`` for a removed one, ``~`` for a changed one."""
        if self.change.before is None:
            return "+"
        return "-" if self.change.after is None else "~"


class ModelComparison:
    """Differences between two models beyond a tolerance."""

    def __init__(self, before: Model, after: Model, tolerance: float, operations: str = "auto") -> None:
        self.before, self.after, self.tolerance = before, after, tolerance
        self.diff: Diff = compare_models(before, after)
        self.differences: list[ValueDifference] = []
        self.alike: list[str] = []
        self._asked = operations
        samples = StateSamples(before, after)
        parts = measure_deltas(self.diff.changes, samples)
        elsewhere = self._reparented(samples)
        for change, found in zip(self.diff.changes, parts, strict=True):
            if change.path in elsewhere:
                found = (found[0], elsewhere[change.path])
            counting = tuple(delta for delta in found if not delta.is_within(tolerance))
            alone = (change.before is None or change.after is None) and not self._is_redundant_record(change)
            if counting or alone:
                self.differences.append(ValueDifference(change, counting))
            else:
                self.alike.append(change.path)

    def _repr_html_(self) -> str:
        from kineverse._rich_display import html_table  # for start-up time

        rows = [
            (one.sign, one.change.path, ", ".join(part.what for part in one.parts))
            for one in self.differences
        ]
        caption = f"{count_values(len(rows), 'differences')} beyond {self.tolerance:g}"
        rows += [(sign, f"operation {tag}", "") for sign, tags in self.operations.items() for tag in tags]
        return html_table(caption, ("", "what", "parts"), rows)

    def _reparented(self, samples: StateSamples) -> dict[str, Delta]:
        """Return the difference in world pose of all frames with a new parent.

        Their poses in the old and the new parent cannot be compared.
        """
        frames = [c for c in self.diff.changes if isinstance(c.before, Frame) and isinstance(c.after, Frame)]
        changes = [c for c in frames if c.before.parent != c.after.parent]
        poses = samples.values([model.fk(c.name) for c in changes for model in (self.before, self.after)])
        result = {}
        for change, one, other in zip(changes, poses[::2], poses[1::2], strict=True):
            off = _summarize(*measure_pose_distances(one, other))
            result[change.path] = Delta("place", change.before.parent, change.after.parent, *off)
        return result

    def _is_redundant_record(self, change: Change) -> bool:
        record = change.after if change.before is None else change.before
        if not isinstance(record, Articulation) or record.kind != "fixed":
            return False
        return record.child in self.before.frames and record.child in self.after.frames

    @property
    def equal(self) -> bool:
        """True if there are no differences beyond the tolerance."""
        return not (self.differences or any(self.operations.values()))

    def by_kind(self, kind: str) -> list[ValueDifference]:
        """Return the differences of one kind of data."""
        return [found for found in self.differences if found.change.kind == kind]

    @cached_property
    def operations(self) -> dict[str, tuple[str, ...]]:
        """Tags of operations by sign, ``>`` for moved ones; empty if operations are not compared."""
        if not self.operations_compared:
            return {}
        diff, changed = self.diff, tuple(filter(self._counts, self.diff.replaced))
        return {"-": diff.removed, "~": changed, "+": diff.added, ">": diff.moved}

    @cached_property
    def operations_compared(self) -> bool:
        """True if operations are compared: on request, or if most of them have a counterpart.

        Descriptions of one robot in different formats become different operations.
        """
        if self._asked != "auto":
            return self._asked == "yes"
        tags, others = set(self.before.history.tags), set(self.after.history.tags)
        return 2 * len(tags & others) >= max(len(tags), len(others))

    def _counts(self, tag: str) -> bool:
        """Return whether the writes of an operation differ by more than rounding."""
        old, new = (model.history.entry(tag).writes for model in (self.before, self.after))
        different = [cell for cell in {*old, *new} if old.get(cell) != new.get(cell)]
        counting = {found.change.path for found in self.differences}
        return any(
            path in counting
            or self.after.history.writers(path)[-1:] not in ([tag], [])  # not its last writer
            for path in (f"{kind}/{name}" for kind, name in different)
        )

    @property
    def counts(self) -> dict[str, int]:
        """Numbers of added, removed and changed values."""
        signs = [found.sign for found in self.differences]
        return {word: signs.count(sign) for sign, word in SIGNS.items()}


COMPARED_STATES = 100


@dataclass(frozen=True, slots=True)
class PoseDifference:
    """Largest pose difference of one frame [m], [rad]; infinite if one of the poses does not exist."""

    frame: str
    distance: float
    angle: float


@dataclass(frozen=True, slots=True)
class LimitDifference:
    """Different limits (lower, upper) of a position [m], [rad] or a speed [m/s], [rad/s]."""

    name: str
    before: tuple[float, float]
    after: tuple[float, float]


class BehaviourComparison:
    """Differences in poses and limits between two models, as ``kineverse diff --values`` prints them.

    Parameters
    ----------
    tolerance
        Largest difference of equal numbers [m], [rad].

    Attributes
    ----------
    states
        Number of states at which poses are compared.
    frames, freedoms
        Names that are ``removed``, ``added`` and ``common``.
    helpers
        Frames without bodies that are in between in one of the models; they do not count.
    apart
        Frames whose poses differ by more than the tolerance, the farthest first, each with the largest
        ``distance`` [m] and ``angle`` [rad].
    largest
        Largest distance [m] and angle [rad] of all.
    ranges
        Limits of positions and speeds that differ, each with those ``before`` and ``after``.

    Examples
    --------
    >>> model = kv.load("kitchen")
    >>> other = model.copy()
    >>> with other.edit() as edit:
    ...     edit.attach("kitchen/fridge_door_handle", "kitchen/fridge_door", kv.translation(0.1, 0, 0))
    'attach kitchen/fridge_door_handle to kitchen/fridge_door'
    >>> comparison = kv.model.BehaviourComparison(model, other)
    >>> comparison.equal, comparison.apart[0].frame
    (False, 'kitchen/fridge_door_handle')
    """

    def __init__(self, before: ModelView, after: ModelView, tolerance: float = 1e-9) -> None:
        self.tolerance = tolerance
        self.helpers = [*find_helper_frames(before, after), *find_helper_frames(after, before)]
        self.frames = _partition_names(
            *([name for name in model.frames if name not in self.helpers] for model in (before, after))
        )
        old, new = ({str(s): s for s in model.degrees_of_freedom} for model in (before, after))
        self.freedoms = _partition_names(list(old), list(new))
        samples = StateSamples(before, after, count=COMPARED_STATES)
        self.states = samples.size
        common = self.frames["common"]
        poses = samples.values([model.fk(frame) for frame in common for model in (before, after)])
        found = [
            PoseDifference(frame, *_summarize(*measure_pose_distances(one, other))[:2])
            for frame, one, other in zip(common, poses[::2], poses[1::2], strict=True)
        ]
        self.largest = tuple(max((getattr(a, f) for a in found), default=0.0) for f in ("distance", "angle"))
        self.apart = sorted(
            (a for a in found if max(a.distance, a.angle) > tolerance), key=lambda a: (-a.distance, -a.angle)
        )
        self.ranges = [
            LimitDifference(str(s), limits, others)
            for name in self.freedoms["common"]
            for s in (old[name], old[name].derivative())
            if not _limits_equal(
                limits := before.limits(s),
                others := after.limits(new[name].derivative() if s.order else new[name]),
                tolerance,
            )
        ]

    @property
    def equal(self) -> bool:
        """True if there are no differences beyond the tolerance."""
        sides = (self.frames, self.freedoms)
        return not (self.apart or self.ranges or any(s["added"] or s["removed"] for s in sides))


def _partition_names(before: list[str], after: list[str]) -> dict[str, list[str]]:
    old, new = set(before), set(after)
    return {
        "removed": [name for name in before if name not in new],
        "added": [name for name in after if name not in old],
        "common": [name for name in before if name in new],
    }


def _limits_equal(one: tuple[float, float], other: tuple[float, float], tolerance: float) -> bool:
    return all(
        a == b or math.isclose(a, b, rel_tol=tolerance, abs_tol=tolerance)
        for a, b in zip(one, other, strict=True)
    )


def find_helper_frames(model: ModelView, original: ModelView) -> list[str]:
    """Return the frames that a writer or a reader had to add to the original model.

    They have no body. Either they are between two frames that are parent and child in the original, with the
    name of their coordinate or a name below that of the child; or they are leaves with the name of their only
    coordinate.
    """
    candidates = {name for name in model.frames if name not in original.frames and name not in model.bodies}
    found = set(_find_links_between(model, original, candidates)) if candidates else set()
    parents = {frame.parent for frame in model.frames.values()}
    found.update(name for name in candidates - parents if _is_carrier(model, name))
    return [name for name in model.frames if name in found]


def _find_links_between(model: ModelView, original: ModelView, candidates: set[str]) -> Iterator[str]:
    for lower, frame in original.frames.items():
        if lower not in model.frames:
            continue
        chain = []
        above = model.frames[lower].parent
        while above in candidates and _has_helper_name(model, above, lower):
            chain.append(above)
            above = model.frames[above].parent
        if above == frame.parent:
            yield from chain


def _has_helper_name(model: ModelView, name: str, lower: str) -> bool:
    movers = (name, name.removesuffix("_joint"))
    return name.startswith(f"{lower}/") or any(mover in model.articulations for mover in movers)


def _is_carrier(model: ModelView, name: str) -> bool:
    moving = [s for s in model.fk(name, model.frames[name].parent).symbols if s.has_derivative]
    return len(moving) == 1 and name in (moving[0].path, f"{moving[0].path}/carrier")
