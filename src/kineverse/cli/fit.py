"""``kineverse fit``: from recorded poses of two parts to the model of what connects them."""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from kineverse.cli.assignments import parse_length, parse_value
from kineverse.cli.progress import doing
from kineverse.errors import ValueRejectedError

if TYPE_CHECKING:
    from kineverse.estimation import Fit, Found
    from kineverse.estimation.recording import Pair

Array = npt.NDArray[np.float64]

HELP = """learn how a part moves from a table of its poses

The table is text, with a head that names its columns: time, part, x, y, z and qx, qy, qz, qw (or roll,
pitch, yaw, or rx, ry, rz, a rotation vector), in m, rad and s unless a unit follows as in "x [mm]". There is
a part in each row, or all parts are in one row, and then columns are called door.x. Without a head, 3 columns
are positions and 7 are poses.

Errors of observations are taken for independent of each other. Those of a camera at 30 Hz are not; where
what is left of neighbours is alike, so many are judged as tell something of their own, evenly over the
recording. --thin N takes another number of them.

Joints of all kinds are tried: rigid, prismatic, revolute, screw, cylindrical, spherical, planar, free. Each
gets the probability with which it explains what was seen.

The exit status is 0 if one of them stands out, 1 if it cannot be told, 2 if the table cannot be read.

examples:
  kineverse fit poses.csv --parent cupboard --child door
  kineverse fit poses.csv --child door --noise 3mm,1deg --picture door.png
  kineverse fit handle.log --columns x,y,z,- --families prismatic,revolute
  kineverse fit poses.csv --child door --document door.kv.json     then: kineverse view door.kv.json"""

UNDECIDED = 1

MOST_TURNED = 2.0
"""Turns are counted where it turns by no more than this from one pose to the next [rad]."""


@dataclass(frozen=True)
class Noise:
    """How far observations are believed to be off.

    Attributes
    ----------
    position, orientation
        Standard deviations of each coordinate [m] and about each axis [rad]; no orientation where only
        positions were seen.
    given
        Whether they were given, rather than estimated.
    """

    position: float
    orientation: float | None
    given: bool


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("poses", metavar="POSES", help="path of the table")
    parser.add_argument(
        "--parent",
        metavar="NAME",
        default="world",
        help="the part in which it moves (world, which stands still)",
    )
    parser.add_argument("--child", metavar="NAME", help="the part that moves, if there are several")
    parser.add_argument(
        "--columns", metavar="NAMES", help="what the columns are: x,y,z,-,qx,... (- for none)"
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
        help="take so many of the poses, evenly (as many as tell something of their own)",
    )
    parser.add_argument("--families", metavar="NAMES", help="only these joints: prismatic,revolute")
    parser.add_argument(
        "--picture", metavar="FILE", help="draw what was seen and what was found (.png, .svg)"
    )
    parser.add_argument("--document", metavar="FILE", help="write the joint as a model (.kv.json)")
    parser.add_argument("--json", action="store_true", help="everything, as one JSON object")


def run(arguments: argparse.Namespace) -> int:
    """Read the table, learn the joint, and say, draw and write it."""
    from kineverse.cli.fit_report import as_json, as_text
    from kineverse.estimation.recording import read_recording

    if arguments.document and not arguments.document.endswith(".kv.json"):
        raise ValueRejectedError(
            f"--document {arguments.document!r}: the joint is written as a document, whose name ends in "
            ".kv.json. Then: kineverse convert joint.kv.json joint.urdf"
        )
    stated = None if arguments.noise is None else parse_noise(arguments.noise)
    recording = read_recording(arguments.poses, arguments.columns)
    if recording.ignored:
        names = ", ".join(recording.ignored)
        print(f"kineverse: note: columns that mean nothing here: {names}", file=sys.stderr)
    pair = recording.pair(arguments.parent, arguments.child)
    if pair.alone:
        print(f"kineverse: note: {pair.alone} poses of one part without the other", file=sys.stderr)
    if arguments.thin is not None:
        pair = pair.thinned(arguments.thin)
    with doing(f"learning from {len(pair.lines)} poses"):
        learned = fitted(pair, stated, arguments.families, arguments.thin is None)
    written = write(arguments, pair, learned)
    if arguments.json:
        answer = {"poses": arguments.poses, **as_json(pair, learned), **written}
        print(json.dumps(answer, indent=2, allow_nan=False))
    else:
        print(as_text(arguments.poses, pair, learned))
        for what, path in written.items():
            if path:
                print(f"{what}: {path}")
    return UNDECIDED if learned.found.cannot_tell else 0


def parse_noise(text: str) -> tuple[float, float | None]:
    """Return the standard deviations [m], [rad] of a text such as ``3mm,1deg``, or ``3mm`` for positions.

    Raises
    ------
    ValueRejectedError
        If it is something else.
    """
    first, comma, second = text.partition(",")
    try:
        position = parse_length(first)
        orientation = parse_value(second) if comma else None
        good = position > 0.0 and (orientation is None or orientation > 0.0)
    except ValueRejectedError:
        good = False
    if not good or second.strip().endswith("m"):
        raise ValueRejectedError(
            f"--noise {text!r}: write two positive numbers of m and rad: 0.003,0.02 or 3mm,1deg"
        )
    return position, orientation


@dataclass(frozen=True)
class Learned:
    """What was learned from poses.

    Attributes
    ----------
    found
        All families with their probabilities.
    noise
        How far observations are off.
    judged
        How many of the poses families were weighed by.
    fit
        The best one, with all poses: those that are wrong altogether are outlying.
    """

    found: Found
    noise: Noise
    judged: int
    fit: Fit


def fitted(
    pair: Pair, stated: tuple[float, float | None] | None, families: str | None, thins: bool
) -> Learned:
    """Return what is learned from poses; if it thins, from so many as tell something of their own.

    Raises
    ------
    ValueRejectedError, UnknownNameError
        See :func:`learn`.
    """
    from kineverse.estimation import Outliers
    from kineverse.estimation.identification.beside import completed
    from kineverse.estimation.identification.observations import observations
    from kineverse.estimation.recording import evenly

    found, noise = learn(pair, stated, families)
    count = telling(found, pair) if thins else len(pair.lines)
    if count == len(pair.lines):
        return Learned(found, noise, count, found.best)
    judged = evenly(len(pair.lines), count)
    found, noise = learn(pair.at(judged), stated, families)
    covariance = covariance_of(noise.position, noise.orientation)
    seen = observations(pair.parent_poses, pair.child_poses, covariance, covariance)
    fit = completed(found.best, seen, judged, outliers=Outliers(), stated=noise.given, ordered=pair.timed)
    return Learned(found, noise, count, fit)


def learn(pair: Pair, stated: tuple[float, float | None] | None, families: str | None) -> tuple[Found, Noise]:
    """Return what was found, and how far observations are off.

    Raises
    ------
    ValueRejectedError
        If a noise of positions alone is stated for poses, or there is nothing to learn from the poses.
    UnknownNameError
        For a family that does not exist.
    """
    from kineverse.estimation import identify
    from kineverse.estimation.identification.identify import UNKNOWN_NOISE

    if stated is not None and stated[1] is None and pair.is_whole:
        raise ValueRejectedError("--noise: poses have two, of positions and orientations: 3mm,1deg")
    chosen = None if families is None else [name.strip() for name in families.split(",")]
    covariance = None if stated is None else covariance_of(*stated)
    found = identify(
        pair.parent_poses,
        pair.child_poses,
        noise=covariance,
        families=chosen,
        outliers=True,
        ordered=pair.timed,
    )
    position, orientation = stated or (found.noise_scale * one for one in UNKNOWN_NOISE)
    return found, Noise(position, orientation if pair.is_whole else None, stated is not None)


def covariance_of(position: float, orientation: float | None) -> Array:
    """Return the covariance of poses; where only positions are seen, the other half is not looked at."""
    from kineverse.estimation import pose_covariance

    return pose_covariance(position, orientation or 1.0)


def telling(found: Found, pair: Pair) -> int:
    """Return how many of the poses tell something of their own, by what the best joint leaves of them."""
    from kineverse.estimation.recording import evenly, independent_count

    count = len(pair.lines)
    # What is free leaves nothing.
    fit = next((fit for fit in found if fit.family != "free"), None)
    if fit is None:
        return count
    # As many more as are wrong and tell nothing.
    right = len(fit.right)
    judged = min(count, round(independent_count(fit.residuals[fit.right]) * count / right))
    # And enough to count turns.
    while pair.timed and judged < count and fit.at(evenly(count, judged)).turned > MOST_TURNED:
        judged += 1
    return judged


def write(arguments: argparse.Namespace, pair: Pair, learned: Learned) -> dict[str, Any]:
    """Write what was asked for, and return where it is."""
    fit = learned.fit
    if arguments.picture:
        from kineverse.experiments.report import Figure
        from kineverse.view.identified import SIZE, draw_identified

        title = f"{pair.child} in {pair.parent}: {learned.found}"
        picture = Figure(lambda c: draw_identified(c, fit, pair.relative, title), SIZE)
        picture.save(arguments.picture)
    if arguments.document:
        from kineverse.cli.fit_document import document_of

        document_of(pair.at(fit.right), fit).save(arguments.document)
    return {"picture": arguments.picture, "document": arguments.document}
