"""``kineverse reach``: a configuration in which a frame has a pose."""

from __future__ import annotations

import argparse
import json
from typing import Any

import numpy as np

import kineverse as kv
from kineverse.control import Goal, InverseKinematics, same_pose, same_position
from kineverse.errors import InvalidValueError
from kineverse.expressions.printing import format_number
from kineverse.model.kinematics import infer_units

from .arguments import (
    add_model_options,
    check_assigned_units,
    find_turn_notes,
    load_model,
    match_coordinates,
    needs_mujoco,
    parse_assignments,
    parse_pose_numbers,
    print_notes,
    require,
)
from .output import name_options
from .pages import check_picture_path, list_mesh_problems, print_mesh_problems
from .plan_arguments import add_robot_option, include_robot

HELP = """\
The pose is given by 3 numbers [m] for a position alone, by 6 for position and roll, pitch, yaw [rad], or by
the name of a frame. All limits are respected. Without a solution the nearest positions are printed, with the
reason, and the exit status is 1. This needs the extra 'control'.

examples:
  kineverse reach fetch fetch/gripper_link --pose 0.7 0.2 0.9
  kineverse reach fetch fetch/gripper_link --pose 0.7 0.2 0.9 0 1.57 0 --still fetch/base
  kineverse reach pr2 pr2/l_gripper_tool_frame --pose 0 0.3 0 --relative-to pr2/r_gripper_tool_frame
  kineverse reach kitchen fetch/gripper_link --robot fetch --pose kitchen/oven_door_handle --position-only"""

REACHED, NOT_REACHED = 0, 1


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    # Options that take several words come last, or they would take MODEL and FRAME as well.
    parser.usage = "%(prog)s MODEL FRAME --pose (X Y Z [ROLL PITCH YAW] | NAME) [options]"
    parser.add_argument("model", metavar="MODEL", help="name of a shipped model, or path of a file")
    parser.add_argument("frame", metavar="FRAME", help="frame that reaches, such as fetch/gripper_link")
    parser.add_argument(
        "--pose",
        nargs="+",
        required=True,
        metavar=("X", "Y Z ROLL PITCH YAW"),
        help="position, or position and roll, pitch, yaw (0.3, 12cm, 30deg), or the name of a frame",
    )
    parser.add_argument("--position-only", action="store_true", help="any orientation")
    parser.add_argument(
        "--relative-to", metavar="FRAME", default="world", help="frame in which the numbers are given (world)"
    )
    add_robot_option(parser)
    parser.add_argument(
        "--still",
        nargs="+",
        action="extend",
        default=[],
        metavar="NAME",
        help="coordinates, articulations or patterns ('kitchen/*') that stay still",
    )
    parser.add_argument("--starts", type=int, default=16, metavar="N", help="largest number of starts (16)")
    parser.add_argument(
        "--from",
        metavar="NAME=VALUE",
        action="append",
        default=[],
        dest="assignments",
        help="a position of the first start, which also holds for what does not move; repeatable",
    )
    parser.add_argument("--collisions", action="store_true", help="avoid collisions")
    parser.add_argument("--picture", metavar="FILE", help="write a picture (.png) of the positions found")
    add_model_options(parser)
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output")


def run(arguments: argparse.Namespace) -> int:
    """Search the positions and print them."""
    # Parsed before the model is loaded, so that a typing error is reported at once.
    require(
        "kineverse reach",
        {"control": True, "geometry": arguments.collisions, "mjcf": needs_mujoco(arguments.model)},
    )
    assigned = parse_assignments(arguments.assignments, "--from")
    numbers = parse_pose(arguments.pose)
    print_notes(find_turn_notes(arguments.pose[3:]))
    check_picture_path(arguments.picture)

    from kineverse.geometry import Scene  # for start-up time
    from kineverse.view import save_picture  # for start-up time

    model = load_model(arguments, arguments.model)
    check_assigned_units(model, arguments.assignments, "--from")
    standing: dict[kv.Symbol, float] = {}
    if arguments.robot is not None:
        _, standing = include_robot(arguments, model)
        assigned = {**{str(s): value for s, value in standing.items()}, **assigned}
    goal, still = make_goal(model, arguments, numbers)
    still += [s for s in standing if s not in still]
    scene = Scene(model) if arguments.collisions else None
    fixed: list[kv.Symbol | str] = [*match_coordinates(model, arguments.still, "--still"), *still]
    solver = InverseKinematics(model, [goal], scene=scene, fixed=fixed)
    result = solver.solve(assigned, starts=arguments.starts)
    positions = {str(s): result.best[s] for s in solver.coordinates}
    if arguments.picture is not None:
        save_picture(arguments.picture, model, {str(s): result.best[s] for s in model.symbols})
        print_mesh_problems(list_mesh_problems(model))
    error = result.residuals[goal.name]
    if arguments.json:
        answer: dict[str, Any] = {
            "frame": arguments.frame,
            "reached": result.solved,
            "positions": positions,
            "error": error,
            "starts": result.starts,
            "active": list(result.active),
            "why": result.why,
        }
        print(json.dumps(answer, allow_nan=False))
    else:
        verdict = "reached" if result.solved else f"not reached. {name_options(result.why, arguments)}"
        print(f"{arguments.frame}: {verdict}")
        width = max(map(len, positions))
        units = infer_units(model, {str(s): result.best[s] for s in model.symbols}, positions)
        for name, value in positions.items():
            print(f"  {name:<{width}}  {format_number(value, 6)} {units[name]}".rstrip())
        if arguments.picture is not None:
            print(f"picture: {arguments.picture}")
    return REACHED if result.solved else NOT_REACHED


def parse_pose(words: list[str]) -> list[float] | None:
    """Return the 3 or 6 numbers of a pose, None for the name of a frame."""
    if len(words) == 1:
        return None
    if len(words) not in (3, 6):
        raise InvalidValueError(
            f"--pose takes 3 numbers for a position, 6 with roll, pitch and yaw, or the name of a frame, "
            f"and not {len(words)} words."
        )
    return [*parse_pose_numbers(words)]


def make_goal(
    model: kv.Model, arguments: argparse.Namespace, numbers: list[float] | None
) -> tuple[Goal, list[kv.Symbol]]:
    """Return the goal, and the coordinates that move nothing but the target."""
    if numbers is None:
        (frame,) = arguments.pose
        hand, target = model.fk(arguments.frame), model.fk(frame)
        own = set(model.symbols_of(arguments.frame))
        still = [s for s in model.symbols_of(frame) if s not in own]
    else:
        hand, still = model.fk(arguments.frame, arguments.relative_to), []
        target = kv.translation(*numbers[:3]) @ kv.rpy(*(numbers[3:] or (0.0, 0.0, 0.0)))
    free = arguments.position_only or (numbers is not None and len(numbers) == 3)
    error = same_position(target, hand) if free else same_pose(target, hand)
    if not error.gradient() or arguments.pose == [arguments.frame]:
        raise InvalidValueError(
            f"Nothing moves '{arguments.frame}' with respect to the target; its pose is constant."
        )
    return Goal(error, np.zeros(error.shape), name="pose"), still
