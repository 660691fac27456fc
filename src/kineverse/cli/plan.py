"""``kineverse plan``: a path without collisions."""

from __future__ import annotations

import argparse
import json
import math
import sys
from dataclasses import dataclass
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from kineverse.control import Hold
from kineverse.errors import InvalidValueError, SimulationError
from kineverse.expressions.printing import format_number
from kineverse.formats import read_srdf
from kineverse.geometry import Rule
from kineverse.planning import Planner
from kineverse.planning.trajectories.trajectory import check_trajectory_name
from kineverse.worlds import Robot

from .arguments import (
    add_model_options,
    check_assigned_units,
    load_model,
    needs_mujoco,
    parse_length,
    require,
)
from .output import format_table, join_lines, name_options, show_activity
from .outside_robot import ConnectedRobot, check_served, check_world, connect_robot, is_live
from .pages import (
    add_page_options,
    check_picture_path,
    handle_interrupts,
    list_mesh_problems,
    page_options,
    print_address,
    print_mesh_problems,
)
from .plan_arguments import (
    FrameTarget,
    Request,
    add_robot_option,
    choose_coordinates,
    find_robot_name,
    include_robot,
    make_grip,
    make_hold,
    parse_frame_target,
    parse_request,
)

if TYPE_CHECKING:
    import kineverse as kv
    from kineverse.planning import Path
    from kineverse.planning.trajectories.trajectory import Trajectory

HELP = """\
A goal is values of coordinates (NAME=VALUE), poses of frames, or a state of an SRDF. FRAME@FRAME brings a
frame to another one, in all directions or some (FRAME@FRAME:xyz, :xyz,rx,ry), FRAME@FRAME+X,Y,Z to a place
beside it, FRAME@X,Y,Z to a position in the world; ROLL,PITCH,YAW may follow. A start is the same, or a file
of values (the JSON of kineverse reach); what it does not say stands as in the default state.

What is named moves, and what the frames before @ depend on, but no base that is placed; --move says it
otherwise. --along A@B holds frame A in B as it is at the start, such as a hand at a handle: NAME=VALUE is
reached with the hold kept, and bodies of both frames may touch.

The first plan of a robot takes a while: its shapes are covered by spheres, and code is compiled. Both are
kept. This needs a C compiler and the extra 'geometry'. The exit status is 1 if no path was found.

With --world ros the path begins where a robot behind topics of ROS 2 is, and the robot follows it; with
--world live it is the robot of a live system, and MODEL is live:NAME. The exit status is 1, too, if that is
given up.

examples:
  kineverse plan shelf_door --to shelf_door/door=80deg
  kineverse plan fetch --to fetch/gripper_link@0.6,0.2,0.9 --picture plan.png
  kineverse plan kitchen --robot fetch@0.45,0.7,90deg --to fetch/gripper_link@1,1.35,1.1
  kineverse plan pr2 --from pr2/r_elbow_flex_joint=-1 --to pr2/r_elbow_flex_joint=-2 --save path.json"""

FOUND, NOT_FOUND = 0, 1
_MOST_STARTS = 8
_GHOSTS = 4


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    # Options that take several words come last, or they would take MODEL as well.
    parser.usage = "%(prog)s MODEL --to (NAME=VALUE | FRAME@POSE | STATE) ... [options]"
    parser.add_argument(
        "model", metavar="MODEL", nargs="?", help="name of a shipped model, or path of a file; it comes first"
    )
    parser.add_argument(
        "--to",
        nargs="+",
        action="extend",
        required=True,
        metavar="GOAL",
        help="values (door=30deg), a pose of a frame (hand@handle, hand@0.7,0,1) or a state of the SRDF",
    )
    parser.add_argument(
        "--from",
        nargs="+",
        action="extend",
        default=[],
        metavar="START",
        dest="start",
        help="the same, or a JSON file of values (the default state)",
    )
    add_robot_option(parser)
    parser.add_argument(
        "--move",
        nargs="+",
        action="extend",
        default=[],
        metavar="NAME",
        help="coordinates, articulations or patterns ('fetch/*') that move",
    )
    parser.add_argument(
        "--along",
        nargs="+",
        action="extend",
        default=[],
        metavar="A@B[:MASK]",
        help="holds all along the path",
    )
    parser.add_argument(
        "--srdf", metavar="FILE", help="SRDF of the robot: pairs that are not checked, states"
    )
    parser.add_argument(
        "--leave-out",
        nargs="+",
        action="extend",
        default=[],
        metavar="BODY",
        help="bodies or patterns that are no obstacles, such as those whose mesh is missing",
    )
    parser.add_argument(
        "--decomposed", action="store_true", help="use the hulls of kineverse decompose for hollow meshes"
    )
    parser.add_argument(
        "--margin", metavar="M", default="0", help="least distance from everything, such as 1cm (0)"
    )
    parser.add_argument(
        "--seconds", type=float, default=5.0, metavar="S", help="largest time of the search (5)"
    )
    parser.add_argument(
        "--optimize", action="store_true", help="use all of these seconds to shorten the path"
    )
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="seed of the search (0)")
    parser.add_argument(
        "--world",
        metavar="live|ros[:FILE]",
        help="begin where the robot is, and have it follow the path: live is that of a live system, whose "
        "MODEL is live:NAME; ros is by topics of ROS 2 (settings: .toml)",
    )
    parser.add_argument("--save", metavar="FILE", help="write the trajectory to a file (.json)")
    parser.add_argument("--picture", metavar="FILE", help="write a picture (.png) of the motion")
    parser.add_argument("--view", action="store_true", help="play the trajectory in the browser")
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output")
    parser.add_argument(
        "-v",
        "--verbose",
        action="store_true",
        default=argparse.SUPPRESS,
        help="print the positions on the way",
    )
    add_model_options(parser)
    add_page_options(parser)


@dataclass(frozen=True)
class _Problem:
    model: kv.Model
    planner: Planner  # planner, placed at the start
    state: kv.State  # state at the start, but for what --from says of frames
    start: Request  # what the options say
    goal: Request
    holds: list[FrameTarget]  # targets of --along
    start_tasks: list[Hold]  # poses of frames at both ends
    goal_tasks: list[Hold]
    grips: list[Hold | None]  # holds along the path; None for those that depend on the start
    robot: ConnectedRobot | None  # the robot that is to follow the path


def run(arguments: argparse.Namespace) -> int:
    """Plan the path, print it, show it if wanted, and return the status."""
    # Parsed before the model is loaded, so that a typing error is reported at once.
    if arguments.model is None:
        raise InvalidValueError("MODEL comes first, before options that take several words, such as --to.")
    models = (arguments.model, arguments.robot or "")
    extras = {"geometry": True, "mjcf": any(map(needs_mujoco, models)), "view": arguments.view}
    require("kineverse plan", extras, compiler=True)
    start = parse_request(arguments.start, "--from", read_files=True)
    goal = parse_request(arguments.to, "--to")
    holds = [parse_frame_target(word, "--along") for word in arguments.along]
    margin = parse_length(arguments.margin)
    check_picture_path(arguments.picture)
    if arguments.world is not None:
        check_world(arguments.world)
    if arguments.save is not None:
        check_trajectory_name(arguments.save)
    if not arguments.seconds > 0 or math.isinf(arguments.seconds):
        raise InvalidValueError(f"--seconds is a positive number, not {arguments.seconds:g}.")

    from kineverse.planning.bindings import planning_functions  # for start-up time

    with show_activity("compiling the planner"):
        planning_functions()
    begin = perf_counter()
    problem = _prepare(arguments, start, goal, holds, margin)
    path = _plan(problem, arguments.seconds, arguments.seed, arguments.optimize)
    trajectory = path.trajectory() if path.found else None
    preparation = perf_counter() - begin - path.seconds
    if arguments.save is not None and trajectory is not None:
        trajectory.save(arguments.save)
    why = "" if problem.robot is None or trajectory is None else _follow(problem.robot, trajectory)
    if arguments.json:
        answer = path_to_json(path, preparation)
        if problem.robot is not None:
            answer |= {"world": problem.robot.name, "followed": path.found and not why, "given_up": why}
        print(json.dumps(answer, allow_nan=False))
    else:
        print_path(arguments, path, preparation)
        if problem.robot is not None and path.found:
            print(f"not followed: {why}" if why else "followed by the robot")
    if arguments.picture is not None:
        _write_picture(arguments.picture, problem, path)
    if arguments.view:
        _view(arguments, problem, path)
    return FOUND if path.found and not why else NOT_FOUND


def _follow(robot: ConnectedRobot, trajectory: Trajectory) -> str:
    """Have a robot follow a path, and return why it has not; empty if it has."""
    try:
        with show_activity("following the path"):
            robot.follow(trajectory)
    except SimulationError as error:
        return join_lines(error)
    return ""


def _prepare(
    arguments: argparse.Namespace, start: Request, goal: Request, holds: list[FrameTarget], margin: float
) -> _Problem:
    with show_activity(f"reading {arguments.model}"):
        model = load_model(arguments, arguments.model)
        standing: dict[kv.Symbol, float] = {}
        robot = next(iter(model.frames), "").partition("/")[0]
        if is_live(arguments.world):
            check_served(arguments.model)
            robot = find_robot_name(model, arguments.robot)
        elif arguments.robot is not None:
            # Whose joints are whose, a robot outside is told by prefixes, as kineverse open does.
            prefix = "" if arguments.world is None else None
            robot, standing = include_robot(arguments, model, prefix)
    outside: ConnectedRobot | None = None
    read: dict[kv.Symbol, float] = {}
    if arguments.world is not None:
        outside, read = _connect(arguments, Robot.of(model, _prefix(model, robot)), start)
        standing = {s: v for s, v in read.items() if s in outside.robot.planar_base}
    srdf = None if arguments.srdf is None else read_srdf(arguments.srdf, model, _prefix(model, robot))
    for line in () if srdf is None else srdf.warnings[:3]:
        print(f"kineverse: note: {arguments.srdf}: {line}", file=sys.stderr)
    states = {} if srdf is None else srdf.states
    start.resolve(states, "--from")
    goal.resolve(states, "--to")
    for name in (*start.values, *goal.values):
        model.symbol(name)  # raises for unknown names, with similar ones
    for option, request in (("--from", start), ("--to", goal)):
        check_assigned_units(model, request.assignments, option)
    move: Any = arguments.move
    if not move:
        targets = [*goal.targets, *start.targets]
        move = choose_coordinates(model, goal.values, targets, holds, standing)
    rules = [] if srdf is None else [Rule(*rule) for rule in srdf.rules]
    # Made before the planner, so that mistakes are reported at once.
    start_tasks = [make_hold(model, target) for target in start.targets]
    goal_tasks = [make_hold(model, target) for target in goal.targets]
    grips = [make_grip(model, target, start.targets, None) for target in holds]
    with show_activity("covering shapes by spheres and compiling; this is kept for the next time"):
        planner = Planner(
            model,
            move,
            rules=rules,
            margin=margin,
            decomposed=("*",) if arguments.decomposed else (),
            leave_out=arguments.leave_out,
        )
    moving = {*planner.symbols}
    bare = [b for b in model.bodies if b not in planner.scene.bodies and moving & {*model.symbols_of(b)}]
    if bare:
        print(f"kineverse: note: without shapes, and not checked: {', '.join(bare[:6])}", file=sys.stderr)
    still = [name for name in goal.values if model.symbol(name) not in planner.symbols]
    if still:
        raise InvalidValueError(f"--to has a value of '{still[0]}', which --move does not list.")
    if outside is not None and (driven := [str(s) for s in planner.symbols if s in standing]):
        raise InvalidValueError(
            f"--world: a robot follows paths of its joints, and '{driven[0]}' is of its base. --move names "
            "joints."
        )
    state = model.default_state().updated(standing).updated(read).updated(start.values)
    planner.place(state)
    return _Problem(model, planner, state, start, goal, holds, start_tasks, goal_tasks, grips, outside)


def _connect(
    arguments: argparse.Namespace, robot: Robot, start: Request
) -> tuple[ConnectedRobot, dict[kv.Symbol, float]]:
    """Return the robot of ``--world``, and its readings; where it stands, nobody else says."""
    own = [name for name in start.values if robot.moves(robot.model.symbol(name))]
    if own or start.targets:
        name = own[0] if own else start.targets[0].frame
        raise InvalidValueError(f"--from {name}: with --world, the robot says itself where it is.")
    if arguments.robot is not None and robot.base is not None and "@" in arguments.robot:
        raise InvalidValueError("--robot ROBOT@X,Y,ANGLE: a robot with a base says itself where it stands.")
    connected = arguments.opened.enter_context(connect_robot(arguments.world, robot, (), arguments.model))
    return connected, dict(connected.observe().joints)


def _prefix(model: kv.Model, robot: str) -> str:
    """Return the prefix of a robot's names; empty if the model's names have none."""
    return robot if any(name.startswith(f"{robot}/") for name in model.frames) else ""


def _plan(problem: _Problem, seconds: float, seed: int, optimize: bool) -> Path:
    """Return the path from the first of some starts from which there is one."""
    planner, start, goal = problem.planner, problem.start, problem.goal
    symbol = problem.model.symbol
    starts: list[Any] = [None]
    if start.targets:
        fixed = [Hold(symbol(n), v, name=n) for n, v in start.values.items() if symbol(n) in planner.symbols]
        with show_activity("looking for a start"):
            starts = list(
                planner.solutions([*problem.start_tasks, *fixed], _MOST_STARTS, seconds=seconds, seed=seed)
            )
        if not starts:
            raise InvalidValueError(
                f"--from {start.targets[0].frame}@{start.targets[0].target}: no configuration without "
                "collision was found there. Out of reach, or always in contact? 'kineverse reach' says which."
            )
    standing = [_state(problem, q) for q in starts]
    # Holds as they are at a start are others at the next one.
    if None in problem.grips:
        del standing[1:]
    along = [
        hold or make_grip(problem.model, given, start.targets, standing[0])
        for hold, given in zip(problem.grips, problem.holds, strict=True)
    ]
    tasks = list(problem.goal_tasks)
    if tasks or along:
        tasks += [Hold(symbol(n), v, name=n) for n, v in goal.values.items()]
    for state in standing:
        goals: Any = tasks or state.updated(goal.values)
        with show_activity("planning"):
            path = planner.plan(
                state,
                goals,
                along=[hold for hold in along if hold],
                seconds=seconds / len(standing),
                seed=seed,
                optimize=optimize,
            )
        if path.found:
            break
    return path


def _state(problem: _Problem, q: Any) -> kv.State:
    """Return the state at a start (n,), or where everything stands if that is None."""
    if q is None:
        return problem.state
    return problem.state.updated(dict(zip(problem.planner.symbols, q.tolist(), strict=True)))


def _moved_frame(problem: _Problem) -> str:
    """Return the frame that is asked for, else the body that depends on most coordinates."""
    for target in (*problem.goal.targets, *problem.holds):
        return target.frame
    model = problem.model
    moving = {*problem.planner.symbols}
    return max(problem.planner.checker.moving, key=lambda body: len(moving & {*model.symbols_of(body)}))


def _trace(problem: _Problem, path: Path) -> Any:
    from kineverse.view.drawables import draw_frame_path  # for start-up time

    states = [path.at(fraction) for fraction in np.linspace(0.0, 1.0, 60)]
    return draw_frame_path(problem.model, _moved_frame(problem), states)


def _write_picture(file: str, problem: _Problem, path: Path) -> None:
    """Write a picture of some configurations on the way."""
    from kineverse.view import save_picture  # for start-up time
    from kineverse.view.drawables import draw_ghosts  # for start-up time

    model, planner = problem.model, problem.planner
    overlay = [_trace(problem, path)]
    if len(path) > 1:
        states = [path.at(k / _GHOSTS) for k in range(_GHOSTS)]
        overlay += draw_ghosts(model, planner.checker.moving, states)
    save_picture(file, model, path.at(1.0), overlay=overlay)
    print_mesh_problems(list_mesh_problems(model))
    print(f"picture: {file}", file=sys.stderr)


def _view(arguments: argparse.Namespace, problem: _Problem, path: Path) -> None:
    """Play the path in the browser; without one, show how far the search came."""
    from kineverse.view.page import read_title  # for start-up time
    from kineverse.view.viewer import Viewer  # for start-up time

    label, model = read_title(arguments.model), problem.model
    state = path.at(0.0 if path.found else 1.0)
    with handle_interrupts(), Viewer(model, state, label=label, **page_options(arguments)) as page:
        page.show_overlay([_trace(problem, path)])
        print_mesh_problems(page.problems)
        print_address(page, browser=not arguments.no_browser)
        if path.found:
            page.play(path.trajectory(), loop=True)
        page.wait()


_COLUMNS = 6  # number of points of a path in a table


def print_path(arguments: argparse.Namespace, path: Path, preparation: float) -> None:
    """Print what was found."""
    goal = " ".join(arguments.to)
    if not path.found:
        print(f"{goal}: not found. {name_options(path.why, arguments)}")
        if not arguments.move:
            print(f"  moves      {_list_moving(path)}; --move names others")
        return
    clearance = path.clearance()
    near = "nothing within 50 cm" if math.isinf(clearance) else f"{format_number(1e3 * clearance, 4)} mm"
    print(f"{goal}: found")
    for name, value in (
        ("moves", _list_moving(path)),
        ("points", str(len(path))),
        ("length", f"{format_number(path.length, 4)} (rad, m)"),
        ("duration", f"{format_number(float(path.times[-1]), 4)} s"),
        ("clearance", near),
        ("planned", _format_time(path.seconds)),
        ("prepared", _format_time(preparation)),
    ):
        print(f"  {name:<9}  {value}")
    if arguments.verbose:
        print(_format_way(path))
    if arguments.save is not None:
        print(f"trajectory: {arguments.save}")


def _list_moving(path: Path) -> str:
    more = f" and {len(path.symbols) - 3} more" if len(path.symbols) > 3 else ""
    return ", ".join(map(str, path.symbols[:3])) + more


def _format_time(seconds: float) -> str:
    return f"{format_number(1e3 * seconds, 3)} ms" if seconds < 1 else f"{format_number(seconds, 3)} s"


def _format_way(path: Path) -> str:
    chosen = np.unique(np.linspace(0, len(path) - 1, _COLUMNS).round().astype(int))
    head = ["time [s]", *(format_number(float(t), 3) for t in path.times[chosen])]
    rows = [
        [str(symbol), *(format_number(float(v), 4) for v in column[chosen])]
        for symbol, column in zip(path.symbols, path.points.T, strict=True)
    ]
    return format_table(head, rows, "<" + ">" * len(chosen))


def path_to_json(path: Path, preparation: float) -> dict[str, Any]:
    """Return a path as plain data."""
    clearance = path.clearance() if path.found else math.inf
    return {
        "found": path.found,
        "why": path.why,
        "coordinates": [str(symbol) for symbol in path.symbols],
        "points": path.points.tolist(),
        "times": path.times.tolist() if path.found else None,
        "length": path.length,
        "clearance": clearance if math.isfinite(clearance) else None,
        "seconds": path.seconds,
        "preparation_seconds": preparation,
        # The end, as 'kineverse reach' writes it: --from takes the file.
        "positions": dict(zip(map(str, path.symbols), path.points[-1].tolist(), strict=True)),
    }
