"""``kineverse demo``: a kitchen and a robot."""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING

from kineverse.cli.table import figure, table
from kineverse.cli.view import add_page_options, announce, until_interrupted

if TYPE_CHECKING:
    import kineverse as kv
    from kineverse.view.camera import Camera

HELP = """show the kitchen and a robot that ship with Kineverse

Opens them in the browser until Ctrl-C. With --headless everything that moves is driven through its range, a
picture is written, and the command ends; that needs neither a browser nor anything beyond the core.

examples:
  kineverse demo
  kineverse demo --headless --picture kitchen.png"""

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
"""The opening scene [m], [rad]: the robot stands before the row, and somebody forgot to shut the doors."""

EYE, TARGET, VIEW = (-3.5, 4.9, 2.75), (0.2, 0.0, 0.8), 0.66
"""Where it is seen from [m], [rad]: over the island's corner, along the open doors."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--headless", action="store_true", help="drive everything, write a picture, end")
    parser.add_argument("--picture", metavar="PATH", default="demo.png", help="with --headless (demo.png)")
    add_page_options(parser)


def run(arguments: argparse.Namespace) -> int:
    """Load both models; show or drive them."""
    import kineverse as kv

    model = kv.Model()
    for name in MODELS:
        model.include(name)
    if arguments.headless:
        return _headless(model, arguments.picture)
    from kineverse.view.viewer import Viewer

    with (
        until_interrupted(),
        Viewer(model, _state(model), port=arguments.port, label="Kineverse demo", camera=_camera()) as page,
    ):
        announce(page, browser=not arguments.no_browser)
        print(_contents(model), flush=True)
        page.wait()
    return 0


def _state(model: kv.Model) -> dict[str, float]:
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
    return table(("model", "frames", "DoF", "constraints"), rows, "<>>>")


def _headless(model: kv.Model, path: str) -> int:
    """Drive everything through its range, check it, write a picture, and say how it went."""
    from kineverse.cli.drive import drive
    from kineverse.view import save

    # First: a path that cannot be written to should not be found out at the end.
    save(path, model, _state(model), camera=_camera())
    print(_contents(model), flush=True)
    result = drive(model)
    print(
        f"{result.freedoms} DoF driven through their ranges: {result.poses} poses of frames at "
        f"{figure(result.rate, 3)} poses/s, {result.violations} limits violated"
    )
    for line in result.problems[:10]:
        print(f"kineverse: {line}", file=sys.stderr)
    print(f"picture: {path}")
    return 1 if result.problems else 0
