"""``kineverse demo``: a kitchen that lives, or a kitchen and a robot to be moved by hand."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import kineverse
from kineverse.cli.output import format_table, show_progress
from kineverse.cli.view import add_page_options, handle_interrupts, page_options, print_address
from kineverse.errors import InvalidValueError
from kineverse.expressions.printing import format_number

if TYPE_CHECKING:
    from living_kitchen.track import Figures

    import kineverse as kv
    from kineverse.view.camera import Camera

HELP = """show a kitchen that lives, tracked through noise, and a joint that is learned

Opens it in the browser until Ctrl-C: doors and drawers move, noisy markers are all that is seen of them, and
beside the truth stands what is believed. In front something moves of which nobody says how. With --headless
some seconds of that pass without a browser, in numbers and a picture; that needs nothing beyond the core.
With --sliders it is the kitchen and a robot instead, to be moved by hand.

examples:
  kineverse demo
  kineverse demo --headless --picture kitchen.png
  kineverse demo --stranger stool
  kineverse demo --sliders"""

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
"""Where sliders start [m], [rad]: the robot stands before the row, and somebody forgot to shut the doors."""

EYE, TARGET, VIEW = (-3.5, 4.9, 2.75), (0.2, 0.0, 0.8), 0.66
"""Where it is seen from [m], [rad]: over the island's corner, along the open doors."""


SECONDS, STEP, SETTLED = 18.0, 1.0 / 12.0, 3.0
"""Without a browser: how much time passes, in what steps, and from when on figures count [s]."""

LONGEST = 3600.0
"""The most time that may be asked for [s]."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--headless", action="store_true", help="numbers and a picture instead of a page")
    parser.add_argument(
        "--picture", metavar="PATH", default="demo.png", help="with --headless, a .png (demo.png)"
    )
    parser.add_argument(
        "--stranger", choices=("chest", "crate", "stool"), default="chest", help="what is learned"
    )
    parser.add_argument(
        "--seconds", type=float, default=SECONDS, metavar="S", help=f"with --headless: how long ({SECONDS:g})"
    )
    parser.add_argument("--sliders", action="store_true", help="a kitchen and a robot, to be moved by hand")
    add_page_options(parser)


def run(arguments: argparse.Namespace) -> int:
    """Show the scene that is asked for, or compute it."""
    from kineverse.view.pictures import check_png_name

    check_png_name(arguments.picture)
    if not arguments.sliders and not _find_example():
        print(
            "kineverse: note: the living kitchen is an example of the source checkout "
            "(examples/living_kitchen); these are its sliders.",
            file=sys.stderr,
        )
        arguments.sliders = True
    if arguments.sliders:
        return _show_sliders(arguments)
    from living_kitchen.simulation import Life

    if arguments.headless:
        return _simulate(arguments)
    from living_kitchen.page import LivingPage

    with (
        handle_interrupts(),
        LivingPage(
            Life(stranger=arguments.stranger), label="Kineverse demo", **page_options(arguments)
        ) as page,
    ):
        print_address(page, browser=not arguments.no_browser)
        print(f"{page.life.kitchen}, tracked; a {page.life.stranger.name}, learned", flush=True)
        page.wait()
    return 0


def _find_example() -> bool:
    """Make the package ``living_kitchen`` importable; return whether this is a checkout that has it."""
    folder = Path(kineverse.__file__).resolve().parents[2] / "examples"
    if not (folder / "living_kitchen" / "__init__.py").is_file():
        return False
    if str(folder) not in sys.path:
        sys.path.append(str(folder))
    return True


def _simulate(arguments: argparse.Namespace) -> int:
    """Let the scene live for a while without a browser, say how it went, and write a picture of its end."""
    from living_kitchen.picture import save
    from living_kitchen.report import table_of_learning, table_of_tracking
    from living_kitchen.simulation import Life
    from living_kitchen.track import average

    steps = _count_steps(arguments.seconds)
    life = Life(stranger=arguments.stranger)
    # First: a path that cannot be written to should not be found out at the end.
    _try_to_write(arguments.picture)
    figures: list[Figures] = []
    for _ in show_progress(range(steps), "living", "step"):
        life.step(STEP)
        if life.time > SETTLED or not figures:
            figures.append(life.now)
    print(format_table(*table_of_tracking(life, average(figures)), "<>"), end="\n\n")
    print(format_table(*table_of_learning(life), "<>"))
    save(arguments.picture, life)
    print(f"picture: {arguments.picture}")
    return 0


def _try_to_write(path: str) -> None:
    """Open a file for writing, and leave none that was not there: who interrupts finds nothing empty."""
    new = not os.path.lexists(path)
    open(path, "ab").close()
    if new:
        os.remove(path)


def _count_steps(seconds: float) -> int:
    """Return in how many steps so much time passes."""
    if not STEP <= seconds <= LONGEST:
        raise InvalidValueError(f"--seconds is between {STEP:.2g} and {LONGEST:g}, not {seconds!r}")
    return round(seconds / STEP)


def _show_sliders(arguments: argparse.Namespace) -> int:
    """Load both models; show or drive them."""
    import kineverse as kv

    model = kv.Model()
    for name in MODELS:
        model.include(name)
    if arguments.headless:
        return _exercise_models(model, arguments.picture)
    from kineverse.view.viewer import Viewer

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
    """Return the opening scene, of which those symbols count that the models have."""
    known = {str(symbol) for symbol in model.symbols}
    return {name: value for name, value in STATE.items() if name in known}


def _camera() -> Camera:
    from kineverse.view.camera import Camera

    return Camera(EYE, TARGET, field_of_view=VIEW)


def _contents(model: kv.Model) -> str:
    """Return the table of what is shown."""
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
    """Drive everything through its range, check it, write a picture, and say how it went."""
    from kineverse.cli.exercise import exercise_model
    from kineverse.view import save_picture

    # First: a path that cannot be written to should not be found out at the end.
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
