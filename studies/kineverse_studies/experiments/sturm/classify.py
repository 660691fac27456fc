"""Classification of the recordings as hinges and drawers, with report and figure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from kineverse.estimation import identify
from kineverse.estimation.identification.result import Fit, IdentificationResult
from kineverse.view.plots import Figure, FitProjection, draw_axial_view, draw_side_view
from kineverse_studies.experiments.registry import Options, Progress
from kineverse_studies.experiments.report import Report, ReportTable
from kineverse_studies.experiments.sturm.noise_statements import (
    StatementAnswer,
    answer_statements,
    statement_numbers,
    statement_table,
)
from kineverse_studies.experiments.sturm.recordings import (
    ORIENTATION,
    POSITION,
    SOURCE,
    THINNED,
    LabelledRecording,
    read_labelled_pairs,
    read_labelled_recordings,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas


@dataclass(frozen=True, eq=False)
class Classification:
    """Identification result of a recording."""

    recording: LabelledRecording  # recording with its label
    result: IdentificationResult  # identification result with the probabilities of all families

    @property
    def predicted(self) -> str:
        """Most probable family."""
        return self.result.best.family

    @property
    def is_correct(self) -> bool:
        """True if the most probable family is the label."""
        return self.predicted == self.recording.label


def classify_recording(recording: LabelledRecording) -> Classification:
    """Identify the joint of one recording."""
    return Classification(recording, identify(None, recording.poses, child_covariance=recording.covariance))


FIGURE_COLUMNS = 10
SMALL, LARGE = 1.5, 4.0
"""Edge of the picture of a recording, and of a misclassified one [inch]."""

RIGHT, WRONG = "0.25", "tab:red"


def figure_size(classified: Sequence[Classification]) -> tuple[float, float]:
    """Return width and height of the figure [inch]."""
    misclassified = sum(not j.is_correct for j in classified)
    rows = math.ceil(len(classified) / FIGURE_COLUMNS)
    return FIGURE_COLUMNS * SMALL, SMALL * rows + LARGE * misclassified + 0.5


def draw_recordings(canvas: Canvas, classified: Sequence[Classification]) -> None:
    """Draw all recordings with their classes, and below both fits of the misclassified ones."""
    misclassified = [j for j in classified if not j.is_correct]
    rows = math.ceil(len(classified) / FIGURE_COLUMNS)
    heights = [SMALL * rows, *[LARGE] * len(misclassified)]
    above, *below = canvas.subfigures(len(heights), 1, height_ratios=heights, squeeze=False)[:, 0]
    axes = above.subplots(rows, FIGURE_COLUMNS, squeeze=False).ravel()
    for place, item in zip(axes, classified, strict=False):
        _draw_recording(place, item)
    for place in axes[len(classified) :]:
        place.axis("off")
    for part, item in zip(below, misclassified, strict=True):
        families = (item.recording.label, item.result.best.family)
        for place, family, shown in zip(
            part.subplots(1, 4), (families[0], *families, families[1]), (0, 1, 0, 1), strict=True
        ):
            projection = FitProjection.from_fit(item.result[family], item.recording.poses)
            (draw_axial_view, draw_side_view)[shown](place, projection)
            place.set_title(
                f"{family} {item.result[family].probability:.2g}: {place.get_title()}", fontsize="small"
            )
        part.suptitle(f"missed: {item.recording.name}", color=WRONG)


def _draw_recording(axes: Axes, item: Classification) -> None:
    projection = FitProjection.from_fit(item.result.best, item.recording.poses)
    right, up = (2, 0) if item.result.best.family == "prismatic" else (0, 1)
    axes.plot(
        projection.observed[:, right], projection.observed[:, up], ".", markersize=2, color="tab:orange"
    )
    axes.plot(projection.path[:, right], projection.path[:, up], linewidth=0.8, color="tab:blue")
    if projection.has_axis:
        axes.plot(0.0, 0.0, "+", color="tab:blue", markersize=5)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xticks([])
    axes.set_yticks([])
    color = RIGHT if item.is_correct else WRONG
    name = "\n".join(item.recording.name.split("/")[-2:])
    axes.set_title(f"{name}: {item.predicted}", fontsize=6, color=color)
    for spine in axes.spines.values():
        spine.set_color(color)


OPTIONS = ("quick", "data")

LEAST_RIGHT = 0.95
LABEL_NAMES = {"revolute": "hinge", "prismatic": "drawer"}


def run(progress: Progress, options: Options) -> Report:
    """Identify the joint of each recording, with fixed noise, and with all of its poses.

    ``quick`` leaves out the second part.
    """
    recordings = list(read_labelled_recordings(options.data))
    classified = [classify_recording(recording) for recording in progress(recordings, "sturm", "recording")]
    if options.quick:
        return report_recordings(classified)
    pairs = list(read_labelled_pairs(options.data))
    answers = [answer_statements(*one) for one in progress(pairs, "sturm, all poses", "recording")]
    return report_recordings(classified, [answer for some in answers for answer in some])


def report_recordings(
    classified: Sequence[Classification], answers: Sequence[StatementAnswer] = ()
) -> Report:
    """Return the report on the classified recordings, and on the answers by all poses if there are any."""
    right = sum(j.is_correct for j in classified)
    misclassified = [j for j in classified if not j.is_correct]
    share = right / len(classified)
    return Report(
        name="sturm",
        title=f"Recorded doors and drawers ({SOURCE}): {right} of {len(classified)} taken for what they are",
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
                tuple(_recording_row(j) for j in classified),
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
                    (j.recording.name, LABEL_NAMES[j.recording.label], _format_families(j.result))
                    for j in misclassified
                ),
            ),
            *([statement_table(answers)] if answers else []),
        ),
        numbers={
            "constants": {
                "position_noise": POSITION,
                "orientation_noise_deg": math.degrees(ORIENTATION),
                "poses": THINNED,
            },
            "right": share,
            "asked": LEAST_RIGHT,
            "missed": [j.recording.name for j in misclassified],
            "recordings": [_numbers(j) for j in classified],
            **({"all_poses": statement_numbers(answers)} if answers else {}),
        },
        figure=Figure(lambda canvas: draw_recordings(canvas, classified), figure_size(classified)),
    )


def axis_distance(fit: Fit) -> float:
    """Return the mean distance of the child from the axis [m]; NaN without a rotation axis."""
    if fit.family not in ("revolute", "screw", "cylindrical"):
        return math.nan
    axis, point = np.asarray(fit.parameters["axis"]), np.asarray(fit.parameters["point"])
    offsets = fit.motion.linearise(fit.joint_values).pose[:, :3, 3] - point
    return float(np.linalg.norm(np.cross(offsets, axis), axis=1).mean())


def format_travel(fit: Fit) -> str:
    """Format the range of the joint values."""
    ranges = np.ptp(fit.joint_values, axis=0) if fit.joint_values.size else []
    turns = fit.family in ("revolute", "screw")
    return (
        " ".join(f"{math.degrees(travel):.0f} deg" if turns else f"{travel:.2f} m" for travel in ranges)
        or "-"
    )


def _recording_row(item: Classification) -> tuple[float | str, ...]:
    best, recording = item.result.best, item.recording
    radius = axis_distance(best)
    return (
        recording.name,
        float(len(recording.poses)),
        LABEL_NAMES[recording.label],
        item.predicted,
        best.probability,
        radius if math.isfinite(radius) else "-",
        format_travel(best),
        1e3 * best.rms[0],
        ("yes" if item.is_correct else "NO") + (", cannot tell" if item.result.is_ambiguous else ""),
    )


def _format_families(result: IdentificationResult) -> str:
    return ", ".join(f"{fit.family} {fit.probability:.2g}" for fit in result.fits)


def _numbers(item: Classification) -> dict[str, Any]:
    best, recording = item.result.best, item.recording
    radius = axis_distance(best)
    return {
        "name": recording.name,
        "count": len(recording.poses),
        "label": recording.label,
        "taken_for": item.predicted,
        "right": item.is_correct,
        "told": not item.result.is_ambiguous,
        "probabilities": {fit.family: fit.probability for fit in item.result.fits},
        "radius": radius if math.isfinite(radius) else None,
        "ranges": best.range.tolist(),
        "rms": list(best.rms),
    }
