"""``kineverse demo --living`` and ``--sliders``: a tracked kitchen in motion, and models moved by hand."""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

import kineverse
import kineverse as kv
from kineverse.errors import InvalidValueError
from kineverse.expressions.printing import format_number
from kineverse.model.model_view import ModelView
from kineverse.view import save_picture
from kineverse.view.camera import Camera
from kineverse.view.poses import FramePoses, complete
from kineverse.view.sliders import Ranges, choose_slider_range, infer_units

from .output import format_table, show_progress
from .pages import check_file_path, handle_interrupts, page_options, print_address

if TYPE_CHECKING:
    from living_kitchen.track import TrackingQuality

MODELS = ("kitchen", "pr2")

STATE = {
    "kitchen/fridge_door": 1.0,
    "kitchen/oven_door": 0.5,
    "kitchen/oven_knob": 1.2,
    "kitchen/oven_right_drawer": 0.3,
    "kitchen/sink_left_middle_drawer": 0.14,
    "kitchen/sink_left_upper_drawer": 0.32,
    "kitchen/sink_trash_drawer": 0.22,
    "pr2/base/angle": 0.95,
    "pr2/base/x": 0.1,
    "pr2/base/y": -0.35,
    "pr2/head_pan_joint": 0.1,
    "pr2/head_tilt_joint": 0.35,
    "pr2/l_elbow_flex_joint": -1.75,
    "pr2/l_gripper_joint": 0.05,
    "pr2/l_shoulder_lift_joint": 0.55,
    "pr2/l_shoulder_pan_joint": 0.75,
    "pr2/l_upper_arm_roll_joint": 1.0,
    "pr2/l_wrist_flex_joint": -0.9,
    "pr2/r_elbow_flex_joint": -0.75,
    "pr2/r_gripper_joint": 0.07,
    "pr2/r_shoulder_lift_joint": 0.1,
    "pr2/r_shoulder_pan_joint": -0.55,
    "pr2/r_wrist_flex_joint": -0.35,
    "pr2/torso_lift_joint": 0.15,
}
"""The initial values of the sliders [m], [rad]: open doors, and the robot in front of them."""

EYE, TARGET, VIEW = (-3.5, 4.9, 2.75), (0.2, 0.0, 0.8), 0.66
"""The initial camera [m], [rad]: over the corner of the island, along the open doors."""

SECONDS, STEP, SETTLED = 18.0, 1.0 / 12.0, 3.0
"""Duration and time step without a browser, and the time from which the quality counts [s]."""

_STRANGER = "chest"

LONGEST = 3600.0  # the longest duration [s]

OPTIONS = ("stranger", "seconds")  # options of the kitchen in motion alone


def add_arguments(parser: argparse._ArgumentGroup) -> None:
    """Declare the options of the kitchen in motion."""
    parser.add_argument(
        "--stranger",
        choices=("chest", "crate", "stool"),
        help="the mechanism of unknown type (chest)",
    )
    parser.add_argument("--seconds", type=float, metavar="S", help=f"with --headless: how long ({SECONDS:g})")


def run(arguments: argparse.Namespace) -> int:
    """Run the kitchen in motion, or show sliders."""
    if arguments.sliders:
        return _show_sliders(arguments)
    if not _find_example():
        raise InvalidValueError(
            "--living runs examples/living_kitchen of the source checkout, which is not installed here. "
            "Leave it out, or take --sliders."
        )
    from living_kitchen.simulation import Simulation  # an example of the checkout

    if arguments.headless:
        return _simulate(arguments)
    from living_kitchen.page import SimulationPage

    simulation = Simulation(mechanism=arguments.stranger or _STRANGER)
    with (
        handle_interrupts(),
        SimulationPage(simulation, label="Kineverse demo", **page_options(arguments)) as page,
    ):
        print_address(page, browser=not arguments.no_browser)
        print(f"{page.simulation.kitchen}, tracked; a {page.simulation.mechanism.name}, learned", flush=True)
        page.wait()
    return 0


def _find_example() -> bool:
    """Make the package ``living_kitchen`` importable; return True if this is a checkout that has it."""
    folder = Path(kineverse.__file__).resolve().parents[2] / "examples"
    if not (folder / "living_kitchen" / "__init__.py").is_file():
        return False
    if str(folder) not in sys.path:
        sys.path.append(str(folder))
    return True


def _simulate(arguments: argparse.Namespace) -> int:
    """Run the simulation without a browser, print its results, and write a picture of its end."""
    from living_kitchen.picture import save  # an example of the checkout
    from living_kitchen.report import tabulate_identification, tabulate_tracking
    from living_kitchen.simulation import Simulation  # an example of the checkout
    from living_kitchen.track import average

    steps = _count_steps(SECONDS if arguments.seconds is None else arguments.seconds)
    simulation = Simulation(mechanism=arguments.stranger or _STRANGER)
    # First, so that an unwritable path is reported before the work.
    check_file_path(arguments.picture)
    qualities: list[TrackingQuality] = []
    for _ in show_progress(range(steps), "living", "step"):
        simulation.step(STEP)
        if simulation.time > SETTLED or not qualities:
            qualities.append(simulation.quality)
    print(format_table(*tabulate_tracking(simulation, average(qualities)), "<>"), end="\n\n")
    print(format_table(*tabulate_identification(simulation), "<>"))
    save(arguments.picture, simulation)
    print(f"picture: {arguments.picture}")
    return 0


def _count_steps(seconds: float) -> int:
    if not STEP <= seconds <= LONGEST:
        raise InvalidValueError(f"--seconds is between {STEP:.2g} and {LONGEST:g}, not {seconds!r}")
    return round(seconds / STEP)


def _show_sliders(arguments: argparse.Namespace) -> int:
    """Load both models; show or drive them."""
    model = kv.Model()
    for name in MODELS:
        model.include(name)
    if arguments.headless:
        return _exercise_models(model, arguments.picture)
    from kineverse.view.viewer import Viewer  # for start-up time

    with (
        handle_interrupts(),
        Viewer(
            model, _initial_state(model), label="Kineverse demo", camera=_camera(), **page_options(arguments)
        ) as page,
    ):
        print_address(page, browser=not arguments.no_browser)
        print(_contents(model), flush=True)
        page.wait()
    return 0


def _initial_state(model: kv.Model) -> dict[str, float]:
    known = {str(symbol) for symbol in model.symbols}
    return {name: value for name, value in STATE.items() if name in known}


def _camera() -> Camera:

    return Camera(EYE, TARGET, field_of_view=VIEW)


def _contents(model: kv.Model) -> str:
    rows = []
    for name in MODELS:
        inside = f"{name}/"
        rows.append(
            (
                name,
                str(sum(frame.startswith(inside) for frame in model.frames)),
                str(sum(symbol.path.startswith(inside) for symbol in model.degrees_of_freedom)),
                str(sum(constraint.startswith(inside) for constraint in model.constraints)),
            )
        )
    return format_table(("model", "frames", "DoF", "constraints"), rows, "<>>>")


def _exercise_models(model: kv.Model, path: str) -> int:
    """Drive all coordinates through their ranges, write a picture, and report problems."""
    # First, so that an unwritable path is reported before the work.
    save_picture(path, model, _initial_state(model), camera=_camera())
    print(_contents(model), flush=True)
    result = exercise_model(model)
    print(
        f"{result.freedoms} DoF driven through their ranges: {result.poses} poses of frames at "
        f"{format_number(result.rate, 3)} poses/s, {result.violations} limits violated"
    )
    for line in result.problems[:10]:
        print(f"kineverse: {line}", file=sys.stderr)
    print(f"picture: {path}")
    return 1 if result.problems else 0


SAMPLES_PER_RANGE = 65  # number of samples of each range, limits included
CHECKED_PER_RANGE = 5  # number of these samples at which constraints are evaluated, limits included


@dataclass(frozen=True, slots=True)
class ExerciseResult:
    """Result of an exercise."""

    freedoms: int  # number of degrees of freedom
    poses: int  # number of frame poses computed
    rate: float  # frame poses per second
    violations: int  # number of constraints violated inside the ranges
    problems: list[str]  # texts for these constraints, and for frames whose poses are not finite and rigid


def exercise_model(model: ModelView) -> ExerciseResult:
    """Move each degree of freedom of a model from limit to limit, with the others at their defaults.

    Problems are poses that are not finite and rigid, and constraints that are violated although each
    coordinate is within its limits.
    """
    values = complete(model)
    poses, ranges = FramePoses(model), Ranges(model)
    unit = infer_units(model, values, ranges.names)
    limits = ranges.limits_at(values)
    base = np.array([values[name] for name in poses.inputs])
    count, seconds, violated, problems = 0, 0.0, set(), []
    for name in show_progress(ranges.names, "driving", "DoF"):
        path = np.linspace(*choose_slider_range(limits[name], values[name], unit[name]), SAMPLES_PER_RANGE)
        # Rounding must not move the last sample beyond the limit.
        path = np.clip(path, *limits[name])
        if name in poses.inputs:
            rows = np.tile(base, (SAMPLES_PER_RANGE, 1))
            rows[:, poses.inputs.index(name)] = path
            start = time.perf_counter()
            results = poses.batch(rows)
            seconds += time.perf_counter() - start
            count += SAMPLES_PER_RANGE * len(results)
            wrong = [frame for frame, pose in zip(poses.moving, results, strict=True) if not _rigid(pose)]
            if wrong:
                problems.append(f"{name}: {len(wrong)} frames have no rigid pose, such as {wrong[0]}")
        for value in path[:: (SAMPLES_PER_RANGE - 1) // (CHECKED_PER_RANGE - 1)]:
            violated |= {v.name for v in model.violations({**values, name: float(value)})}
    problems += [f"{name} is violated inside the limits" for name in sorted(violated)]
    return ExerciseResult(len(ranges.names), count, count / max(seconds, 1e-9), len(violated), problems)


def _rigid(poses: npt.NDArray[np.float64]) -> bool:
    """Return whether all of (K, 4, 4) matrices are finite and their rotations orthonormal."""
    rotation = poses[:, :3, :3]
    error = rotation @ np.swapaxes(rotation, 1, 2) - np.eye(3)
    return bool(np.isfinite(poses).all() and np.abs(error).max() < 1e-6)
