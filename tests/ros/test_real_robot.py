"""Robots behind topics of a real ROS: skills move them, and they stand when anything that moves them is cut."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from pathlib import Path

import pytest

from finger_and_flap import ARM, make_box

HERE = Path(__file__).parent
pytestmark = pytest.mark.ros

BOX = make_box(0.915, 0.03)


def run_robot(python: str, *words: str) -> dict:
    """Return what the program of a robot prints."""
    path = os.pathsep.join([str(HERE), str(HERE.parent), *filter(None, [os.environ.get("PYTHONPATH")])])
    done = subprocess.run(
        [python, str(HERE / "real_robot.py"), *words],
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        timeout=280,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(done.stdout)


@pytest.mark.parametrize("rounds", [1, pytest.param(10, marks=pytest.mark.long)])
def test_speeds_are_zero_within_a_tenth_of_a_second_after_a_cut(ros_python, rounds):
    """The skill killed, stopped, or out of hearing; the node killed or stopped: measured at the robot."""
    answer = run_robot(ros_python, "cuts", str(rounds))
    times = answer["times"]
    assert set(times) == {"skill stopped", "skill killed", "robot silent", "node stopped", "node killed"}
    print({name: f"{1000 * max(seconds):.0f} ms of {len(seconds)}" for name, seconds in times.items()})
    # A machine that does other things as well is late at times, also to measure.
    assert max(map(max, times.values())) <= (0.1 if rounds > 1 else 1.0), times
    ended = "The robot node has ended, and the robot was stopped."
    assert answer["said"].count(ended) == rounds, answer["said"]


def test_a_skill_moves_an_object_through_topics_alone(ros_python, tmp_path, monkeypatch):
    """The command with a robot that the other command simulates, each in a process of its own."""
    pytest.importorskip("coal")
    pytest.importorskip("daqp")
    (tmp_path / "arm.urdf").write_text(ARM)
    (tmp_path / "box.urdf").write_text(BOX)
    robot = ["box.urdf", "--robot", "arm.urdf@0.5,0,0.5,0"]
    simulated = subprocess.Popen(
        [ros_python, "-m", "kineverse", "ros", *robot, "--simulate"],
        cwd=tmp_path, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        said = [simulated.stdout.readline().strip() for _ in range(4)]
        assert said[0].startswith("robot: arm in the kinematic world")
        assert said[3] == "velocity_controller/commands has the speeds of slide"
        words = ["--what", "flap", "--hand", "arm/finger", "--to", "3cm", "--world", "ros", "--json"]
        done = subprocess.run(
            [ros_python, "-m", "kineverse", "push", *robot, *words],
            cwd=tmp_path, capture_output=True, text=True, timeout=120,
        )  # fmt: skip
        assert done.stdout, done.stderr[-3000:]
        answer = json.loads(done.stdout)
        assert (answer["claimed"], answer["done"], answer["world"]) == (True, True, "ros"), answer["reason"]
        assert answer["value"] == pytest.approx(0.03, abs=answer["measures"]["tolerance"])
        assert done.returncode == 0
    finally:
        simulated.send_signal(signal.SIGTERM)
        simulated.stdout.close()
        assert simulated.wait(30.0) == 0


@pytest.mark.long
@pytest.mark.parametrize("what", ["kitchen/fridge_door", "kitchen/sink_left_middle_drawer"])
@pytest.mark.parametrize("robot", ["hsr", "pr2", "fetch"])
def test_shipped_robots_open_a_kitchen_through_topics_alone(ros_python, robot, what):
    answer = run_robot(ros_python, "open", "kitchen", robot, what, "--seconds", "120")
    assert answer.get("done"), answer.get("reason", answer["said"])
    assert answer["true"] == pytest.approx(answer["target"], abs=answer["measures"]["tolerance"])


@pytest.mark.long
@pytest.mark.parametrize("robot", ["hsr", "pr2", "fetch"])
def test_the_robot_stands_when_an_opening_is_killed(ros_python, robot):
    answer = run_robot(ros_python, "open", "kitchen", robot, "kitchen/fridge_door", "--cut", "approach")
    assert answer["seconds"] <= 0.1
