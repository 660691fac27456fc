"""``kineverse demo``: a robot opens and closes a kitchen, on a page or without one."""

from __future__ import annotations

import argparse
import json
import sys
import time
from contextlib import ExitStack, redirect_stdout
from typing import TYPE_CHECKING

from kineverse.errors import InvalidValueError

from .demo_living import check_picture_path
from .demo_output import (
    ALIGN,
    HEAD,
    PAGE_HEAD,
    ProgressLine,
    describe_belief,
    format_page_row,
    format_row,
    report_as_data,
)
from .output import format_table, show_activity
from .view import handle_interrupts, page_options, print_address

if TYPE_CHECKING:
    from kineverse.manipulation import ArticulatedObject, OpenCloseReport, Session
    from kineverse.view.run_overlay import LiveRun
    from kineverse.view.skill_stills import SkillStills
    from kineverse.view.viewer import Viewer

KITCHEN, ROBOT, WORLD = "kitchen", "hsr", "kinematic"
NOISE = "3mm+3mm/m,0.5deg,30Hz"
"""Noise of the observed poses, unless another one is asked for."""
_BRIEF = ("*/oven_door", "*/fridge_door", "*/sink_left_upper_drawer")
"""The objects without a page: a flap, a door and a drawer."""
_FASTEST = 100.0
_INTERRUPTED = 130
"""Exit status after Ctrl-C, as of all commands."""
_PATIENCE = 15.0
"""Time that a browser has to show the page before the robot begins [s]."""

OPTIONS = ("robot", "what", "world", "noise", "speed", "seed", "json")
"""Options of the robot's demo alone."""


def add_arguments(parser: argparse._ArgumentGroup) -> None:
    """Declare the options of the robot's demo."""
    parser.add_argument("--robot", metavar="ROBOT", help=f"a robot that ships ({ROBOT})")
    parser.add_argument(
        "--what",
        nargs="+",
        metavar="COORDINATE",
        help="objects by name or pattern ('*_door'), in this order (all; with --headless one of each kind)",
    )
    parser.add_argument("--world", choices=("kinematic", "mujoco"), help=f"the world ({WORLD})")
    parser.add_argument("--noise", metavar="NOISE", help=f"noise of observed poses, or none ({NOISE})")
    parser.add_argument("--speed", type=float, metavar="X", help="show it X times as fast (1); 0: no waiting")
    parser.add_argument("--seed", type=int, metavar="N", help="seed of noise and searches (0)")
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output")


def run(arguments: argparse.Namespace) -> int:
    """Let the robot open and close objects; return 0 if all of it was done, 1 if not, 130 after Ctrl-C."""
    demo = RobotDemo(arguments)
    finished = False
    with handle_interrupts(), ExitStack() as stack:
        page = None if arguments.headless else stack.enter_context(demo.open_page())
        demo.act(page)
        demo.report()
        finished = True
        if page is not None:
            page.wait()
    if not finished:
        demo.report()
        return _INTERRUPTED
    return 0 if all(demo.reports) else 1


class RobotDemo:
    """Robot that opens and closes objects of the kitchen."""

    def __init__(self, arguments: argparse.Namespace) -> None:
        from kineverse.manipulation import find_articulated_objects
        from kineverse.manipulation.robot_sources import find_robot
        from kineverse.planning.bindings import request_planner
        from kineverse.worlds import Sensors

        self._arguments = arguments
        self._speed = 1.0 if arguments.speed is None else arguments.speed
        if not 0.0 <= self._speed <= _FASTEST:
            raise InvalidValueError(f"--speed is between 0 and {_FASTEST:g}, not {self._speed!r}.")
        self._seed = arguments.seed or 0
        if self._seed < 0:
            raise InvalidValueError(f"--seed is a number from 0 on, not {self._seed}.")
        noise = NOISE if arguments.noise is None else arguments.noise
        self._sensors = None if noise == "none" else Sensors.parse(noise)
        self._robot = find_robot(arguments.robot or ROBOT)
        if arguments.headless:
            check_picture_path(arguments.picture)
        request_planner()
        with show_activity(f"reading the {KITCHEN} and the {self._robot.name}"):
            self.model = self._robot.load()
            self.model.include(KITCHEN)
            self.gripper = self._robot.gripper(self.model)
            found = find_articulated_objects(self.model, self._robot.prefix)
        self.objects = _choose_objects(found, arguments.what, arguments.headless)
        self.reports: list[OpenCloseReport] = []
        self._progress = ProgressLine(len(self.objects))
        self._live: LiveRun | None = None
        self._stills: SkillStills | None = None

    def open_page(self) -> Viewer:
        """Return a page of the model."""
        from kineverse.view.viewer import Viewer

        start = self._robot.start_state(self.model)
        options = page_options(self._arguments)
        page = Viewer(self.model, start, label=f"Kineverse demo, {self._robot.name}", **options)
        with redirect_stdout(sys.stderr if self._arguments.json else sys.stdout):
            print_address(page, browser=not self._arguments.no_browser)
        return page

    def act(self, page: Viewer | None) -> None:
        """Open and close all objects, on a page if there is one, with a line for each."""
        from kineverse.manipulation import OpenCloseRunner, TrackedBelief
        from kineverse.worlds import KinematicWorld, MujocoWorld

        self._show_on(page)
        with show_activity("preparing the world"):
            make_world = MujocoWorld if self._arguments.world == "mujoco" else KinematicWorld
            prefix, sensors = self._robot.prefix, self._sensors
            # First, so that its code is compiled while the world is made.
            belief = None if sensors is None else TrackedBelief(self.model, prefix, sensors)
            world = make_world(self.model, prefix, self.gripper, sensors=sensors, seed=self._seed)
            start = self._robot.start_state(self.model)
            runner = OpenCloseRunner(
                world,
                start,
                belief=belief,
                on_step=self._look,
                hand=self.gripper.hand,
                seed=self._seed,
            )
        self._runner = runner
        if page is not None and self._speed:
            self._say("The robot begins when a browser shows this page.")
            _wait_for_browser(page)
        for one in self.objects:
            self._begin(one)
            report = runner.open_and_close(one)
            self.reports.append(report)
            self._progress.finish(report)
            if self._live is not None:
                self._live.show_table(PAGE_HEAD, map(format_page_row, self.reports))
            if self._stills is not None:
                self._stills.end_row(one.coordinate)
        self._say(f"{sum(map(bool, self.reports))} of {len(self.objects)} opened and closed.")

    def report(self) -> None:
        """Print what was done so far, and write the picture."""
        arguments, picture = self._arguments, ""
        self._progress.clear()
        if self._stills:
            self._stills.save(arguments.picture)
            picture = arguments.picture
        done = sum(map(bool, self.reports))
        if arguments.json:
            data = {
                "done": done == len(self.objects),
                "robot": self._robot.name,
                "world": arguments.world or WORLD,
                "noise": str(self._sensors or "none"),
                "objects": [report_as_data(one) for one in self.reports],
                "picture": picture or None,
            }
            print(json.dumps(data, allow_nan=False), flush=True)
            return
        if self.reports:
            print(format_table(HEAD, map(format_row, self.reports), ALIGN))
        print(f"{done} of {len(self.objects)} opened and closed by the {self._robot.name}", flush=True)
        if picture:
            print(f"picture: {picture}", flush=True)

    def _show_on(self, page: Viewer | None) -> None:
        if page is None:
            from kineverse.view.skill_stills import SkillStills

            self._stills = SkillStills(self.model, self._robot.prefix)
        else:
            from kineverse.view.run_overlay import LiveRun

            self._live = LiveRun(page, self._speed, self.gripper.hand)

    def _say(self, text: str) -> None:
        if self._live is not None:
            self._live.captions = ()
            self._live.show_text(text)

    def _begin(self, one: ArticulatedObject) -> None:
        """Show that an object comes next."""
        self._progress.begin()
        if self._live is not None:
            self._live.captions = (self._title(one),)
            self._live.show_text("A place, a grasp and a way are searched.")

    def _title(self, one: ArticulatedObject) -> str:
        return f"{len(self.reports) + 1} of {len(self.objects)}: {one.coordinate}"

    def _look(self, session: Session) -> None:
        """Show a step."""
        runner = self._runner
        one = runner.current
        assert one is not None
        self._progress.update(session, one, runner.opening)
        if self._live is not None:
            self._live.captions = (self._title(one), describe_belief(session, one))
            self._live(session)
        if self._stills is not None:
            self._stills.watch(session, runner.opening)


def _choose_objects(
    found: tuple[ArticulatedObject, ...], patterns: list[str] | None, headless: bool
) -> tuple[ArticulatedObject, ...]:
    """Return the objects to open: those that are asked for, or all but knobs, without a page a few."""
    from kineverse.manipulation.articulated_objects import select_objects

    if patterns is None and not headless:
        return tuple(one for one in found if one.kind != "knob")
    return select_objects(found, _BRIEF if patterns is None else patterns)


def _wait_for_browser(page: Viewer) -> None:
    """Wait for a browser to show a page, but not for long: there may be none."""
    end = time.monotonic() + _PATIENCE
    while not page.server.get_clients() and time.monotonic() < end:
        time.sleep(0.1)
