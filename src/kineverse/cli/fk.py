"""``kineverse fk``: pose of a frame."""

from __future__ import annotations

import argparse
import json

import numpy as np

import kineverse as kv
from kineverse.errors import InvalidValueError
from kineverse.expressions.printing import format_number
from kineverse.lie import to_quaternion
from kineverse.view.poses import complete, roll_pitch_yaw

from .arguments import (
    add_model_options,
    add_set_option,
    find_limit_notes,
    load_model,
    parse_assignments,
    print_notes,
)

HELP = """\
Positions that are not set have their defaults: 0, or the nearest value within the limits.

examples:
  kineverse fk kitchen kitchen/fridge_door_handle
  kineverse fk kitchen kitchen/fridge_door_handle --set kitchen/fridge_door=30deg --json
  kineverse fk pr2 pr2/l_gripper_tool_frame --relative-to pr2/torso_lift_link"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("model", metavar="MODEL", help="name of a shipped model, or path of a file")
    parser.add_argument("frame", metavar="FRAME", help="name of a frame, such as kitchen/fridge_door")
    parser.add_argument("--relative-to", metavar="FRAME", default="world", help="reference frame (world)")
    add_set_option(parser)
    add_model_options(parser)
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output")


def run(arguments: argparse.Namespace) -> int:
    """Evaluate the pose and print it."""
    # Parsed before the model is loaded, so that a typing error is reported at once.
    assigned = parse_assignments(arguments.assignments)

    model = load_model(arguments, arguments.model)
    expression = model.fk(arguments.frame, arguments.relative_to)
    values = complete(model, assigned)
    pose = np.asarray(expression(kv.State(values)), dtype=float)
    notes = find_limit_notes(model, values, arguments.assignments)
    used = {str(s): values[str(s)] for s in expression.symbols if str(s) in values}
    if not np.isfinite(pose).all():
        print_notes(notes)
        where = ", ".join(f"{name}={format_number(value, 6)}" for name, value in used.items()) or "all values"
        raise InvalidValueError(
            f"The pose of '{arguments.frame}' in '{arguments.relative_to}' is not finite at {where}; "
            "set other positions with --set."
        )
    position, rpy = pose[:3, 3], roll_pitch_yaw(pose)
    xyzw = to_quaternion(pose[:3, :3])
    if arguments.json:
        answer = {
            "frame": arguments.frame,
            "relative_to": arguments.relative_to,
            "transform": pose.tolist(),
            "position": position.tolist(),
            "quaternion_xyzw": xyzw.tolist(),
            "roll_pitch_yaw": rpy.tolist(),
            "depends_on": used,
        }
        print(json.dumps(answer, allow_nan=False))
    else:
        print(f"{arguments.frame} in {arguments.relative_to}")
        print("\n".join("  " + "".join(f"{format_number(x, 6):>12}" for x in row) for row in pose))
        rows = ("position", position, "m"), ("roll pitch yaw", rpy, "rad"), ("quaternion xyzw", xyzw, "")
        for name, numbers, unit in rows:
            cells = "".join(f"{format_number(x, 6):>12}" for x in numbers)
            print(f"  {name:<16}{cells}  {unit}".rstrip())
        if used:
            print("  at " + ", ".join(f"{name}={format_number(value, 6)}" for name, value in used.items()))
    print_notes(notes)
    return 0
