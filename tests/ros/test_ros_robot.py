"""A robot that is only topics, with its node and a simulated robot on a small ROS in this process."""

from __future__ import annotations

import math
import re
import threading
from dataclasses import replace
from pathlib import Path
from time import monotonic

import msgspec
import numpy as np
import pytest
from fake_rclpy import FakeRos
from robots import connect, load_robot

import kineverse as kv
from kineverse.errors import (
    InvalidValueError,
    KineverseError,
    MissingDependencyError,
    OfflineError,
    SimulationError,
)
from kineverse.manipulation import SkillError, SkillRun
from kineverse.manipulation.session import EncoderBelief, Session
from kineverse.planning.trajectories.trajectory import Trajectory
from kineverse.worlds import KinematicWorld
from kineverse_ros import ros_robot
from kineverse_ros.robot_link import Beat, End, Follow, Link, Note, Pose, Readings, Speeds, now
from kineverse_ros.robot_node import RobotNode
from kineverse_ros.robot_settings import BaseSettings, connect_names, read_settings
from kineverse_ros.ros_robot import RosRobot
from kineverse_ros.simulated_robot import SimulatedRobot

pytest.importorskip("coal")
pytest.importorskip("daqp")

STILL = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


class Far(threading.Thread):
    """What is at the other end of the link of a robot: it stands for a process."""

    def __init__(self, end) -> None:
        super().__init__(daemon=True)
        self.link, self.heard, self.over = Link(end), [], threading.Event()
        self.start()

    def run(self) -> None:
        try:
            self.wiring = self.link.receive(5.0).wiring
            self.begin()
            while not self.over.is_set():
                message = self.link.receive(0.002)
                if isinstance(message, End):
                    break
                if message is not None:
                    self.heard.append(message)
                self.live(message)
        except EOFError:
            pass
        self.link.close()

    def begin(self) -> None:
        self.link.send(Beat(now(), False))

    def live(self, message) -> None:
        pass

    # The methods of a process that are used.

    def wait(self, timeout=None) -> None:
        self.join(timeout)

    def kill(self) -> None:
        self.over.set()


class Scripted(Far):
    """A robot that reports what it is told to."""

    numbers, joints, poses, until = STILL, (0.1, 0.2), (), math.inf

    def live(self, message) -> None:
        if (stamp := now()) < self.until:
            poses, self.poses = self.poses, ()
            self.link.send(Readings(stamp, self.joints, self.numbers, poses))


class Simulated(Far):
    """A robot node and a simulated robot."""

    def begin(self) -> None:
        ros = self.ros = FakeRos(start=1000.0)
        model = load_robot(omni=False)
        self.node = RobotNode(
            ros, ros.rclpy.create_node("node"), self.wiring, self.link.send, lambda beat: None
        )
        self.world = KinematicWorld(model, "bot")
        self.robot = SimulatedRobot(ros, ros.rclpy.create_node("robot"), self.world, connect(model))
        self.due = self.last = monotonic()
        super().begin()

    def live(self, message) -> None:
        if message is not None:
            self.node.take(message)
        self.node.watch()
        time = monotonic()
        self.ros.advance(time - self.last)
        if time > self.due:
            self.due = time + 0.01
            self.robot.step(0.01)
        self.last = time


def connect_patiently(*arguments):
    """Return names whose robot is not said to be silent when this computer is busy."""
    names = connect_names(*arguments)
    return replace(names, wiring=msgspec.structs.replace(names.wiring, timeout=5.0))


@pytest.fixture
def started(monkeypatch):
    """Have robots begin with an end of this kind, and return the robot and the end."""
    opened = []
    monkeypatch.setattr(ros_robot, "connect_names", connect_patiently)

    def start(kind, *, omni=True, **settings):
        ends = []
        monkeypatch.setattr(ros_robot, "_start_node", lambda end: ends.append(kind(end)) or ends[0])
        path = settings.pop("path", None)
        given = ros_robot.RobotSettings(**settings) if path is None else path
        robot = RosRobot(load_robot(omni), "bot", given)
        opened.append(robot)
        return robot, ends[0]

    yield start
    for robot in opened:
        robot.close()


def test_wheels_drive_the_base_at_the_pace_of_the_steps(started):
    robot, far = started(Simulated, omni=False)
    wheels = ["bot/base/left_wheel:velocity", "bot/base/right_wheel:velocity"]
    begin, steps = monotonic(), 0
    while steps < 20 or far.world.state["bot/base/x"] < 0.04:
        robot.apply(dict.fromkeys(wheels, 2.0) | {"bot/pan:velocity": 0.5}, 0.02, stamp=robot.observe().stamp)
        steps += 1
        assert monotonic() - begin < 20.0
    assert monotonic() - begin >= 0.02 * steps - 0.001
    robot.apply({}, 0.1)
    joints = {str(s): v for s, v in robot.observe().joints.items()}
    state = far.world.state
    assert state["bot/base/x"] == pytest.approx(0.1 * 2.0 * state["bot/pan"] / 0.5, rel=0.1)
    assert joints["bot/base/x"] == pytest.approx(state["bot/base/x"], abs=0.01)
    assert joints["bot/base/y"] == pytest.approx(0.0, abs=1e-9)


def test_a_session_moves_it_and_ends_with_a_reason_if_its_node_does(started):
    robot, far = started(Simulated, omni=False)
    session = Session(robot, belief=EncoderBelief(robot.model, robot.robot))
    run = SkillRun(session, None, 10.0)

    def skill() -> str:
        for _ in range(1000):
            session.act({"bot/lift:velocity": 0.3})
            if session.state["bot/lift"] > 0.02:
                far.over.set()
        return "never"

    outcome = run.perform(skill)
    assert not outcome
    assert outcome.reason == "The robot node has ended, and the robot was stopped."
    assert session.broken


def test_an_end_of_the_node_is_said_by_who_finds_it_out_first(started):
    robot, far = started(Scripted)
    with robot._lock:  # the thread that hears it waits
        far.kill()
        far.wait()
        with pytest.raises(SimulationError, match="has ended"):
            robot.apply({}, 0.02)


def test_a_skill_that_hears_nothing_from_the_robot_ends_with_a_reason(started):
    robot, far = started(Scripted)
    session = Session(robot, belief=EncoderBelief(robot.model, robot.robot), patience=0.1)
    far.until = 0.0
    with pytest.raises(SkillError, match=r"The robot 'ros' was observed last at .* has waited for"):
        for _ in range(100):
            session.act({"bot/lift:velocity": 0.3})
    assert session.fault


def test_a_simulated_robot_refuses_what_is_no_command():
    ros, model = FakeRos(), load_robot()
    node, other = ros.rclpy.create_node("robot"), ros.rclpy.create_node("other")
    world = KinematicWorld(model, "bot")
    robot = SimulatedRobot(ros, node, world, connect(model, observed={"door": "tf:tag"}))
    heard = []
    other.create_subscription(ros.TFMessage, "/tf", heard.append, ros.QUEUED)
    twist = ros.Twist()
    twist.linear.x = math.nan

    def path(name, *positions):
        point = ros.JointTrajectoryPoint(positions=list(positions))
        point.time_from_start.sec = 1
        return ros.JointTrajectory(joint_names=[name], points=[point])

    for topic, message in (
        ("cmd_vel", twist),
        ("velocity_controller/commands", ros.Float64MultiArray(data=[1.0])),
        ("velocity_controller/commands", ros.Float64MultiArray(data=[1.0, math.inf])),
        *(
            ("joint_trajectory_controller/joint_trajectory", message)
            for message in (path("nothing", 1.0), path("lift", 1.0, 2.0), path("lift", math.nan))
        ),
    ):
        other.create_publisher(type(message), topic, 1).publish(message)
    ros.deliver()
    start = world.state
    robot.step(0.1)
    ros.deliver()
    assert dict(world.state) == dict(start)
    assert [text.split(" ")[1] for _, text in node.logged] == ["Twist", "takes", "path", "path"]
    (message,) = heard
    assert [one.child_frame_id for one in message.transforms] == ["base_link", "tag"]


def test_poses_are_placed_where_the_camera_was_when_it_saw_them(started):
    robot, far = started(Scripted)
    stamp = now()
    far.joints = (0.1, 0.2)
    far.poses = (Pose("door", "bot/camera", stamp, (1.0, *STILL[1:])), Pose("wall", "world", stamp, STILL))
    deadline = monotonic() + 5.0
    while not (seen := robot.observe()).poses:
        assert monotonic() < deadline
    assert seen.seen == pytest.approx(stamp - robot._begin)
    assert seen.picture_stamp <= seen.stamp
    expected = robot.model.fk("bot/camera")(
        robot.model.default_state().updated({"bot/lift": 0.1, "bot/pan": 0.2, "bot/base/x": -0.1})
    )
    np.testing.assert_allclose(
        seen.poses["door"][:3, 3], expected[:3, 3] + [math.cos(0.2), math.sin(0.2), 0.0], atol=1e-12
    )
    assert not robot.observe().poses


def test_the_heading_goes_on_beyond_a_half_turn(started):
    robot, far = started(Scripted)
    angle = robot.robot.planar_base[2]
    for k in range(1, 8):
        far.numbers = (0.0, 0.0, 0.0, 0.0, 0.0, math.sin(0.5 * k), math.cos(0.5 * k))
        deadline = monotonic() + 5.0
        while abs(robot.observe().joints[angle] - k) > 1e-9:
            assert monotonic() < deadline, (k, robot.observe().joints[angle])


def test_fingers_and_stale_speeds_are_as_the_interface_says(started):
    robot, far = started(Scripted)
    robot.apply({"bot/pan:velocity": 0.5}, 0.01, stamp=robot.time)
    robot.apply({"bot/pan:velocity": 0.5}, 0.01, stamp=robot.time - 9.0)
    robot.apply({}, 0.01)
    deadline, sent = monotonic() + 5.0, []
    while len(sent) < 3 and monotonic() < deadline:
        sent = [message.controllers for message in far.heard if isinstance(message, Speeds)]
    assert sent == [((0.0, 0.5),), ((0.0, 0.0),), ((0.0, 0.0),)]
    with pytest.raises(InvalidValueError, match="finite"):
        robot.apply({"bot/pan:velocity": math.nan}, 0.01)
    with pytest.raises(KineverseError, match="no free speed"):
        robot.apply({"bot/nothing:velocity": 0.0}, 0.01)


def make_path(model, *values, seconds=0.2):
    rows = np.array([[v] for v in values])
    return Trajectory((model.symbol("bot/pan"),), np.linspace(0.0, seconds, len(rows)), rows, 0.0 * rows)


def test_a_path_is_followed_to_its_end(started):
    robot, far = started(Simulated, omni=False)
    reported = []
    robot.follow(make_path(robot.model, 0.0, 0.2), report=reported.append)
    assert far.world.state["bot/pan"] == pytest.approx(0.2, abs=0.01)
    assert reported == sorted(reported)


@pytest.mark.parametrize("why", ["stays behind", "leaves", "silent", "interrupted"])
def test_a_path_is_given_up(started, why, monkeypatch):
    robot, far = started(Scripted)
    monkeypatch.setattr(ros_robot, "_LAG", 0.05)
    robot.timeout = 0.08 if why == "silent" else robot.timeout
    monkeypatch.setattr(ros_robot, "_ARRIVAL", 0.05)
    path = make_path(robot.model, 0.2, 0.6) if why == "leaves" else make_path(robot.model, 0.2, 0.25)

    def report(time):
        if why == "silent":
            far.until = 0.0
        elif why == "interrupted":
            raise KeyboardInterrupt

    match = {
        "stays behind": "still 0.05",
        "leaves": "left its path",
        "silent": "readings are",
        "interrupted": None,
    }
    error = KeyboardInterrupt if why == "interrupted" else SimulationError
    with pytest.raises(error, match=match[why]):
        robot.follow(path, report=report)
    robot.apply({}, 0.02)
    kinds = [type(message) for message in far.heard]
    assert kinds.count(Follow) == 1
    last = [message for message in far.heard if isinstance(message, Beat)][-1]
    assert not last.follows


def test_paths_of_other_things_and_from_elsewhere_are_refused(started):
    robot, _ = started(Scripted)
    base = Trajectory((robot.robot.planar_base[0],), np.zeros(1), np.zeros((1, 1)), np.zeros((1, 1)))
    with pytest.raises(InvalidValueError, match="bot/base/x; a controller of trajectories moves joints"):
        robot.follow(base)
    with pytest.raises(InvalidValueError, match=r"begins 0\.7 from where 'bot/pan' is"):
        robot.follow(make_path(robot.model, 0.9, 1.0))


class Complaining(Far):
    def begin(self) -> None:
        self.link.send(Note("Nobody publishes /joint_states."))
        super().begin()


class Broken(Far):
    def begin(self) -> None:
        self.link.send(Note("ROS 2 cannot be imported.", fatal=True))


@pytest.mark.parametrize(
    ("kind", "match"),
    [
        (Complaining, "'bot' has not reported for 0.1 s. Nobody publishes /joint_states."),
        (Broken, "cannot be imported"),
    ],
)
def test_a_robot_that_does_not_report_is_an_error_with_what_is_missing(started, kind, match, monkeypatch):
    monkeypatch.setattr(ros_robot, "_WAIT", 0.1)
    with pytest.raises(OfflineError, match=match):
        started(kind)


def test_without_ros_that_is_said(monkeypatch):
    monkeypatch.setattr(ros_robot, "_has_ros", lambda: False)
    monkeypatch.delenv(ros_robot.PYTHON, raising=False)
    with pytest.raises(MissingDependencyError, match="KINEVERSE_ROS_PYTHON"):
        RosRobot(load_robot(), "bot")
    monkeypatch.setenv(ros_robot.PYTHON, "/nowhere/python")
    with pytest.raises(MissingDependencyError, match="/nowhere/python cannot be started"):
        RosRobot(load_robot(), "bot")


SETTINGS = """
joint_states = "robot/joint_states"
joints = { "bot/pan" = "head_pan" }
frames = { "bot/camera" = "head" }
timeout = 0.05

[base]
command = "robot/cmd_vel"
fixed = "map"
frame = "base_link"

[controllers]
neck = ["head_pan"]
body = ["lift"]

[observed]
door = "tags/door"
wall = "tf:tag_7"
"""


def test_settings_name_topics_joints_and_frames(tmp_path):
    path = tmp_path / "robot.toml"
    path.write_text(SETTINGS)
    settings = read_settings(path)
    names = connect(load_robot(), **{key: getattr(settings, key) for key in settings.__struct_fields__})
    wiring = names.wiring
    assert wiring.joint_states == "robot/joint_states"
    assert wiring.odometry == ("map", "base_link")
    assert wiring.controllers == (("neck/commands", 1), ("body/commands", 1))
    assert [[str(v) for v in group] for group in names.controllers] == [
        ["bot/pan:velocity"],
        ["bot/lift:velocity"],
    ]
    assert (wiring.poses, wiring.transforms) == ({"door": "tags/door"}, {"tag_7": "wall"})
    assert (wiring.frames["map"], wiring.frames["head"]) == ("world", "bot/camera")
    assert "door" not in wiring.frames  # whose place no readings say
    assert wiring.timeout == 0.05
    assert names.frame_in_base[0, 3] == 0.1


def test_without_settings_one_controller_has_all_joints_sorted_by_name():
    model = load_robot().copy()
    with model.edit() as edit:
        edit.apply(
            kv.Revolute(name="bot/arm", parent="bot/column", child="bot/hand", axis=(0, 0, 1), velocity=1.0)
        )
    names = connect(model, joints={"bot/arm": "z_arm"})
    assert names.wiring.controllers == (("velocity_controller/commands", 3),)
    assert [[str(v.position) for v in group] for group in names.controllers] == [
        ["bot/arm", "bot/lift", "bot/pan"]
    ]


def test_the_settings_on_the_page_can_be_read(tmp_path):
    page = (Path(__file__).parents[2] / "docs" / "ros.md").read_text()
    (block,) = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
    path = tmp_path / "robot.toml"
    path.write_text(block)
    settings = read_settings(path)
    assert {name for name in settings.__struct_fields__ if not getattr(settings, name)} == set()


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("speed = 1", "unknown field 'speed'.*The keys are joint_states"),
        ("base = 3", "Expected 'object', got 'int'"),
        ("[base]\nwheels = 2", "unknown field 'wheels'.*'base'"),
        ("joint_states =", "not TOML"),
        ("timeout = 0.5", "up to 0.1"),
        ("[controllers]\na = ['lift', 'pam']", "has 'pam', and no joint of 'bot' .* Did you mean 'pan'"),
        ("[controllers]\na = ['lift', 'pan']\nb = ['pan']", "'pan' is in 'a' and in 'b'"),
        ("[controllers]\na = ['lift']", "no controller moves pan"),
        ("[joints]\n'bot/nothing' = 'x'", "names nothing"),
        ("[joints]\n'bot/pan' = 'lift'", "would both be 'lift'"),
        ("[base]\nframe = 'column'", "no frame of that name that stands still on its base"),
        ("[base]\njoints = ['x', 'y']", "has 2 names; the base of 'bot' has the coordinates"),
        ("joint_states = 'joint states'", "'joint states' is no name of a topic"),
        ("[controllers]\n'2nd' = ['lift', 'pan']", "'2nd/commands' is no name of a topic"),
        ("[observed]\nnowhere = 'x'", "there is no frame 'nowhere'"),
        ("[observed]\ndoor = 'tf:a'\nwall = 'tf:a'", "'tf:a' stands for 'door' and for 'wall'"),
        ("[observed]\ndoor = 'tf:'", "'tf:' is no name of a topic"),
    ],
)
def test_bad_settings_are_one_error_each(started, tmp_path, text, match):
    path = tmp_path / "robot.toml"
    path.write_text(text)
    with pytest.raises(KineverseError, match=match):
        started(Scripted, path=path)


def test_a_base_that_joint_states_say_needs_no_tf(started):
    class Reading(Scripted):
        numbers, joints = None, (0.5, 1.0, 2.0, 0.1, 0.2)

    robot, far = started(Reading, base=BaseSettings(joints=("odom_x", "odom_y", "odom_t")))
    assert far.wiring.odometry is None
    joints = {str(s): v for s, v in robot.observe().joints.items()}
    assert dict(zip(far.wiring.read, Reading.joints, strict=True)) == joints
    assert kv.position("bot/base/x") in robot.observe().joints
