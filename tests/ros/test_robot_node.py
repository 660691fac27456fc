"""The robot node on a small ROS in this process: what it forwards, and when it stops the robot."""

from __future__ import annotations

import math
import threading

import msgspec
import numpy as np
import pytest
from fake_rclpy import SECOND, FakeRos
from robots import connect, load_robot

from kineverse_ros.robot_link import Beat, End, Follow, Link, Note, Readings, Speeds, Start, now
from kineverse_ros.robot_node import Commands, RobotNode, guard_robot, serve_skill
from kineverse_ros.transforms import make_transform

POSE = (1.0, 2.0, 0.0, 0.0, 0.0, math.sin(0.25), math.cos(0.25))
TIMEOUT = 0.08


class Bench:
    """A robot node, and what arrives at its robot, its skill and its guard."""

    def __init__(self, **settings) -> None:
        self.ros = FakeRos()
        self.told, self.beats, self.twists, self.speeds, self.paths = [], [], [], [], []
        self.wiring = connect(load_robot(), **settings).wiring
        self.node = RobotNode(
            self.ros,
            self.ros.rclpy.create_node("kineverse_robot"),
            self.wiring,
            self.told.append,
            self.beats.append,
            self.now,
        )
        self.robot = self.ros.rclpy.create_node("robot")
        for kind, topic, heard in (
            ("Twist", "cmd_vel", self.twists),
            ("Float64MultiArray", "velocity_controller/commands", self.speeds),
            ("JointTrajectory", "joint_trajectory_controller/joint_trajectory", self.paths),
        ):
            self.robot.create_subscription(getattr(self.ros, kind), topic, heard.append, 1)
        self.publishers = {}

    def now(self) -> float:
        return self.ros.nanoseconds / SECOND

    @property
    def notes(self) -> list[str]:
        return [message.text for message in self.told if isinstance(message, Note)]

    @property
    def readings(self) -> list[Readings]:
        return [message for message in self.told if isinstance(message, Readings)]

    def publish(self, topic, message) -> None:
        if topic not in self.publishers:
            kind = type(message)
            self.publishers[topic] = self.robot.create_publisher(kind, topic, self.ros.QUEUED)
        self.publishers[topic].publish(message)
        self.ros.deliver()

    def stamp(self, age: float):
        time = self.ros.nanoseconds - round(age * SECOND)
        return self.ros.Time(sec=time // SECOND, nanosec=time % SECOND)

    def say_joints(self, names=("lift", "pan"), positions=(0.5, 0.1), age=0.0) -> None:
        message = self.ros.JointState(name=list(names), position=list(positions))
        message.header.stamp = self.stamp(age)
        self.publish("joint_states", message)

    def say_base(self, pose=POSE, age=0.0, frames=("odom", "base_link")) -> None:
        time = self.ros.nanoseconds - round(age * SECOND)
        message = self.ros.TFMessage(transforms=[make_transform(self.ros, frames, time, pose)])
        self.publish("/tf", message)

    def say_all(self) -> None:
        self.say_base()
        self.say_joints()

    def say_pose(self, frame="odom", age=0.0, x=2.0, w=1.0) -> None:
        message = self.ros.PoseStamped()
        message.header.stamp, message.header.frame_id = self.stamp(age), frame
        message.pose.position.x, message.pose.orientation.w = x, w
        self.publish("poses/door", message)

    def command(self, base=(0.1, 0.2, 0.3), speeds=(0.4, 0.5), age=0.0, stamp_age=0.0) -> None:
        now = self.now()
        self.node.take(Speeds(now - age, now - stamp_age, base, (speeds,)))
        self.ros.deliver()

    def run(self, seconds, *, reads=True, commands=False) -> None:
        """Let time pass in steps of 5 ms, in which the node looks at its watch."""
        for _ in range(round(seconds / 0.005)):
            self.ros.advance(0.005)
            if reads:
                self.say_all()
            if commands:
                self.command()
            self.node.watch()
            self.ros.deliver()

    @property
    def stands(self) -> bool:
        """Whether the last commands that have arrived are zero."""
        last = self.twists[-1]
        return not any((last.linear.x, last.linear.y, last.angular.z, *self.speeds[-1].data))


@pytest.fixture
def bench() -> Bench:
    result = Bench()
    result.say_all()
    return result


def test_speeds_arrive_as_a_twist_and_in_the_order_of_the_controller(bench):
    bench.command()
    assert (bench.twists[0].linear.x, bench.twists[0].linear.y, bench.twists[0].angular.z) == (0.1, 0.2, 0.3)
    assert bench.speeds[0].data == [0.4, 0.5]


def test_readings_are_complete_and_carry_their_oldest_stamp():
    bench = Bench()
    bench.say_joints(["lift"], [0.5], age=0.02)
    bench.say_joints(["pan", "elsewhere"], [0.1, 9.0], age=0.01)
    assert not bench.readings  # where is the base?
    bench.say_base(age=0.005)
    bench.say_joints(["pan"], [0.2])
    (readings,) = bench.readings
    assert readings.joints == (0.5, 0.2)
    assert readings.stamp == pytest.approx(bench.now() - 0.02)
    np.testing.assert_allclose(readings.base, POSE)


def test_the_base_is_composed_over_tf_and_static_transforms(bench):
    turn = (0.0, 0.0, math.sin(0.5), math.cos(0.5))
    bench.say_base((1.0, 0.0, 0.0, *turn), frames=("odom", "footprint"))
    static = make_transform(bench.ros, ("footprint", "base_link"), 0, (0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0))
    bench.publish("/tf_static", bench.ros.TFMessage(transforms=[static]))
    bench.ros.advance(0.01)
    bench.say_base((1.0, 0.0, 0.0, *turn), frames=("odom", "footprint"))
    bench.say_joints()
    expected = (1.0 + 0.5 * math.cos(1.0), 0.5 * math.sin(1.0), 0.0, *turn)
    np.testing.assert_allclose(bench.readings[-1].base, expected, atol=1e-12)


def test_the_robot_stands_when_the_skill_is_silent(bench):
    bench.command()
    bench.run(TIMEOUT - 0.01)
    assert not bench.stands
    bench.run(0.015)
    assert bench.stands
    assert bench.notes == ["The last command, or the readings for it, are 0.08 s old. The robot stops."]
    count = len(bench.twists)
    bench.run(1.0)
    assert (
        count + 1 < len(bench.twists) < count + 10
    )  # said again, since a message may be lost, but not for ever


@pytest.mark.parametrize("silent", ["joints", "base"])
def test_the_robot_stands_when_its_readings_are_silent(bench, silent):
    for _ in range(15):
        bench.ros.advance(0.01)
        if silent == "joints":
            bench.say_base()
        else:
            bench.say_joints()
        bench.command()
        bench.node.watch()
        bench.ros.deliver()
        if bench.stands:
            break
    assert bench.now() == pytest.approx(1000.0 + TIMEOUT)
    assert "The robot's readings are 0.08 s old. The robot stops." in bench.notes[-1]
    bench.say_all()
    bench.command()
    assert not bench.stands


@pytest.mark.parametrize(
    ("command", "why"),
    [
        ({"age": 0.2}, "0.20 s old"),
        ({"stamp_age": 0.2}, "0.20 s old"),
        ({"base": (math.nan, 0.0, 0.0)}, "not finite"),
        ({"speeds": (0.1, math.inf)}, "not finite"),
        ({"speeds": (0.1,)}, "too few"),
    ],
)
def test_bad_commands_are_never_forwarded_and_stop_the_robot(bench, command, why):
    bench.command()
    bench.command(**command)
    assert bench.stands
    assert len(bench.notes) == 1
    assert why in bench.notes[0]
    assert all(math.isfinite(v) for one in bench.speeds for v in one.data)


def test_nothing_moves_before_all_has_been_read():
    bench = Bench()
    bench.command()
    assert bench.stands
    assert bench.notes == ["A command is refused. Not all of the robot has been read yet. The robot stops."]


def test_poses_come_in_frames_that_readings_or_tf_place(bench):
    bench.say_pose()
    bench.say_pose("camera", x=1.0)
    eye = make_transform(bench.ros, ("camera", "optical"), 0, (0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0))
    bench.publish("/tf_static", bench.ros.TFMessage(transforms=[eye]))
    bench.say_pose("optical", x=1.0)
    bench.say_pose("door")  # which moves as nobody knows
    bench.say_pose("nowhere")
    bench.say_pose(w=0.0)
    bench.say_pose(x=math.nan)
    bench.say_pose(age=5.0)
    bench.say_joints()
    poses = bench.readings[-1].poses
    assert [(pose.frame, pose.parent, pose.numbers[0]) for pose in poses] == [
        ("door", "world", 2.0),
        ("door", "bot/camera", 1.0),
        ("door", "bot/camera", 1.5),
    ]
    told = " ".join(bench.notes)
    for part in ("the frame 'door'", "a pose that is none", "it is 5 s old"):
        assert part in told


def test_markers_in_tf_are_poses(bench):
    bench = Bench(observed={"door": "tf:tag_3"})
    bench.say_all()
    bench.say_base((2.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0), frames=("camera", "tag_3"))
    bench.say_joints()
    (pose,) = bench.readings[-1].poses
    assert (pose.frame, pose.parent, pose.numbers[0]) == ("door", "bot/camera", 2.0)


@pytest.mark.parametrize(("pose", "parent"), [(POSE, "lost"), ((math.nan, *POSE[1:]), "odom")])
def test_a_way_in_tf_that_is_lost_is_said_and_stops_the_robot(bench, pose, parent):
    bench.command()
    for _ in range(20):
        bench.ros.advance(0.005)
        bench.say_joints()
        bench.say_base(frames=("base_link", "lost"))
        bench.say_base(pose, frames=(parent, "base_link"))
        bench.node.watch()
    bench.ros.deliver()
    assert bench.stands
    assert bench.notes[0] == "TF has no way from 'odom' to 'base_link' any more, or one without numbers."


def test_a_clock_that_is_set_back_begins_anew(bench):
    bench.ros.nanoseconds -= 500 * SECOND
    bench.say_all()
    bench.say_pose()
    bench.say_joints()
    assert bench.readings[-1].poses
    assert bench.notes == ["The clock was set back by 500 s."]


def test_what_is_missing_is_said():
    bench = Bench()
    bench.ros.advance(5.0)
    told = " ".join(bench.notes)
    for part in (
        "No position of lift, pan has come on /joint_states.",
        "TF has no way from 'odom' to 'base_link'.",
        "Nobody publishes /joint_states",
        "Nobody publishes the poses /poses/door.",
    ):
        assert part in told


def test_a_path_is_given_up_where_its_joints_are(bench):
    path = Follow(bench.now(), bench.now(), ("pan",), (0.5, 1.5), ((0.2,), (0.4,)), ((0.2,), (0.0,)))
    bench.node.take(path)
    bench.ros.deliver()
    (sent,) = bench.paths
    assert [p.time_from_start.sec + p.time_from_start.nanosec / SECOND for p in sent.points] == [0.5, 1.5]
    for _ in range(10):
        bench.run(0.02)
        bench.node.take(Beat(bench.now(), True))
    assert len(bench.paths) == 1
    assert bench.beats[-1].hold == (("pan",), (0.1,))
    bench.run(TIMEOUT + 0.01)
    last = bench.paths[-1]
    assert last.joint_names == ["pan"]
    assert [(p.positions, p.velocities) for p in last.points] == [([0.1], [0.0])]


def test_a_path_is_given_up_when_the_skill_says_so(bench):
    bench.node.take(Follow(bench.now(), bench.now(), ("pan",), (1.0,), ((0.2,),), ((0.0,),)))
    bench.node.take(Beat(bench.now(), False))
    bench.ros.deliver()
    assert [path.points[0].positions for path in bench.paths] == [[0.2], [0.1]]


@pytest.mark.parametrize(
    ("joints", "times", "positions", "velocities"),
    [
        (("pan",), (1.0,), ((math.nan,),), ((0.0,),)),
        (("pan",), (1.0,), ((0.2,),), ((math.inf,),)),
        (("pan",), (1.0,), ((0.2, 0.3),), ((0.0,),)),
        (("pan",), (1.0, 2.0), ((0.2,),), ((0.0,),)),
        (("nothing",), (1.0,), ((0.2,),), ((0.0,),)),
    ],
)
def test_bad_paths_are_never_forwarded(bench, joints, times, positions, velocities):
    bench.node.take(Follow(bench.now(), bench.now(), joints, times, positions, velocities))
    bench.ros.deliver()
    assert not bench.paths
    assert "A command is refused" in bench.notes[0]


def test_a_bad_command_gives_up_a_path(bench):
    bench.node.take(Follow(bench.now(), bench.now(), ("pan",), (1.0,), ((0.2,),), ((0.0,),)))
    bench.command((math.nan, 0.0, 0.0))
    assert [path.points[0].positions for path in bench.paths] == [[0.2], [0.1]]


def test_the_guard_is_told_of_motion_alone(bench):
    bench.command()
    assert bench.beats[-1].moves
    bench.run(0.06, commands=True)
    assert all(beat.moves for beat in bench.beats)
    bench.command((0.0, 0.0, 0.0), (0.0, 0.0))
    assert not bench.beats[-1].moves
    count = len(bench.beats)
    bench.run(0.3)
    assert len(bench.beats) == count


@pytest.mark.parametrize("end", ["killed", "stopped", "good-bye", "at rest"])
def test_the_guard_stops_the_robot_of_a_node_that_is_gone(end):
    ros, arrived = FakeRos(), []
    wiring = connect(load_robot()).wiring
    ros.rclpy.create_node("robot").create_subscription(ros.Twist, "cmd_vel", arrived.append, 1)
    commands = Commands(ros, ros.rclpy.create_node("guard"), wiring)
    link, other = Link.pair()
    far = Link(other)
    guard = threading.Thread(target=guard_robot, args=(commands, far, 0.03))
    guard.start()
    link.send(Beat(now(), False, moves=end != "at rest"))
    if end == "stopped":
        deadline = now() + 5.0
        while len(arrived) < 5 and now() < deadline:
            ros.deliver()
        guard.join(0.1)
        ros.deliver()
        assert len(arrived) == 5
    elif end == "good-bye":
        link.send(End())
    link.close()
    guard.join(5.0)
    far.close()
    ros.deliver()
    assert not guard.is_alive()
    assert bool(arrived) == (end != "good-bye")


def test_messages_survive_the_link_and_a_full_one_drops_them():
    link, other = Link.pair()
    end = Link(other)
    start = Start(connect(load_robot()).wiring)
    assert link.send(start)
    assert end.receive(1.0) == start
    assert end.receive(0.0) is None
    sent = 0
    while link.send(Note("x" * 10_000)) and sent < 10_000:
        sent += 1
    assert 10 < sent < 10_000
    link.close()
    for _ in range(sent):
        end.receive(1.0)
    with pytest.raises(EOFError):
        end.receive(1.0)
    assert not end.send(End())
    end.close()


@pytest.mark.parametrize("gone", ["skill", "guard"])
def test_the_robot_stands_when_the_skill_or_the_guard_is_gone(gone):
    ros, arrived = FakeRos(), []
    ros.rclpy.create_node("robot").create_subscription(ros.Twist, "cmd_vel", arrived.append, 1)
    (skill, node_end), (guard, guard_end) = Link.pair(), Link.pair()
    near, far = Link(node_end), Link(guard_end)
    wiring = msgspec.structs.replace(connect(load_robot()).wiring, timeout=5.0)
    node = RobotNode(ros, ros.rclpy.create_node("node"), wiring, near.send, guard.send)
    node.watchdog.read = now() + 100.0
    skill.send(Speeds(now(), now(), (0.1, 0.0, 0.0), ((0.0, 0.0),)))
    thread = threading.Thread(target=serve_skill, args=(node, near, guard))
    thread.start()
    assert far.receive(5.0).moves
    (skill if gone == "skill" else far).close()
    thread.join(5.0)
    ros.deliver()
    assert not thread.is_alive()
    assert arrived[0].linear.x == 0.1
    assert {message.linear.x for message in arrived[1:]} == {0.0}
    if gone == "guard":
        assert skill.receive(1.0) == Note("The guard of the robot node has ended.", fatal=True)
    for link in (skill, near, guard, far):
        link.close()
