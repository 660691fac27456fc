"""``kineverse fit``: identification of the joint between two parts from their recorded poses."""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from kineverse.cli.arguments import parse_length, parse_value
from kineverse.cli.output import show_activity
from kineverse.errors import InvalidValueError
from kineverse.lie import Array

if TYPE_CHECKING:
    from kineverse.estimation import Fit, IdentificationResult
    from kineverse.estimation.recordings import RecordedPair


HELP = """identify the joint of a part from a table of its poses

The table is text, with a head that names its columns: time, part, x, y, z and qx, qy, qz, qw (or roll,
pitch, yaw, or rx, ry, rz, a rotation vector), in m, rad and s unless a unit follows as in "x [mm]". There is
a part in each row, or all parts are in one row, and then columns are called door.x. Without a head, 3 columns
are positions and 7 are poses.

Errors of observations are assumed to be independent. Those of a camera at 30 Hz are not. If the residuals of
neighbours are correlated, families are compared by a subset of the poses, evenly over the recording, as large
as the effective sample size. --thin N sets another size.

Joints of all kinds are tried: rigid, prismatic, revolute, screw, cylindrical, spherical, planar, free. Each
gets its probability, given the observations.

The exit status is 0 if the joint is determined, 1 if it is ambiguous, 2 if the table cannot be read.

examples:
  kineverse fit poses.csv --parent cupboard --child door
  kineverse fit poses.csv --child door --noise 3mm,1deg --picture door.png
  kineverse fit handle.log --columns x,y,z,- --families prismatic,revolute
  kineverse fit poses.csv --child door --document door.kv.json     then: kineverse view door.kv.json"""

AMBIGUOUS = 1

MAX_ROTATION_STEP = 2.0
"""Largest rotation between successive poses for which revolutions are counted reliably [rad]."""


@dataclass(frozen=True)
class ObservationNoise:
    """Assumed noise of the observations.

    Attributes
    ----------
    position, orientation
        Standard deviations of each coordinate [m] and about each axis [rad]; orientation is None if only
        positions are observed.
    given
        True if they were given, False if estimated.
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
        help="number of poses to use, evenly spaced (the effective sample size)",
    )
    parser.add_argument("--families", metavar="NAMES", help="joint families to try: prismatic,revolute (all)")
    parser.add_argument("--picture", metavar="FILE", help="draw the observations and the joint (.png, .svg)")
    parser.add_argument("--document", metavar="FILE", help="write the joint as a model (.kv.json)")
    parser.add_argument("--json", action="store_true", help="everything, as one JSON object")


def run(arguments: argparse.Namespace) -> int:
    """Read the table, identify the joint, and print, draw and save it."""
    from kineverse.cli.fit_output import fit_to_json, format_fit
    from kineverse.estimation.recordings import read_recording

    if arguments.document and not arguments.document.endswith(".kv.json"):
        raise InvalidValueError(
            f"--document {arguments.document!r}: the joint is written as a document, whose name ends in "
            ".kv.json. Then: kineverse convert joint.kv.json joint.urdf"
        )
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
    with show_activity(f"learning from {len(pair.lines)} poses"):
        learned = fit_joint(pair, stated, arguments.families, arguments.thin is None)
    written = write_results(arguments, pair, learned)
    if arguments.json:
        answer = {"poses": arguments.poses, **fit_to_json(pair, learned), **written}
        print(json.dumps(answer, indent=2, allow_nan=False))
    else:
        print(format_fit(arguments.poses, pair, learned))
        for what, path in written.items():
            if path:
                print(f"{what}: {path}")
    return AMBIGUOUS if learned.found.is_ambiguous else 0


def parse_noise(text: str) -> tuple[float, float | None]:
    """Return the standard deviations [m], [rad] of a text such as ``3mm,1deg``, or ``3mm`` for positions.

    Raises
    ------
    InvalidValueError
        If the text is not of this form.
    """
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


@dataclass(frozen=True)
class LearnedJoint:
    """Joint identified from poses.

    Attributes
    ----------
    found
        All families, with their probabilities.
    noise
        Noise of the observations.
    judged
        Number of poses that the families were compared by.
    fit
        Fit of the most probable family to all poses, outliers marked.
    """

    found: IdentificationResult
    noise: ObservationNoise
    judged: int
    fit: Fit


def fit_joint(
    pair: RecordedPair, stated: tuple[float, float | None] | None, families: str | None, thins: bool
) -> LearnedJoint:
    """Identify a joint; if ``thins``, from as many poses as the effective sample size.

    Raises
    ------
    InvalidValueError, UnknownNameError
        See :func:`identify_joint`.
    """
    from kineverse.estimation import Outliers
    from kineverse.estimation.identification.observations import check_observations
    from kineverse.estimation.identification.projection import complete_fit
    from kineverse.estimation.recordings import spaced_indices

    found, noise = identify_joint(pair, stated, families)
    count = count_independent(found, pair) if thins else len(pair.lines)
    if count == len(pair.lines):
        return LearnedJoint(found, noise, count, found.best)
    judged = spaced_indices(len(pair.lines), count)
    found, noise = identify_joint(pair.select(judged), stated, families)
    covariance = make_covariance(noise.position, noise.orientation)
    observations = check_observations(pair.parent_poses, pair.child_poses, covariance, covariance)
    fit = complete_fit(
        found.best, observations, judged, outliers=Outliers(), stated=noise.given, sequential=pair.is_timed
    )
    return LearnedJoint(found, noise, count, fit)


def identify_joint(
    pair: RecordedPair, stated: tuple[float, float | None] | None, families: str | None
) -> tuple[IdentificationResult, ObservationNoise]:
    """Identify a joint from all poses, and return it with the noise of the observations.

    Raises
    ------
    InvalidValueError
        If the noise of orientations is missing, or the poses do not allow an identification.
    UnknownNameError
        For a family that does not exist.
    """
    from kineverse.estimation import identify

    if stated is not None and stated[1] is None and pair.has_orientation:
        raise InvalidValueError("--noise: poses have two, of positions and orientations: 3mm,1deg")
    chosen = None if families is None else [name.strip() for name in families.split(",")]
    covariance = None if stated is None else make_covariance(*stated)
    found = identify(
        pair.parent_poses,
        pair.child_poses,
        noise=covariance,
        families=chosen,
        outliers=True,
        sequential=pair.is_timed,
    )
    noise = found.noise if stated is None else stated
    assert noise is not None  # it is estimated if it is not stated
    position, orientation = noise
    return found, ObservationNoise(
        position, orientation if pair.has_orientation else None, stated is not None
    )


def make_covariance(position: float, orientation: float | None) -> Array:
    """Return the covariance of poses (6, 6); for positions alone its orientation block is unused."""
    from kineverse.estimation import pose_covariance

    return pose_covariance(position, orientation or 1.0)


def count_independent(found: IdentificationResult, pair: RecordedPair) -> int:
    """Return the effective sample size of the poses, by the residuals of the most probable joint."""
    from kineverse.estimation.recordings import effective_sample_size, spaced_indices

    count = len(pair.lines)
    # The free family has no residuals, and a curve follows errors that are correlated.
    fit = next((fit for fit in found if fit.family not in ("free", "curve")), None)
    if fit is None:
        return count
    # Outliers carry no information: the share of inliers in the subset is that in the recording.
    inliers = len(fit.inliers)
    size = min(count, round(effective_sample_size(fit.residuals[fit.inliers]) * count / inliers))
    # The subset must be dense enough to count revolutions.
    while (
        pair.is_timed
        and size < count
        and fit.select(spaced_indices(count, size)).largest_turn > MAX_ROTATION_STEP
    ):
        size += 1
    return size


def write_results(arguments: argparse.Namespace, pair: RecordedPair, learned: LearnedJoint) -> dict[str, Any]:
    """Write the requested picture and document, and return their paths."""
    fit = learned.fit
    if arguments.picture:
        from kineverse.experiments.plots import SIZE, draw_fit
        from kineverse.experiments.report import Figure

        title = f"{pair.child} in {pair.parent}: {learned.found}"
        picture = Figure(lambda c: draw_fit(c, fit, pair.relative, title), SIZE)
        picture.save(arguments.picture)
    if arguments.document:
        from kineverse.cli.fit_output import make_joint_model

        make_joint_model(pair.select(fit.inliers), fit).save(arguments.document)
    return {"picture": arguments.picture, "document": arguments.document}
