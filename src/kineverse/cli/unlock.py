"""``kineverse unlock``: the order of moves that unlocks a goal."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from kineverse.errors import InvalidValueError, KineverseError
from kineverse.reasoning import plan_unlocking

from .arguments import (
    add_model_options,
    check_assigned_units,
    load_model,
    match_coordinates,
    parse_assignments,
)

if TYPE_CHECKING:
    from kineverse.model.model import Model

HELP = """\
The interlocks of the model are derived from its constraints. Each step is printed with its reason. If the
goal cannot be reached, the locks that prevent it are printed, and the exit status is 1; it is 3 if that stays
undecided. Both answers are checked by evaluating the constraints.

With --execute the parts are moved as planned, in a world that has the constraints of the model: by the
velocity controller, one at a time. If one does not move, the plan is made again without it. This needs the
extra 'control', and --record 'recording'.

examples:
  kineverse unlock lockboxes/thesis --goal lockbox/a=1.2
  kineverse unlock articulations/microwave --goal microwave/oven/door=90deg
  kineverse unlock articulations/latch --goal latch/gate/door=0.5 --goal latch/gate/bolt=0
  kineverse unlock lockboxes/17 --goal lockbox/part_9=1 --still lockbox/part_0
  kineverse unlock lockboxes/17 --goal lockbox/part_9=1 --execute --jam lockbox/part_2 --record run.mcap"""

FOUND, REFUTED, UNDECIDED = 0, 1, 3
STATUS = {"found": FOUND, "refuted": REFUTED, "undecided": UNDECIDED}
"""Exit statuses; 2 is that of a request that cannot be fulfilled."""
_DT = 0.05  # time of a step [s]
_VIOLATED = 1e-6  # excess of a constraint from which on it is violated, in its unit


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("model", metavar="MODEL", help="name of a shipped model, or path of a file")
    parser.add_argument(
        "--goal",
        metavar="NAME=VALUE",
        action="append",
        required=True,
        help="a position to reach: 0.3, pi/2, 30deg, 12cm; repeatable",
    )
    parser.add_argument(
        "--from",
        metavar="NAME=VALUE",
        action="append",
        default=[],
        dest="assignments",
        help="a position at the start (that of the default state); repeatable",
    )
    parser.add_argument(
        "--still",
        nargs="+",
        action="extend",
        default=[],
        metavar="NAME",
        help="coordinates or patterns ('box/*') that do not move, such as one that is stuck",
    )
    parser.add_argument(
        "--budget", type=float, default=10.0, metavar="S", help="time for the search [s] (10)"
    )
    parser.add_argument("--execute", action="store_true", help="move the parts as planned")
    parser.add_argument(
        "--jam",
        nargs="+",
        action="extend",
        default=[],
        metavar="NAME",
        help="coordinates that do not move in the world, which the plan does not know",
    )
    parser.add_argument("--record", type=Path, metavar="FILE.mcap", help="file to which the run is recorded")
    add_model_options(parser)
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output")


def run(arguments: argparse.Namespace) -> int:
    """Plan the moves and print them."""
    # Parsed before the model is loaded, so that a typing error is reported at once.
    goal = parse_assignments(arguments.goal, "--goal")
    start = parse_assignments(arguments.assignments, "--from")
    if (arguments.jam or arguments.record) and not arguments.execute:
        raise InvalidValueError("--jam and --record need --execute.")

    model = load_model(arguments, arguments.model)
    for option, texts in (("--goal", arguments.goal), ("--from", arguments.assignments)):
        check_assigned_units(model, texts, option)
    still = match_coordinates(model, arguments.still, "--still")
    plan = plan_unlocking(model, goal, start, fixed=still, budget=arguments.budget)
    if arguments.execute:
        return _execute(arguments, model, goal, start, still)
    print(json.dumps(plan.as_data(), allow_nan=False) if arguments.json else plan)
    return STATUS[plan.verdict]


def _execute(
    arguments: argparse.Namespace,
    model: Model,
    goal: Mapping[str, float],
    start: Mapping[str, float],
    still: Sequence[str],
) -> int:
    """Execute the plan in a world, print what moved, and record it if wanted."""
    from kineverse.manipulation import Session, execute_unlocking  # for start-up time
    from kineverse.worlds import MechanismWorld, Recorder, RunMetrics  # for start-up time

    world = MechanismWorld(model, match_coordinates(model, arguments.jam, "--jam"))
    world.reset(start)
    metrics = RunMetrics(world)
    watchers: list[Callable[[Session], object]] = [metrics]
    with ExitStack() as stack:
        if arguments.record is not None:
            about = {"model": arguments.model, "world": world.name}
            recorder = stack.enter_context(Recorder(arguments.record, model, about, world=world))
            watchers.append(recorder)

        def look(session: Session) -> None:
            for watch in watchers:
                watch(session)

        session = Session(world, dt=_DT, on_step=look)
        execution = execute_unlocking(session, goal, fixed=still, budget=arguments.budget)
        overlap, violation = metrics.overlap, metrics.violation
        done = execution.done and overlap is None
        constraint = metrics.limit if violation > _VIOLATED else ""
        answer = execution.as_data() | {
            "claimed": execution.done,
            "done": done,
            "reason": str(overlap or execution.reason),
            "violation": violation,
            "constraint": constraint,
            "overlap": 0.0 if overlap is None else overlap.depth,
            "overlapping": ["", ""] if overlap is None else [overlap.a, overlap.b],
        }
        if arguments.record is not None:
            recorder.write_outcome(answer)
    if arguments.json:
        print(json.dumps(answer, allow_nan=False))
    else:
        print(execution)
        if overlap is not None:
            print(overlap)
    if constraint:
        raise KineverseError(f"The motion violated '{constraint}', by {violation:.3g}.")
    return FOUND if done else STATUS[execution.plan.verdict] or REFUTED
