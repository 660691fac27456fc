"""``--world ros``: a robot that another distribution connects; a simulated world stands for it here."""

import json
from types import SimpleNamespace
from typing import ClassVar

import pytest

import kineverse as kv
from finger_and_flap import ARM, make_box
from kineverse.cli import outside_robot
from kineverse.errors import OfflineError, SimulationError
from kineverse.worlds import KinematicWorld, Observation

pytest.importorskip("coal")
pytest.importorskip("daqp")

BOX = make_box(0.92, 0.06)

PUSH = ["push", "box.urdf", "--robot", "arm.urdf@0.5,0,0.5,0", "--what", "flap", "--hand", "arm/finger"]
PLAN = ["plan", "box.urdf", "--robot", "arm.urdf@0.5,0,0.5,0"]
ROS = ["--world", "ros:arm.toml"]


class Outside(KinematicWorld):
    """A robot of which the commands may use the interface alone, and that is to be left."""

    name = "ros"
    made: ClassVar[list] = []

    def __init__(self, model, robot, settings, *, observed):
        self.settings, self.observed, self.left, self.followed = settings, tuple(observed), False, []
        super().__init__(model, robot)
        self.blind, self.fails = False, ""
        Outside.made.append(self)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.left = True

    def observe(self):
        seen = super().observe()
        # Nothing happens between two looks here.
        self.apply({}, 0.001)
        poses = (
            {} if self.blind else {name: pose for name, pose in seen.poses.items() if name in self.observed}
        )
        return Observation(seen.stamp, seen.joints, poses, seen.touching)

    def follow(self, trajectory):
        self.followed.append(trajectory)
        if self.fails:
            raise SimulationError(self.fails)


@pytest.fixture
def outside(tmp_path, monkeypatch):
    """What the entry point names; files are in the working directory."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "arm.urdf").write_text(ARM)
    (tmp_path / "box.urdf").write_text(BOX)
    point = SimpleNamespace(load=lambda: point.connect, connect=Outside)
    monkeypatch.setattr(outside_robot, "entry_points", lambda group, name: [point] * (name == "ros"))
    monkeypatch.setattr(outside_robot, "_LOOKING", 0.2)
    monkeypatch.setattr(Outside, "made", [])
    return point


def test_done_is_what_the_robot_believes(run, outside):
    status, out, err = run(*PUSH, *ROS, "--to", "6cm", "--json")
    answer = json.loads(out)
    assert (status, answer["claimed"], answer["done"], answer["world"]) == (0, True, True, "ros"), answer[
        "reason"
    ]
    assert answer["value"] == pytest.approx(0.06, abs=0.006)
    assert not {"penetration", "peak_force", "estimate_mean"} & set(answer["measures"])
    (robot,) = Outside.made
    assert (robot.settings, robot.observed, robot.left) == ("arm.toml", ("front",), True)
    assert "push" in err


def test_words_of_the_result_say_who_believes_it(run, outside):
    status, out, _ = run(*PUSH, "--world", "ros", "--to", "6cm")
    assert status == 0
    assert "flap: done at 0.0" in out
    assert "as the robot believes" in out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([*PUSH, "--world", "gazebo"], "there is no such world. There is kinematic, mujoco, live, ros"),
        ([*PUSH, "--world", "ros:"], "there is no such world"),
        ([*PUSH, *ROS, "--from", "1cm"], "--from is for simulated worlds; with --world ros, the robot sees"),
        ([*PUSH, *ROS, "--set", "arm/slide=0.1"], "--set is for simulated worlds"),
        ([*PUSH, *ROS, "--noise", "3mm"], "--noise is for simulated worlds"),
        ([*PUSH, *ROS, "--base", "omni"], "a robot with a base says itself where it stands"),
        ([*PLAN, "--to", "arm/slide=0.1", "--world", "mujoco"], "there is no such world. There is live, ros"),
        ([*PLAN, "--to", "arm/slide=0.1", *ROS, "--from", "arm/slide=0.2"], "says itself where it is"),
    ],
)
def test_what_a_robot_outside_does_not_know_is_refused(run, outside, words, message):
    if "--base" in words:
        words[words.index("arm.urdf@0.5,0,0.5,0")] = "arm.urdf@0.5,0,0"
    status, _, err = run(*words, *(["--to", "6cm"] if words[0] == "push" else []))
    assert status == 2
    assert message in err
    assert len([line for line in err.splitlines() if line.startswith("kineverse:")]) == 1


def test_the_time_to_be_seen_begins_when_the_estimator_is_there(monkeypatch):
    class Belief:
        time, looks = 0.0, 0

        @property
        def seen(self):
            return {"flap": self.time} if self.looks > 2 else {}

        def update(self, observation, time):
            self.looks += 1
            self.time += 100.0 if self.looks == 1 else 0.1
            return self.looks

    belief = Belief()
    clock = SimpleNamespace(monotonic=lambda: belief.time, sleep=lambda seconds: None)
    monkeypatch.setattr(outside_robot, "time", clock)
    robot = object.__new__(outside_robot.OutsideRobot)
    robot.belief, robot._coordinate = belief, "flap"
    robot.interface = SimpleNamespace(observe=lambda: None, time=0.0)
    assert robot.look() > 2


@pytest.mark.parametrize("why", ["blind", "nobody observes it", "offline", "not installed"])
def test_what_keeps_a_robot_from_beginning_is_one_error(run, outside, why):
    class Blind(Outside):
        def __init__(self, *arguments, **options):
            super().__init__(*arguments, **options)
            self.blind, self.remarks = True, ("Nobody publishes the poses /poses/front.",)

    class Elsewhere(Outside):
        def __init__(self, *arguments, **options):
            super().__init__(*arguments, **options | {"observed": ["wall"]})

    def refuse(*arguments, **options):
        raise OfflineError("'arm' has not reported for 6 s.")

    message = {
        "blind": "'flap' has not been seen for 0.2 s. Nobody publishes the poses /poses/front.",
        "nobody observes it": "Nobody observes 'flap'. [observed] in the settings of the robot is to name",
        "offline": "'arm' has not reported for 6 s.",
        "not installed": "--world ros is brought by kineverse_ros, which is not installed",
    }[why]
    outside.connect = {"blind": Blind, "nobody observes it": Elsewhere, "offline": refuse}.get(why)
    if why == "not installed":
        outside_robot.entry_points = lambda group, name: []
    status, _, err = run(*PUSH, *ROS, "--to", "6cm")
    assert (status, message in err) == (2, True), err
    assert all(robot.left for robot in Outside.made)


@pytest.mark.compiler
@pytest.mark.parametrize("fails", ["", "The robot has left its path by 0.2 (rad, m)."])
def test_a_planned_path_begins_at_the_readings_and_is_followed(run, outside, fails):
    def connect(*arguments, **options):
        robot = Outside(*arguments, **options)
        robot.reset({"arm/slide": 0.004})
        robot.fails = fails
        return robot

    outside.connect = connect
    status, out, _ = run(*PLAN, "--to", "arm/slide=0.001", *ROS, "--json")
    answer = json.loads(out)
    assert answer["found"], answer["why"]
    assert (status, answer["followed"], answer["given_up"]) == (bool(fails), not fails, fails)
    (robot,) = Outside.made
    (path,) = robot.followed
    assert path.symbols == (kv.position("arm/slide"),)
    assert [path.positions[0, 0], path.positions[-1, 0]] == pytest.approx([0.004, 0.001])
    assert robot.left
