"""``kineverse world``, ``track``, ``behave``, ``learn``: processes of a live system around a model server."""

from __future__ import annotations

import argparse
import gc
import json
import math
import re
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, closing, contextmanager
from typing import TYPE_CHECKING, Any, NamedTuple

from kineverse.errors import DuplicateNameError, InvalidValueError
from kineverse.exchange.address import SCHEME

from .arguments import print_notes, require
from .output import join_lines, print_line, show_activity
from .pages import check_file_path, check_recording_path, handle_interrupts
from .plan_arguments import find_robot_name, parse_robot

if TYPE_CHECKING:
    from kineverse.exchange import LiveModel
    from kineverse.live.streams import ActivityNote, SkillResult
    from kineverse.model.model_view import ModelView
    from kineverse.state import State
    from kineverse.worlds import Sensors
    from kineverse.worlds.simulated_world import ChangeableWorld

NOISE = "3mm+3mm/m,0.5deg,30Hz"  # noise of the observed poses, unless another one is asked for
WORLDS = ("kinematic", "mujoco")
STEP = 1e-3  # time step of physics [s]
_TIME = re.compile(r"\s*([0-9]*\.?[0-9]+)\s*(ms|s|)\s*")
_WITHOUT_ROUNDS = ("closer", "unknown")  # behaviours
_SWITCHING = 5e-4  # time for which another thread may hold up a process in real time [s]

_ABOUT = """
It is a process of a live system, beside those of 'kineverse serve', 'world', 'track' and 'behave'; 'kineverse
live' starts them all. live:NAME is the address of the model server. The state goes directly between the
processes, so that they go on while the server is away. Ctrl-C ends it.

examples:
"""


class LiveCommand(NamedTuple):
    """Command that runs a process of a live system."""

    HELP: str
    add_arguments: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace], int]


def add_live_options(parser: argparse.ArgumentParser) -> None:
    """Declare the server and the robot of a process."""
    parser.add_argument("server", metavar="live:NAME", help="address of the model server")
    parser.add_argument(
        "--robot", metavar="ROBOT", help="prefix of the robot's names in the model (the only robot in it)"
    )


def add_noise_option(parser: argparse.ArgumentParser) -> None:
    """Declare the noise of the sensors."""
    parser.add_argument("--noise", metavar="TEXT", default=NOISE, help=f"sensors, or none ({NOISE})")


def add_far_option(parser: argparse.ArgumentParser) -> None:
    """Declare how far things are opened."""
    parser.add_argument(
        "--far",
        type=float,
        default=1.0,
        metavar="SHARE",
        help="share of the way by which they are opened (1)",
    )


def add_force_option(parser: argparse.ArgumentParser) -> None:
    """Declare the limit of the force on the robot."""
    parser.add_argument(
        "--force-limit",
        type=float,
        metavar="N",
        help="force on the robot that stops it [N], in MuJoCo (none)",
    )


def check_force(limit: float | None, world: str) -> None:
    """Check ``--force-limit`` in a world."""
    if limit is None:
        return
    if not 0.0 < limit < math.inf:
        raise InvalidValueError(f"--force-limit is a positive number of newtons, not {limit:g}.")
    if world == "kinematic":
        raise InvalidValueError("--force-limit: the kinematic world has no forces; --world mujoco has.")


def add_rounds_option(parser: argparse.ArgumentParser) -> None:
    """Declare how often things are opened and closed."""
    parser.add_argument(
        "--rounds", type=int, default=1, metavar="N", help="how often each is opened and closed (1)"
    )


def check_task(do: str, far: float, rounds: int) -> None:
    """Check ``--far`` and ``--rounds`` of a behaviour."""
    if rounds < 1 or (rounds > 1 and do in _WITHOUT_ROUNDS):
        raise InvalidValueError(
            f"--rounds {rounds}: '{do}' has no rounds; --do tour has."
            if rounds > 1
            else f"--rounds is a number from 1 on, not {rounds}."
        )
    if not 0.1 <= far <= 1.0:
        raise InvalidValueError(f"--far is a share of the way between 0.1 and 1, not {far:g}.")


def parse_sensors(text: str) -> Sensors:
    """Return the sensors of ``--noise``."""
    from kineverse.worlds import Sensors  # for start-up time

    return Sensors() if text == "none" else Sensors.parse(text)


def parse_time(text: str, option: str) -> float:
    """Return a time [s] from a text such as ``40ms`` or ``0.04``."""
    found = _TIME.fullmatch(text)
    seconds = 0.0 if found is None else float(found[1]) * (1e-3 if found[2] == "ms" else 1.0)
    if not seconds > 0.0:
        raise InvalidValueError(f"{option} is a time, such as 40ms or 0.04, not {text!r}.")
    return seconds


@contextmanager
def live_model(arguments: argparse.Namespace) -> Iterator[LiveModel]:
    """Load the served model for a process that runs until Ctrl-C or SIGTERM."""
    import kineverse as kv  # for start-up time

    name = arguments.server
    address = name if name.startswith(SCHEME) else SCHEME + name
    with show_activity(f"reading {address}"):
        live: Any = kv.load(address)
    with live:
        yield live


@contextmanager
def explain_twice(what: str, server: str) -> Iterator[None]:
    """Say what to do if a process runs twice for a server."""
    try:
        yield
    except DuplicateNameError as error:
        raise DuplicateNameError(
            f"Another process is the {what} of {server} already: end that one first, or use it. "
            f"{join_lines(error)}"
        ) from None


def prepare_real_time() -> None:
    """Make the steps of a process even: what there is already is not collected, and threads give way."""
    gc.collect()
    gc.freeze()
    sys.setswitchinterval(_SWITCHING)


def announce(text: str) -> None:
    """Print what runs, in a line."""
    print(f"{text}   (Ctrl-C ends)", flush=True)


# -- world ---------------------------------------------------------------------------------------------------


def _add_world_arguments(parser: argparse.ArgumentParser) -> None:
    add_live_options(parser)
    parser.add_argument("--world", choices=WORLDS, default=WORLDS[0], help=f"the world ({WORLDS[0]})")
    parser.add_argument(
        "--truth", metavar="MODEL", help="model of what is there in truth (the served one, with its edits)"
    )
    add_noise_option(parser)
    parser.add_argument(
        "--timeout",
        metavar="TIME",
        default="40ms",
        help="age of a command's state at which the robot stops (40ms)",
    )
    add_force_option(parser)
    parser.add_argument("--kept", metavar="FILE", help="file that keeps the true state, and where it goes on")
    parser.add_argument("--record", metavar="FILE", help="record all (.mcap), for kineverse view")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="seed of the noise (0)")


def _run_world(arguments: argparse.Namespace) -> int:
    extras = {
        "exchange": True,
        "geometry": True,
        "mjcf": arguments.world == "mujoco",
        "recording": arguments.record is not None,
    }
    require("kineverse world", extras)
    timeout, sensors = parse_time(arguments.timeout, "--timeout"), parse_sensors(arguments.noise)
    check_force(arguments.force_limit, arguments.world)
    if arguments.seed < 0:
        raise InvalidValueError(f"--seed is a number from 0 on, not {arguments.seed}.")
    check_recording_path(arguments.record)
    if arguments.kept is not None:
        check_file_path(arguments.kept)
    from kineverse.live import WorldProcess  # for start-up time

    with handle_interrupts(), live_model(arguments) as live, ExitStack() as stack:
        source, place = (None, None) if arguments.robot is None else parse_robot(arguments.robot)
        snapshot = live.snapshot()
        robot = find_robot_name(snapshot, source)
        truth = None if arguments.truth is None else _load_truth(arguments.truth, robot)
        start = find_start(truth or snapshot, robot, place)

        def make(model: ModelView) -> ChangeableWorld:
            from kineverse.worlds import KinematicWorld, MujocoWorld  # for start-up time

            options: dict[str, Any] = {"sensors": sensors, "seed": arguments.seed}
            if arguments.world == "mujoco":
                return MujocoWorld(truth or model, robot, step=STEP, **options)
            return KinematicWorld(truth or model, robot, **options)

        with explain_twice("world", arguments.server), show_activity("making the world"):
            world = stack.enter_context(
                closing(
                    WorldProcess(
                        live,
                        make,
                        start,
                        timeout=timeout,
                        kept=arguments.kept,
                        follows=truth is None,
                        force_limit=arguments.force_limit,
                    )
                )
            )
        print_notes(world.world.remarks if arguments.verbose else ())
        if arguments.record is not None:
            from kineverse.live.stream_recorder import StreamRecorder  # for start-up time

            about = {"robot": robot, "world": arguments.world, "noise": arguments.noise}
            stack.enter_context(StreamRecorder(arguments.record, live.exchange, truth or snapshot, about))
        announce(f"{robot} in the {arguments.world} world of {arguments.server}")
        prepare_real_time()
        world.run()
    return 0


def _load_truth(source: str, robot: str) -> ModelView:
    """Return the model of the truth, with the robot put into it if it has none."""
    import kineverse as kv  # for start-up time
    from kineverse.manipulation import place_robot  # for start-up time

    model = kv.load(source)
    if not any(s.path.startswith(f"{robot}/") for s in model.degrees_of_freedom):
        place_robot(model, robot)
    return model


def find_start(model: ModelView, robot: str, place: tuple[float, ...] | None = None) -> State:
    """Return the state at the beginning: the robot at a place, or the nearest where it touches nothing."""
    from kineverse.manipulation import PlacedRobot  # for start-up time
    from kineverse.worlds import Robot  # for start-up time

    base = Robot.of(model, robot).planar_base
    if place is not None and (len(place) != 3 or not base):
        raise InvalidValueError(f"--robot {robot}@…: a place of a robot on a planar base is X,Y,ANGLE.")
    placed = PlacedRobot(robot, base, dict(zip(base, place or (), strict=False)), robot)
    start, contact = placed.find_free_start(model, placed.start_state(model))
    if contact:
        print_line(f"start: {contact} touch, so the robot begins elsewhere")
    return start


WORLD = LiveCommand(
    f"""\
A simulated robot in real time: it obeys commands whose state is not older than --timeout, publishes its
encoders, what its camera sees, and, for pages and recordings, the truth. Silence stops it; fingers keep their
force. It follows edits of the served model, unless it has a --truth of its own.
{_ABOUT}  kineverse world live:home --robot hsr
  kineverse world live:home --world mujoco --noise 3mm+3mm/m,0.5deg,30Hz,drop=0.1 --record run.mcap""",
    _add_world_arguments,
    _run_world,
)


# -- tracker -------------------------------------------------------------------------------------------------


def _add_track_arguments(parser: argparse.ArgumentParser) -> None:
    add_live_options(parser)
    add_noise_option(parser)


def _run_track(arguments: argparse.Namespace) -> int:
    require("kineverse track", {"exchange": True})
    sensors = parse_sensors(arguments.noise)
    from kineverse.live import TrackerProcess  # for start-up time

    with handle_interrupts(), live_model(arguments) as live:
        robot = find_robot_name(live.snapshot(), arguments.robot)
        with explain_twice("tracker", arguments.server), show_activity("making the tracker"):
            tracker = TrackerProcess(live, robot, sensors)
        with closing(tracker):
            print_notes(tracker.belief.remarks)
            announce(f"tracker of {arguments.server}, with {robot}")
            prepare_real_time()
            tracker.run(on_problem=print_line)
    return 0


TRACK = LiveCommand(
    f"""\
The state estimator: from encoders and the poses of markers to the state of all coordinates, with their
deviations, and what was never seen or is lost. --noise says what it has to expect.
{_ABOUT}  kineverse track live:home --robot hsr""",
    _add_track_arguments,
    _run_track,
)


# -- behaviour -----------------------------------------------------------------------------------------------


def _add_behave_arguments(parser: argparse.ArgumentParser) -> None:
    from kineverse.live.behaviour_process import BEHAVIOURS  # for start-up time

    add_live_options(parser)
    parser.add_argument("--do", choices=[*BEHAVIOURS], default="closer", help="the behaviour (closer)")
    parser.add_argument(
        "--what", nargs="+", metavar="NAME", help="objects by name or pattern ('*_door') (all)"
    )
    parser.add_argument(
        "--missing-ok", action="store_true", help="leave out names that the model does not have"
    )
    add_far_option(parser)
    add_rounds_option(parser)
    parser.add_argument("--hand", metavar="FRAME", help="hand of the robot (the likeliest gripper)")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="seed of all searches (0)")
    parser.add_argument(
        "--json", action="store_true", help="the results as one JSON object on standard output"
    )


def _run_behave(arguments: argparse.Namespace) -> int:
    require("kineverse behave", {"control": True, "exchange": True, "geometry": True}, compiler=True)
    if arguments.do in ("open", "close", "unknown") and not arguments.what:
        named = "a part by the name of its frame" if arguments.do == "unknown" else "objects by name"
        raise InvalidValueError(f"--do {arguments.do} is about {named}: --what NAME.")
    if arguments.seed < 0:
        raise InvalidValueError(f"--seed is a number from 0 on, not {arguments.seed}.")
    check_task(arguments.do, arguments.far, arguments.rounds)
    from kineverse.live import BehaviourProcess  # for start-up time
    from kineverse.live.behaviour_process import BEHAVIOURS  # for start-up time
    from kineverse.planning.bindings import request_planner  # for start-up time

    request_planner()
    done = False
    with handle_interrupts(), live_model(arguments) as live:
        robot = find_robot_name(live.snapshot(), arguments.robot)
        lines = ActivityLines(sys.stderr if arguments.json else sys.stdout)

        def make(sessions: Any, tell: Callable[[ActivityNote], object]) -> Any:
            def report(note: ActivityNote) -> None:
                tell(note)
                lines.print(note)

            rounds = {} if arguments.do in _WITHOUT_ROUNDS else {"rounds": arguments.rounds}
            return BEHAVIOURS[arguments.do](
                sessions,
                **rounds,
                patterns=arguments.what,
                missing_ok=arguments.missing_ok,
                report=report,
                hand=arguments.hand,
                seed=arguments.seed,
                far=arguments.far,
            )

        with explain_twice("behaviour", arguments.server):
            process = BehaviourProcess(live, robot, make)
        with closing(process):
            announce(f"{arguments.do} with {robot} of {arguments.server}")
            prepare_real_time()
            process.run()
            done = process.behaviour.is_done and not process.behaviour.note.failed
    if arguments.json:
        print(json.dumps({"done": done, "results": results_as_data(process.behaviour.note.results)}))
    return 0 if done else 1


def results_as_data(results: Iterable[SkillResult]) -> list[dict[str, Any]]:
    """Return results of skills as JSON data, times in [s]."""
    return [
        {"what": one.what, "skill": one.skill, "done": one.done, "reason": one.reason, "seconds": one.seconds}
        for one in results
    ]


class ActivityLines:
    """Lines about what is done and why, one for each change."""

    def __init__(self, stream: Any) -> None:
        self._stream, self._shown, self._results = stream, ("", ""), 0

    def print(self, note: ActivityNote) -> None:
        """Print what is new."""
        number = note.done + note.failed
        if number > self._results:
            self._results = number
            print(join_lines(note.last), file=self._stream, flush=True)
        why = re.sub(r"[0-9.]+ s\b", "", note.why)  # times count down
        if (note.doing, why) != self._shown:
            self._shown = note.doing, why
            print(f"{note.behaviour} {note.doing}: {join_lines(note.why)}", file=self._stream, flush=True)


BEHAVE = LiveCommand(
    f"""\
A behaviour: it looks, decides, opens or closes something with the robot, says what it does and why, and goes
on. 'closer' closes whatever is open, for ever; 'tour' opens and closes each object once, and goes on as
closer; 'open' and 'close' do that by name, and end, with exit status 0 if all was done; 'unknown' opens a
part that no joint moves in the model, and closes it once 'kineverse learn' has written one. It can be ended
and started at any time: it looks first, lets go of what the hand may hold, and plans anew.
{_ABOUT}  kineverse behave live:home --do closer
  kineverse behave live:home --do open --what kitchen/fridge_door""",
    _add_behave_arguments,
    _run_behave,
)


# -- learner -------------------------------------------------------------------------------------------------


def _add_learn_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("server", metavar="live:NAME", help="address of the model server")
    parser.add_argument(
        "--parts",
        nargs="+",
        metavar="FRAME",
        help="parts whose joints are unknown, by name or pattern (all that something with a marker carries)",
    )
    parser.add_argument(
        "--propose", action="store_true", help="replace what the model has only once that is accepted"
    )


def _run_learn(arguments: argparse.Namespace) -> int:
    require("kineverse learn", {"exchange": True})
    from kineverse.live import LearnerProcess  # for start-up time

    with handle_interrupts(), live_model(arguments) as live:
        with explain_twice("learner", arguments.server):
            learner = LearnerProcess(live, arguments.parts or (), asks=arguments.propose)
        with closing(learner):
            announce(f"learner of {arguments.server}")
            learner.run(on_edit=print_line)
    return 0


LEARN = LiveCommand(
    f"""\
The model estimator: it watches the markers that the camera sees. It learns the joint of a part that the model
holds to be fixed, once that moves, and writes it into the served model. It tests the joints that the model
has; what does not explain what was seen is replaced after a while, as is the place of furniture. What
somebody takes back is proposed only. It needs no noise: that is measured.
{_ABOUT}  kineverse learn live:home
  kineverse learn live:home --parts kitchen/fridge_door --propose""",
    _add_learn_arguments,
    _run_learn,
)
