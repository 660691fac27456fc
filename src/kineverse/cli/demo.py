"""``kineverse demo``: a robot opens and closes a kitchen; with options, a tracked kitchen, or sliders."""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from contextlib import ExitStack, redirect_stdout
from typing import TYPE_CHECKING, Any

import numpy as np

from kineverse.errors import InvalidValueError
from kineverse.expressions.printing import format_number
from kineverse.manipulation import OpenCloseRunner, Robot, TrackedBelief, find_articulated_objects
from kineverse.manipulation.articulated_objects import select_objects
from kineverse.manipulation.robot_sources import find_robot

from . import demo_living
from .arguments import require
from .output import format_table, join_lines, shorten_text, show_activity
from .pages import add_page_options, check_picture_path, handle_interrupts, page_options, print_address

if TYPE_CHECKING:
    from kineverse.manipulation import Belief, OpenCloseReport, Outcome, Session
    from kineverse.manipulation.articulated_objects import ArticulatedObject
    from kineverse.view.run_overlay import LiveRun
    from kineverse.view.skill_stills import SkillStills
    from kineverse.view.viewer import Viewer
    from kineverse.worlds import SimulatedWorld

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
    add_robot_arguments(parser.add_argument_group("the robot"))
    others = parser.add_argument_group("other demos").add_mutually_exclusive_group()
    others.add_argument("--living", action="store_true", help="a kitchen in motion, tracked and identified")
    others.add_argument("--sliders", action="store_true", help="a kitchen and a robot, to be moved by hand")
    demo_living.add_arguments(parser.add_argument_group("with --living"))
    add_page_options(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run ``kineverse demo``."""
    check_picture_path(arguments.picture if arguments.headless else None)
    other = "--living" if arguments.living else "--sliders" if arguments.sliders else ""
    if other:
        _refuse(arguments, ROBOT_OPTIONS, f"is for the robot, not for {other}")
    if not arguments.living:
        _refuse(arguments, demo_living.OPTIONS, "is for --living")
    extras = {"control": not other, "geometry": not other, "view": not arguments.headless}
    require("kineverse demo", extras, compiler=not other)
    return demo_living.run(arguments) if other else run_robot(arguments)


def _refuse(arguments: argparse.Namespace, options: tuple[str, ...], why: str) -> None:
    for name in options:
        if getattr(arguments, name) not in (None, False):
            raise InvalidValueError(f"--{name} {why}; leave one of them out.")


KITCHEN, ROBOT, WORLD = "kitchen", "hsr", "kinematic"
NOISE = "3mm+3mm/m,0.5deg,30Hz"  # noise of the observed poses, unless another one is asked for
_BRIEF = ("*/oven_door", "*/fridge_door", "*/sink_left_upper_drawer")
"""The objects without a page: a flap, a door and a drawer."""
_FASTEST = 100.0
_INTERRUPTED = 130  # exit status after Ctrl-C, as of all commands
_PATIENCE = 15.0  # time that a browser has to show the page before the robot begins [s]

ROBOT_OPTIONS = ("robot", "what", "world", "noise", "speed", "seed", "json")
"""Options of the robot's demo alone."""


def add_robot_arguments(parser: argparse._ArgumentGroup) -> None:
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


def run_robot(arguments: argparse.Namespace) -> int:
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
        from kineverse.planning.bindings import request_planner  # for start-up time
        from kineverse.worlds import Sensors  # for start-up time

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
        request_planner()
        with show_activity(f"reading the {KITCHEN} and the {self._robot.name}"):
            self.model = self._robot.load()
            self.model.include(KITCHEN)
            self.robot = Robot.of(self.model, self._robot.prefix)
            self.gripper = self._robot.gripper(self.model)
            found = find_articulated_objects(self.model, self.robot)
        self.objects = _choose_objects(found, arguments.what, arguments.headless)
        self.reports: list[OpenCloseReport] = []
        self._progress = ProgressLine(len(self.objects))
        self._live: LiveRun | None = None
        self._stills: SkillStills | None = None

    def open_page(self) -> Viewer:
        """Return a page of the model."""
        from kineverse.view.viewer import Viewer  # for start-up time

        start = self._robot.start_state(self.model)
        options = page_options(self._arguments)
        page = Viewer(self.model, start, label=f"Kineverse demo, {self._robot.name}", **options)
        with redirect_stdout(sys.stderr if self._arguments.json else sys.stdout):
            print_address(page, browser=not self._arguments.no_browser)
        return page

    def act(self, page: Viewer | None) -> None:
        """Open and close all objects, on a page if there is one, with a line for each."""
        from kineverse.worlds import KinematicWorld, MujocoWorld, TrueBelief  # for start-up time

        with show_activity("preparing the world"):
            make_world = MujocoWorld if self._arguments.world == "mujoco" else KinematicWorld
            sensors, tracked = self._sensors, None
            if sensors is not None:  # first, so that its code is compiled while the world is made
                tracked = TrackedBelief(self.model, self.robot, sensors)
            world: SimulatedWorld = make_world(
                self.model, self.robot, self.gripper, sensors=sensors, seed=self._seed
            )
            belief: Belief = TrueBelief(world) if tracked is None else tracked
            start = self._robot.start_state(self.model)
            runner = OpenCloseRunner(
                world,
                start,
                belief=belief,
                on_step=self._look,
                hand=self.gripper.hand,
                seed=self._seed,
            )
        self._runner, self._world = runner, world
        self._show_on(page)
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
            from kineverse.view.skill_stills import SkillStills  # for start-up time

            self._stills = SkillStills(self.robot, self._world)
        else:
            from kineverse.view.run_overlay import LiveRun  # for start-up time

            self._live = LiveRun(page, self._world, speed=self._speed, hand=self.gripper.hand)

    def _say(self, text: str) -> None:
        if self._live is not None:
            self._live.captions = ()
            self._live.show_text(text)

    def _begin(self, one: ArticulatedObject) -> None:
        self._progress.begin()
        if self._live is not None:
            self._live.captions = (self._title(one),)
            self._live.show_text("A place, a grasp and a way are searched.")

    def _title(self, one: ArticulatedObject) -> str:
        return f"{len(self.reports) + 1} of {len(self.objects)}: {one.coordinate}"

    def _look(self, session: Session) -> None:
        runner = self._runner
        one = runner.current
        assert one is not None
        value = float(self._world.state[one.coordinate])
        self._progress.update(session.phase, one, value, runner.opening)
        if self._live is not None:
            self._live.captions = (self._title(one), describe_belief(session, one, value))
            self._live(session)
        if self._stills is not None:
            self._stills.watch(session, runner.opening)


def _choose_objects(
    found: tuple[ArticulatedObject, ...], patterns: list[str] | None, headless: bool
) -> tuple[ArticulatedObject, ...]:
    """Return the objects to open: those that are asked for, or all but knobs, without a page a few."""
    if patterns is None and not headless:
        return tuple(one for one in found if one.kind != "knob")
    return select_objects(found, _BRIEF if patterns is None else patterns)


def _wait_for_browser(page: Viewer) -> None:
    """Wait for a browser to show a page, but not for long: there may be none."""
    end = time.monotonic() + _PATIENCE
    while not page.server.get_clients() and time.monotonic() < end:
        time.sleep(0.1)


HEAD = (
    "object",
    "kind",
    "opened",
    "closed",
    "time",
    "grasp error",
    "estimate error",
    "step, median",
    "p99",
    "remark",
)
"""Titles of the table of objects."""
ALIGN = "<<>>>>>>><"
PAGE_HEAD = ("object", "opened", "closed", "time")  # titles of the table on the page
_REFRESH = 0.1  # least time between two states of the line of progress [s]
_LONGEST_REASON = 100


class ProgressLine:
    """Line of progress on standard error: rewritten while an object is handled, if that is a terminal."""

    def __init__(self, count: int) -> None:
        self._count, self._number, self._shown = count, 0, 0.0
        self._terminal = sys.stderr.isatty()

    def begin(self) -> None:
        """Begin the next object."""
        self._number += 1

    def update(self, phase: str, one: ArticulatedObject, value: float, opening: bool) -> None:
        """Show the phase and the value of an object, at most ten times a second."""
        now = time.monotonic()
        if self._terminal and now - self._shown >= _REFRESH:
            self._shown = now
            skill = "open" if opening else "close"
            text = f"{self._place} {one.coordinate}: {skill}, {phase}, {format_reading(one, value)}"
            print(f"\r\033[K{text}", end="", file=sys.stderr, flush=True)

    def finish(self, report: OpenCloseReport) -> None:
        """Leave a line about a report."""
        self.clear()
        print(f"{self._place} {describe_report(report)}", file=sys.stderr, flush=True)

    def clear(self) -> None:
        """Remove the line of an object that was not finished."""
        if self._terminal:
            print("\r\033[K", end="", file=sys.stderr, flush=True)

    @property
    def _place(self) -> str:
        return f"[{self._number:{len(str(self._count))}}/{self._count}]"


def describe_report(report: OpenCloseReport) -> str:
    """Return a sentence on an object."""
    one = report.object
    if report:
        how = "opened and closed, pushed in part," if report.pushed else "opened and closed"
        return f"{one.coordinate}: {how} in {report.seconds:.1f} s"
    value = format_reading(one, report.outcomes[-1].value)
    skill = "opened" if report.closed is None else "closed"
    return f"{one.coordinate}: not {skill}, at {value}. {join_lines(report.reason)}"


def format_row(report: OpenCloseReport) -> list[str]:
    """Return the cells of an object."""
    one, scale = report.object, 1e3 if report.object.kind == "drawer" else math.degrees(1.0)
    unit = " mm" if one.kind == "drawer" else "°"
    steps = 1e3 * np.array(report.steps) if report.steps else np.array([math.nan])
    remark = ("pushed in part" if report.pushed else "") if report else join_lines(report.reason)
    return [
        str(one.coordinate),
        one.kind,
        _format_outcome(one, report.opened),
        _format_outcome(one, report.closed),
        f"{report.seconds:.1f} s",
        "-" if math.isnan(report.grasp_error) else f"{1e3 * report.grasp_error:.2f} mm",
        "-" if math.isnan(error := report.estimate_error) else f"{scale * error:.1f}{unit}",
        f"{np.median(steps):.2f} ms",
        f"{np.quantile(steps, 0.99):.2f} ms",
        shorten_text(remark, _LONGEST_REASON),
    ]


def format_page_row(report: OpenCloseReport) -> list[str]:
    """Return the cells of an object on the page."""
    name, _, opened, closed, seconds, *_ = format_row(report)
    return [name.rpartition("/")[2], opened, closed, seconds]


def describe_belief(session: Session, one: ArticulatedObject, value: float) -> str:
    """Return a line on the true and the believed value of an object."""
    drawer, symbol = one.kind == "drawer", one.coordinate
    scale, unit = (1e3, "mm") if drawer else (math.degrees(1.0), "°")
    space = " " if drawer else ""
    true, believed = scale * value, scale * session.state[symbol]
    if not (deviation := scale * session.deviation(symbol)):
        return f"at {true:.1f}{space}{unit}"
    return f"at {true:.1f}, believed at {believed:.1f} ± {deviation:.1f}{space}{unit}"


def report_as_data(report: OpenCloseReport) -> dict[str, Any]:
    """Return a report as JSON data: lengths in [m], angles in [rad], times in [s]; NaN is null."""
    one = report.object
    steps = np.array(report.steps)
    return {
        "what": str(one.coordinate),
        "kind": one.kind,
        "done": bool(report),
        "opened": _outcome_as_data(report.opened),
        "closed": _outcome_as_data(report.closed),
        "pushed": report.pushed,
        "seconds": report.seconds,
        "grasp_error": None if math.isnan(report.grasp_error) else report.grasp_error,
        "estimate_error": None if math.isnan(report.estimate_error) else report.estimate_error,
        "steps": len(steps),
        "step_median": float(np.median(steps)) if len(steps) else None,
        "step_p99": float(np.quantile(steps, 0.99)) if len(steps) else None,
        "reason": report.reason,
    }


def format_reading(one: ArticulatedObject, value: float) -> str:
    """Return a value of an object's coordinate with its unit."""
    return f"{format_number(value, 3)} {'m' if one.kind == 'drawer' else 'rad'}"


def _format_outcome(one: ArticulatedObject, outcome: Outcome | None) -> str:
    if outcome is None:
        return "-"
    value = format_reading(one, outcome.value)
    return value if outcome else f"no, {value}"


def _outcome_as_data(outcome: Outcome | None) -> dict[str, Any] | None:
    if outcome is None:
        return None
    return {
        "done": outcome.done,
        "value": outcome.value,
        "seconds": outcome.seconds,
        "reason": outcome.reason,
    }
