"""Values of models and their differences as short text and JSON."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from typing import Any

from kineverse.cli.output import shorten_text
from kineverse.expressions.expression import Expression
from kineverse.expressions.printing import format_number
from kineverse.model.articulation import Articulation
from kineverse.model.body import Body, Inertia, Mesh, Pose, Shape
from kineverse.model.compare import Delta
from kineverse.model.constraint import Constraint
from kineverse.model.frame import Frame
from kineverse.model.model_view import ModelView
from kineverse.view.poses import roll_pitch_yaw

LONGEST = 60
_NEGLIGIBLE = 1e-9
"""Threshold below which a distance is printed as zero beside a larger one [m], [rad]."""


def format_contents(model: ModelView) -> str:
    """Return the numbers of frames, degrees of freedom and constraints of a model."""
    counts = (model.frames, "frame"), (model.degrees_of_freedom, "DoF"), (model.constraints, "constraint")
    return ", ".join(format_count(len(items), noun) for items, noun in counts)


def format_count(count: int, noun: str) -> str:
    """Return a number with its noun, in the plural unless it is 1."""
    if count != 1 and noun != "DoF":
        noun = f"{noun[:-1]}ies" if noun.endswith("dy") else f"{noun}s"
    return f"{count} {noun}"


def format_value(given: Any) -> str:
    """Return a value as a short text."""
    if given is None:
        return "none"
    if isinstance(given, bool | str):
        return str(given) or '""'
    if isinstance(given, int | float):
        return format_number(given, 6) if math.isfinite(given) else str(given)
    if isinstance(given, Expression):
        return _format_expression(given)
    if isinstance(given, Constraint):
        return " <= ".join(map(format_value, (given.lower, given.expression, given.upper)))
    if isinstance(given, Frame):
        return f"in {given.parent}"
    if isinstance(given, Articulation):
        return f"{given.kind}, {given.parent} to {given.child}"
    if isinstance(given, Body):
        return _format_body(given)
    if isinstance(given, Shape):
        return format_value(given.geometry)
    if isinstance(given, Mesh):
        return f"mesh {given.uri}"
    if isinstance(given, Inertia):
        return f"{format_number(given.mass)} kg"
    if isinstance(given, Pose):
        return f"at {' '.join(format_number(x) for x in given.rows[3::4])}"
    if is_dataclass(given):
        return " ".join(
            [type(given).__name__.lower(), *(format_value(getattr(given, f.name)) for f in fields(given))]
        )
    if isinstance(given, tuple):
        return shorten_text(" ".join(map(format_value, given)), LONGEST) or "nothing"
    return shorten_text(str(given), LONGEST)


def value_to_json(given: Any) -> Any:
    """Return a value as JSON data: numbers, lists of them, transforms as matrices; others as text."""
    if isinstance(given, Expression) and given.is_constant and not given.shape:
        given = float(given)
    if given is None or isinstance(given, bool | str | int):
        return given
    if isinstance(given, float):
        return given if math.isfinite(given) else str(given)
    if isinstance(given, Pose):
        return given.matrix.tolist()
    if isinstance(given, tuple):
        return [value_to_json(item) for item in given]
    return repr(given) if isinstance(given, Expression) else format_value(given)


def _format_expression(given: Expression) -> str:
    if given.is_constant and not given.shape:
        return format_value(float(given))
    return shorten_text(repr(given), LONGEST)


def _format_body(body: Body) -> str:
    parts = [] if body.inertia is None else [format_value(body.inertia)]
    for count, what in ((len(body.visuals), "visual"), (len(body.collisions), "collision shape")):
        if count:
            parts.append(format_count(count, what))
    return ", ".join(parts) or "empty"


def format_delta(delta: Delta) -> list[str]:
    """Return the lines that describe the difference of one part of a value."""
    if delta.what == "place":
        return [f"in the world {_format_transform_delta(delta)}"]
    if delta.what == "transform":
        return [_format_transform_delta(delta), *_transform_values(delta)]
    name = f"{delta.what} " if delta.what else ""
    if isinstance(delta.before, Pose) and isinstance(delta.after, Pose):
        return [f"{name}{_format_transform_delta(delta)}"]
    if delta.before is None or delta.after is None:
        value, change = (delta.after, "added") if delta.before is None else (delta.before, "removed")
        return [f"{name}{change}: {format_value(value)}"]
    if delta.distance == 0.0 and delta.angle == 0.0:
        return [f"{name}is written in another way"]
    before, after = format_value(delta.before), format_value(delta.after)
    if before == after:  # equal in the printed digits, or in the printed part of a formula
        off = format_number(delta.distance, 2)
        return [
            f"{name}{before}, off by {off}" if math.isfinite(delta.distance) else f"{name}{before}, otherwise"
        ]
    return [f"{name}{before} → {after}"]


def _format_transform_delta(delta: Delta) -> str:
    """Return the distance and angle between two transforms, at the default state and elsewhere."""
    default, worst = delta.at_default, (delta.distance, delta.angle)
    if max(worst) == 0.0:
        return "is written in another way"
    if not all(map(math.isfinite, worst)):
        return format_pose_difference(*worst)
    if max(default) < _NEGLIGIBLE < max(worst):
        return f"up to {format_pose_difference(*worst)} apart, but not at the default state"
    text = f"{format_pose_difference(*default)} apart"
    further = any(w > 1.001 * d and w - d > _NEGLIGIBLE for w, d in zip(worst, default, strict=True))
    return f"{text}, up to {format_pose_difference(*worst)} elsewhere" if further else text


def format_pose_difference(metres: float, radians: float) -> str:
    """Return a distance [m] and an angle [rad] in millimetres and degrees; zeros are left out."""
    if not (math.isfinite(metres) and math.isfinite(radians)):
        return "somewhere on one side only"
    parts = [f"{format_number(1000.0 * metres, 3)} mm"] if metres else []
    if radians:
        parts.append(f"{format_number(math.degrees(radians), 3)} deg")
    return " and ".join(parts) or "0 mm"


def format_interval(lower: float, upper: float) -> str:
    """Return limits as text."""
    return f"[{format_value(lower)}, {format_value(upper)}]"


def _transform_values(delta: Delta) -> Iterator[str]:
    """Yield origins and angles of transforms whose printed values differ."""
    if isinstance(delta.before, Pose) and isinstance(delta.after, Pose):
        sides = [
            (_format_row(p.rows[3::4]), _format_row(roll_pitch_yaw(p.matrix)))
            for p in (delta.before, delta.after)
        ]
        for name, before, after in zip(("xyz", "rpy"), *sides, strict=True):
            if before != after:
                yield f"{name} {before} → {after}"
        return
    for row, name in enumerate("xyz"):
        before, after = (_transform_entry(side, row) for side in (delta.before, delta.after))
        if before != after:
            yield f"{name} = {before} → {after}"


def _format_row(numbers: Any) -> str:
    return " ".join(format_number(x) for x in numbers)


def _transform_entry(side: Pose | Expression, row: int) -> str:
    return format_number(side.rows[4 * row + 3], 6) if isinstance(side, Pose) else format_value(side[row, 3])
