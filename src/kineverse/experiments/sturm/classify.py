"""Classification of the recordings as hinges and drawers: report and figure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from kineverse.estimation import identify
from kineverse.estimation.identification.result import Fit, IdentificationResult
from kineverse.experiments.plots import FitProjection, draw_axial_view, draw_side_view
from kineverse.experiments.registry import Options, Progress
from kineverse.experiments.report import Figure, Report, ReportTable
from kineverse.experiments.sturm.recordings import (
    ORIENTATION,
    POSITION,
    SOURCE,
    THINNED,
    LabelledRecording,
    read_labelled_recordings,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas


@dataclass(frozen=True, eq=False)
class Classification:
    """A recording and what it was taken for.

    Attributes
    ----------
    recording
        What was seen.
    found
        All families with their probabilities.
    """

    recording: LabelledRecording
    found: IdentificationResult

    @property
    def called(self) -> str:
        """The most probable family."""
        return self.found.best.family

    @property
    def right(self) -> bool:
        """True if the type is the label."""
        return self.called == self.recording.label


def classify_recording(recording: LabelledRecording) -> Classification:
    """Identify what one recording shows."""
    return Classification(recording, identify(None, recording.poses, child_covariance=recording.covariance))


FIGURE_COLUMNS = 10
SMALL, LARGE = 1.5, 4.0
"""The edge of a picture of one recording, and of a missed one [inch]."""

RIGHT, WRONG = "0.25", "tab:red"


def figure_size(judged: Sequence[Classification]) -> tuple[float, float]:
    """Return width and height of the whole [inch]."""
    missed = sum(not j.right for j in judged)
    return FIGURE_COLUMNS * SMALL, SMALL * math.ceil(len(judged) / FIGURE_COLUMNS) + LARGE * missed + 0.5


def draw_recordings(canvas: Canvas, judged: Sequence[Classification]) -> None:
    """Draw all recordings with what they were taken for, and below both explanations of those missed."""
    missed = [j for j in judged if not j.right]
    rows = math.ceil(len(judged) / FIGURE_COLUMNS)
    heights = [SMALL * rows, *[LARGE] * len(missed)]
    above, *below = canvas.subfigures(len(heights), 1, height_ratios=heights, squeeze=False)[:, 0]
    axes = above.subplots(rows, FIGURE_COLUMNS, squeeze=False).ravel()
    for place, one in zip(axes, judged, strict=False):
        _draw_recording(place, one)
    for place in axes[len(judged) :]:
        place.axis("off")
    for part, one in zip(below, missed, strict=True):
        families = (one.recording.label, one.found.best.family)
        for place, family, shown in zip(
            part.subplots(1, 4), (families[0], *families, families[1]), (0, 1, 0, 1), strict=True
        ):
            projection = FitProjection.from_fit(one.found[family], one.recording.poses)
            (draw_axial_view, draw_side_view)[shown](place, projection)
            place.set_title(
                f"{family} {one.found[family].probability:.2g}: {place.get_title()}", fontsize="small"
            )
        part.suptitle(f"missed: {one.recording.name}", color=WRONG)


def _draw_recording(axes: Axes, one: Classification) -> None:
    projection = FitProjection.from_fit(one.found.best, one.recording.poses)
    right, up = (2, 0) if one.found.best.family == "prismatic" else (0, 1)
    axes.plot(
        projection.observed[:, right], projection.observed[:, up], ".", markersize=2, color="tab:orange"
    )
    axes.plot(projection.path[:, right], projection.path[:, up], linewidth=0.8, color="tab:blue")
    if projection.has_axis:
        axes.plot(0.0, 0.0, "+", color="tab:blue", markersize=5)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xticks([])
    axes.set_yticks([])
    color = RIGHT if one.right else WRONG
    name = "\n".join(one.recording.name.split("/")[-2:])
    axes.set_title(f"{name}: {one.called}", fontsize=6, color=color)
    for spine in axes.spines.values():
        spine.set_color(color)


OPTIONS = ("data",)

LEAST_RIGHT = 0.95
LABEL_NAMES = {"revolute": "hinge", "prismatic": "drawer"}


def run(progress: Progress, options: Options) -> Report:
    """Identify what each recording shows, with what is fixed beforehand for its kind of sensor."""
    recordings = list(read_labelled_recordings(options.data))
    return report_recordings(
        [classify_recording(recording) for recording in progress(recordings, "sturm", "recording")]
    )


def report_recordings(judged: Sequence[Classification]) -> Report:
    """Return the report on recordings."""
    right = sum(j.right for j in judged)
    missed = [j for j in judged if not j.right]
    share = right / len(judged)
    return Report(
        name="sturm",
        title=f"Recorded doors and drawers ({SOURCE}): {right} of {len(judged)} taken for what they are",
        tables=(
            ReportTable(
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
                tuple(_recording_row(j) for j in judged),
            ),
            ReportTable(
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
            ReportTable(
                "Missed",
                ("recording", "shows", "all families, the most probable first"),
                tuple(
                    (j.recording.name, LABEL_NAMES[j.recording.label], _format_families(j.found))
                    for j in missed
                ),
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
        figure=Figure(lambda canvas: draw_recordings(canvas, judged), figure_size(judged)),
    )


def axis_distance(fit: Fit) -> float:
    """Return the mean distance of the child from the axis [m]; NaN for what does not turn about one."""
    if fit.family not in ("revolute", "screw", "cylindrical"):
        return math.nan
    axis, point = np.asarray(fit.parameters["axis"]), np.asarray(fit.parameters["point"])
    offsets = fit.motion.at(fit.joint_values).pose[:, :3, 3] - point
    return float(np.linalg.norm(np.cross(offsets, axis), axis=1).mean())


def format_travel(fit: Fit) -> str:
    """Return how far the joint moved, in words."""
    ways = np.ptp(fit.joint_values, axis=0) if fit.joint_values.size else []
    turns = fit.family in ("revolute", "screw")
    return " ".join(f"{math.degrees(way):.0f} deg" if turns else f"{way:.2f} m" for way in ways) or "-"


def _recording_row(judged: Classification) -> tuple[float | str, ...]:
    best, recording = judged.found.best, judged.recording
    around = axis_distance(best)
    return (
        recording.name,
        float(len(recording.poses)),
        LABEL_NAMES[recording.label],
        judged.called,
        best.probability,
        around if math.isfinite(around) else "-",
        format_travel(best),
        1e3 * best.rms[0],
        ("yes" if judged.right else "NO") + (", cannot tell" if judged.found.is_ambiguous else ""),
    )


def _format_families(found: IdentificationResult) -> str:
    return ", ".join(f"{fit.family} {fit.probability:.2g}" for fit in found.fits)


def _numbers(judged: Classification) -> dict[str, Any]:
    best, recording = judged.found.best, judged.recording
    around = axis_distance(best)
    return {
        "name": recording.name,
        "count": len(recording.poses),
        "label": recording.label,
        "taken_for": judged.called,
        "right": judged.right,
        "told": not judged.found.is_ambiguous,
        "probabilities": {fit.family: fit.probability for fit in judged.found.fits},
        "radius": around if math.isfinite(around) else None,
        "ranges": best.range.tolist(),
        "rms": list(best.rms),
    }
