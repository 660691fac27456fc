"""``kineverse unlock``: the order of moves that unlocks a goal."""

from __future__ import annotations

import argparse
import json

from kineverse.cli.arguments import add_model_options, load_model, parse_assignments

HELP = """find the order in which locked parts have to move

The interlocks of the model are derived from its constraints. Each step is printed with its reason. The steps
are checked by evaluating the constraints along them. If the goal cannot be reached, the locks that prevent it
are printed, and the exit status is 1; it is 3 if that stays undecided.

examples:
  kineverse unlock lockboxes/thesis --goal lockbox/a=1.2
  kineverse unlock articulations/microwave --goal microwave/oven/door=90deg
  kineverse unlock articulations/latch --goal latch/gate/door=0.5 --goal latch/gate/bolt=0
  kineverse unlock lockboxes/17 --goal lockbox/part_9=1 --still lockbox/part_0"""

FOUND, REFUTED, UNDECIDED = 0, 1, 3
STATUS = {"found": FOUND, "refuted": REFUTED, "undecided": UNDECIDED}
"""Exit statuses; 2 is that of a request that cannot be fulfilled."""


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
        help="coordinates that do not move, such as one that is stuck",
    )
    parser.add_argument(
        "--budget", type=float, default=10.0, metavar="S", help="time for the search [s] (10)"
    )
    add_model_options(parser)
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output")


def run(arguments: argparse.Namespace) -> int:
    """Plan the moves, check them, and print them."""
    # Parsed before the model is loaded, so that a typing error is reported at once.
    goal = parse_assignments(arguments.goal, "--goal")
    start = parse_assignments(arguments.assignments, "--from")

    from kineverse.errors import KineverseError
    from kineverse.reasoning import plan_unlocking, plan_violations

    model = load_model(arguments, arguments.model)
    plan = plan_unlocking(model, goal, start, still=arguments.still, budget=arguments.budget)
    wrong = plan_violations(model, plan, start)
    if wrong:
        raise KineverseError(f"The plan violates constraints of the model: {'; '.join(wrong)}.")
    if arguments.json:
        print(json.dumps(plan.as_data(), allow_nan=False))
    else:
        print(plan)
    return STATUS[plan.verdict]
