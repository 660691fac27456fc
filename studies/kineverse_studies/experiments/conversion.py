"""``conversion``: models written as URDF, MJCF and SDF, and compared with engines that read these.

Each model is written in each format. An engine that reads the format on its own computes the poses of all
frames in 100 states: pinocchio for URDF, MuJoCo for MJCF and drake for SDF. A model that a format cannot
express has to be refused by the name of a joint.
"""

from __future__ import annotations

import math
import re
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from kineverse import gallery
from kineverse.formats import ConversionCheck, check_conversion, load
from kineverse.formats.export.capabilities import UnsupportedError
from kineverse.formats.locate import model_folders, shipped_models
from kineverse.formats.reader_warnings import collect_warnings
from kineverse.view.plots import Figure

from .execution import run_jobs
from .registry import Options, Progress
from .report import Cell, Report, ReportTable, format_yes, make_table

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

OPTIONS = ("quick", "model", "processes")
FORMATS = {"URDF": ".urdf", "MJCF": ".xml", "SDF": ".sdf"}
KITCHENS = ("kitchens/0", "kitchens/1")
LOOPS = ("four_bar", "slider_crank", "spatial_four_bar", "parallel_gripper", "delta_robot", "jansen_leg")
MECHANISMS = ("screw", "universal", "ball", "floating", "gearbox", "rack_and_pinion", "cam", "pedal_bin")
QUICK_STATES, STATES = 10, 100
_NAME = re.compile(r"this model\. '([^']+)'")  # first thing that a refusal names


@dataclass(frozen=True)
class ConversionJob:
    model: str  # name of a model, or path of its file
    title: str
    states: int


@dataclass(frozen=True)
class Conversion:
    """Model in each format: what the check found, or the name of the joint for which it is refused."""

    title: str
    frames: int
    dof: int
    checks: dict[str, ConversionCheck] = field(default_factory=dict)
    refused: dict[str, str] = field(default_factory=dict)


def run(progress: Progress, options: Options) -> Report:
    """Write and check all models; the option ``quick`` takes a few, in 10 states."""
    names = [options.model] if options.model else list(_list_models(options.quick))
    states = QUICK_STATES if options.quick else STATES
    jobs = [ConversionJob(name, _title(name), states) for name in names]
    return report_conversions(run_jobs(convert, jobs, progress, "conversions", "model", options))


def _list_models(quick: bool) -> Iterator[str]:
    """Yield the names of models that ship, and one file of each robot of example-robot-data."""
    if quick:
        yield from ("shelf_door", "fetch", "articulations/four_bar", "articulations/cam")
        return
    yield from shipped_models()
    yield from KITCHENS
    known = set(gallery.names())
    yield from (f"articulations/{name}" for name in (*MECHANISMS, *LOOPS) if name in known)
    for origin, folder in model_folders():
        if origin == "example-robot-data":
            yield from map(str, _one_of_each(folder))


def _one_of_each(folder: Path) -> Iterator[Path]:
    """Yield one URDF of each robot: the first by name, without those that are templates."""
    for robot in sorted(path for path in folder.iterdir() if path.is_dir()):
        files = sorted(path for path in robot.rglob("*.urdf") if b"<link" in path.read_bytes())
        yield from files[:1]


def _title(name: str) -> str:
    path = Path(name)
    return f"{path.stem} (example-robot-data)" if path.suffix == ".urdf" and path.is_absolute() else name


def convert(job: ConversionJob) -> list[Conversion]:
    """Write a model in each format, and check the files."""
    with collect_warnings(), tempfile.TemporaryDirectory() as folder:
        model = load(job.model)
        result = Conversion(job.title, len(model.frames), len(model.degrees_of_freedom))
        for name, suffix in FORMATS.items():
            path = Path(folder) / f"model{suffix}"
            try:
                saved = model.save(path)
            except UnsupportedError as error:
                blamed = _NAME.search(str(error))
                result.refused[name] = blamed[1] if blamed else ""
                continue
            result.checks[name] = check_conversion(model, path, states=job.states, bounds=saved.errors)
    return [result]


def report_conversions(found: Sequence[Conversion]) -> Report:
    return Report(
        name="conversion",
        title=f"{len(found)} models in {len(FORMATS)} formats, checked by the engines of these",
        tables=(model_table(found), engine_table(found)),
        numbers={"models": {one.title: _numbers(one) for one in found}},
        figure=Figure(lambda canvas: _draw(canvas, found), (6.0, 3.0)),
    )


def _numbers(one: Conversion) -> dict[str, object]:
    return {
        name: {"refused": one.refused[name]}
        if name in one.refused
        else {"ok": one.checks[name].ok, "largest": str(one.checks[name].largest)}
        for name in FORMATS
    }


def model_table(found: Sequence[Conversion]) -> ReportTable:
    def result(name: str) -> Callable[[Conversion], Cell]:
        def cell(one: Conversion) -> Cell:
            if name in one.refused:
                return f"refused: {one.refused[name] or 'NO JOINT IS NAMED'}"
            check = one.checks[name]
            return "equal" if check.ok else f"off by {check.largest} at {check.cause}"

        return cell

    return make_table(
        "Models in each format",
        found,
        {
            "model": lambda one: one.title,
            "frames": lambda one: one.frames,
            "DoF": lambda one: one.dof,
            **{name: result(name) for name in FORMATS},
        },
    )


def engine_table(found: Sequence[Conversion]) -> ReportTable:
    def checks(name: str) -> list[ConversionCheck]:
        return [one.checks[name] for one in found if name in one.checks]

    return make_table(
        "Engines",
        FORMATS,
        {
            "format": lambda name: name,
            "engine": lambda name: " ".join({f"{c.engine} {c.version}": None for c in checks(name)}),
            "files": lambda name: len(checks(name)),
            "all equal": lambda name: format_yes(all(check.ok for check in checks(name))),
            "refused": lambda name: sum(name in one.refused for one in found),
            "largest distance [m]": lambda name: _largest(check.largest.position for check in checks(name)),
            "largest angle [rad]": lambda name: _largest(check.largest.angle for check in checks(name)),
        },
    )


def _largest(values: Iterator[float]) -> str:
    return f"{max(values, default=math.nan):.0e}"


def _draw(canvas: Canvas, found: Sequence[Conversion]) -> None:
    """Draw the largest difference of each file, by format."""
    axes = canvas.subplots()
    for name in FORMATS:
        values = [max(c.largest.position, c.largest.angle) for one in found if (c := one.checks.get(name))]
        axes.semilogy(sorted(max(value, 1e-18) for value in values), "o", markersize=3, label=name)
    axes.axhline(1e-9, color="gray", linewidth=0.8)
    axes.set_xlabel("file, by its difference")
    axes.set_ylabel("largest difference [m], [rad]")
    axes.legend()
