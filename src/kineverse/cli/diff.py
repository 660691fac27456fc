"""``kineverse diff``: differences of two models."""

from __future__ import annotations

import argparse
import json
import math

from kineverse.errors import InvalidValueError

from .arguments import add_model_options, load_model
from .output import colorize, show_activity

HELP = """\
Models are compared name by name, whatever their formats. Numbers and formulas that agree within the tolerance
at sampled states count as equal. Operations are compared if most of them have a counterpart with the same
tag. Meshes are compared by name, not by the content of the files.

With --values, behaviour is compared instead of structure: the poses of all frames in the world at sampled
states, and the limits of the degrees of freedom. Helper frames without bodies, which some formats need, are
listed but not counted.

  +  only in B      -  only in A      ~  changed      >  at another position

The exit status is 0 if they are equal, 1 if they differ, and 2 if a model cannot be read.

examples:
  kineverse diff robot_old.urdf robot.urdf
  kineverse diff robot.urdf robot.sdf --values
  kineverse diff kitchen my_kitchen.urdf --prefix kitchen --tolerance 1e-4
  kineverse diff home.kv.json today.kv.json --json"""

EQUAL, DIFFERENT = 0, 1
SHOWN = 20
"""Number of differences of a kind printed without --all."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    for name, what in (("A", "model before"), ("B", "model after")):
        parser.add_argument(
            name.lower(), metavar=name, help=f"{what}: name of a shipped model, or path of a file"
        )
    parser.add_argument("--prefix", metavar="NAME", help="prefix of all names of both, followed by a slash")
    add_model_options(parser)
    parser.add_argument(
        "--tolerance",
        metavar="X",
        type=float,
        default=1e-9,
        help="largest difference of equal numbers (1e-9): [m], [rad], relative above 1; 0: equal to the bit",
    )
    parser.add_argument("--values", action="store_true", help="compare poses at sampled states, and limits")
    parser.add_argument(
        "--operations",
        choices=("auto", "yes", "no"),
        default="auto",
        help="compare operations, too (auto: if most of them have a counterpart)",
    )
    parser.add_argument("--all", action="store_true", help=f"print more than {SHOWN} differences of a kind")
    parser.add_argument("--json", action="store_true", help="everything, as one JSON object")


def run(arguments: argparse.Namespace) -> int:
    """Load both models, compare them, and print the differences."""
    if not (math.isfinite(arguments.tolerance) and arguments.tolerance >= 0.0):
        raise InvalidValueError(f"--tolerance is a number from 0 on, not {arguments.tolerance}.")

    from kineverse.model.comparison import BehaviourComparison, ModelComparison

    from .diff_report import BehaviourComparisonReport, ModelComparisonReport, format_contents

    models = []
    for source in (arguments.a, arguments.b):
        with show_activity(f"reading {source}"):
            models.append(load_model(arguments, source, arguments.prefix))
    before, after = models
    report: BehaviourComparisonReport | ModelComparisonReport
    with show_activity("comparing"):
        if arguments.values:
            report = BehaviourComparisonReport(BehaviourComparison(before, after, arguments.tolerance))
        else:
            report = ModelComparisonReport(
                ModelComparison(before, after, arguments.tolerance, arguments.operations)
            )
    equal = report.comparison.equal
    if arguments.json:
        answer = {
            "before": arguments.a,
            "after": arguments.b,
            "equal": equal,
            "tolerance": arguments.tolerance,
        }
        print(json.dumps({**answer, **report.as_json()}, allow_nan=False))
    else:
        sides = (("-", arguments.a, before), ("+", arguments.b, after))
        head = [colorize(f"{sign * 3} {name}  {format_contents(model)}", sign) for sign, name, model in sides]
        blocks = report.blocks(None if arguments.all else SHOWN)
        print("\n\n".join("\n".join(block) for block in ([] if equal else head, *blocks) if block))
    return EQUAL if equal else DIFFERENT
