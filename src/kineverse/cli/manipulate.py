"""``kineverse open``, ``close`` and ``push``: a robot moves a door or a drawer in a world."""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, redirect_stdout
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from kineverse.errors import InvalidValueError, MissingDependencyError
from kineverse.expressions.printing import format_number
from kineverse.manipulation.swept_volume import find_obstacle
from kineverse.worlds import KinematicWorld, Sensors, TrueBelief

from .arguments import add_model_options, add_set_option, needs_mujoco, print_notes, require
from .manipulate_skills import (
    ManipulationScene,
    SkillTrial,
    is_shut,
    make_scene,
)
from .output import format_table, join_lines, name_options, show_activity
from .outside_robot import OutsideRobot, check_world, is_outside, refuse_start
from .pages import (
    add_page_options,
    check_picture_path,
    check_recording_path,
    handle_interrupts,
    list_mesh_problems,
    page_options,
    print_address,
    print_mesh_problems,
)

if TYPE_CHECKING:
    from kineverse.manipulation import Belief, JudgedOutcome
    from kineverse.manipulation.swept_volume import Obstacle
    from kineverse.state import State
    from kineverse.symbols import Symbol
    from kineverse.worlds import Robot, RobotInterface, SimulatedWorld
    from kineverse.worlds.robot_interface import SkillStep

DONE, NOT_DONE = 0, 1

_COMMON = """
MODEL is any model or file, ROBOT any shipped robot or robot file; ROBOT@X,Y,ANGLE places it, and
ROBOT@X,Y,Z,ANGLE one that is bolted to something. The world gets the speeds of the robot alone, and judges by
its own truth: kinematic (the default), or mujoco with contacts, forces and friction. With --world live it is
the robot of 'kineverse world', and MODEL is live:NAME; with --world ros, one behind topics of ROS 2. Such a
robot begins where it is, and the result is what it believes. Nothing is moved where
something is in the way of the object. The exit status is 0 if it is done and nothing went through anything, 1
if not, 2 if the request is wrong. This needs the extras 'control' and 'geometry', the other world 'mjcf',
--record 'recording', and opening and closing a C compiler.

examples:
"""


class ManipulationCommand(NamedTuple):
    """One of the three commands."""

    skill: str  # its name
    HELP: str

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Declare the options."""
        _add_arguments(parser, self.skill)

    def run(self, arguments: argparse.Namespace) -> int:
        """Run the skill in a world, print its result, and return the status."""
        return _run(arguments, self.skill)


OPEN = ManipulationCommand(
    "open",
    f"""\
The object is at its default value at first, unless --from says otherwise, and is opened to the limit that
is farthest from shut, or to --to.
{_COMMON}  kineverse open kitchen --robot fetch --what kitchen/fridge_door
  kineverse open kitchens/17 --robot hsr --what kitchen/oven_door --world mujoco --json
  kineverse open shelf.urdf --robot arm.urdf --base omni --what drawer --to 20cm
  kineverse open kitchen --robot hsr --what kitchen/fridge_door --unknown --noise 3mm,0.5deg,30Hz""",
)
CLOSE = ManipulationCommand(
    "close",
    f"""\
The object is open by .4 (rad, m) or to its limit at first, unless --from says otherwise. It is shut at the
limit nearest to its default value.
{_COMMON}  kineverse close kitchen --robot fetch --what kitchen/fridge_door
  kineverse close kitchen --robot hsr --what kitchen/oven_door --from 60deg --record run.mcap
  kineverse close kitchen --robot hsr --what kitchen/fridge_door --set kitchen/oven_door=90deg""",
)
PUSH = ManipulationCommand(
    "push",
    f"""\
The object is open by .4 (rad, m) or to its limit at first, unless --from says otherwise. It is shut at the
limit nearest to its default value. A robot without a place starts where it stands, or from a place that is
searched if the push does not go through from there. --hand may name any body of the robot, which then pushes.
{_COMMON}  kineverse push kitchen --robot hsr --what kitchen/sink_left_upper_drawer
  kineverse push kitchen --robot pr2@-0.6,-1.4,0 --what kitchen/fridge_door --view""",
)


class _Once(argparse.Action):
    """Value of an option that is given once."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: str | Sequence[Any] | None,
        option_string: str | None = None,
    ) -> None:
        if getattr(namespace, self.dest) is not None:
            raise InvalidValueError(f"{option_string} is given twice; one robot moves one object.")
        setattr(namespace, self.dest, values)


def _add_arguments(parser: argparse.ArgumentParser, skill: str) -> None:
    parser.usage = "%(prog)s MODEL --robot ROBOT[@X,Y,ANGLE] --what COORDINATE [options]"
    parser.add_argument("model", metavar="MODEL", help="name of a shipped model, or path of a file")
    parser.add_argument(
        "--robot",
        metavar="ROBOT[@X,Y,ANGLE]",
        required=True,
        action=_Once,
        help="the robot, by name or file, and its place (X,Y,Z,ANGLE if it is bolted to something)",
    )
    parser.add_argument(
        "--what", metavar="COORDINATE", required=True, action=_Once, help="coordinate of the object"
    )
    parser.add_argument(
        "--world",
        metavar="WORLD",
        default="kinematic",
        help="kinematic (the default), mujoco, live: the robot of a live system, whose MODEL is live:NAME, "
        "or ros: a robot behind topics of ROS 2; ros:FILE names its settings (.toml)",
    )
    parser.add_argument("--from", metavar="VALUE", dest="start", help="value at the start (0.3, 30deg, 12cm)")
    parser.add_argument("--to", metavar="VALUE", help="wanted value")
    add_set_option(parser, "another coordinate at the start")
    parser.add_argument(
        "--hand", metavar="FRAME", help="hand of the robot, or one of its fingers (the likeliest gripper)"
    )
    if skill != "push":
        parser.add_argument("--handle", metavar="FRAME", help="handle of the object (the best one)")
    if skill == "open":
        parser.add_argument(
            "--unknown",
            action="store_true",
            help="the robot knows the bodies but not the joint of the object; it pulls at the handle and "
            "learns the joint from what it sees (to 25 cm or 60°, or as far as --to is from the start)",
        )
    parser.set_defaults(unknown=False)
    parser.add_argument(
        "--grasp",
        choices=("friction", "tie"),
        help="grasps in MuJoCo: held by friction (the default), or by a weld as soon as both fingers touch",
    )
    parser.add_argument(
        "--noise",
        metavar="TEXT",
        help="sensors, such as 3mm+3mm/m,0.5deg,30Hz,drop=0.1; the robot then acts on estimates from them "
        "(the truth)",
    )
    parser.add_argument(
        "--base",
        choices=("omni",),
        help="put a robot file without a base on one that moves in all directions",
    )
    longest = 60.0 if skill == "push" else 120.0
    parser.add_argument(
        "--seconds",
        type=float,
        default=longest,
        metavar="S",
        help=f"largest time in the world ({longest:g})",
    )
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="seed of everything sampled (0)")
    parser.add_argument("--record", metavar="FILE", help="record the run (.mcap), for kineverse view")
    parser.add_argument("--view", action="store_true", help="show the run in the browser while it happens")
    parser.add_argument("--picture", metavar="FILE", help="write a picture (.png) of the end")
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output")
    add_model_options(parser)
    add_page_options(parser)


def _run(arguments: argparse.Namespace, skill: str) -> int:
    from kineverse.planning.bindings import request_planner  # for start-up time

    _check(arguments, skill)
    request_planner()
    if is_outside(arguments.world):
        return _run_outside(arguments, skill)
    with show_activity(f"reading {arguments.model} and {arguments.robot}"):
        scene = make_scene(arguments, skill)
    _print_violations(scene)
    with show_activity("preparing the world"):
        world = _make_world(arguments, scene)
    belief: Belief = TrueBelief(world)
    if arguments.noise is not None:
        belief = _track(scene, Sensors.parse(arguments.noise))
    return _run_in(arguments, skill, scene, world, world, belief)


def _run_outside(arguments: argparse.Namespace, skill: str) -> int:
    """Run the skill with a robot outside of this process."""
    with ExitStack() as stack:
        outside: OutsideRobot | None = None

        def look(robot: Robot, coordinate: Symbol) -> State:
            nonlocal outside
            outside = stack.enter_context(
                OutsideRobot(
                    arguments.world, robot, coordinate, whole=arguments.unknown, server=arguments.model
                )
            )
            return outside.look()

        with show_activity(f"reading {arguments.model} and looking at {arguments.robot}"):
            scene = make_scene(arguments, skill, look)
        assert outside is not None
        _print_violations(scene)
        return _run_in(arguments, skill, scene, outside.interface, None, outside.belief)


def _print_violations(scene: ManipulationScene) -> None:
    print_notes(
        f"{violation.name} is violated at the start: {format_number(violation.value)} is not in "
        f"[{format_number(violation.lower)}, {format_number(violation.upper)}]"
        for violation in scene.model.violations(scene.start)[:3]
    )


def _run_in(
    arguments: argparse.Namespace,
    skill: str,
    scene: ManipulationScene,
    interface: RobotInterface,
    world: SimulatedWorld | None,
    belief: Belief,
) -> int:
    """Run the skill with a robot, in a simulated world if it is in one, and return the status."""
    if arguments.verbose:
        print_notes(interface.remarks)
    run = _Run(arguments, skill, scene, interface, world, belief, scene.start)
    outcome = None
    with ExitStack() as stack:
        if arguments.view:
            outcome = _view(run, stack)
        else:
            outcome = _act(run, [], arguments.record)
            _report_outcome(run, outcome)
    if outcome is None:
        raise KeyboardInterrupt  # before there was a result
    return DONE if outcome else NOT_DONE


@dataclass
class _Run:
    """Run of a skill with a robot."""

    arguments: argparse.Namespace
    skill: str
    scene: ManipulationScene
    interface: RobotInterface
    world: SimulatedWorld | None  # the world if it is a simulated one
    belief: Belief
    believed: State  # the latest

    @property
    def state(self) -> State:
        """The present state: the true one, else the believed one."""
        return self.believed if self.world is None else self.world.state


def _check(arguments: argparse.Namespace, skill: str) -> None:
    """Check requirements and options before anything is loaded."""
    models = (arguments.model, arguments.robot.rpartition("@")[0] or arguments.robot)
    extras = {
        "control": True,
        "geometry": True,
        "mjcf": arguments.world == "mujoco" or any(map(needs_mujoco, models)),
        "recording": arguments.record is not None,
        "view": arguments.view,
    }
    check_world(arguments.world, ("kinematic", "mujoco"))
    if is_outside(arguments.world):
        refuse_start(arguments)
    # A push takes what stands in its way into account without a planner.
    require(f"kineverse {skill}", extras, compiler=skill != "push")
    if not arguments.seconds > 0 or math.isinf(arguments.seconds):
        raise InvalidValueError(f"--seconds is a positive number, not {arguments.seconds:g}.")
    if arguments.seed < 0:
        raise InvalidValueError(f"--seed is a number from 0 on, not {arguments.seed}.")
    if arguments.grasp is not None and arguments.world != "mujoco":
        raise InvalidValueError("--grasp is for --world mujoco; the kinematic world has no friction.")
    if arguments.noise is not None:
        Sensors.parse(arguments.noise)  # says at once what cannot be read
    check_picture_path(arguments.picture)
    check_recording_path(arguments.record)


def _make_world(arguments: argparse.Namespace, scene: ManipulationScene) -> SimulatedWorld:
    world: SimulatedWorld
    sensors = None if arguments.noise is None else Sensors.parse(arguments.noise)
    if arguments.world == "mujoco":
        from kineverse.worlds import MujocoWorld  # for start-up time

        grasp: Literal["friction", "tie"] = arguments.grasp or "friction"
        world = MujocoWorld(
            scene.model, scene.robot, scene.gripper, grasp=grasp, sensors=sensors, seed=arguments.seed
        )
    else:
        world = KinematicWorld(scene.model, scene.robot, scene.gripper, sensors=sensors, seed=arguments.seed)
    world.reset(scene.start)
    return world


def _track(scene: ManipulationScene, sensors: Sensors) -> Belief:
    """Return a belief from noisy sensors, and print what is to be known of it."""
    from kineverse.manipulation import TrackedBelief  # for start-up time

    tracked = TrackedBelief(scene.model, scene.robot, sensors)
    print_notes(tracked.remarks)
    if tracked.sensors.position > 0.0 and tracked.sensors.orientation == 0.0:
        print_notes(["orientations are seen exactly; 0.5deg in --noise gives them noise, too"])
    return tracked


def _act(run: _Run, watchers: list[Callable[[SkillStep], object]], record: str | None) -> JudgedOutcome:
    arguments, skill, scene = run.arguments, run.skill, run.scene
    with ExitStack() as stack:
        watchers = [_PhaseLines(run), *watchers]
        recorder = None
        if record is not None:
            about = {
                "skill": skill,
                "robot": scene.robot.name,
                "what": str(scene.coordinate),
                "world": run.interface.name,
            }
            if arguments.noise is not None:
                about["noise"] = arguments.noise
            from kineverse.worlds import Recorder  # for start-up time

            recorder = stack.enter_context(Recorder(record, scene.model, about, world=run.world))
            watchers.append(recorder)

        def look(step: SkillStep) -> None:
            # The model of a skill that learns a joint has other coordinates.
            known = {s: v for s, v in step.state.items() if s in run.believed}
            run.believed = run.believed.updated(known)
            for watch in watchers:
                watch(step)

        trial = SkillTrial(arguments, scene, run.interface, run.world, run.belief, look)
        there = abs(scene.start[scene.coordinate] - scene.target) <= scene.tolerance
        if scene.fixed and (not there or (skill == "open" and arguments.to is None)):
            outcome = trial.skip(False, scene.fixed)
        elif there:
            outcome = trial.skip(True, f"'{scene.coordinate}' is there from the start")
        elif not arguments.unknown and (obstacle := _find_obstacle(scene)) is not None:
            outcome = trial.skip(False, str(obstacle), obstacle.measures)
        else:
            act = (
                trial.push if skill == "push" else trial.open_as_unknown if arguments.unknown else trial.grasp
            )
            outcome = act()
            out_of_reach = outcome.measures.get("failure") == "reach"
            if not outcome and out_of_reach and scene.robot.base is None:
                advice = "The robot stands still without a mobile base: --base omni gives it one."
                outcome = replace(outcome, reason=f"{outcome.reason} {advice}")
        if recorder is not None:
            recorder.write_outcome(outcome)
    return outcome


def _find_obstacle(scene: ManipulationScene) -> Obstacle | None:
    """Return what is in the way of the object at the start of a scene; None if nothing is."""
    return find_obstacle(scene.model, scene.coordinate, scene.start, scene.target, robot=scene.robot)


def _view(run: _Run, stack: ExitStack) -> JudgedOutcome | None:
    """Run the skill on a page, then play it there until Ctrl-C; return None if it was interrupted before."""
    from kineverse.view.page import read_title  # for start-up time
    from kineverse.view.run_overlay import LiveRun, play_recording  # for start-up time
    from kineverse.view.viewer import Viewer  # for start-up time
    from kineverse.worlds import read_run_recording  # for start-up time
    from kineverse.worlds.recorder import import_mcap  # for start-up time

    arguments, scene = run.arguments, run.scene
    record = arguments.record
    if record is None:
        try:
            import_mcap("mcap.writer")
        except MissingDependencyError as error:
            print(f"kineverse: note: the run is not played again. {error}", file=sys.stderr)
        else:
            record = str(Path(stack.enter_context(tempfile.TemporaryDirectory())) / "run.mcap")
    label = f"{read_title(arguments.model)}, {scene.robot.name}"
    outcome = None
    with (
        handle_interrupts(),
        Viewer(scene.model, run.state, label=label, **page_options(arguments)) as page,
    ):
        print_mesh_problems(page.problems)
        with redirect_stdout(sys.stderr if arguments.json else sys.stdout):
            print_address(page, browser=not arguments.no_browser)
        # A robot outside keeps time itself.
        live = LiveRun(page, run.world, speed=0.0 if run.world is None else 1.0)
        outcome = _act(run, [live], record)
        live.remove()
        _report_outcome(run, outcome)
        sys.stdout.flush()
        if record is not None and outcome.steps:
            play_recording(page, read_run_recording(record), loop=True)
        page.wait()
    return outcome


class _PhaseLines:
    """Lines on standard error, one for each phase that begins."""

    def __init__(self, run: _Run) -> None:
        self._run, self._phase = run, ""
        self._begin: float | None = None

    def __call__(self, session: SkillStep) -> None:
        if self._begin is None:  # a robot outside has the time of the day
            self._begin = 0.0 if self._run.world is not None else session.time
        if session.phase != self._phase:
            self._phase, scene = session.phase, self._run.scene
            state = session.state if self._run.world is None else self._run.world.state
            value = state.given(scene.coordinate)  # None for a joint that is being learned
            text = "" if value is None else f"{value:.3f} {scene.unit}".rstrip()
            print(
                f"{session.time - self._begin:7.2f} s  {self._phase:<12}  {text}".rstrip(),
                file=sys.stderr,
                flush=True,
            )


def _report_outcome(run: _Run, outcome: JudgedOutcome) -> None:
    """Print the result of a skill, and write a picture if wanted."""
    arguments, scene = run.arguments, run.scene
    if arguments.picture is not None:
        from kineverse.view import save_picture  # for start-up time

        save_picture(arguments.picture, scene.model, {str(s): v for s, v in run.state.items()})
        print_mesh_problems(list_mesh_problems(scene.model))
        print(f"picture: {arguments.picture}", file=sys.stderr)
    if arguments.json:
        answer = {
            "claimed": outcome.claimed,
            "done": outcome.done,
            "value": outcome.value,
            "reason": outcome.reason,
            "world": outcome.world,
            "seconds": outcome.seconds,
            "steps": outcome.steps,
            "skill": run.skill,
            "robot": scene.robot.name,
            "what": str(scene.coordinate),
            "start": scene.start[scene.coordinate],
            "target": None if arguments.unknown and arguments.to is None else scene.target,
            "hand": None if scene.gripper is None else scene.gripper.hand,
            "measures": outcome.measures,
            "remarks": run.interface.remarks,
        }
        print(json.dumps(_plain(answer), allow_nan=False))
        return
    at = f"{format_number(outcome.value, 4)} {scene.unit}".rstrip()
    if not outcome:
        verdict = f"not done, at {at}. {outcome.reason}"
    else:
        state = "shut" if is_shut(scene) else "done"
        verdict = f"{state} at {at}, after {format_number(outcome.seconds, 4)} s {_name_world(run)}"
    print(f"{scene.coordinate}: {name_options(join_lines(verdict), arguments)}")
    if "family" in outcome.measures:
        if outcome:
            print(outcome.reason)
        print(f"learned joint: {_describe_joint(outcome.measures)}")
    if outcome.steps:
        rows = [("steps", str(outcome.steps))]
        rows += [
            (name, _format_measure(value, _MEASURE_UNITS.get(name, scene.unit if name in _OF_OBJECT else "")))
            for name, value in _plain(outcome.measures).items()
        ]
        print(format_table(("measure", "value"), rows))
    if arguments.record is not None:
        print(f"recording: {arguments.record}")


def _name_world(run: _Run) -> str:
    if run.world is None:
        return "as the robot believes"
    return f"in the {run.world.name} world"


def _describe_joint(measures: Mapping[str, Any]) -> str:
    """Return a learned joint in words: family, axis, and a point on it."""
    words = str(measures["family"])
    for key, link in (("axis", "axis"), ("point", "through")):
        if key in measures:
            words += f", {link} [{', '.join(f'{v:.3f}' for v in np.ravel(measures[key]))}]"
    certain = f"certain after {100 * measures['decided_way']:.1f} cm"
    return f"{words} in {measures['parent']}, {certain} and {math.degrees(measures['decided_turn']):.1f}°"


def _plain(value: Any) -> Any:
    """Return a value as JSON has it: what is not finite is null, and what is unknown is its text."""
    if isinstance(value, Mapping):
        return {str(key): _plain(one) for key, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(one) for one in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return _plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, (bool, int, str)) else str(value)


_MEASURE_UNITS = {
    **dict.fromkeys(("penetration", "grasp_error", "distance", "hand_distance", "pressed"), "m"),
    **dict.fromkeys(("way", "decided_way"), "m"),
    **dict.fromkeys(("grasp_rotation", "turn", "decided_turn"), "rad"),
    **dict.fromkeys(("opened_seconds", "pull_seconds", "decided_seconds"), "s"),
    "jitter": "m/s, rad/s",
    "limit_violation": "in the unit of the limit",
    "peak_force": "N",
    "reversals": "1/s",
}
"""Units of figures; others are numbers, or have the unit of what they are about."""

_OF_OBJECT = ("penetration_from", "target", "tolerance", "estimate_mean", "estimate_largest")
"""Figures in the unit of the object's coordinate."""


def _format_measure(value: Any, unit: str) -> str:
    if isinstance(value, float):
        return f"{format_number(value, 4)} {unit}".rstrip()
    if isinstance(value, list) and all(isinstance(one, str) for one in value):
        return ", ".join(filter(None, value)) or "-"
    if isinstance(value, (list, dict)):
        return f"{len(value)}, see --json"
    return "-" if value in (None, "") else str(value)
