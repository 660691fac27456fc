"""``kineverse fit``: identification of the joint between two parts from their recorded poses."""

from __future__ import annotations

import argparse
import json
import sys
from typing import TYPE_CHECKING, Any

from kineverse.errors import InvalidValueError

from .arguments import parse_length, parse_value, require
from .output import show_activity

if TYPE_CHECKING:
    from kineverse.estimation.recordings import ObservationNoise, RecordedJoint, RecordedPair


HELP = """\
The table is text, with a head that names its columns: time, part, x, y, z and qx, qy, qz, qw (or roll,
pitch, yaw, or rx, ry, rz, a rotation vector), in m, rad and s unless a unit follows as in "x [mm]". There is
a part in each row, or all parts are in one row, and then columns are called door.x. Without a head, 3 columns
are positions and 7 are poses.

Errors of a camera at 30 Hz are alike in neighbouring rows. The time over which the residuals are correlated
is estimated, and the poses count for as many independent ones as they are worth. --thin N takes N poses,
evenly over the recording, as independent.

The answer is compared with those for half and twice the noise, and for the noise of the residuals. If it
depends on these, it is ambiguous, and the other answers are printed.

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
        "--parent",
        metavar="NAME",
        default="world",
        help="part relative to which the child moves (world)",
    )
    parser.add_argument("--child", metavar="NAME", help="part that moves; needed if there are several")
    parser.add_argument(
        "--columns", metavar="NAMES", help="names of the columns: x,y,z,-,qx,... (- to ignore one)"
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
    from kineverse.estimation.recordings import identify_recorded_joint, read_recording

    from .fit_output import fit_to_json, format_fit

    if arguments.document and not arguments.document.endswith(".kv.json"):
        raise InvalidValueError(
            f"--document {arguments.document!r}: the joint is written as a document, whose name ends in "
            ".kv.json. Then: kineverse convert joint.kv.json joint.urdf"
        )
    require("kineverse fit --picture", {"figures": arguments.picture is not None})
    stated = None if arguments.noise is None else parse_noise(arguments.noise)
    recording = read_recording(arguments.poses, arguments.columns)
    if recording.ignored:
        names = ", ".join(recording.ignored)
        print(f"kineverse: note: columns that mean nothing here: {names}", file=sys.stderr)
    pair = recording.pair(arguments.parent, arguments.child)
    if pair.unpaired:
        print(f"kineverse: note: {pair.unpaired} poses of one part without the other", file=sys.stderr)
    if arguments.thin is not None:
        pair = pair.thin(arguments.thin)
    noise = None if stated is None else check_noise(stated, pair)
    families = None if arguments.families is None else [n.strip() for n in arguments.families.split(",")]
    with show_activity(f"learning from {len(pair.lines)} poses"):
        learned = identify_recorded_joint(pair, noise, families, independent=arguments.thin is not None)
    written = write_results(arguments, pair, learned)
    if arguments.json:
        answer = {"poses": arguments.poses, **fit_to_json(pair, learned), **written}
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
    from kineverse.estimation.recordings import ObservationNoise

    position, orientation = stated
    if orientation is None and pair.has_orientation:
        raise InvalidValueError("--noise: poses have two, of positions and orientations: 3mm,1deg")
    return ObservationNoise(position, orientation if pair.has_orientation else None, True)


def write_results(
    arguments: argparse.Namespace, pair: RecordedPair, learned: RecordedJoint
) -> dict[str, Any]:
    """Write the requested picture and document, and return their paths."""
    fit = learned.fit
    if arguments.picture:
        from kineverse.view.plots import SIZE, Figure, draw_fit

        title = f"{pair.child} in {pair.parent}: {learned.found}"
        picture = Figure(lambda c: draw_fit(c, fit, pair.relative, title), SIZE)
        picture.save(arguments.picture)
    if arguments.document:
        from .fit_output import make_joint_model

        make_joint_model(pair.select(fit.inliers), fit).save(arguments.document)
    return {"picture": arguments.picture, "document": arguments.document}
