"""``kineverse diff``: differences of two models."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from kineverse.errors import InvalidValueError
from kineverse.expressions.expression import Expression
from kineverse.expressions.printing import format_number
from kineverse.model.articulation import Articulation
from kineverse.model.body import Body, Inertia, Mesh, Pose, Shape
from kineverse.model.comparison import (
    SIGNS,
    BehaviourComparison,
    Delta,
    ModelComparison,
    ValueDifference,
    field_names,
)
from kineverse.model.constraint import Constraint
from kineverse.model.frame import Frame
from kineverse.model.operation import ARTICULATIONS, BODIES, CONSTRAINTS, DATA, FRAMES, RATES
from kineverse.view.poses import roll_pitch_yaw

from .arguments import add_model_options, load_model
from .output import colorize, format_contents, format_count, shorten_text, show_activity, truncate_lines

HELP = """\
Models are compared name by name, whatever their formats. Numbers and formulas that agree within the tolerance
at sampled states count as equal. Operations are compared if most of them have a counterpart with the same
tag. Meshes are compared by name, not by the content of the files.

With --values, behaviour is compared instead of structure: the poses of all frames in the world at sampled
states, and the limits of the degrees of freedom. Helper frames without bodies, which some formats need, are
listed but not counted.

  +  only in B      -  only in A      ~  changed      >  at another position

The exit status is 0 if they are equal, 1 if they differ, and 2 if a model cannot be read.

examples:
  kineverse diff robot_old.urdf robot.urdf
  kineverse diff robot.urdf robot.sdf --values
  kineverse diff kitchen my_kitchen.urdf --prefix kitchen --tolerance 1e-4
  kineverse diff home.kv.json today.kv.json --json"""

EQUAL, DIFFERENT = 0, 1
SHOWN = 20  # number of differences of a kind printed without --all


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    for name, what in (("A", "model before"), ("B", "model after")):
        parser.add_argument(
            name.lower(), metavar=name, help=f"{what}: name of a shipped model, or path of a file"
        )
    parser.add_argument("--prefix", metavar="NAME", help="prefix of all names of both, followed by a slash")
    add_model_options(parser)
    parser.add_argument(
        "--tolerance",
        metavar="X",
        type=float,
        default=1e-9,
        help="largest difference of equal numbers (1e-9): [m], [rad], relative above 1; 0: equal to the bit",
    )
    parser.add_argument("--values", action="store_true", help="compare poses at sampled states, and limits")
    parser.add_argument(
        "--operations",
        choices=("auto", "yes", "no"),
        default="auto",
        help="compare operations, too (auto: if most of them have a counterpart)",
    )
    parser.add_argument("--all", action="store_true", help=f"print more than {SHOWN} differences of a kind")
    parser.add_argument("--json", action="store_true", help="everything, as one JSON object")


def run(arguments: argparse.Namespace) -> int:
    """Load both models, compare them, and print the differences."""
    if not (math.isfinite(arguments.tolerance) and arguments.tolerance >= 0.0):
        raise InvalidValueError(f"--tolerance is a number from 0 on, not {arguments.tolerance}.")

    models = []
    for source in (arguments.a, arguments.b):
        with show_activity(f"reading {source}"):
            models.append(load_model(arguments, source, arguments.prefix))
    before, after = models
    report: BehaviourComparisonReport | ModelComparisonReport
    with show_activity("comparing"):
        if arguments.values:
            report = BehaviourComparisonReport(BehaviourComparison(before, after, arguments.tolerance))
        else:
            report = ModelComparisonReport(
                ModelComparison(before, after, arguments.tolerance, arguments.operations)
            )
    equal = report.comparison.equal
    if arguments.json:
        answer = {
            "before": arguments.a,
            "after": arguments.b,
            "equal": equal,
            "tolerance": arguments.tolerance,
        }
        print(json.dumps({**answer, **report.as_json()}, allow_nan=False))
    else:
        sides = (("-", arguments.a, before), ("+", arguments.b, after))
        head = [colorize(f"{sign * 3} {name}  {format_contents(model)}", sign) for sign, name, model in sides]
        blocks = report.blocks(None if arguments.all else SHOWN)
        print("\n\n".join("\n".join(block) for block in ([] if equal else head, *blocks) if block))
    return EQUAL if equal else DIFFERENT


LONGEST = 60
_NEGLIGIBLE = 1e-9  # threshold below which a distance is printed as zero beside a larger one [m], [rad]


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
    if names := field_names(given):
        parts = (format_value(getattr(given, name)) for name in names)
        return " ".join([type(given).__name__.lower(), *parts])
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


ORDER = (FRAMES, CONSTRAINTS, BODIES, ARTICULATIONS, RATES, DATA)
WORDS = {**SIGNS, ">": "moved"}
_WIDEST = 44


@dataclass(frozen=True)
class ModelComparisonReport:
    """Printable differences of two models, by value."""

    comparison: ModelComparison

    def blocks(self, most: int | None) -> list[list[str]]:
        """Return the paragraphs of the report, with at most ``most`` differences each."""
        result = [_operation_lines(self.comparison, most)] if any(self.comparison.operations.values()) else []
        for kind in ORDER:
            differences = self.comparison.by_kind(kind)
            if differences:
                result.append([colorize(kind, "bold"), *_difference_lines(differences, most)])
        result.append(_totals(self.comparison))
        return result

    def as_json(self) -> dict[str, Any]:
        """Return the report as JSON data, by operation and by kind of data."""
        operations = {WORDS[sign]: list(tags) for sign, tags in self.comparison.operations.items()}
        return {
            "operations": operations if self.comparison.operations_compared else None,
            **{kind: _kind_to_json(self.comparison.by_kind(kind)) for kind in ORDER},
            "alike": self.comparison.alike,
        }


def _operation_lines(comparison: ModelComparison, most: int | None) -> list[str]:
    lines = [
        f"  {colorize(sign, sign)} {tag}" for sign, tags in comparison.operations.items() for tag in tags
    ]
    return [colorize("operations", "bold"), *truncate_lines(lines, most)]


def _difference_lines(differences: list[ValueDifference], most: int | None) -> list[str]:
    shown = differences[:most]
    width = min(max(len(d.change.name) for d in shown), _WIDEST)
    entries = []
    for difference in shown:
        first, *others = _difference_texts(difference)
        sign = colorize(difference.sign, difference.sign)
        line = f"  {sign} {difference.change.name:<{width}}  {first}".rstrip()
        entries.append("\n".join([line, *(" " * (width + 6) + text for text in others)]))
    return [*entries, *truncate_lines([""] * len(differences), len(shown))[len(shown) :]]


def _difference_texts(difference: ValueDifference) -> list[str]:
    change = difference.change
    if change.before is not None and change.after is not None:
        return [text for delta in difference.parts for text in format_delta(delta)]
    value = change.after if change.before is None else change.before
    return [format_value(value[1] if change.kind == RATES else value)]


def _totals(comparison: ModelComparison) -> list[str]:
    """Return the number of differences, with a note on those that are not counted."""
    within = f"within {comparison.tolerance:g}" if comparison.tolerance else "to the bit"
    notes = []
    if comparison.alike:
        notes.append(f"{format_count(len(comparison.alike), 'value')} written or rounded in another way")
    if not comparison.operations_compared:
        notes.append("operations not compared")
    note = f" ({', '.join(notes)})" if notes else ""
    if comparison.equal:
        return [f"equal {within}: {format_contents(comparison.after)}{note}"]
    counts = ", ".join(f"{count} {word}" for word, count in comparison.counts.items() if count)
    count = format_count(len(comparison.differences), "difference")
    lines = [f"{count}: {counts or 'in operations only'}{note}"]
    before, after = comparison.before.frames, comparison.after.frames
    if before and after and not set(before) & set(after):
        lines.append("They have no frame in common; --prefix NAME puts the same name in front of both.")
    return lines


def _kind_to_json(differences: list[ValueDifference]) -> dict[str, Any]:
    by_sign = {word: [d for d in differences if d.sign == sign] for sign, word in SIGNS.items()}
    return {
        "added": [d.change.name for d in by_sign["added"]],
        "removed": [d.change.name for d in by_sign["removed"]],
        "changed": [
            {"name": d.change.name, "parts": [_delta_to_json(delta) for delta in d.parts]}
            for d in by_sign["changed"]
        ],
    }


def _delta_to_json(delta: Delta) -> dict[str, Any]:
    return {
        "what": delta.what,
        "before": value_to_json(delta.before),
        "after": value_to_json(delta.after),
        "distance": delta.distance if math.isfinite(delta.distance) else None,
        "angle": delta.angle if math.isfinite(delta.angle) else None,
    }


@dataclass(frozen=True)
class BehaviourComparisonReport:
    """Printable differences of two models, by behaviour."""

    comparison: BehaviourComparison

    def blocks(self, most: int | None) -> list[list[str]]:
        """Return the paragraphs of the report, with at most ``most`` lines each."""
        result = []
        for title, sides in (
            ("frames", self.comparison.frames),
            ("degrees of freedom", self.comparison.freedoms),
        ):
            lines = [
                f"  {colorize(sign, sign)} {name}"
                for sign, side in (("-", "removed"), ("+", "added"))
                for name in sides[side]
            ]
            if lines:
                result.append([colorize(title, "bold"), *truncate_lines(lines, most)])
        if self.comparison.apart:
            width = max(len(a.frame) for a in self.comparison.apart)
            lines = [
                f"  {colorize('~', '~')} {a.frame:<{width}}  {format_pose_difference(a.distance, a.angle)}"
                for a in self.comparison.apart
            ]
            title = f"{colorize('poses', 'bold')}, at worst in {self.comparison.states} states"
            result.append([title, *truncate_lines(lines, most)])
        if self.comparison.ranges:
            width = max(len(r.name) for r in self.comparison.ranges)
            lines = [
                f"  {colorize('~', '~')} {r.name:<{width}}  "
                f"{format_interval(*r.before)} → {format_interval(*r.after)}"
                for r in self.comparison.ranges
            ]
            result.append([colorize("limits", "bold"), *truncate_lines(lines, most)])
        if self.comparison.helpers:
            names = ", ".join(self.comparison.helpers[:most])
            more = "" if most is None or len(self.comparison.helpers) <= most else ", ..."
            result.append([f"not counted, in between and without bodies: {names}{more}"])
        if not self.comparison.apart:
            common = format_count(len(self.comparison.frames["common"]), "frame")
            agree = f"{common} at the same places in {self.comparison.states} states"
            result.append(
                [
                    f"{agree}, to within {format_pose_difference(*self.comparison.largest)}"
                    if any(self.comparison.largest)
                    else agree
                ]
            )
        return result

    def as_json(self) -> dict[str, Any]:
        """Return the report as JSON data; a distance is null if the pose exists on one side only."""
        return {
            "states": self.comparison.states,
            "largest": {
                "distance": _finite_or_none(self.comparison.largest[0]),
                "angle": _finite_or_none(self.comparison.largest[1]),
            },
            "frames": {
                "removed": self.comparison.frames["removed"],
                "added": self.comparison.frames["added"],
                "helpers": self.comparison.helpers,
                "changed": [
                    {
                        "name": a.frame,
                        "distance": _finite_or_none(a.distance),
                        "angle": _finite_or_none(a.angle),
                    }
                    for a in self.comparison.apart
                ],
            },
            "dof": {
                "removed": self.comparison.freedoms["removed"],
                "added": self.comparison.freedoms["added"],
                "changed": [
                    {
                        "name": r.name,
                        "before": [_finite_or_none(bound) for bound in r.before],
                        "after": [_finite_or_none(bound) for bound in r.after],
                    }
                    for r in self.comparison.ranges
                ],
            },
        }


def _finite_or_none(number: float) -> float | None:
    return number if math.isfinite(number) else None
