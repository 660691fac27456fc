"""Entry point of the command line: parser, errors, exit status."""

from __future__ import annotations

import argparse
import importlib
import logging
import os
import re
import signal
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from traceback import walk_tb
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NoReturn, Protocol, TextIO, cast

from kineverse._extras import ROS, STUDIES, install_command, install_distribution
from kineverse._version import __version__
from kineverse.errors import FormatError, KineverseError, MissingDependencyError, UnknownNameError, suggest

from .output import join_lines, name_options, safe_streams

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint


class CommandModule(Protocol):
    """Module or object that is a command; it is imported only if it runs."""

    @property
    def HELP(self) -> str:
        """Description; that of a command of another distribution begins with a line of summary."""

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Declare the options."""

    def run(self, arguments: argparse.Namespace) -> int:
        """Run the command and return its exit status."""


COMMANDS: Mapping[str, tuple[str, str]] = MappingProxyType(
    {
        "info": ("info", "print the contents of a model: frames, degrees of freedom, constraints, size"),
        "fk": ("info:FK", "print the pose of a frame at given positions"),
        "reach": ("reach", "find positions in which a frame has a pose: inverse kinematics"),
        "plan": ("plan", "find a path without collisions"),
        "unlock": ("unlock", "find the order in which locked parts have to move"),
        "open": ("manipulate:OPEN", "open a door or drawer with a robot that grasps its handle"),
        "close": ("manipulate:CLOSE", "close a door or drawer with a robot that grasps its handle"),
        "push": ("manipulate:PUSH", "push a door or drawer shut with a robot"),
        "view": ("view", "show a model in the browser, with a slider for everything that moves"),
        "convert": ("convert", "write a model to a file, in the format of its suffix"),
        "diff": ("diff", "print the differences of two models: operations, frames, constraints, bodies"),
        "validate": ("validate", "read files strictly, and list their mistakes and problems"),
        "decompose": (
            "decompose",
            "decompose meshes into convex hulls, for fast distances with penetration depth",
        ),
        "spheres": ("spheres", "cover collision shapes by spheres, and show how far these stick out"),
        "fit": ("fit", "identify the joint of a part from a table of its poses"),
        "calibrate": ("calibrate", "correct joints, mounts and lengths of a model by what was seen"),
        "serve": ("serve", "serve a model that other processes read and edit, and keep it"),
        "world": (
            "live:WORLD",
            "run a simulated robot in real time, for a live system around a model server",
        ),
        "track": ("live:TRACK", "estimate the state of a live system from what its robot reads and sees"),
        "behave": ("live:BEHAVE", "let the robot of a live system open and close things, and go on"),
        "learn": (
            "live:LEARN",
            "learn joints that nobody has described in a live system, and doubt known ones",
        ),
        "keys": ("exchange:KEYS", "make the keys of a model server and its users, for other computers"),
        "relay": ("exchange:RELAY", "relay a site's clients to a model server elsewhere"),
        "ls": ("exchange:LS", "list the model servers of this user"),
        "status": ("exchange:STATUS", "print how a model server is: times, clients, refused edits"),
        "watch": ("exchange:WATCH", "print a line for each commit of a served model"),
        "history": ("exchange:HISTORY", "list the last commits of a served model"),
        "undo": ("exchange:UNDO", "take back a commit of a served model"),
        "dump": ("exchange:DUMP", "write a backup of a served model, or a document of it"),
        "apply": ("exchange:APPLY", "add the operations of a file to a served model"),
        "cache": ("cache", "print what is kept on the disk to be fast, and remove it"),
        "live": (
            "live_system",
            "let a robot open and close a kitchen, live: world, estimators, behaviour, page",
        ),
    }
)
"""Module of each command, with its object after a colon if there are several, and the summary."""

ENTRY_POINTS = "kineverse.commands"
"""Group of entry points by which other distributions add commands; each names a :class:`CommandModule`."""

BESIDE: Mapping[str, str] = MappingProxyType({"bench": STUDIES, "reproduce": STUDIES, "ros": ROS})
"""Commands of distributions beside this one, which need not be installed."""

ERROR, INTERRUPTED, PIPE_CLOSED = 2, 130, 141
"""Exit statuses: the request failed; Ctrl-C; the output pipe was closed (128 and the signal's number)."""

_PACKAGE = __name__.partition(".")[0]

_NEGATIVE_VALUE = re.compile(r"-\s*(\d|\.\d|(pi|π|inf|nan)\b)")

VERBOSE = "print more messages on standard error"

# The commands report missing meshes themselves; a missing compiler does not change their results.
QUIET = ("kineverse.view.meshes", "kineverse.compile.toolchain")

EXAMPLES = """\
A MODEL is the name of a shipped model (kitchen, pr2, articulations/screw ...), the path of a file, or the
address of a model that kineverse serve keeps (live:kitchen).

examples:
  kineverse info kitchen                              its frames, degrees of freedom, constraints
  kineverse fk kitchen kitchen/fridge_door_handle --set kitchen/fridge_door=30deg
  kineverse reach fetch fetch/gripper_link --pose 0.7 0.2 0.9
  kineverse plan shelf_door --to shelf_door/door=80deg
  kineverse unlock lockboxes/thesis --goal lockbox/a=1.2
  kineverse push kitchen --robot hsr --what kitchen/fridge_door
  kineverse view kitchen                              move it in the browser
  kineverse convert kitchen kitchen.kv.json           write it in another format
  kineverse diff kitchen kitchen.kv.json              differences of two models
  kineverse serve kitchen --store kitchen.db          share it between processes, and keep it
  kineverse info live:kitchen                         the one that is served
  kineverse fit poses.csv --child door                learn a joint from recorded poses
  kineverse live --headless                           a robot opens and closes a door, a flap, a drawer
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status.

    Parameters
    ----------
    argv
        Arguments without the name of the program; those of the process if None. If there are none, the help
        is printed.

    Returns
    -------
    0 on success; 2 if the request cannot be fulfilled, with the reason in one line on standard error; 130
    after Ctrl-C; 141 if the output pipe was closed.

    Examples
    --------
    >>> kv.cli.main(["fk", "kitchen", "kitchen/fridge_door_handle", "--set", "kitchen/fridge_door=30deg"])
    kitchen/fridge_door_handle in world
         -0.866025           0        -0.5    0.829037
              -0.5           0    0.866025    -1.41117
                 0           1           0     1.18425
                 0           0           0           1
      position            0.829037    -1.41117     1.18425  m
      roll pitch yaw        1.5708           0    -2.61799  rad
      quaternion xyzw     0.183013   -0.683013   -0.683013    0.183013
      at kitchen/fridge_door=0.523599
    0
    """
    words = sys.argv[1:] if argv is None else list(argv)
    try:
        with safe_streams(), _end_by_exception(argv is None):
            status = _run(words)
            try:
                sys.stdout.flush()
            except BrokenPipeError:
                status = PIPE_CLOSED
            except OSError as error:
                if status != ERROR:
                    print(f"kineverse: {format_error(error)}", file=sys.stderr)
                status = ERROR
            else:
                return status
    except FormatError as error:  # standard output is closed
        print(f"kineverse: {format_error(error)}", file=sys.stderr)
        return ERROR
    _discard_stdout()
    return status


def _run(words: Sequence[str]) -> int:
    """Run the command of some words and return its status; print the reason of a failure."""
    try:
        if not set(words) - {"-v", "--verbose"}:
            make_parser().print_help()
            return 0
        arguments = _parse_arguments(words)
        try:
            with _log_warnings_to(sys.stderr, arguments.verbose), ExitStack() as arguments.opened:
                status: int = arguments.run(arguments)
        except KineverseError as error:
            print(f"kineverse: {name_options(format_error(error), arguments)}", file=sys.stderr)
            return ERROR
    except SystemExit as stop:  # argparse would end the process.
        return stop.code if isinstance(stop.code, int) else ERROR
    except BrokenPipeError:
        return PIPE_CLOSED
    except KeyboardInterrupt:
        print(file=sys.stderr)
        return INTERRUPTED
    except (KineverseError, OSError) as error:
        print(f"kineverse: {format_error(error)}", file=sys.stderr)
        return ERROR
    except ImportError as error:
        reason = _explain_import(error)
        if reason is None:
            raise
        print(f"kineverse: {reason}", file=sys.stderr)
        return ERROR
    return status


def _explain_import(error: ImportError) -> str | None:
    """Return why a module of others cannot be imported, with the extra that it belongs to; None for ours."""
    if (error.name or _PACKAGE).partition(".")[0] == _PACKAGE:
        return None
    importers = [error.name or ""]
    importers += [str(frame.f_globals.get("__name__")) for frame, _ in walk_tb(error.__traceback__)]
    from .arguments import MODULES  # for start-up time

    modules = {name.partition(".")[0] for name in importers}
    extra = next((extra for extra, module in MODULES.items() if module in modules), None)
    if extra is None:
        return f"{join_lines(error)}. 'pip check' says what is installed in part."
    return f"The extra '{extra}' is not installed completely ({join_lines(error)}): {install_command(extra)}"


@contextmanager
def _end_by_exception(enabled: bool) -> Iterator[None]:
    """Have SIGTERM and SIGHUP end the process like an exception, so that temporary folders are removed."""
    numbers = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]

    def end(number: int, frame: object) -> None:
        signal.signal(number, signal.SIG_DFL)  # the next one ends it at once
        raise SystemExit(128 + number)

    # A process that was started to outlive its terminal ignores SIGHUP, and goes on to do so.
    before = {n: signal.getsignal(n) for n in numbers if enabled and signal.getsignal(n) == signal.SIG_DFL}
    for number in before:
        signal.signal(number, end)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def find_added_commands() -> Mapping[str, EntryPoint]:
    """Return the entry points of commands that other distributions add, by name, without importing them."""
    from importlib.metadata import entry_points  # for start-up time

    try:
        found = {point.name: point for point in entry_points(group=ENTRY_POINTS)}
    except Exception as error:  # of a damaged file of any installed distribution
        reason = f"the entry points of one cannot be read ({join_lines(error)})"
        print(f"kineverse: commands of other distributions are left out, as {reason}", file=sys.stderr)
        return {}
    return {name: found[name] for name in sorted(found) if name not in COMMANDS}


def load_command(name: str) -> CommandModule:
    """Return a command of this package, or import one that another distribution adds."""
    if name in COMMANDS:
        module, _, attribute = COMMANDS[name][0].partition(":")
        found: Any = importlib.import_module(f".{module}", __package__)
        return cast(CommandModule, getattr(found, attribute) if attribute else found)
    added = find_added_commands()
    if name not in added:
        if name in BESIDE:
            raise MissingDependencyError(
                f"'kineverse {name}' is a command of {BESIDE[name]}, which is not installed: "
                f"{install_distribution(BESIDE[name])}"
            )
        raise UnknownNameError(f"There is no command {name!r}. {_suggest_command(name, added)}")
    point = added[name]
    distribution = point.dist.name if point.dist else point.value
    try:
        command = point.load()
    except (Exception, SystemExit) as error:  # somebody else's code
        reason = join_lines(error) or "no reason given"
        raise MissingDependencyError(
            f"'kineverse {name}' is a command of {distribution}, and {point.value} cannot be imported "
            f"({type(error).__name__}: {reason}). Install {distribution} again."
        ) from error
    parts = ("HELP", "add_arguments", "run")
    lacking = [part for part in parts if getattr(command, part, None) is None]
    if lacking:
        raise MissingDependencyError(
            f"'kineverse {name}' is a command of {distribution}, and {point.value} has no "
            f"{', '.join(lacking)}. Install {distribution} again."
        )
    return cast(CommandModule, command)


def make_parser(name: str | None = None) -> argparse.ArgumentParser:
    """Return the parser of the command line with the options of one command; None only lists commands."""
    top = _Parser(
        prog="kineverse",
        description="View, move and query articulation models.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    top.add_argument("--version", action="version", version=f"kineverse {__version__}")
    top.add_argument("-v", "--verbose", action="store_true", help=VERBOSE)
    commands = top.add_subparsers(title="commands", metavar="COMMAND", required=True)
    if name is None:
        for listed, summary in _list_summaries().items():
            commands.add_parser(listed, help=summary)
        return top
    command = load_command(name)
    summary, _, description = command.HELP.partition("\n")
    if name in COMMANDS:
        summary, description = COMMANDS[name][1], command.HELP
    sub = commands.add_parser(
        name,
        help=summary,
        description=f"{summary}\n\n{description.strip()}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    command.add_arguments(sub)
    if "--verbose" not in sub._option_string_actions:
        words = [word for word in ("-v", "--verbose") if word not in sub._option_string_actions]
        sub.add_argument(*words, action="store_true", default=argparse.SUPPRESS, help=VERBOSE)
    sub.set_defaults(run=command.run, command=sub)
    return top


def _parse_arguments(words: Sequence[str]) -> argparse.Namespace:
    at = next((k for k, word in enumerate(words) if not word.startswith("-")), len(words))
    name = words[at] if at < len(words) else None
    if name is not None and not {"-h", "--help"}.isdisjoint(words[:at]):
        words = [name, "--help"]  # help of the command, wherever it is asked for
    # A leading space tells argparse that -30deg, -pi/2 or -1e-3 is a value and no option.
    words = [f" {word}" if _NEGATIVE_VALUE.match(word) else word for word in words]
    try:
        arguments, unknown = make_parser(name).parse_known_args(words)
    except _UsageError as error:
        # A misspelt option is why another one is missing.
        known = error.parser._option_string_actions
        for word in words:
            asked = word.partition("=")[0] if word.startswith("--") else word[:2]  # -n5 is -n 5
            if re.match("--?[^-]", asked) and not any(option.startswith(asked) for option in known):
                raise _unknown_option_error(error.parser, asked) from None
        argparse.ArgumentParser.error(error.parser, str(error))
    if unknown:
        sub: argparse.ArgumentParser = arguments.command
        word = unknown[0].partition("=")[0]
        if ":=" in unknown[0]:
            raise UnknownNameError(
                f"{sub.prog} takes the arguments of a template with its path, in quotes: "
                f"'robot.urdf.xacro {unknown[0]}'."
            )
        if not word.startswith("-"):
            raise UnknownNameError(
                f"{sub.prog} takes no argument {word!r}. '{sub.prog} --help' lists those that it takes."
            )
        raise _unknown_option_error(sub, word)
    return arguments


class _UsageError(Exception):
    parser: argparse.ArgumentParser


class _Parser(argparse.ArgumentParser):
    """Parser that raises an error of usage, in place of printing it at once."""

    def error(self, message: str) -> NoReturn:
        error = _UsageError(message)
        error.parser = self
        raise error


def _unknown_option_error(parser: argparse.ArgumentParser, word: str) -> UnknownNameError:
    options = [option for option in parser._option_string_actions if option.startswith("--")]
    return UnknownNameError(f"{parser.prog} has no option {word!r}. {suggest(word, options, 'option')}")


def _list_summaries() -> dict[str, str]:
    """Return the summaries of all commands; those of other distributions are not imported for that."""
    found = {name: summary for name, (_, summary) in COMMANDS.items()}
    for name, point in find_added_commands().items():
        found[name] = f"command of {point.dist.name if point.dist else point.value}"
    return found | {
        name: f"command of {distribution}, which is not installed"
        for name, distribution in BESIDE.items()
        if name not in found
    }


def _suggest_command(name: str, added: Iterable[str]) -> str:
    from kineverse.formats.locate import shipped_models  # for start-up time

    if name in shipped_models() or os.path.exists(name):
        return f"It is a model or file: 'kineverse info {name}' says what it consists of."
    known = dict.fromkeys([*COMMANDS, *added, *BESIDE])
    return f"{suggest(name, known, 'command')} 'kineverse --help' says what each does."


def format_error(error: BaseException) -> str:
    """Return the message of an error on one line."""
    if isinstance(error, OSError) and error.strerror:
        where = f"{error.filename}: " if error.filename else ""
        return f"{where}{error.strerror}"
    return join_lines(error) or type(error).__name__


@contextmanager
def _log_warnings_to(stream: TextIO, verbose: bool) -> Iterator[None]:
    """Print warnings of the library on a stream; those of :data:`QUIET` loggers only if verbose."""
    handler = logging.StreamHandler(stream)
    handler.setFormatter(logging.Formatter("kineverse: %(message)s"))
    log, quiet = logging.getLogger("kineverse"), [logging.getLogger(name) for name in QUIET]
    levels = [(logger, logger.level) for logger in (log, *quiet)]
    log.addHandler(handler)
    log.setLevel(logging.INFO if verbose else logging.WARNING)
    for logger in quiet:
        logger.setLevel(logging.INFO if verbose else logging.ERROR)
    try:
        yield
    finally:
        log.removeHandler(handler)
        for logger, level in levels:
            logger.setLevel(level)


def _discard_stdout() -> None:
    """Redirect standard output to the null device, so that the interpreter can flush it at exit."""
    try:
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, sys.stdout.fileno())
        os.close(null)
    except (OSError, ValueError):
        pass  # Under a test, standard output may not be a file.
