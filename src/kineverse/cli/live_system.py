"""``kineverse live``: all processes of a live system, supervised, with a table on the terminal."""

from __future__ import annotations

import argparse
import json
import math
import os
import re
import select
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

from kineverse.errors import DuplicateNameError, InvalidValueError, KineverseError
from kineverse.exchange.address import SCHEME, check_server_name, list_servers

from .arguments import require
from .live import (
    NOISE,
    WORLDS,
    ActivityLines,
    add_far_option,
    add_force_option,
    add_noise_option,
    add_rounds_option,
    check_force,
    check_task,
    find_start,
    parse_sensors,
    results_as_data,
)
from .output import format_table, join_lines, shorten_text, show_activity
from .pages import add_page_options, check_picture_path, check_recording_path, handle_interrupts
from .plan_arguments import parse_robot

if TYPE_CHECKING:
    from kineverse.live.children import Child
    from kineverse.live.supervisor import LiveStatus, Supervisor
    from kineverse.manipulation import ArticulatedObject
    from kineverse.model.model import Model
    from kineverse.worlds import Robot

HELP = f"""\
A robot opens and closes the doors and drawers of a kitchen, and then closes whatever is open, also what
people open, until Ctrl-C. Around a model server run a simulated world in real time, a state estimator, a
learner, a behaviour and a page, each a process; what dies is started again. The terminal shows the processes,
what is done and why. Keys: e emergency stop, r release, k and a number kill that process, q quit.

With --headless there is no page: one object of each kind is opened, by 30 % of its way unless --far says
otherwise, and closed, within 90 s, with numbers and a picture. The exit status is 0 if all of it was done,
else 1. This needs the extras 'exchange', 'control', 'geometry', a C compiler, for the page 'view', and for
--world mujoco 'mjcf'.

examples:
  kineverse live
  kineverse live kitchens/17 --robot fetch --world mujoco --noise {NOISE},outliers=0.05
  kineverse live --do closer --record run.mcap
  kineverse live --unknown kitchen/fridge_door
  kineverse live --headless --json --picture kitchen.png"""

KITCHEN, ROBOT = "kitchen", "hsr"
_BRIEF = ("*/sink_left_upper_drawer", "*/fridge_door", "*/oven_door")
"""Objects without a page, a drawer, a door and a flap, of the kitchen that ships."""
_BRIEFLY = 0.3  # share of their ways by which they are opened
_KINDS = ("drawer", "door", "flap")  # kinds of which one each is taken in another kitchen
_DEADLINE = 80.0  # time from the start after which a run without a page ends [s]
_INTERRUPTED = 130  # exit status after Ctrl-C, as of all commands
_UNKNOWN = "unknown"  # behaviour that opens what nobody has described
_SERVED, _TRUTH = "served.kv.json", "truth.kv.json"  # models of its run
_RUN = "kineverse-live-"  # folders of runs, by the number of the supervisor's process
_REDRAWN = 0.5  # time between two tables [s]
_ADDRESS = re.compile(r"https?://\S+")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    from kineverse.live.behaviour_process import BEHAVIOURS  # for start-up time

    parser.add_argument("kitchen", metavar="KITCHEN", nargs="?", default=KITCHEN, help=f"a model ({KITCHEN})")
    parser.add_argument(
        "--robot", metavar="ROBOT[@X,Y,ANGLE]", default=ROBOT, help=f"a robot, and its place ({ROBOT})"
    )
    parser.add_argument("--world", choices=WORLDS, default=WORLDS[0], help=f"the world ({WORLDS[0]})")
    add_noise_option(parser)
    known = [name for name in BEHAVIOURS if name != _UNKNOWN]
    parser.add_argument("--do", choices=known, default="tour", help="the behaviour (tour)")
    parser.add_argument(
        "--what",
        nargs="+",
        metavar="COORDINATE",
        help="objects by name or pattern ('*_door'), in this order (all; with --headless one of each kind)",
    )
    parser.add_argument(
        "--unknown",
        metavar="COORDINATE",
        help="nobody has described the joint of this object: it is opened, learned, and closed by name",
    )
    add_far_option(parser)
    add_rounds_option(parser)
    add_force_option(parser)
    parser.add_argument("--headless", action="store_true", help="numbers and a picture instead of a page")
    parser.add_argument(
        "--picture", metavar="PATH", help="write a picture (.png) of what was done at the end"
    )
    parser.add_argument(
        "--seconds", type=float, metavar="S", help="end after this time (80 for the objects of --headless)"
    )
    parser.add_argument("--record", metavar="FILE", help="record all (.mcap), for kineverse view")
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output")
    parser.add_argument("--name", metavar="NAME", help="name of the model server (live)")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="seed of noise and searches (0)")
    add_page_options(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run all processes until it is over."""
    begin = time.monotonic()
    extras = {
        "control": True,
        "exchange": True,
        "geometry": True,
        "mjcf": arguments.world == "mujoco",
        "recording": arguments.record is not None,
        "view": not arguments.headless,
    }
    require("kineverse live", extras, compiler=True)
    check_picture_path(arguments.picture)
    check_recording_path(arguments.record)
    if arguments.name is not None:
        check_server_name(arguments.name)
    parse_sensors(arguments.noise)
    check_force(arguments.force_limit, arguments.world)
    check_task(arguments.do, arguments.far, arguments.rounds)
    if arguments.seed < 0:
        raise InvalidValueError(f"--seed is a number from 0 on, not {arguments.seed}.")
    if arguments.seconds is not None and not 0.0 < arguments.seconds < math.inf:
        raise InvalidValueError(f"--seconds is a positive number, not {arguments.seconds:g}.")
    brief = arguments.headless and arguments.what is None and arguments.unknown is None
    seconds = arguments.seconds or (_DEADLINE if brief else math.inf)
    finished = False
    with handle_interrupts(), ExitStack() as stack:
        system = LiveSystem(arguments, stack.enter_context(run_folder()))
        stack.callback(system.close)
        try:
            system.start()
            system.watch(begin + seconds)
            finished = True
        finally:
            system.supervisor.close()  # before the numbers, so that these are of the end
            system.report()
    return (0 if system.is_done or not arguments.headless else 1) if finished else _INTERRUPTED


@contextmanager
def run_folder() -> Iterator[Path]:
    """Yield a folder of this run, and remove those that killed supervisors have left."""
    parent = Path(tempfile.gettempdir())
    for left in parent.glob(f"{_RUN}*"):
        number = left.name.removeprefix(_RUN).partition("-")[0]
        if number.isdigit() and not _is_alive(int(number)):
            shutil.rmtree(left, ignore_errors=True)
    with tempfile.TemporaryDirectory(prefix=f"{_RUN}{os.getpid()}-", ignore_cleanup_errors=True) as folder:
        yield Path(folder)


def _is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True


class LiveSystem:
    """Processes of a live system, with what is shown of them."""

    def __init__(self, arguments: argparse.Namespace, folder: Path) -> None:
        from kineverse.live.supervisor import BEHAVE, LEARN, SERVE, TRACK, VIEW, WORLD, Supervisor
        from kineverse.manipulation import find_articulated_objects, place_robot

        self._arguments, self._folder = arguments, folder
        self.name = _choose_name(arguments.name)
        address = SCHEME + self.name
        source, place = parse_robot(arguments.robot)
        store = ["--name", self.name, "--store", str(folder / "model.db")]
        with show_activity(f"reading {arguments.kitchen} and {source}"):
            self.model = _load(arguments.kitchen)
            placed = place_robot(self.model, source)
            from kineverse.worlds import Robot

            self.robot = Robot.of(self.model, placed.name)
            find_start(self.model, placed.name, place)  # raises for a place that is none
            found = find_articulated_objects(self.model, self.robot)
        self.do = arguments.do if arguments.unknown is None else _UNKNOWN
        model, truth, served = arguments.kitchen, list[str](), ["--robot", source]
        if arguments.unknown is None:
            objects = _choose_objects(found, arguments.what, arguments.headless)
            self.names = [str(one.coordinate) for one in objects]
        else:
            self.names, served = [self._forget(arguments.unknown)], []
            model, truth = str(folder / _SERVED), ["--truth", str(folder / _TRUTH)]
        robot = ["--robot", placed.name]
        noise, seed = ["--noise", arguments.noise], ["--seed", str(arguments.seed)]
        guard = [] if arguments.force_limit is None else ["--force-limit", str(arguments.force_limit)]
        at = "" if place is None else "@" + ",".join(f"{v!r}" for v in place)
        world = ["world", address, "--robot", placed.name + at, "--world", arguments.world, *noise, *seed]
        brief = arguments.headless and arguments.what is None and arguments.far == 1.0
        far = ["--far", str(_BRIEFLY if brief else arguments.far)]
        rounds = ["--rounds", str(arguments.rounds)]
        behave = ["behave", address, "--missing-ok"]  # it is to outlive that somebody deletes an object
        commands = {
            SERVE: ["serve", model, *served, *store],
            WORLD: [*world, *guard, *truth, "--kept", str(folder / "world.state")],
            TRACK: ["track", address, *robot, *noise],
            BEHAVE: [*behave, *robot, *seed, *far, *rounds, "--do", self.do, "--what", *self.names],
        }
        if not arguments.headless or self.do == _UNKNOWN:
            commands[LEARN] = ["learn", address]
        if not arguments.headless:
            host = ["--host", arguments.host] if arguments.host else []
            quiet = ["--no-browser"] if arguments.no_browser else []
            from kineverse.view.server import find_free_port

            # Now, so that a page that is started again has the same address.
            port = find_free_port(arguments.host or "127.0.0.1", arguments.port)
            commands[VIEW] = ["view", address, "--port", str(port), *host, *quiet]
        self.supervisor = Supervisor(self.name, commands, folder, ending=(BEHAVE,), prepare=self._prepare)
        self._stills: LiveStills | None = None
        self._records = False
        self._stack = ExitStack()
        self._screen = Screen(self, sys.stderr if arguments.json else sys.stdout)

    def _forget(self, what: str) -> str:
        """Write the model of the truth, and one without the joint of an object; return its part."""
        from kineverse.live import make_unknown_scene  # for start-up time

        scene = make_unknown_scene(self.model, what)
        self.model.save(self._folder / _TRUTH)
        scene.model.save(self._folder / _SERVED)
        return scene.part

    def start(self) -> None:
        """Start all processes."""
        with show_activity("starting the model server"):
            self.supervisor.start()
        if self._arguments.picture or self._arguments.headless:
            self._stills = LiveStills(self.robot, self.supervisor)
        if self._arguments.record is not None:
            from kineverse.live.stream_recorder import StreamRecorder

            connection = self.supervisor.connection
            about = {"robot": self.robot.name, "world": self._arguments.world, "noise": self._arguments.noise}
            recorder = StreamRecorder(self._arguments.record, connection, self.model, about)
            self._stack.enter_context(recorder)
            self._records = True

    def watch(self, until: float) -> None:
        """Watch all processes until a time of the clock that only counts [s], or until all is done."""
        with self._screen:
            self.supervisor.run(lambda status: self._look(status) or time.monotonic() > until)

    def _look(self, status: LiveStatus) -> bool:
        if self._stills is not None:
            self._stills.look(status)
        return self._screen.look(status) or (self._arguments.headless and self.is_over)

    def close(self) -> None:
        """Finish the recording."""
        self._stack.close()

    def _prepare(self, child: Child, status: LiveStatus) -> None:
        """Have a behaviour that is started again do what is left, and a page open no second window."""
        if child.name == "view" and "--no-browser" not in child.words:
            child.words.append("--no-browser")
        if child.name != "behave" or self.do in ("closer", _UNKNOWN):
            return
        rounds = {name: self._arguments.rounds - self._count(name) for name in self.names}
        left = [name for name, number in rounds.items() if number > 0]
        head = child.words[: child.words.index("--do")]
        task = ["--do", self.do, "--rounds", str(max(rounds.values()))]
        child.words = [*head, *(task if left else ["--do", "closer"]), "--what", *(left or self.names)]

    @property
    def _skills(self) -> tuple[str, ...]:
        """Skills of which the results count."""
        return {"open": ("open",), "close": ("close",)}.get(self.do, ("open", "close"))

    def _count(self, name: str) -> int:
        """Return how often an object was handled as wanted."""
        return len(self.supervisor.status.list_results(name, self._skills[-1]))

    def _is_handled(self, name: str) -> bool:
        return self.do != _UNKNOWN and self._count(name) >= self._arguments.rounds

    @property
    def is_over(self) -> bool:
        """True if all objects were handled."""
        if self.do == _UNKNOWN:
            return self.supervisor.children["behave"].is_done
        return self.do != "closer" and all(map(self._is_handled, self.names))

    @property
    def is_done(self) -> bool:
        """True if all objects were opened and closed, or what was wanted."""
        return all(one["done"] for one in self.list_objects())

    def list_objects(self) -> list[dict[str, Any]]:
        """Return what became of each object, as JSON data."""
        status, rows = self.supervisor.status, []
        for name in self.names:
            found = [one for skill in self._skills for one in status.list_results(name, skill)]
            if self.do == _UNKNOWN:  # it is closed by the name that its joint has got
                found = status.results
            failed = [f"{one.skill}: {one.reason}" for one in found if not one.done]
            if not failed and self.do != "closer" and not (self.is_over or self._is_handled(name)):
                failed = [f"The time was up after {len(found)} of {self._wanted} skills."]
            rows.append(
                {
                    "what": name,
                    "robot": self.robot.name,
                    "done": not failed,
                    "reason": join_lines(" ".join(failed)),
                    "seconds": sum(one.seconds for one in found),
                    "results": results_as_data(found),
                }
            )
        return rows

    @property
    def _wanted(self) -> int:
        rounds: int = self._arguments.rounds
        return rounds * len(self._skills)

    def report(self) -> None:
        """Print what was done, and write the picture."""
        arguments, status = self._arguments, self.supervisor.status
        picture = arguments.picture or ("live.png" if arguments.headless else None)
        if picture is not None and self._stills is not None and self._stills.save(picture):
            shown: str | None = picture
        else:
            shown = None
        note = status.robot
        factor = None if note is None else note.factor
        late = status.late_steps / status.steps if status.steps else None
        objects = self.list_objects()
        if arguments.json:
            data = {
                "done": self.is_done,
                "robot": self.robot.name,
                "world": arguments.world,
                "noise": arguments.noise,
                "objects": objects,
                "steps": status.steps,
                "late": late,
                "real_time_factor": factor,
                "dropped_ticks": None if note is None else note.dropped,
                "restarts": status.restarts,
                "picture": shown,
            }
            print(json.dumps(data, allow_nan=False), flush=True)
            return
        if arguments.headless:
            rows = [
                [one["what"], "yes" if one["done"] else "no", f"{one['seconds']:.1f} s", one["reason"]]
                for one in objects
            ]
            print(format_table(("object", "done", "time", "reason"), rows, "<<><"))
        numbers = [] if factor is None else [f"real-time factor {factor:.4f}"]
        numbers += [] if late is None else [f"{100 * late:.2f} % of {status.steps} control steps late"]
        numbers += [f"{number} restarts of {name}" for name, number in status.restarts.items()]
        print(", ".join(numbers), flush=True)
        if shown is not None:
            print(f"picture: {shown}", flush=True)
        if self._records:
            print(f"recording: {arguments.record}", flush=True)


def _load(source: str) -> Model:
    import kineverse as kv  # for start-up time

    if source.startswith(SCHEME):
        raise InvalidValueError(
            f"{source} is served already: start the processes around it, see kineverse world --help."
        )
    model = kv.Model()
    model.include(source)
    return model


def _choose_name(wanted: str | None) -> str:
    """Return the name of the server: the wanted one if nobody has it, or the first that is free."""
    taken, number = {*list_servers()}, 1
    if wanted is not None and wanted in taken:  # else all would work for the server of somebody else
        raise DuplicateNameError(
            f"--name {wanted}: a model server of that name is running already. Use another name, or none."
        )
    if wanted is not None:
        return wanted
    while (name := "live" if number == 1 else f"live-{number}") in taken:
        number += 1
    return name


def _choose_objects(
    found: Sequence[ArticulatedObject], patterns: Sequence[str] | None, brief: bool
) -> Sequence[ArticulatedObject]:
    """Return the objects that are asked for: all but knobs, or briefly one of each kind."""
    from kineverse.manipulation.articulated_objects import select_objects  # for start-up time

    if patterns is not None:
        return select_objects(found, patterns)
    if not brief:
        return [one for one in found if one.kind != "knob"]
    with suppress(KineverseError):
        return select_objects(found, _BRIEF)
    return [one for kind in _KINDS for one in [one for one in found if one.kind == kind][:1]]


class LiveStills:
    """Stills of what is done, from the streams of a live system."""

    def __init__(self, robot: Robot, supervisor: Supervisor) -> None:
        from kineverse.state import State  # for start-up time
        from kineverse.view.skill_stills import SkillStills  # for start-up time

        self._supervisor, self._known = supervisor, {str(s): s for s in robot.model.symbols}
        self._default = robot.model.default_state()
        self.state: State = self._default  # the true one
        self._stills = SkillStills(robot, self)
        self._drawn: set[str] = set()
        self._told = 0  # results that were looked at

    def look(self, status: LiveStatus) -> None:
        """Keep the present moment, and end the row of an object that was handled."""
        from kineverse.live.streams import TRACKER, TRUTH  # for start-up time

        note = status.activity
        truth, belief = self._read(TRUTH), self._read(TRACKER)
        if note is None or truth is None:
            return
        self.state = truth
        way = note.read_way()
        reference = None if way is None else SimpleNamespace(ahead=way)
        step: Any = SimpleNamespace(state=belief or truth, phase=note.phase, reference=reference)
        for one in status.results[self._told :]:
            self._told += 1
            if one.skill == "close" and one.what not in self._drawn:
                self._drawn.add(one.what)
                self._stills.end_row(self._known[one.what])
        if note.doing.startswith(("opens", "closes", "pushes")):
            self._stills.watch(step, note.doing.startswith("opens"))

    def _read(self, source: str) -> Any:
        newest = self._supervisor.reader.newest(source)
        if newest is None:
            return None
        return self._default.updated({self._known[n]: v for n, v in newest.named.items() if n in self._known})

    def save(self, path: str) -> bool:
        """Write the picture, and return True; False if there is nothing to show."""
        if not self._stills:
            return False
        self._stills.save(path)
        return True


class Screen:
    """Table of the processes on a terminal, and its keys; elsewhere a line for each change."""

    def __init__(self, system: LiveSystem, stream: Any) -> None:
        self._system, self._stream = system, stream
        self._is_terminal = bool(stream.isatty())
        self._lines = ActivityLines(stream)
        self._states: dict[str, str] = {}
        self._address, self._answer, self._kills = "", "", False
        self._drawn, self._height = -math.inf, 0
        self._stack = ExitStack()

    def __enter__(self) -> Screen:
        if self._is_terminal and sys.stdin.isatty():
            self._stack.enter_context(_single_keys())
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def look(self, status: LiveStatus) -> bool:
        """Show the present state; return True if it is to end."""
        if not self._address:
            self._find_address()
        if not self._is_terminal:
            self._print_changes(status)
            return False
        ends = self._read_keys(status)
        if ends or time.monotonic() - self._drawn >= _REDRAWN:
            self._drawn = time.monotonic()
            self._draw(status)
        return ends

    def _find_address(self) -> None:
        page = self._system.supervisor.children.get("view")
        text = "" if page is None or not page.log.is_file() else page.log.read_text("utf-8", "replace")
        if found := _ADDRESS.search(text):
            self._address = found[0]
            if not self._is_terminal:
                print(self._address, file=self._stream, flush=True)

    def _print_changes(self, status: LiveStatus) -> None:
        for row in status.rows:
            before = self._states.get(row.name)
            if row.state != before and (before is not None or row.state != "starting"):
                print(f"{row.name}: {row.state}", file=self._stream, flush=True)
            self._states[row.name] = row.state
        if status.activity is not None:
            self._lines.print(status.activity)

    def _draw(self, status: LiveStatus) -> None:
        from kineverse.live.live_status import describe_all  # for start-up time

        supervisor = self._system.supervisor
        columns, height = shutil.get_terminal_size()
        width = columns - 1
        lines = [f"{SCHEME}{self._system.name}   {self._address}".rstrip()]
        lines += self._list_processes(status, width)
        lines += [join_lines(line) for line in describe_all(supervisor.reader)]
        lines = [*lines[: max(height - 2, 0)], self._answer or _KEYS]  # no higher, else it would scroll
        up = f"\033[{self._height}A" if self._height else ""
        text = "".join(f"\033[2K{shorten_text(line, width)}\n" for line in lines)
        below = "\033[J"
        print(f"{up}\r{text}{below}", end="", file=self._stream, flush=True)
        self._height = len(lines)

    def _list_processes(self, status: LiveStatus, width: int) -> list[str]:
        """Return a table of the processes, with the numbers by which they are killed."""
        from kineverse.live.live_status import HEAD, list_processes  # for start-up time
        from kineverse.live.streams import SUPERVISOR, SupervisorNote  # for start-up time

        supervisor = self._system.supervisor
        ages = {name: age for name, age in supervisor.reader.age.items() if name != SUPERVISOR}
        numbers = {name: str(k) for k, name in enumerate(supervisor.children, 1)}
        pids = {row.name: str(row.pid or "") for row in status.rows}
        found = list_processes(ages, SupervisorNote(status.rows), is_online=supervisor.is_online)
        rows = [
            (numbers.get(p.name, ""), pids.get(p.name, ""), p.name, p.state, p.load, p.starts, p.news)
            for p in found
        ]
        return format_table(("", "pid", *HEAD), rows, ">><<>><", width).split("\n")

    def _read_keys(self, status: LiveStatus) -> bool:
        """Do what the keys ask for; return True to end."""
        if not sys.stdin.isatty():
            return False
        supervisor = self._system.supervisor
        while select.select([sys.stdin], [], [], 0.0)[0]:
            key = os.read(sys.stdin.fileno(), 1).decode("ascii", "replace")
            if not key or key == "q":
                return True
            if self._kills and key.isdigit():
                self._kills = False
                children = [*supervisor.children.values()]
                self._answer = f"There is no process {key}."
                if 1 <= int(key) <= len(children):
                    children[int(key) - 1].kill()
                    self._answer = f"killed: {children[int(key) - 1].name}"
                continue
            self._kills = key == "k"
            if key == "e":
                self._answer = supervisor.ask_world("stop") or "Emergency stop: r releases the robot."
            elif key == "r":
                self._answer = supervisor.ask_world("release")
            else:
                self._answer = "The number of the process to kill?" if self._kills else ""
        return False


_KEYS = "e: emergency stop, r: release, k and a number: kill that process, q: quit"


@contextmanager
def _single_keys() -> Iterator[None]:
    """Have each key read at once, and not shown."""
    try:
        import termios  # not everywhere
        import tty
    except ImportError:
        yield
        return
    before = termios.tcgetattr(sys.stdin)
    tty.setcbreak(sys.stdin)
    try:
        yield
    finally:
        termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)
