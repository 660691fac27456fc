"""What the recordings are taken for, as a table, numbers and a figure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from kineverse.estimation.identification.fit import Fit, Found
from kineverse.experiments.options import Options
from kineverse.experiments.registry import Progress
from kineverse.experiments.report import Figure, Report, Table
from kineverse.experiments.sturm.figure import draw_recordings, size_of
from kineverse.experiments.sturm.judging import Judged, judge
from kineverse.experiments.sturm.recordings import (
    ORIENTATION,
    POSITION,
    SOURCE,
    THINNED,
    labelled_recordings,
)

OPTIONS = ("data",)

LEAST_RIGHT = 0.95
NAMES = {"revolute": "hinge", "prismatic": "drawer"}


def run(progress: Progress, options: Options) -> Report:
    """Identify what each recording shows, with what is fixed beforehand for its kind of sensor."""
    recordings = list(labelled_recordings(options.data))
    return report([judge(recording) for recording in progress(recordings, "sturm", "recording")])


def report(judged: Sequence[Judged]) -> Report:
    """Return the report on recordings."""
    right = sum(j.right for j in judged)
    missed = [j for j in judged if not j.right]
    share = right / len(judged)
    return Report(
        name="sturm",
        title=f"Recorded doors and drawers ({SOURCE}): {right} of {len(judged)} taken for what they are",
        tables=(
            Table(
                "The recordings",
                (
                    "recording",
                    "N",
                    "shows",
                    "taken for",
                    "probability",
                    "radius [m]",
                    "travel",
                    "rms [mm]",
                    "right",
                ),
                tuple(_row(j) for j in judged),
            ),
            Table(
                "What is asked for, and what came out",
                ("", "measured", "asked for", "holds"),
                (
                    (
                        "taken for what they are",
                        share,
                        f">= {LEAST_RIGHT:g}",
                        "yes" if share >= LEAST_RIGHT else "no",
                    ),
                ),
            ),
            Table(
                "Missed",
                ("recording", "shows", "all families, the most probable first"),
                tuple((j.recording.name, NAMES[j.recording.label], _families(j.found)) for j in missed),
            ),
        ),
        numbers={
            "constants": {
                "position_noise": POSITION,
                "orientation_noise_deg": math.degrees(ORIENTATION),
                "poses": THINNED,
            },
            "right": share,
            "asked": LEAST_RIGHT,
            "missed": [j.recording.name for j in missed],
            "recordings": [_numbers(j) for j in judged],
        },
        figure=Figure(lambda canvas: draw_recordings(canvas, judged), size_of(judged)),
    )


def radius(fit: Fit) -> float:
    """Return the mean distance of the child from the axis [m]; NaN for what does not turn about one."""
    if fit.family not in ("revolute", "screw", "cylindrical"):
        return math.nan
    axis, point = np.asarray(fit.parameters["axis"]), np.asarray(fit.parameters["point"])
    offsets = fit.motion.at(fit.joint_values).pose[:, :3, 3] - point
    return float(np.linalg.norm(np.cross(offsets, axis), axis=1).mean())


def travel(fit: Fit) -> str:
    """Return how far the joint moved, in words."""
    ways = np.ptp(fit.joint_values, axis=0) if fit.joint_values.size else []
    turns = fit.family in ("revolute", "screw")
    return " ".join(f"{math.degrees(way):.0f} deg" if turns else f"{way:.2f} m" for way in ways) or "-"


def _row(judged: Judged) -> tuple[float | str, ...]:
    best, recording = judged.found.best, judged.recording
    around = radius(best)
    return (
        recording.name,
        float(len(recording.poses)),
        NAMES[recording.label],
        judged.called,
        best.probability,
        around if math.isfinite(around) else "-",
        travel(best),
        1e3 * best.rms[0],
        ("yes" if judged.right else "NO") + (", cannot tell" if judged.found.cannot_tell else ""),
    )


def _families(found: Found) -> str:
    return ", ".join(f"{fit.family} {fit.probability:.2g}" for fit in found.fits)


def _numbers(judged: Judged) -> dict[str, Any]:
    best, recording = judged.found.best, judged.recording
    around = radius(best)
    return {
        "name": recording.name,
        "count": len(recording.poses),
        "label": recording.label,
        "taken_for": judged.called,
        "right": judged.right,
        "told": not judged.found.cannot_tell,
        "probabilities": {fit.family: fit.probability for fit in judged.found.fits},
        "radius": around if math.isfinite(around) else None,
        "ranges": best.range.tolist(),
        "rms": list(best.rms),
    }
