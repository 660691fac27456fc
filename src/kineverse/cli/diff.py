"""``kineverse diff``: differences of two models."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
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
    for name, when in (("A", "before"), ("B", "after")):
        what = f"model {when}: name of a shipped model, or path of a file"
        parser.add_argument(name.lower(), metavar=name, help=what)
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
    most = None if arguments.all else SHOWN
    comparison: ModelComparison | BehaviourComparison
    with show_activity("comparing"):
        if arguments.values:
            comparison = BehaviourComparison(before, after, arguments.tolerance)
        else:
            comparison = ModelComparison(before, after, arguments.tolerance, arguments.operations)
    equal = comparison.equal
    if arguments.json:
        answer = {"before": arguments.a, "after": arguments.b, "equal": equal}
        answer |= {"tolerance": arguments.tolerance, **_to_json(comparison)}
        print(json.dumps(answer, allow_nan=False))
    else:
        sides = (("-", arguments.a, before), ("+", arguments.b, after))
        head = [colorize(f"{sign * 3} {name}  {format_contents(model)}", sign) for sign, name, model in sides]
        blocks = _blocks(comparison, most)
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
        number = given.is_constant and not given.shape
        return format_value(float(given)) if number else shorten_text(repr(given), LONGEST)
    if isinstance(given, Constraint):
        return " <= ".join(map(format_value, (given.lower, given.expression, given.upper)))
    if isinstance(given, Frame):
        return f"in {given.parent}"
    if isinstance(given, Articulation):
        return f"{given.kind}, {given.parent} to {given.child}"
    if isinstance(given, Body):
        counts = (len(given.visuals), "visual"), (len(given.collisions), "collision shape")
        parts = [] if given.inertia is None else [format_value(given.inertia)]
        return ", ".join(parts + [format_count(*count) for count in counts if count[0]]) or "empty"
    if isinstance(given, Shape):
        return format_value(given.geometry)
    if isinstance(given, Mesh):
        return f"mesh {given.uri}"
    if isinstance(given, Inertia):
        return f"{format_number(given.mass)} kg"
    if isinstance(given, Pose):
        return f"at {' '.join(format_number(x) for x in given.rows[3::4])}"
    if names := field_names(given):
        return " ".join([type(given).__name__.lower(), *(format_value(getattr(given, n)) for n in names)])
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
        far = math.isfinite(delta.distance)
        return [f"{name}{before}, {f'off by {format_number(delta.distance, 2)}' if far else 'otherwise'}"]
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
        rows = [(pose.rows[3::4], roll_pitch_yaw(pose.matrix)) for pose in (delta.before, delta.after)]
        for name, *sides in zip(("xyz", "rpy"), *rows, strict=True):
            before, after = (" ".join(map(format_number, numbers)) for numbers in sides)
            if before != after:
                yield f"{name} {before} → {after}"
        return
    for row, name in enumerate("xyz"):
        before, after = (_transform_entry(side, row) for side in (delta.before, delta.after))
        if before != after:
            yield f"{name} = {before} → {after}"


def _transform_entry(side: Pose | Expression, row: int) -> str:
    return format_number(side.rows[4 * row + 3], 6) if isinstance(side, Pose) else format_value(side[row, 3])


ORDER = (FRAMES, CONSTRAINTS, BODIES, ARTICULATIONS, RATES, DATA)
WORDS = {**SIGNS, ">": "moved"}
_WIDEST = 44


def _blocks(comparison: ModelComparison | BehaviourComparison, most: int | None) -> list[list[str]]:
    """Return the paragraphs of the report, with at most ``most`` differences each."""
    if isinstance(comparison, BehaviourComparison):
        return _behaviour_blocks(comparison, most)
    result = [_name_lines("operations", comparison.operations, most)]
    for kind in ORDER:
        differences = comparison.by_kind(kind)
        if differences:
            result.append([colorize(kind, "bold"), *_difference_lines(differences, most)])
    return [*result, _totals(comparison)]


def _to_json(comparison: ModelComparison | BehaviourComparison) -> dict[str, Any]:
    """Return the differences as JSON data, by operation and by kind of data."""
    if isinstance(comparison, BehaviourComparison):
        return _behaviour_to_json(comparison)
    operations = {WORDS[sign]: list(tags) for sign, tags in comparison.operations.items()}
    return {
        "operations": operations if comparison.operations_compared else None,
        **{kind: _kind_to_json(comparison.by_kind(kind)) for kind in ORDER},
        "alike": comparison.alike,
    }


def _name_lines(title: str, names: Mapping[str, Iterable[str]], most: int | None) -> list[str]:
    """Return a paragraph with names by their sign; none if there are no names."""
    lines = [f"  {colorize(sign, sign)} {name}" for sign, side in names.items() for name in side]
    return [colorize(title, "bold"), *truncate_lines(lines, most)] if lines else []


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
        **_apart_to_json(delta.distance, delta.angle),
    }


def _behaviour_blocks(comparison: BehaviourComparison, most: int | None) -> list[list[str]]:
    states, (apart, ranges) = comparison.states, (comparison.apart, comparison.ranges)
    result = [
        _name_lines(title, {"-": sides["removed"], "+": sides["added"]}, most)
        for title, sides in (("frames", comparison.frames), ("degrees of freedom", comparison.freedoms))
    ]
    if apart:
        rows = [(a.frame, format_pose_difference(a.distance, a.angle)) for a in apart]
        title = f"{colorize('poses', 'bold')}, at worst in {states} states"
        result.append([title, *_changed_lines(rows, most)])
    if ranges:
        rows = [(r.name, f"{format_interval(*r.before)} → {format_interval(*r.after)}") for r in ranges]
        result.append([colorize("limits", "bold"), *_changed_lines(rows, most)])
    if comparison.helpers:
        names = ", ".join(comparison.helpers[:most])
        more = "" if most is None or len(comparison.helpers) <= most else ", ..."
        result.append([f"not counted, in between and without bodies: {names}{more}"])
    if not apart:
        common = format_count(len(comparison.frames["common"]), "frame")
        within = f", to within {format_pose_difference(*comparison.largest)}"
        agree = f"{common} at the same places in {states} states"
        result.append([agree + within if any(comparison.largest) else agree])
    return result


def _changed_lines(rows: Sequence[tuple[str, str]], most: int | None) -> list[str]:
    width = max(len(name) for name, _ in rows)
    return truncate_lines([f"  {colorize('~', '~')} {name:<{width}}  {text}" for name, text in rows], most)


def _behaviour_to_json(comparison: BehaviourComparison) -> dict[str, Any]:
    frames, freedoms = comparison.frames, comparison.freedoms
    apart = [{"name": a.frame, **_apart_to_json(a.distance, a.angle)} for a in comparison.apart]
    ranges = [
        {"name": r.name, "before": _finite(*r.before), "after": _finite(*r.after)} for r in comparison.ranges
    ]
    sides = {"removed": frames["removed"], "added": frames["added"], "helpers": comparison.helpers}
    return {
        "states": comparison.states,
        "largest": _apart_to_json(*comparison.largest),
        "frames": {**sides, "changed": apart},
        "dof": {"removed": freedoms["removed"], "added": freedoms["added"], "changed": ranges},
    }


def _apart_to_json(distance: float, angle: float) -> dict[str, float | None]:
    """Return a distance [m] and an angle [rad]; they are null if a pose exists on one side only."""
    return dict(zip(("distance", "angle"), _finite(distance, angle), strict=True))


def _finite(*numbers: float) -> list[float | None]:
    return [number if math.isfinite(number) else None for number in numbers]
