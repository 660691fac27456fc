"""``checks``: what the motion checks find in models that are broken on purpose, and in sound ones.

Each seed draws, for each break, a model and one of its joints that it applies to. A break is found if the
checks say something at the joint's coordinate that they do not say of the sound model: a finding for a break
that can be known for certain, a finding or a suspect for the others.
"""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from kineverse.errors import FormatError, KineverseError
from kineverse.formats import load
from kineverse.geometry.motion_checks.check import check_motion
from kineverse.geometry.motion_checks.report import MotionFinding, MotionReport
from kineverse.model.model import Model
from kineverse.view.plots import Figure
from kineverse_studies.experiments.registry import Options, Progress
from kineverse_studies.experiments.report import Report, ReportTable

from .breaks import BREAKS, Break, SoundJoint, find_joints

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

OPTIONS = ("quick", "seed", "count", "models")
COUNT, QUICK_COUNT = 20, 2  # broken models of each break

SOUND = (
    "kitchen",
    "shelf_door",
    "shelf_drawers",
    *(f"kitchens/{number}" for number in range(4)),
    *(
        f"articulations/{name}"
        for name in ("revolute", "prismatic", "garage_door", "folding_door", "microwave", "door_with_handle")
    ),
)
"""Furniture and scenes that ship or are generated."""

SUFFIXES = (".urdf", ".sdf", ".xml")  # of the descriptions in a folder


@dataclass(frozen=True)
class BrokenModel:
    break_: str  # name of the break
    model: str
    coordinate: str
    is_found: bool
    is_named: bool  # whether by a kind of the break
    said: tuple[str, ...]  # kinds


def load_models(folders: Sequence[Path]) -> dict[str, Model]:
    """Return models by name: those of :data:`SOUND`, and those in folders that have joints and shapes."""
    models = {name: load(name) for name in SOUND}
    for folder in folders:
        if not folder.is_dir():
            raise FormatError(f"There is no folder {folder}.")
        for file in sorted(file for end in SUFFIXES for file in folder.rglob(f"*{end}")):
            try:
                model = load(file)
            except (KineverseError, OSError):
                continue
            if model.bodies and model.degrees_of_freedom:
                models[str(file.relative_to(folder.parent))] = model
    return models


def run(progress: Progress, options: Options) -> Report:
    count = options.count or (QUICK_COUNT if options.quick else COUNT)
    models = load_models(options.models)
    sound = {
        name: check_motion(model) for name, model in progress(list(models.items()), "sound models", "model")
    }
    joints = {name: tuple(find_joints(model)) for name, model in models.items()}
    seeds = range(options.seed, options.seed + count)
    broken = [
        one for seed in progress(seeds, "broken models", "seed") for one in break_models(seed, joints, sound)
    ]
    return report_checks(seeds, sound, broken)


def break_models(
    seed: int, joints: dict[str, tuple[SoundJoint, ...]], sound: dict[str, MotionReport]
) -> list[BrokenModel]:
    """Return what is found in one broken model for each break."""
    silent = {
        name: {one.name for one in report.coordinates if not one.findings and not one.suspects}
        for name, report in sound.items()
    }
    result = []
    for number, break_ in enumerate(BREAKS):
        rng = np.random.default_rng([seed, number])
        fitting = {
            name: [one for one in some if break_.applies(one) and one.coordinate in silent[name]]
            for name, some in joints.items()
        }
        names = [name for name, some in fitting.items() if some]
        if not names:
            continue
        name = names[int(rng.integers(len(names)))]
        joint = fitting[name][int(rng.integers(len(fitting[name])))]
        with tempfile.TemporaryDirectory() as folder:
            report = check_motion(break_.make(joint, rng, Path(folder)))
        result.append(_judge(break_, name, joint, sound[name], report))
    return result


def _judge(
    break_: Break, name: str, joint: SoundJoint, sound: MotionReport, report: MotionReport
) -> BrokenModel:
    coordinate = joint.coordinate
    before = Counter(_key(entry) for entry in sound[coordinate].entries)
    new = [entry for entry in report[coordinate].entries if not before[_key(entry)]]
    said = [
        e.kind for e in new if e.severity == "finding" or (not break_.is_certain and e.severity == "suspect")
    ]
    is_named = any(kind in break_.kinds for kind in said)
    return BrokenModel(break_.name, name, coordinate, bool(said), is_named, tuple(e.kind for e in new))


def _key(entry: MotionFinding) -> tuple[str, ...]:
    return entry.kind, entry.severity, entry.joint


def report_checks(seeds: Sequence[int], sound: dict[str, MotionReport], broken: list[BrokenModel]) -> Report:
    rows = []
    for break_ in BREAKS:
        some = [one for one in broken if one.break_ == break_.name]
        found, named = sum(one.is_found for one in some), sum(one.is_named for one in some)
        tier = "certain" if break_.is_certain else "suspect"
        rows.append((break_.name, tier, f"{found} of {len(some)}", f"{named} of {len(some)}"))
    for tier in ("certain", "suspect"):
        names = {one.name for one in BREAKS if one.is_certain == (tier == "certain")}
        some = [one for one in broken if one.break_ in names]
        found, named = sum(one.is_found for one in some), sum(one.is_named for one in some)
        rows.append(("all", tier, f"{found} of {len(some)}", f"{named} of {len(some)}"))
    head = ("break", "kind of break", "found", "named rightly")
    said = [
        (name, len(report.findings), len(report.suspects), ", ".join(sorted(_kinds(report))))
        for name, report in sound.items()
        if report.findings or report.suspects
    ]
    said += [("all", sum(row[1] for row in said), sum(row[2] for row in said), f"{len(sound)} models")]
    missed = [
        (one.break_, one.model, one.coordinate, ", ".join(one.said)) for one in broken if not one.is_found
    ]
    return Report(
        name="checks",
        title=f"Motion checks of models broken on purpose, seeds {seeds[0]} to {seeds[-1]}",
        tables=(
            ReportTable("Broken models", head, tuple(rows)),
            ReportTable("Said of sound models", ("model", "findings", "suspects", "kinds"), tuple(said)),
            ReportTable("Missed", ("break", "model", "coordinate", "said"), tuple(missed) or (("-",) * 4,)),
        ),
        numbers={"seeds": list(seeds), "sound": list(sound), "broken": broken, "said_of_sound": said},
        figure=Figure(lambda canvas: draw_shares(canvas, broken), (9.0, 4.0)),
    )


def _kinds(report: MotionReport) -> set[str]:
    return {entry.kind for entry in (*report.findings, *report.suspects)}


def draw_shares(canvas: Canvas, broken: list[BrokenModel]) -> None:
    axes = canvas.subplots()
    names = [break_.name for break_ in BREAKS]
    shares = []
    for name in names:
        some = [one for one in broken if one.break_ == name]
        shares.append(100.0 * sum(one.is_found for one in some) / max(1, len(some)))
    axes.barh(names[::-1], shares[::-1])
    axes.set_xlabel("found [%]")
    axes.set_xlim(0.0, 100.0)
