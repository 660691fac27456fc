"""``kineverse fit``: identification of the joint between two parts from their recorded poses."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from kineverse.errors import InvalidValueError
from kineverse.estimation.recordings import (
    ObservationNoise,
    identify_recorded_joint,
    make_joint_model,
    read_recording,
)
from kineverse.estimation.recordings.recorded_joint import MAX_ROTATION_STEP
from kineverse.expressions.printing import format_number

from .arguments import parse_length, parse_value, print_notes, require
from .output import format_table, show_activity

if TYPE_CHECKING:
    from kineverse.estimation import Fit, IdentificationResult
    from kineverse.estimation.recordings import Assumption, RecordedJoint, RecordedPair

HELP = """\
The table is text, with a head that names its columns: time, part, x, y, z and qx, qy, qz, qw (or roll,
pitch, yaw, or rx, ry, rz, a rotation vector), with units as in "x [mm]". There is a part in each row, or all
parts are in one row, and then columns are called door.x. Exports of ROS bags and PlotJuggler, and files of
OptiTrack, Vicon, TUM, EuRoC and KITTI are read as they are. What the table leaves open, such as the unit of
angles, shows in the motion, or is asked for. A note says what was assumed; --units and --columns replace it.

Errors of a camera at 30 Hz are alike in neighbouring rows. The time over which the residuals are correlated
is estimated, and the poses count for as many independent ones as they are worth. --thin N takes N poses,
evenly over the recording, as independent.

The answer is compared with those for twice the noise, and for the noise of the residuals. If it depends on
these, it is ambiguous, and the other answers are printed.

Joints of all kinds are tried: rigid, prismatic, revolute, screw, cylindrical, spherical, planar, free. Each
gets its probability, given the observations.

The exit status is 0 if the joint is determined, 1 if it is ambiguous, 2 if the table cannot be read.

examples:
  kineverse fit poses.csv --parent cupboard --child door
  kineverse fit poses.csv --child door --noise 3mm,1deg --picture door.png
  kineverse fit handle.log --columns x,y,z,- --families prismatic,revolute
  kineverse fit poses.csv --child door --document door.kv.json     then: kineverse view door.kv.json"""

AMBIGUOUS = 1


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("poses", metavar="POSES", help="path of the table")
    parser.add_argument(
        "--parent", metavar="NAME", default="world", help="part relative to which the child moves (world)"
    )
    parser.add_argument("--child", metavar="NAME", help="part that moves; needed if there are several")
    parser.add_argument(
        "--columns", metavar="NAMES", help="names of the columns: x,y,z,-,qx,... (- to ignore one)"
    )
    parser.add_argument(
        "--units",
        metavar="UNITS",
        help="units of columns without one: mm, deg, or mm,deg (m, rad, if possible)",
    )
    parser.add_argument(
        "--noise",
        metavar="M[,RAD]",
        help="standard deviations of poses, of each coordinate and about each axis: 3mm,1deg (estimated)",
    )
    parser.add_argument(
        "--thin",
        metavar="N",
        type=int,
        help="number of poses to use, evenly spaced, with independent errors (all, by their correlation)",
    )
    parser.add_argument("--families", metavar="NAMES", help="joint families to try: prismatic,revolute (all)")
    parser.add_argument("--picture", metavar="FILE", help="draw the observations and the joint (.png, .svg)")
    parser.add_argument("--document", metavar="FILE", help="write the joint as a model (.kv.json)")
    parser.add_argument("--json", action="store_true", help="everything, as one JSON object")


def run(arguments: argparse.Namespace) -> int:
    """Read the table, identify the joint, and print, draw and save it."""
    if arguments.document and not arguments.document.endswith(".kv.json"):
        raise InvalidValueError(
            f"--document {arguments.document!r}: the joint is written as a document, whose name ends in "
            ".kv.json. Then: kineverse convert joint.kv.json joint.urdf"
        )
    require("kineverse fit --picture", {"figures": arguments.picture is not None})
    stated = None if arguments.noise is None else parse_noise(arguments.noise)
    recording = read_recording(arguments.poses, arguments.columns, arguments.units)
    if recording.assumptions:
        print_notes([f"assumed: {'; '.join(recording.assumptions)}"])
    if recording.ignored:
        print_notes([f"columns that mean nothing here: {', '.join(recording.ignored)}"])
    pair = recording.pair(arguments.parent, arguments.child)
    if pair.unpaired:
        print_notes([f"{pair.unpaired} poses of one part without the other"])
    if arguments.thin is not None:
        pair = pair.thin(arguments.thin)
    noise = None if stated is None else check_noise(stated, pair)
    families = None if arguments.families is None else [n.strip() for n in arguments.families.split(",")]
    with show_activity(f"learning from {len(pair.lines)} poses"):
        learned = identify_recorded_joint(pair, noise, families, independent=arguments.thin is not None)
    written = write_results(arguments, pair, learned)
    if arguments.json:
        read = {"poses": arguments.poses, "assumptions": list(recording.assumptions)}
        answer = {**read, **fit_to_json(pair, learned), **written}
        print(json.dumps(answer, indent=2, allow_nan=False))
    else:
        print(format_fit(arguments.poses, pair, learned))
        for what, path in written.items():
            if path:
                print(f"{what}: {path}")
    return AMBIGUOUS if learned.is_ambiguous else 0


def parse_noise(text: str) -> tuple[float, float | None]:
    """Return the standard deviations [m], [rad] of a text such as ``3mm,1deg``, or ``3mm`` for positions."""
    first, comma, second = text.partition(",")
    try:
        position = parse_length(first)
        orientation = parse_value(second) if comma else None
        good = position > 0.0 and (orientation is None or orientation > 0.0)
    except InvalidValueError:
        good = False
    if not good or second.strip().endswith("m"):
        raise InvalidValueError(
            f"--noise {text!r}: write two positive numbers of m and rad: 0.003,0.02 or 3mm,1deg"
        )
    return position, orientation


def check_noise(stated: tuple[float, float | None], pair: RecordedPair) -> ObservationNoise:
    """Return the stated noise of the observations of a pair."""
    position, orientation = stated
    if orientation is None and pair.has_orientation:
        raise InvalidValueError("--noise of poses has two values, of positions and of orientations: 3mm,1deg")
    return ObservationNoise(position, orientation if pair.has_orientation else None, True)


def write_results(
    arguments: argparse.Namespace, pair: RecordedPair, learned: RecordedJoint
) -> dict[str, Any]:
    """Write the requested picture and document, and return their paths."""
    fit = learned.fit
    if arguments.picture:
        from kineverse.view.plots import SIZE, Figure, draw_fit  # for start-up time

        title = f"{pair.child} in {pair.parent}: {learned.found}"
        picture = Figure(lambda c: draw_fit(c, fit, pair.relative, title), SIZE)
        picture.save(arguments.picture)
    if arguments.document:
        make_joint_model(pair.select(fit.inliers), fit).save(arguments.document)
    return {"picture": arguments.picture, "document": arguments.document}


_LEAST_PROBABILITY = 1e-4  # less probable families are named without numbers
_MOST_LISTED = 10  # number of outliers listed


def format_fit(source: str, pair: RecordedPair, learned: RecordedJoint) -> str:
    """Return the joint as text, with its uncertainty and the alternatives."""
    found, best, count = learned.found, learned.fit, len(pair.child_poses)
    verdict = f"{best.family}, {_format_percent(best.probability)}"
    if learned.is_ambiguous:
        verdict = f"{format_doubt(learned)}\nThe most probable one: {verdict}"
    what = "poses" if pair.child_poses.ndim == 3 else "positions"
    turns = []
    if pair.is_timed and best.largest_turn >= MAX_ROTATION_STEP:
        most = format_number(math.degrees(best.largest_turn), 3)
        turns = [f"  from one to the next it turns by up to {most} deg: it may be more turns, or fewer"]
    lines = [
        f"{pair.child} in {pair.parent}: {count} {what} ({source})",
        *_format_correlation(learned, count),
        f"noise: {_format_deviations(learned.noise)}, {'as given' if learned.noise.given else 'estimated'}",
        "",
        verdict,
        *(f"  {name:10}{value}" for name, value in _format_parameters(best)),
        *_format_outliers(best.outliers, count, what),
        *turns,
        "",
        *_format_ranking(found),
    ]
    return "\n".join(lines)


def fit_to_json(pair: RecordedPair, learned: RecordedJoint) -> dict[str, Any]:
    """Return the identified joints as JSON data."""
    found, noise = learned.found, learned.noise
    return {
        "parent": pair.parent,
        "child": pair.child,
        "count": len(pair.child_poses),
        "judged": learned.judged,
        "orientations": pair.child_poses.ndim == 3,
        "noise": {"position": noise.position, "orientation": noise.orientation, "given": noise.given},
        "correlation_time": learned.correlation_time,
        "repeated": learned.repeated,
        "told": not learned.is_ambiguous,
        "family": found.best.family,
        "says": format_doubt(learned) if learned.is_ambiguous else str(found),
        "objections": [
            {
                "family": other.found.best.family,
                "probability": other.found.best.probability,
                "noise": {"position": other.noise.position, "orientation": other.noise.orientation},
                "correlation_time": other.correlation_time,
            }
            for other in learned.objections
        ],
        "outliers": list(learned.fit.outliers),
        "fits": [_fit_to_json(fit) for fit in (learned.fit, *found.fits[1:])],
    }


def format_doubt(learned: RecordedJoint) -> str:
    """Return the reason why a joint is ambiguous: the result itself, or what it depends on."""
    found = learned.found
    if not learned.objections:
        return "no joint explains these poses" if learned.is_free else str(found)
    answers = [] if found.is_ambiguous else [f"{found.best.family} if {_format_assumption(learned, learned)}"]
    for other in learned.objections:
        result = other.found
        answer = "nothing is sure" if result.is_ambiguous else result.best.family
        answers.append(f"{answer} if {_format_assumption(other, learned)}")
    first = f"{found}; " if found.is_ambiguous else "cannot tell: "
    return first + ", ".join(answers)


def _format_assumption(assumed: Assumption, made: RecordedJoint) -> str:
    if assumed.correlation_time != made.correlation_time:
        return f"errors are alike over {format_number(assumed.correlation_time, 2)} rows"
    return f"the noise is {_format_deviations(assumed.noise)}"


def _format_correlation(learned: RecordedJoint, count: int) -> list[str]:
    lines = []
    if learned.repeated:
        do = "row repeats" if learned.repeated == 1 else "rows repeat"
        lines.append(f"{learned.repeated} {do} the one before in every digit, and count as not there")
    if learned.judged < count - learned.repeated:
        time = format_number(learned.correlation_time, 2)
        lines.append(
            f"errors are alike over {time} rows, so these are worth {learned.judged} independent ones "
            f"(--thin {count} takes all as independent)"
        )
    return lines


def _format_deviations(noise: ObservationNoise) -> str:
    position = f"{format_number(1e3 * noise.position, 3)} mm"
    if noise.orientation is None:
        return position
    return f"{position} and {format_number(math.degrees(noise.orientation), 3)} deg"


def _format_parameters(fit: Fit) -> list[tuple[str, str]]:
    parts = []
    for name in ("axis", "normal"):
        if name in fit.parameters:
            spread = _standard_deviation(fit, "axis.x", "axis.y")
            error = format_number(math.degrees(spread), 2)
            parts.append((name, f"{_format_vector(fit, name)}   ± {error} deg"))
    for name in ("point", "centre"):
        if name in fit.parameters:
            spread = _standard_deviation(fit, "point.x", "point.y", "point.z")
            parts.append((name, f"{_format_vector(fit, name)} m   ± {format_number(1e3 * spread, 2)} mm"))
    if "pitch" in fit.parameters:
        pitch, spread = 1e3 * float(fit.parameters["pitch"]), 1e3 * fit.deviation("pitch")
        parts.append(("pitch", f"{format_number(pitch)} mm per revolution   ± {format_number(spread, 2)} mm"))
    for low, high, spread, turns in joint_ranges(fit):
        scale, unit = (math.degrees(1.0), "deg") if turns else (1e3, "mm")
        ends = f"{format_number(scale * low)} … {format_number(scale * high)} {unit}"
        parts.append(("seen", f"{ends}   ± {format_number(scale * spread, 2)} {unit} at each end"))
    rms = f"{format_number(1e3 * fit.rms[0], 3)} mm"
    if fit.residuals.shape[1] > 3:
        rms += f", {format_number(math.degrees(fit.rms[1]), 3)} deg"
    return [*parts, ("left over", f"{rms} rms")]


def _format_outliers(outliers: Sequence[int], count: int, what: str) -> list[str]:
    """Return a line with the indices of outliers, from 0; none if there are no outliers."""
    if not outliers:
        return []
    numbers = ", ".join(map(str, outliers[:_MOST_LISTED]))
    more = ", …" if len(outliers) > _MOST_LISTED else ""
    do = "does" if len(outliers) == 1 else "do"
    return [f"  {len(outliers)} of {count} {what} {do} not fit: {numbers}{more} (counted from 0)"]


def joint_ranges(fit: Fit) -> list[tuple[float, float, float, bool]]:
    """Return for each joint value its range, the standard deviation of the ends, and if it is an angle."""
    ranges = []
    for k, kind in enumerate(fit.motion.kinds):
        values = fit.joint_values[fit.inliers, k]
        ends = [values.argmin(), values.argmax()]
        spread = float(fit.deviations[fit.inliers, k][ends].max())
        ranges.append((float(values.min()), float(values.max()), spread, bool(kind)))
    return ranges


def _format_ranking(found: IdentificationResult) -> list[str]:
    shown = [found[name] for name, p in found.probabilities.items() if p >= _LEAST_PROBABILITY]
    head = ["joint", "probability", "log evidence", "left [mm]", "left [deg]"]
    rows = []
    for fit in shown:
        left = [format_number(1e3 * fit.rms[0], 3), "-"]
        if fit.residuals.shape[1] > 3:
            left[1] = format_number(math.degrees(fit.rms[1]), 3)
        rows.append([fit.family, _format_percent(fit.probability), format_number(fit.log_evidence, 6), *left])
    if any(fit.reason for fit in shown):
        head, rows = [*head, "not known"], [[*row, fit.reason] for row, fit in zip(rows, shown, strict=True)]
    lines = [format_table(head, rows, "<>>>>")]
    rest = [name for name, p in found.probabilities.items() if p < _LEAST_PROBABILITY]
    return [*lines, f"not: {', '.join(rest)}"] if rest else lines


def _fit_to_json(fit: Fit) -> dict[str, Any]:
    return {
        "family": fit.family,
        "probability": fit.probability,
        "log_evidence": fit.log_evidence,
        "told": fit.is_determined,
        "reason": fit.reason,
        "parameters": {name: np.asarray(value).tolist() for name, value in fit.parameters.items()},
        "deviations": {name: fit.deviation(name) for name in fit.coordinates},
        "frame": fit.frame.tolist(),
        "ranges": [
            {"lower": low, "upper": high, "deviation": spread, "unit": "rad" if turns else "m"}
            for low, high, spread, turns in joint_ranges(fit)
        ],
        "rms": {"position": fit.rms[0], "orientation": fit.rms[1] if fit.residuals.shape[1] > 3 else None},
    }


def _standard_deviation(fit: Fit, *coordinates: str) -> float:
    """Return the root of the summed variances of coordinates; those that the fit lacks are skipped."""
    return math.hypot(*(fit.deviation(name) for name in coordinates if name in fit.coordinates))


def _format_vector(fit: Fit, name: str) -> str:
    return " ".join(f"{x:.4f}" for x in np.asarray(fit.parameters[name]))


def _format_percent(probability: float) -> str:
    """Return a probability in percent; below 1 it is at most 99.99 %."""
    percent = 100.0 * probability
    return f"{min(percent, 99.99):.4g} %" if probability < 1.0 else "100 %"
