"""``kineverse demo``: a robot opens and closes a kitchen; with options, a tracked kitchen, or sliders."""

from __future__ import annotations

import argparse

from kineverse.errors import InvalidValueError

from . import demo_living, demo_robot
from .arguments import require
from .view import add_page_options

HELP = """\
A robot that ships opens and closes the doors and drawers of the kitchen that ships, one after another, live
in the browser until Ctrl-C: the robot and the true kitchen, what it believes of it from noisy poses, and what
its controller wants. Each object is reported on the terminal, and all of them in a table at the end. With
--headless it opens and closes one object of each kind without a browser, and writes a picture. The exit
status is 0 if all was opened and closed, else 1. This needs the extras 'control' and 'geometry', a C
compiler, and for the page the extra 'view'.

With --living it shows a kitchen in motion without a robot, tracked from noisy markers, and a joint that is
identified; with --headless that needs nothing beyond the core. With --sliders it shows the kitchen and a
robot, to be moved by hand.

examples:
  kineverse demo
  kineverse demo --robot fetch --what 'kitchen/*_door' --speed 2
  kineverse demo --headless --picture kitchen.png
  kineverse demo --living --stranger stool
  kineverse demo --sliders"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--headless", action="store_true", help="numbers and a picture instead of a page")
    parser.add_argument(
        "--picture", metavar="PATH", default="demo.png", help="with --headless, a .png (demo.png)"
    )
    demo_robot.add_arguments(parser.add_argument_group("the robot"))
    others = parser.add_argument_group("other demos").add_mutually_exclusive_group()
    others.add_argument("--living", action="store_true", help="a kitchen in motion, tracked and identified")
    others.add_argument("--sliders", action="store_true", help="a kitchen and a robot, to be moved by hand")
    demo_living.add_arguments(parser.add_argument_group("with --living"))
    add_page_options(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run ``kineverse demo``."""
    from kineverse.view.pictures import check_png_name

    check_png_name(arguments.picture)
    other = "--living" if arguments.living else "--sliders" if arguments.sliders else ""
    if other:
        _refuse(arguments, demo_robot.OPTIONS, f"is for the robot, not for {other}")
    if not arguments.living:
        _refuse(arguments, demo_living.OPTIONS, "is for --living")
    extras = {"control": not other, "geometry": not other, "view": not arguments.headless}
    require("kineverse demo", extras, compiler=not other)
    return demo_living.run(arguments) if other else demo_robot.run(arguments)


def _refuse(arguments: argparse.Namespace, options: tuple[str, ...], why: str) -> None:
    """Raise InvalidValueError if any of some options is given."""
    for name in options:
        if getattr(arguments, name) not in (None, False):
            raise InvalidValueError(f"--{name} {why}; leave one of them out.")
