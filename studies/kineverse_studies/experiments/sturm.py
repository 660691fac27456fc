"""``sturm``: classification of published recordings of doors and drawers.

The recordings of Sturm, Stachniss and Burgard (2011) contain handles and markers of doors and drawers,
moved by hand or by a robot. They are not part of this package. Folders and files are named as in
``tum-vision/articulation``. Each is also identified by all of its poses, as ``kineverse fit`` does, with
noise that is estimated, or stated rightly or wrongly.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from kineverse.errors import FormatError
from kineverse.estimation import identify
from kineverse.estimation.identification.result import Fit, IdentificationResult
from kineverse.estimation.noise import pose_covariance
from kineverse.estimation.recordings import (
    ObservationNoise,
    RecordedPair,
    identify_recorded_joint,
    read_recording,
)
from kineverse.lie import Array
from kineverse.view.plots import Figure, FitProjection, draw_axial_view, draw_side_view

from .registry import Options, Progress
from .report import Report, ReportTable, format_yes, make_table

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas

Label = Literal["revolute", "prismatic"]
SOURCE = "https://github.com/tum-vision/articulation"
LABELS: Mapping[str, Label] = {  # derived from the names of the objects
    "cabinet_one/*.log": "revolute",
    "drawer_one/*.log": "prismatic",
    **dict.fromkeys((f"kitchen_6d/M2U00{n}.log" for n in (389, 390, 391, 393, 406, 411)), "revolute"),
    **dict.fromkeys((f"kitchen_6d/M2U00{n}.log" for n in (394, 395)), "prismatic"),
    "mechanisms_iros_2010/dishwasher/*.log": "revolute",
    "mechanisms_iros_2010/drawer/*.log": "prismatic",
    "mechanisms_iros_2010/left_door/*.log": "revolute",
    "mechanisms_iros_2010/right_door/*.log": "revolute",
    "microwave/*.log": "revolute",
    "models_data/door.txt": "revolute",
}
COLUMNS = {"models_data/door.txt": "x,y,z,qx,qy,qz,qw,-,-"}  # of files with more than those of a pose
POSITION, ORIENTATION = 0.01, math.radians(5.0)
"""Standard deviations of the deviation from an ideal joint, of each coordinate [m] and about each axis [rad].

They are larger than the sensor noise of a millimetre or less: hands slip, handles and hinges yield, and
planar markers have systematic orientation errors.
"""
THINNED = 20
"""Number of poses used of each recording, evenly over time, because errors of neighbours are correlated."""


@dataclass(frozen=True, eq=False)
class LabelledRecording:
    name: str  # path of the file in its folder, without suffix
    label: Label  # true joint family
    poses: Array  # (N, 4, 4) of a marker, or positions (N, 3) of a handle, in the camera's frame [m]

    @property
    def covariance(self) -> Array:
        """Covariance of each pose (6, 6) or position (3, 3), the same for all recordings."""
        whole = pose_covariance(POSITION, ORIENTATION)
        return whole if self.poses.ndim == 3 else whole[:3, :3]


def read_labelled_recordings(folder: Path | None) -> Iterator[LabelledRecording]:
    """Return the recordings in a folder, sorted by name, reduced to some poses each."""
    return (
        LabelledRecording(name, label, pair.thin(THINNED).child_poses)
        for name, label, pair in read_labelled_pairs(folder)
    )


def read_labelled_pairs(folder: Path | None) -> Iterator[tuple[str, Label, RecordedPair]]:
    """Return names, labels and all poses of the recordings in a folder, sorted by name."""
    patterns = LABELS.items() if folder is not None else ()
    found = sorted((file, label) for pattern, label in patterns for file in (folder or Path()).glob(pattern))
    if folder is None or not found:
        what = "none of them is there" if folder and folder.is_dir() else "there is no such folder"
        where = "" if folder is None else f"{folder}: {what}. "
        raise FormatError(
            f"{where}This experiment is about recordings of doors and drawers, cabinet_one/001.log "
            f"and so on, from {SOURCE}. Say where they are: --data FOLDER."
        )
    return (_read_labelled(file, file.relative_to(folder), label) for file, label in found)


def _read_labelled(file: Path, name: Path, label: Label) -> tuple[str, Label, RecordedPair]:
    recording = read_recording(file, COLUMNS.get(name.as_posix()))
    return name.with_suffix("").as_posix(), label, recording.pair()


GUESS = (0.005, math.radians(1.0))  # guessed noise of positions [m] and orientations [rad]
STATEMENTS: Mapping[str, str] = {  # of the noise
    "estimated": "estimated",
    "residuals": "stated, as large as the residuals of the labelled joint",
    "guess": "stated, 5 mm and 1 deg for all",
    "half": "stated, half of the residuals",
    "twice": "stated, twice the residuals",
}


@dataclass(frozen=True)
class StatementAnswer:
    name: str  # name and label of the recording
    label: Label
    statement: str  # one of :data:`STATEMENTS`
    family: str  # most probable family
    is_sure: bool  # true if the joint is told, False for "cannot tell"

    @property
    def verdict(self) -> str:
        if not self.is_sure:
            return "cannot tell"
        return "right" if self.family == self.label else "wrong"


def residual_noise(fit: Fit) -> ObservationNoise:
    """Return noise of the size of the residuals. Directions of joint values have none."""
    (position, orientation), joints = fit.rms, fit.motion.joints
    if fit.rows == 3:
        return ObservationNoise(position / math.sqrt(max(1.0, 3.0 - joints)), None, True)
    root = math.sqrt(max(0.5, 3.0 - 0.5 * joints))
    return ObservationNoise(position / root, orientation / root, True)


def answer_statements(name: str, label: Label, pair: RecordedPair) -> list[StatementAnswer]:
    labelled = identify(pair.parent_poses, pair.child_poses, families=label, outliers=True).best
    noise = residual_noise(labelled)
    stated = {
        "estimated": None,
        "residuals": noise,
        "guess": ObservationNoise(GUESS[0], GUESS[1] if pair.has_orientation else None, True),
        "half": noise.scaled(0.5),
        "twice": noise.scaled(2.0),
    }
    answers = []
    for statement in STATEMENTS:
        joint = identify_recorded_joint(pair, stated[statement])
        family = joint.found.best.family
        answers.append(StatementAnswer(name, label, statement, family, not joint.is_ambiguous))
    return answers


def statement_table(answers: Sequence[StatementAnswer]) -> ReportTable:
    rows: tuple[tuple[float | str, ...], ...] = tuple(
        (STATEMENTS[name], *(float(n) for n in counts)) for name, counts in _counts(answers).items()
    )
    head = ("noise", "right", "sure and wrong", "cannot tell")
    return ReportTable("All poses of each recording, as kineverse fit takes them", head, rows)


def statement_numbers(answers: Sequence[StatementAnswer]) -> dict[str, Any]:
    """Return the numbers of :func:`statement_table`, and the recordings that are wrong or ambiguous."""
    return {
        name: {
            "right": right,
            "wrong": wrong,
            "cannot_tell": ambiguous,
            "not_right": {
                one.name: f"{one.family}, {one.verdict}"
                for one in answers
                if one.statement == name and one.verdict != "right"
            },
        }
        for name, (right, wrong, ambiguous) in _counts(answers).items()
    }


def _counts(answers: Sequence[StatementAnswer]) -> dict[str, tuple[int, ...]]:
    return {
        name: tuple(
            sum(one.statement == name and one.verdict == verdict for one in answers)
            for verdict in ("right", "wrong", "cannot tell")
        )
        for name in STATEMENTS
    }


@dataclass(frozen=True, eq=False)
class Classification:
    recording: LabelledRecording  # recording with its label
    result: IdentificationResult  # identification result with the probabilities of all families

    @property
    def predicted(self) -> str:
        return self.result.best.family

    @property
    def is_correct(self) -> bool:
        return self.predicted == self.recording.label


def classify_recording(recording: LabelledRecording) -> Classification:
    return Classification(recording, identify(None, recording.poses, child_covariance=recording.covariance))


FIGURE_COLUMNS = 10
SMALL, LARGE = 1.5, 4.0  # edge of the picture of a recording, and of a misclassified one [inch]
RIGHT, WRONG = "0.25", "tab:red"


def figure_size(classified: Sequence[Classification]) -> tuple[float, float]:
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
    """Identify each recording, with fixed noise, and with all of its poses unless ``quick``."""
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
    right = sum(j.is_correct for j in classified)
    misclassified = [j for j in classified if not j.is_correct]
    share = right / len(classified)
    return Report(
        name="sturm",
        title=f"Recorded doors and drawers ({SOURCE}): {right} of {len(classified)} taken for what they are",
        tables=(
            make_table(
                "The recordings",
                classified,
                {
                    "recording": lambda j: j.recording.name,
                    "N": lambda j: float(len(j.recording.poses)),
                    "shows": lambda j: LABEL_NAMES[j.recording.label],
                    "taken for": lambda j: j.predicted,
                    "probability": lambda j: j.result.best.probability,
                    "radius [m]": lambda j: r if math.isfinite(r := axis_distance(j.result.best)) else "-",
                    "travel": lambda j: format_travel(j.result.best),
                    "rms [mm]": lambda j: 1e3 * j.result.best.rms[0],
                    "right": lambda j: (
                        ("yes" if j.is_correct else "NO") + (", cannot tell" if j.result.is_ambiguous else "")
                    ),
                },
            ),
            ReportTable(
                "What is asked for, and what came out",
                ("", "measured", "asked for", "holds"),
                (
                    (
                        "taken for what they are",
                        share,
                        f">= {LEAST_RIGHT:g}",
                        format_yes(share >= LEAST_RIGHT),
                    ),
                ),
            ),
            make_table(
                "Missed",
                misclassified,
                {
                    "recording": lambda j: j.recording.name,
                    "shows": lambda j: LABEL_NAMES[j.recording.label],
                    "all families, the most probable first": lambda j: ", ".join(
                        f"{fit.family} {fit.probability:.2g}" for fit in j.result.fits
                    ),
                },
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
    ranges = np.ptp(fit.joint_values, axis=0) if fit.joint_values.size else []
    turns = fit.family in ("revolute", "screw")
    return (
        " ".join(f"{math.degrees(travel):.0f} deg" if turns else f"{travel:.2f} m" for travel in ranges)
        or "-"
    )


def _numbers(item: Classification) -> dict[str, Any]:
    best, recording = item.result.best, item.recording
    return {
        "name": recording.name,
        "count": len(recording.poses),
        "label": recording.label,
        "taken_for": item.predicted,
        "right": item.is_correct,
        "told": not item.result.is_ambiguous,
        "probabilities": {fit.family: fit.probability for fit in item.result.fits},
        "radius": axis_distance(best),
        "ranges": best.range,
        "rms": best.rms,
    }
