"""Program that is a simulated robot behind topics of a real ROS, and measures at the robot what arrives there.

``real_robot.py cuts ROUNDS`` has itself moved on and on, cuts that in all ways, and prints as JSON the times
from the cuts until the first of zeros after which nothing else comes [s], and what the skill has said.
``real_robot.py open MODEL ROBOT COORDINATE WORDS...`` has ``kineverse open`` move it, and prints its answer with
the true value of the coordinate. After ``--cut PHASE`` that is killed in a phase, and the time is printed.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from time import monotonic
from typing import Any

from robots import load_robot

import kineverse as kv
from kineverse.errors import KineverseError
from kineverse.worlds import KinematicWorld, SimulatedWorld
from kineverse_ros.robot_settings import RobotSettings, connect_names
from kineverse_ros.ros import import_ros
from kineverse_ros.ros_robot import RosRobot
from kineverse_ros.simulated_robot import SimulatedRobot, make_world

SPEEDS = {"bot/base/x": 0.1, "bot/base/angle": 0.2, "bot/pan": -0.1, "bot/lift": 0.0}
PERIOD = 0.01
LOOKING = 0.5  # time after a cut in which nothing may move again [s]
HELD = 0.1  # longest step of the world [s]


def move() -> None:
    """Move the robot until this process is killed; connect again after an error."""
    model, speeds = load_robot(), {f"{name}:velocity": value for name, value in SPEEDS.items()}
    while True:
        with RosRobot(model, "bot") as robot:
            print(f"node {robot._process.pid}", flush=True)
            try:
                while True:
                    robot.apply(speeds, 0.02, stamp=robot.observe().stamp)
            except KineverseError as error:
                print(error, flush=True)


class Robot:
    """The robot, which notes the largest speed of each command when it arrives."""

    def __init__(self, world: SimulatedWorld, words: list[str]) -> None:
        self.skill = subprocess.Popen(
            [sys.executable, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        with suppress(OSError, AttributeError):  # after the skill, so that only the robot is always in time
            os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
        ros = import_ros()
        ros.rclpy.init()
        node = ros.rclpy.create_node("robot")
        names = connect_names(world.robot, RobotSettings(), world.robot.markers)
        self.world, self.simulation = world, SimulatedRobot(ros, node, world, names)
        self.heard: list[tuple[float, float]] = []
        self.silent = False
        node.create_subscription(
            ros.Twist, "cmd_vel", lambda m: self.note(m.linear.x, m.linear.y, m.angular.z), 1
        )
        node.create_subscription(
            ros.Float64MultiArray, "velocity_controller/commands", lambda m: self.note(*m.data), 1
        )
        self.executor = ros.rclpy.executors.SingleThreadedExecutor()
        self.executor.add_node(node)
        self.last = self.due = monotonic()
        self.lines: dict[str, list[str]] = {"stdout": [], "stderr": []}
        for name, lines in self.lines.items():
            threading.Thread(target=lines.extend, args=(getattr(self.skill, name),), daemon=True).start()

    def note(self, *speeds: float) -> None:
        self.heard.append((monotonic(), max(map(abs, speeds))))

    def live(self, seconds: float) -> None:
        """Let time pass."""
        end = monotonic() + seconds
        while (time := monotonic()) < end:
            if time >= self.due:
                self.due = time + PERIOD
                if not self.silent:
                    self.simulation.step(min(time - self.last, HELD))
                self.last = time
            self.executor.spin_once(timeout_sec=max(0.0, min(end, self.due) - monotonic()))

    def wait(self, what: Callable[[], object], seconds: float = 60.0) -> Any:
        """Live until something is there, and return it."""
        deadline = monotonic() + seconds
        while not (found := what()):
            assert monotonic() < deadline, self.lines
            self.live(0.05)
        return found

    def await_motion(self) -> None:
        """Live until the skill has moved the robot for a while."""
        count = len(self.heard)
        self.wait(lambda: sum(speed > 0.0 for _, speed in self.heard[count:]) > 10)

    def measure(self, cut: Callable[[], object]) -> float:
        """Return the time from a cut until the robot was told to stand."""
        begin = monotonic()
        cut()
        self.live(LOOKING)
        moved = max(time for time, speed in self.heard if speed > 0.0)
        return min(time for time, speed in self.heard if speed == 0.0 and time > moved) - begin

    def end(self) -> None:
        self.skill.kill()
        self.skill.wait()


def cut_all(rounds: int) -> dict[str, Any]:
    """Cut in each way."""
    robot = Robot(KinematicWorld(load_robot(), "bot"), [__file__, "moves"])
    said, skill, times = robot.lines["stdout"], robot.skill, dict[str, list[float]]()

    def signal_node(number: signal.Signals) -> None:
        os.kill(int([line for line in said if line.startswith("node ")][-1].split()[1]), number)

    def note(name: str, cut: Callable[[], object]) -> None:
        robot.await_motion()
        times.setdefault(name, []).append(robot.measure(cut))

    try:
        for _ in range(rounds):
            robot.wait(lambda: said and said[-1].startswith("node "))
            note("skill stopped", lambda: skill.send_signal(signal.SIGSTOP))
            skill.send_signal(signal.SIGCONT)
            note("robot silent", lambda: setattr(robot, "silent", True))
            robot.silent = False
            note("node stopped", lambda: signal_node(signal.SIGSTOP))
            signal_node(signal.SIGCONT)
            note("node killed", lambda: signal_node(signal.SIGKILL))
        note("skill killed", skill.kill)
    finally:
        robot.end()
    return {"times": times, "said": [line.strip() for line in said if not line.startswith("node ")]}


def open_object(model: str, name: str, coordinate: str, words: list[str]) -> dict[str, Any]:
    """Have the command open an object, or be killed in a phase of that."""
    world = make_world(kv.load(model), name)
    phase = words[words.index("--cut") + 1] if "--cut" in words else ""
    words = words[: words.index("--cut")] if phase else words
    command = ["-m", "kineverse", "open", model, "--robot", name, "--what", coordinate, "--world", "ros"]
    robot = Robot(world, [*command, "--json", *words])
    try:
        if phase:
            robot.wait(lambda: any(f" {phase} " in line for line in robot.lines["stderr"]), 200.0)
            robot.await_motion()
            return {"seconds": robot.measure(robot.skill.kill)}
        robot.wait(lambda: robot.skill.poll() is not None, 200.0)
        robot.live(0.2)
        answer = json.loads("".join(robot.lines["stdout"]) or "{}")
        return answer | {"true": world.state[coordinate], "said": robot.lines["stderr"]}
    finally:
        robot.end()


if __name__ == "__main__":
    match sys.argv[1:]:
        case ["moves"]:
            move()
        case ["cuts", rounds]:
            print(json.dumps(cut_all(int(rounds))))
        case ["open", model, name, coordinate, *words]:
            print(json.dumps(open_object(model, name, coordinate, words)))
