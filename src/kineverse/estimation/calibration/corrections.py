"""Corrections of a model's geometry: joint offsets, mounts, lengths, axes, wheels, pitches.

A correction changes one operation by a few numbers about its present value; zeros change nothing. It is used
twice. While it is estimated, a :class:`CorrectedOperation` inserts it into the frame of the operation as
expressions of its symbols, so the Jacobian of a chain stays as short as that of the chain's own joints. With
numbers it gives an operation of the same class as before, which documents and other formats know.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from kineverse._names import match_names
from kineverse.articulations import Cylindrical, DifferentialDrive, Mecanum, Screw
from kineverse.articulations.joint import Joint, OneAxisMotion, PlacedOperation, Size
from kineverse.articulations.single_axis import rotation_factors, unit_axis
from kineverse.errors import InvalidValueError, UnknownNameError, suggest
from kineverse.expressions.expression import Expression, ExpressionLike, array, as_expression
from kineverse.lie import Array, smallest_rotation_from_z
from kineverse.loops import CloseLoop
from kineverse.model.basic_operations import AddFrame, Attach, Override
from kineverse.model.body import Pose
from kineverse.model.frame import Frame, TransformLike
from kineverse.model.model import Model
from kineverse.model.operation import Operation, Writes
from kineverse.model.read_recorder import ReadRecorder
from kineverse.spatial import X, Y, Z, exp_so3, translation_along
from kineverse.symbols import Symbol, parameter, symbol

Factors = tuple["Pose | Expression", ...]


@dataclass(frozen=True)
class Correction:
    """Correction of one operation by numbers about its present value."""

    word: str  # its kind: offset, mount, length, axis, wheels or pitch
    name: str  # articulation or frame that is corrected
    tag: str  # of its operation
    symbols: tuple[Symbol, ...]  # name/offset and so on; 0 stands for the present value
    units: tuple[str, ...]  # m or rad


class _Word(NamedTuple):
    """Kind of correction: its numbers with their units, what it is for, and how it is made."""

    parts: tuple[tuple[str, str], ...]  # (name, unit)
    wanted: str  # what it can be applied to, in words
    suits: Callable[[Any], bool]
    # Operation with the numbers added, and factors that go before and after its origin instead.
    corrected: Callable[[Any, Sequence[float]], Operation]
    inserted: Callable[[Any, Sequence[Expression]], tuple[Factors, Factors, Factors]] | None = None


# -- origins ---------------------------------------------------------------------------------------------


def _origin(operation: Any) -> Factors:
    """Return the factors of the pose that a placed operation gives its frame at coordinate 0."""
    if isinstance(operation, PlacedOperation):
        return (_as_pose(operation.origin),)
    factors: Factors = operation.frame.factors
    return factors


def _is_placed(operation: object) -> bool:
    return isinstance(operation, (PlacedOperation, AddFrame, Attach))


def _with_origin(operation: Any, factors: Iterable[TransformLike]) -> Operation:
    """Return a placed operation with another origin, the product of some factors."""
    merged: list[Any] = []
    for factor in factors:
        pose = _as_pose(factor)
        if merged and isinstance(pose, Pose) and isinstance(merged[-1], Pose):
            merged[-1] = Pose.from_matrix(merged[-1].matrix @ pose.matrix)
        else:
            merged.append(pose)
    result: Operation
    if not isinstance(operation, PlacedOperation):
        result = replace(operation, frame=Frame(operation.frame.parent, tuple(merged)))
        return result
    origin = merged[0]
    for factor in merged[1:]:
        origin = _matrix(origin) @ _matrix(factor)
    return replace(operation, origin=origin)


def _as_pose(factor: Any) -> Pose | Expression:
    if isinstance(factor, Expression) and not factor.is_constant:
        return factor
    return factor if isinstance(factor, Pose) else Pose.from_matrix(factor)


def _matrix(factor: Pose | Expression) -> Expression:
    return as_expression(factor.matrix) if isinstance(factor, Pose) else factor


# -- kinds of corrections ----------------------------------------------------------------------------------


def _mount_factors(numbers: Sequence[ExpressionLike]) -> Factors:
    """Return translation(d) · exp(r), in the axes of the mounted frame."""
    moved = (translation_along(axis, as_expression(d)) for axis, d in zip((X, Y, Z), numbers, strict=False))
    return *moved, exp_so3(array(list(numbers[3:])))


def _direction(operation: Any) -> tuple[float, float, float]:
    """Return the direction of an origin's translation in the parent frame."""
    x, y, z = _pose_of(operation)[:3, 3].tolist()
    return unit_axis((x, y, z))


def _pose_of(operation: Any) -> Array:
    product = np.eye(4)
    for factor in _origin(operation):
        if not isinstance(factor, Pose):
            return np.eye(4)
        product = product @ factor.matrix
    return product


def _with_length(operation: Any, numbers: Sequence[ExpressionLike]) -> Operation:
    along = translation_along(_direction(operation), numbers[0])
    return _with_origin(operation, (along, *_origin(operation)))


def _tilt(operation: Any, numbers: Sequence[ExpressionLike]) -> Expression:
    """Return the rotation of an axis about two directions orthogonal to it."""
    across = smallest_rotation_from_z(np.array(unit_axis(operation.axis)))[:, :2]
    return exp_so3(numbers[0] * array(across[:, 0]) + numbers[1] * array(across[:, 1]))


def _tilted(operation: Any, numbers: Sequence[float]) -> Operation:
    axis = np.asarray(_tilt(operation, numbers)())[:3, :3] @ np.asarray(operation.axis, dtype=float)
    result: Operation = replace(operation, axis=tuple(axis.tolist()))
    return result


def _tilt_factors(operation: Any, numbers: Sequence[Expression]) -> tuple[Factors, Factors, Factors]:
    tilt = _tilt(operation, numbers)
    return (), (tilt,), (tilt.T,)


def _with_wheels(operation: DifferentialDrive, numbers: Sequence[Size]) -> Operation:
    left, right, track = numbers
    radii = operation.radii
    return replace(operation, radius=(radii[0] + left, radii[1] + right), track=operation.track + track)


def _with_mecanum_wheels(operation: Mecanum, numbers: Sequence[Size]) -> Operation:
    radius, geometry = numbers
    # Only the sum of track and wheelbase matters, so each takes half.
    return replace(
        operation,
        radius=operation.radius + radius,
        track=operation.track + geometry / 2,
        wheelbase=operation.wheelbase + geometry / 2,
    )


_MOUNT = (("dx", "m"), ("dy", "m"), ("dz", "m"), ("rx", "rad"), ("ry", "rad"), ("rz", "rad"))

# In the order in which several corrections of one operation are made: the axis last, since it must not change
# the direction that an offset is about.
_KINDS: dict[str, _Word] = {
    "length": _Word(
        (("length", "m"),),
        "joints and frames whose constant origin is not at that of the parent",
        lambda op: _is_placed(op) and bool(_pose_of(op)[:3, 3].any()),
        lambda op, x: _with_origin(
            op, (translation_along(_direction(op), as_expression(x[0])), *_origin(op))
        ),
        lambda op, x: ((translation_along(_direction(op), x[0]),), (), ()),
    ),
    "offset": _Word(
        (("offset", ""),),  # the unit is that of the coordinate
        "joints with one axis",
        lambda op: isinstance(op, OneAxisMotion),
        lambda op, x: _with_origin(op, (*_origin(op), *op.motion(as_expression(x[0])))),
        lambda op, x: ((), tuple(op.motion(x[0])), ()),
    ),
    "mount": _Word(
        _MOUNT,
        "joints and frames that are placed in a parent",
        _is_placed,
        lambda op, x: _with_origin(op, (*_origin(op), *_mount_factors(x))),
        lambda op, x: ((), _mount_factors(x), ()),
    ),
    "pitch": _Word(
        (("pitch", "m"),),
        "screws",
        lambda op: isinstance(op, Screw),
        lambda op, x: replace(op, pitch=op.pitch + x[0]),
    ),
    "wheels": _Word(
        (("radius_left", "m"), ("radius_right", "m"), ("track", "m")),
        "differential drives and mecanum bases",
        lambda op: isinstance(op, DifferentialDrive),
        _with_wheels,
    ),
    "mecanum": _Word(
        (("radius", "m"), ("geometry", "m")), "", lambda op: isinstance(op, Mecanum), _with_mecanum_wheels
    ),
    "axis": _Word(
        (("tilt_1", "rad"), ("tilt_2", "rad")),
        "joints with an axis",
        lambda op: isinstance(op, (OneAxisMotion, Cylindrical)),
        _tilted,
        _tilt_factors,
    ),
}

_SPELLINGS = {
    **{f"{word}s": (word,) for word in ("offset", "mount", "length")},
    **{word: (word,) for word in ("offset", "mount", "length", "axis", "pitch")},
    "axes": ("axis",),
    "pitches": ("pitch",),
    "wheels": ("wheels", "mecanum"),
    "wheel": ("wheels", "mecanum"),
}


@dataclass(frozen=True)
class CorrectedOperation(Operation):
    """Operation with corrections as expressions, for the time of a calibration."""

    traceable = False

    operation: Operation
    before: Factors  # factors before the origin, between origin and motion, and after the motion
    between: Factors
    after: Factors

    def apply(self, model: ReadRecorder) -> Writes:
        """Write what the operation writes, with the factors in its frame."""
        writes = self.operation.apply(model)
        name, start = frame_of(self.operation), len(_origin(self.operation))
        frame = writes.frames[name]
        if not isinstance(frame, Frame):
            frame = Frame.from_transform(*frame)
        origin, motion, rest = _split(frame.factors, start, start + _motion_length(self.operation))
        corrected = (*self.before, *origin, *self.between, *motion, *self.after, *rest)
        return replace(writes, frames={**writes.frames, name: Frame(frame.parent, corrected)})


def _split(factors: Factors, start: int, end: int) -> tuple[Factors, Factors, Factors]:
    return factors[:start], factors[start:end], factors[end:]


def _motion_length(operation: Any) -> int:
    """Return the number of factors of a joint's motion about or along its axis; 0 for other joints."""
    if isinstance(operation, Cylindrical):
        return 1 + len(rotation_factors(operation.axis, as_expression(1.0)))
    return len(operation.motion(as_expression(1.0))) if isinstance(operation, OneAxisMotion) else 0


def frame_of(operation: Any) -> str:
    """Return the frame that a placed operation writes."""
    return str(getattr(operation, "child", operation.name))


def corrected_operation(
    operation: Operation, corrections: Sequence[Correction], values: Sequence[Sequence[float]]
) -> Operation:
    """Return an operation with corrections by numbers, one sequence for each."""
    if isinstance(operation, Override):
        return replace(operation, operation=corrected_operation(operation.operation, corrections, values))
    result = operation.rebuild() or operation
    for correction, numbers in zip(corrections, values, strict=True):
        result = _KINDS[_kind(correction, result)].corrected(result, numbers)
    return result


def parameterised_operation(operation: Operation, corrections: Sequence[Correction]) -> Operation:
    """Return an operation with corrections as expressions of their symbols."""
    if isinstance(operation, Override):
        inner = parameterised_operation(operation.operation, corrections)
        return replace(operation, operation=inner)
    result: Any = operation.rebuild() or operation
    before: Factors = ()
    between: Factors = ()
    after: Factors = ()
    for correction in corrections:
        kind = _KINDS[_kind(correction, result)]
        if kind.inserted is None or not isinstance(result, (Joint, AddFrame, Attach)):
            result = kind.corrected(result, correction.symbols)  # type: ignore[arg-type]
            continue
        first, second, third = kind.inserted(result, correction.symbols)
        before, between, after = first + before, between + second, third + after
    return CorrectedOperation(result, before, between, after) if before + between + after else result


def _kind(correction: Correction, operation: Operation) -> str:
    return "mecanum" if correction.word == "wheels" and isinstance(operation, Mecanum) else correction.word


def with_parameters(operation: Operation, new: Mapping[Symbol, Symbol]) -> Operation:
    """Return an operation with parameters replaced by others of other values; itself if it has none."""
    if isinstance(operation, Override):
        inner = with_parameters(operation.operation, new)
        return operation if inner is operation.operation else replace(operation, operation=inner)
    mine = operation.rebuild() or operation
    replaced: Operation = replace_parameters(mine, new)
    return operation if replaced is mine else replaced


def replace_parameters(value: Any, new: Mapping[Symbol, Symbol]) -> Any:
    """Return a field with parameters replaced by others of other values; itself if it has none."""
    if isinstance(value, Expression):
        return value.substitute(new) if any(symbol in new for symbol in value.symbols) else value
    if isinstance(value, tuple):
        items = [replace_parameters(item, new) for item in value]
        changed = any(a is not b for a, b in zip(items, value, strict=True))
        return type(value)(items) if changed else value
    if is_dataclass(value) and not isinstance(value, type):
        given = {f.name: getattr(value, f.name) for f in fields(value) if f.init}
        changes = {name: replace_parameters(item, new) for name, item in given.items()}
        changes = {name: item for name, item in changes.items() if item is not given[name]}
        return replace(value, **changes) if changes else value
    return value


# -- selection ---------------------------------------------------------------------------------------------


def find_corrections(model: Model, free: Iterable[str]) -> list[Correction]:
    """Return the corrections that texts like ``offsets pr2/r_*`` stand for, without repetition."""
    found: dict[tuple[str, str], Correction] = {}
    for text in free:
        word, _, pattern = text.strip().partition(" ")
        pattern = pattern.strip()
        if word not in _SPELLINGS:
            raise UnknownNameError(
                f"'{text}' does not say what is free. {suggest(word, _SPELLINGS, 'word')} A word and a "
                "pattern of names are wanted, as in 'offsets arm/*' or 'mount camera'."
            )
        if not pattern:
            raise InvalidValueError(
                f"'{text}' says nothing of where: '{word} PATTERN', as in '{word} arm/*'."
            )
        for correction in _matching(model, word, pattern):
            found.setdefault((correction.word, correction.tag), correction)
    order = list(_KINDS)
    return sorted(found.values(), key=lambda c: order.index(c.word))


def _matching(model: Model, word: str, pattern: str) -> list[Correction]:
    kinds = _SPELLINGS[word]
    tags = {name: _writer(model, "articulations", name) for name in model.articulations}
    if kinds == ("mount",) or kinds == ("length",):
        tags = {**{name: _writer(model, "frames", name) for name in model.frames}, **tags}
    noun = "joint or frame" if kinds[0] in ("mount", "length") else "joint"
    matching = {name: tags[name] for name in match_names(pattern, tags, noun)}
    result: dict[str, Correction] = {}
    has_loops = any(isinstance(_inner(entry.operation), CloseLoop) for entry in model.history.sequence)
    for name, tag in matching.items():
        operation = _inner(model.history.operation(tag)) if tag else None
        for kind in kinds:
            if operation is not None and tag not in result and _KINDS[kind].suits(operation):
                result[tag] = _make_correction(kind, name, tag, operation, has_loops)
    if not result:
        suited = [
            name
            for name, tag in tags.items()
            if tag and any(_KINDS[kind].suits(_inner(model.history.operation(tag))) for kind in kinds)
        ]
        names = sorted(matching)
        which = (
            f"'{names[0]}'" if len(names) == 1 else f"What '{pattern}' names ({len(names)} joints or frames)"
        )
        raise InvalidValueError(
            f"{which} has no {kinds[0]} that can be calibrated; it is for {_KINDS[kinds[0]].wanted}. "
            + (suggest(pattern, suited, "such name") if suited else "This model has none.")
        )
    return list(result.values())


def _inner(operation: Operation) -> Operation:
    while isinstance(operation, Override):
        operation = operation.operation
    return operation.rebuild() or operation


def _writer(model: Model, kind: str, name: str) -> str:
    """Return the tag of the last operation that places what has a name; empty if none does."""
    for entry in reversed(model.history.cells[kind, name]):
        if _is_placed(_inner(entry.operation)):
            return entry.tag
    return ""


def _make_correction(kind: str, name: str, tag: str, operation: Any, has_loops: bool) -> Correction:
    name = str(operation.name) if isinstance(operation, PlacedOperation) else name
    parts = _KINDS[kind].parts
    units = tuple(unit or _coordinate_unit(operation) for _, unit in parts)
    symbols = tuple(
        # With derivatives they are columns of a geometric Jacobian. Loops would take them for coordinates.
        parameter(f"{name}/{part}", 0.0) if has_loops else symbol(f"{name}/{part}", role="location")
        for part, _ in parts
    )
    return Correction("wheels" if kind == "mecanum" else kind, name, tag, symbols, units)


def _coordinate_unit(operation: OneAxisMotion) -> str:
    """Return the unit of a joint's coordinate: [rad] if its motion turns."""
    turn = np.eye(4)
    for factor in operation.motion(as_expression(1.0)):
        turn = turn @ _matrix(factor)()
    return "m" if np.allclose(turn[:3, :3], np.eye(3)) else "rad"
