"""``kineverse ros``: nodes of ROS 2 for a model."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from kineverse.cli.output import show_activity
from kineverse.cli.pages import handle_interrupts
from kineverse.errors import InvalidValueError

from .model_settings import add_setting_options, given_settings
from .ros import import_ros

if TYPE_CHECKING:
    from .model_node import ModelNode

HELP = """\
publish any model in ROS 2: transforms, joint states, markers, URDF

A MODEL is a name, a file, or live:NAME, which is followed through its edits; several are one. It is moved by
the joint states that others publish, by poses of PoseStamped or TF (--observed), and by the sources of a
model server. It takes the place of robot_state_publisher and joint_state_publisher, and needs no URDF. The
robot's own nodes may run beside it: --omit ROBOT/ leaves the robot's frames to them.

With --simulate, a robot in a simulated world stands behind topics, as a real one would, to be moved by
kineverse open MODEL --robot ROBOT --world ros. Ctrl-C ends. It needs a ROS 2 for this Python.

examples:
  kineverse ros kitchen
  kineverse ros kitchen pr2 --robot pr2 --rate 100
  kineverse ros live:home --observed kitchen/fridge_door=tf:marker_12
  kineverse ros kitchen pr2 --robot pr2 --omit pr2/ --frame-names pr2/= --frame-names world=map
  kineverse ros articulations/four_bar --ros-args -p use_sim_time:=true -r robot_description:=bars
  kineverse ros kitchen --robot hsr --simulate"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_setting_options(parser)
    parser.add_argument(
        "--simulate",
        metavar="WORLD",
        nargs="?",
        const="kinematic",
        choices=("kinematic", "mujoco"),
        help="simulate --robot in a world, kinematic (the default) or mujoco, behind topics",
    )
    parser.add_argument("--noise", metavar="NOISE", help="noise of the simulated sensors, as kineverse open")
    parser.add_argument("--settings", metavar="FILE", help="topics of the simulated robot (.toml)")
    parser.add_argument(
        "--ros-args",
        metavar="...",
        nargs=argparse.REMAINDER,
        default=[],
        help="arguments of ROS, the last: remappings (-r), and the settings above as parameters (-p)",
    )


def run(arguments: argparse.Namespace) -> int:
    """Run a node until interrupted."""
    import_ros()  # before anything that takes long
    given = given_settings(arguments)
    if arguments.simulate is not None:
        _simulate(arguments, [name for name in given if name not in ("model", "robot")])
        return 0
    for option in ("noise", "settings"):
        if getattr(arguments, option) is not None:
            raise InvalidValueError(f"--{option} is about a simulated robot: add --simulate.")
    from .model_node import run_model_node  # for start-up time

    with handle_interrupts():
        run_model_node(given, ["--ros-args", *arguments.ros_args], _print_topics)
    return 0


def _print_topics(node: ModelNode) -> None:
    print(f"{node.summary}   (Ctrl-C ends)")
    print("\n".join(f"  {line}" for line in node.topics), flush=True)


def _simulate(arguments: argparse.Namespace, unused: list[str]) -> None:
    from .model_node import load_model  # for start-up time
    from .simulated_robot import simulate_robot

    if arguments.robot is None:
        raise InvalidValueError("--simulate needs a robot: --robot hsr.")
    if unused or arguments.ros_args:
        option = unused[0] if unused else "ros-args"
        raise InvalidValueError(f"--{option.replace('_', '-')} is not for a simulated robot.")
    with show_activity("reading the model"):
        model = load_model(arguments.model)
    with handle_interrupts():
        simulate_robot(
            model,
            arguments.robot,
            world=arguments.simulate,
            noise=arguments.noise,
            settings=arguments.settings,
        )
