"""Robot node: a process between a skill and a robot, which stops the robot when either is silent.

It forwards what a skill commands, and what the robot reports. It keeps the last time of both: a robot whose
skill is killed, stopped or hangs gets zero speeds, and so does one whose own readings do not come any more.
Many velocity controllers keep their last command for ever, so the node has a guard, a second process that
knows of each command and stops the robot if the node itself is gone.
"""

from __future__ import annotations

import math
import os
import select
import signal
import socket
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from functools import partial
from time import sleep
from typing import Any

import msgspec

from kineverse.errors import KineverseError, list_some
from kineverse.lie import Array

from .inputs import SECOND, Complaints, JointStateFilter, StampCheck, Topics
from .names import NameMap
from .robot_link import Beat, End, Follow, Link, Note, Pose, Readings, Speeds, Start, Wiring, now
from .ros import import_ros
from .transforms import TransformTree, from_matrix, nanoseconds, to_matrix, to_numbers

_NEWEST = 10  # depth of queues: of a few publishers, and no more, since what is old is of no use
_POLL, _SPIN = 0.003, 0.2  # times between two looks for messages, and for timers [s]
_MOST_POSES = 1000  # that wait for readings
_BEAT = 0.02  # time between two signs of life, and between two zeros [s]
_ZEROS = 5  # how often a stop is said, since a message may be lost
_PROGRAM = f"""\
import sys
try:
    from {__name__} import main
except ImportError as error:
    sys.exit(f"kineverse: the robot node cannot be imported by {{sys.executable}}: {{error}}.")
main()
"""
_HOLDING = 0.1  # time in which a joint that followed a path comes to rest [s]


class Watchdog:
    """Watch on a skill and a robot: while it has moved the robot, neither is silent for longer than a time.

    Attributes
    ----------
    moves
        Whether the robot has been told to move.
    heard, read
        Times of the last command, and of the latest readings [s].
    """

    def __init__(self, timeout: float) -> None:
        self.timeout, self.moves = timeout, False
        self.heard = self.read = -math.inf

    @property
    def until(self) -> float:
        """Time from which on the robot has to stand [s]; infinite if it stands."""
        return min(self.heard, self.read) + self.timeout if self.moves else math.inf

    def explain(self, time: float, heard: float) -> str:
        """Return why the robot must not move at a time by a command of another one [s]; empty if it may."""
        if math.isinf(self.read):
            return "Not all of the robot has been read yet."
        if time - self.read >= self.timeout:
            return f"The robot's readings are {time - self.read:.2f} s old."
        if time - heard >= self.timeout:
            return f"The last command, or the readings for it, are {time - heard:.2f} s old."
        return ""


class Commands:
    """Publishers of what moves a robot."""

    def __init__(self, ros: Any, node: Any, wiring: Wiring) -> None:
        self._ros = ros
        self._counts = [count for _, count in wiring.controllers]
        self._base = None
        if wiring.command is not None:
            self._base = node.create_publisher(ros.Twist, wiring.command, 1)
        self._controllers = [
            node.create_publisher(ros.Float64MultiArray, topic, 1) for topic, _ in wiring.controllers
        ]
        self._path = node.create_publisher(ros.JointTrajectory, wiring.trajectory, 1)

    def fit(self, speeds: Speeds) -> bool:
        """Return whether speeds are finite, and as many as the controllers have."""
        counts = [len(values) for values in speeds.controllers]
        numbers = [*speeds.base, *(value for values in speeds.controllers for value in values)]
        return counts == self._counts and len(speeds.base) == 3 and all(map(math.isfinite, numbers))

    def move(self, base: Sequence[float], controllers: Iterable[Sequence[float]]) -> None:
        """Publish the speed of the base, and those of the controllers."""
        if self._base is not None:
            twist = self._ros.Twist()
            twist.linear.x, twist.linear.y, twist.angular.z = base
            self._base.publish(twist)
        for publisher, values in zip(self._controllers, controllers, strict=True):
            publisher.publish(self._ros.Float64MultiArray(data=list(values)))

    def stop(self, hold: tuple[Sequence[str], Sequence[float]] = ((), ())) -> None:
        """Publish zero speeds, and the end of a path where its joints are now."""
        self.move((0.0, 0.0, 0.0), [[0.0] * count for count in self._counts])
        if hold[0]:
            self.follow(hold[0], [_HOLDING], [hold[1]], [[0.0] * len(hold[1])])

    def follow(
        self,
        joints: Sequence[str],
        times: Sequence[float],
        positions: Sequence[Sequence[float]],
        velocities: Sequence[Sequence[float]],
    ) -> None:
        """Publish a path with times from now [s]."""
        path = self._ros.JointTrajectory(joint_names=list(joints))
        for time, position, velocity in zip(times, positions, velocities, strict=True):
            point = self._ros.JointTrajectoryPoint(positions=list(position), velocities=list(velocity))
            point.time_from_start.sec, rest = divmod(round(time * SECOND), SECOND)
            point.time_from_start.nanosec = rest
            path.points.append(point)
        self._path.publish(path)


class RobotNode:
    """Node between a skill and a robot.

    What the robot reports is heard in the thread that calls :meth:`hear`. What the skill commands, and the
    watch on both, is the business of the one that calls :meth:`take` and :meth:`watch`.

    Parameters
    ----------
    ros
        Namespace of ROS.
    node
        Node of rclpy.
    tell
        Function that sends a message to the skill.
    beat
        Function that sends a sign of life to the guard.
    clock
        The steady clock of the messages.
    """

    def __init__(
        self,
        ros: Any,
        node: Any,
        wiring: Wiring,
        tell: Callable[[Any], object],
        beat: Callable[[Beat], object],
        clock: Callable[[], float] = now,
    ) -> None:
        self._node, self._wiring, self._tell, self._beat, self._clock = node, wiring, tell, beat, clock
        self.commands, self.watchdog = Commands(ros, node, wiring), Watchdog(wiring.timeout)
        self._complaints = Complaints(lambda text: tell(Note(text)))
        self._joints = NameMap(wiring.joints, wiring.joint_rules)
        self._filter = JointStateFilter(self._joints, wiring.read, self._complaints)
        self._stamps = StampCheck(self._complaints)
        self._tree, self._poses = TransformTree(), deque[Pose](maxlen=_MOST_POSES)
        self._positions: dict[str, tuple[float, float]] = {}  # with their times
        self._base: tuple[tuple[float, ...], float] | None = None
        self._base_stamp: int | None = None
        self._following: tuple[str, ...] = ()  # joints that follow a path
        self._zeros, self._due, self._beaten = 0, 0.0, -math.inf
        # What nobody serves of the others, this node says in words of its own, or it is no matter.
        topics, quiet = (
            Topics(node, complaints, self._ros_now, ros.STEADY)
            for complaints in (self._complaints, Complaints(lambda text: None))
        )
        self._topics = topics, quiet
        if wiring.read:
            topics.subscribe(ros.JointState, wiring.joint_states, self._hear_joints, _NEWEST)
        for frame, topic in wiring.poses.items():
            quiet.subscribe(ros.PoseStamped, topic, partial(self._hear_pose, frame), _NEWEST)
        for topic, quality, static in (("/tf", _NEWEST, False), ("/tf_static", ros.STATIC, True)):
            quiet.subscribe(ros.TFMessage, topic, partial(self._hear_transforms, static), quality)
        node.create_timer(1.0, self._name_missing, clock=ros.STEADY)

    # -- what the robot reports ------------------------------------------------------------------------------

    def hear(self) -> None:
        """Take what the robot has reported since the last call."""
        for topics in self._topics:
            topics.drain()

    def _ros_now(self) -> int:
        present = int(self._node.get_clock().now().nanoseconds)
        self._stamps.follow_clock(present)
        return present

    def _to_steady(self, stamp: int, present: int) -> float:
        """Return the time of a stamp in that of messages [s]; one ahead of the clock counts as of now."""
        return self._clock() - max(present - stamp, 0) / SECOND

    def _hear_joints(self, message: Any, source: str) -> None:
        present = self._ros_now()
        stamp = nanoseconds(message.header.stamp)
        found = self._filter.accept(source, stamp, message.name, message.position, message.velocity, present)
        if found is not None:
            time = self._to_steady(stamp, present)
            self._positions |= {name: (value, time) for name, value in found.positions.items()}
            self._report()

    def _hear_transforms(self, static: bool, message: Any, source: str) -> None:
        for one in message.transforms:
            self._tree.put(one, static)
            frame = self._wiring.transforms.get(one.child_frame_id)
            if frame is not None:
                numbers = to_numbers(one.transform.translation, one.transform.rotation)
                self._see(frame, f"'{one.child_frame_id}' in TF", one.header, numbers)
        if self._wiring.odometry is not None:
            fixed, moving = self._wiring.odometry
            found = self._tree.find(moving, (fixed,))
            if found is not None:
                self._hear_base(found[1], found[2])
            elif self._base is not None:
                text = f"TF has no way from '{fixed}' to '{moving}' any more, or one without numbers."
                self._complaints.add("base", text, self._ros_now())

    def _hear_base(self, stamp: int | None, pose: Array) -> None:
        present = self._ros_now()
        stamp = present if stamp is None else stamp
        if stamp != self._base_stamp and self._stamps.accepts("the base in TF", stamp, present):
            self._base, self._base_stamp = (from_matrix(pose), self._to_steady(stamp, present)), stamp
            if not self._wiring.read:
                self._report()

    def _hear_pose(self, frame: str, message: Any, source: str) -> None:
        numbers = to_numbers(message.pose.position, message.pose.orientation)
        self._see(frame, source, message.header, numbers)

    def _see(self, frame: str, source: str, header: Any, numbers: tuple[float, ...]) -> None:
        """Take an observed pose of a frame of the model."""
        present, stamp = self._ros_now(), nanoseconds(header.stamp)
        pose, parent = to_matrix(numbers), self._wiring.frames.get(header.frame_id)
        if pose is None:
            text = f"{source} has a pose that is none: {list_some((f'{v:g}' for v in numbers), 7)}."
            self._complaints.add(f"pose {source}", text, present)
            return
        if not self._stamps.accepts(source, stamp, present):
            return
        if parent is None:
            found = self._tree.find(header.frame_id, self._wiring.frames)
            if found is None:
                text = (
                    f"{source} is in the frame '{header.frame_id}'. The robot's readings do not say where "
                    "that is, nor does TF."
                )
                self._complaints.add(f"frame {source}", text, present)
                return
            parent, pose = self._wiring.frames[found[0]], found[2] @ pose
            numbers = from_matrix(pose)
        self._poses.append(Pose(frame, parent, self._to_steady(stamp, present), numbers))

    def _report(self) -> None:
        """Send the readings to the skill if there is one of everything."""
        wiring, positions = self._wiring, self._positions
        if len(positions) < len(wiring.read) or (wiring.odometry is not None and self._base is None):
            return
        read = [positions[name] for name in wiring.read]
        times = [time for _, time in read] + ([] if self._base is None else [self._base[1]])
        stamp = self.watchdog.read = min(times)
        poses = tuple(self._poses)
        self._poses.clear()
        base = None if self._base is None else self._base[0]
        self._tell(Readings(stamp, tuple(value for value, _ in read), base, poses))

    def _name_missing(self) -> None:
        """Say what has never been read."""
        wiring = self._wiring
        missing = [self._joints.to_ros(name) for name in wiring.read if name not in self._positions]
        if missing:
            topic = self._node.resolve_topic_name(wiring.joint_states)
            text = f"No position of {list_some(missing, 3)} has come on {topic}."
            self._complaints.add_once(text)
        if wiring.odometry is not None and self._base is None:
            fixed, moving = wiring.odometry
            self._complaints.add_once(f"TF has no way from '{fixed}' to '{moving}'.")
        topics = [
            topic for topic in wiring.poses.values() if not self._node.get_publishers_info_by_topic(topic)
        ]
        if topics:
            names = [self._node.resolve_topic_name(topic) for topic in topics]
            self._complaints.add_once(f"Nobody publishes the poses {list_some(names, 3)}.")

    # -- what the skill commands -----------------------------------------------------------------------------

    def take(self, message: Any) -> None:
        """Take a message of the skill."""
        time, watchdog = self._clock(), self.watchdog
        if isinstance(message, Beat):
            watchdog.heard = message.sent
            if self._following and not message.follows:
                self.stop()
            return
        watchdog.heard = message.sent  # readings that are too old do not make a skill silent
        if why := watchdog.explain(time, min(message.sent, message.stamp)):
            self.stop(f"A command is refused. {why}")
        elif not (self._fits(message) if isinstance(message, Follow) else self.commands.fit(message)):
            self.stop("A command is refused. It has numbers that are not finite, or too few or many of them.")
        elif isinstance(message, Follow):
            self._following, watchdog.moves, self._zeros = message.joints, True, 0
            self.commands.follow(message.joints, message.times, message.positions, message.velocities)
        else:
            self._following, self._zeros = (), 0
            self.commands.move(message.base, message.controllers)
            watchdog.moves = any(message.base) or any(map(any, message.controllers))
        self._live(time)

    def _fits(self, path: Follow) -> bool:
        """Return whether a path has finite numbers for joints that are read."""
        known = {self._joints.to_ros(name) for name in self._wiring.read}
        rows = [*path.positions, *path.velocities]
        return (
            known.issuperset(path.joints)
            and len(path.positions) == len(path.velocities) == len(path.times)
            and all(len(row) == len(path.joints) for row in rows)
            and all(math.isfinite(value) for row in (path.times, *rows) for value in row)
        )

    def stop(self, why: str = "") -> None:
        """Stop the robot, and say why."""
        time = self._clock()
        self.commands.stop(self._hold())
        self.watchdog.moves, self._following = False, ()
        self._zeros, self._due = _ZEROS - 1, time + _BEAT
        if why:
            self._complaints.add("stop", f"{why} The robot stops.", self._ros_now())
        self._live(time)

    def _hold(self) -> tuple[tuple[str, ...], tuple[float, ...]]:
        """Return the joints that follow a path, and where they are."""
        names = [self._joints.to_model(name) for name in self._following]
        return self._following, tuple(self._positions[name][0] for name in names if name is not None)

    def _live(self, time: float) -> None:
        self._beat(Beat(time, bool(self._following), self._hold(), self.watchdog.moves))
        self._beaten = time

    def watch(self) -> float:
        """Stop the robot if it is time to; return the time until the next look [s]."""
        time, watchdog = self._clock(), self.watchdog
        if time >= watchdog.until:
            self.stop(watchdog.explain(time, watchdog.heard))
        elif self._zeros and time >= self._due:
            self.commands.stop()
            self._zeros, self._due = self._zeros - 1, time + _BEAT
        elif watchdog.moves and time >= self._beaten + _BEAT:
            self._live(time)
        due = [watchdog.until]
        due += [self._due] if self._zeros else []
        due += [self._beaten + _BEAT] if watchdog.moves else []
        return min(max(min(due) - self._clock(), 0.0), 1.0)


def serve_skill(node: RobotNode, link: Link, guard: Link) -> None:
    """Take the messages of a skill until it is gone, or the guard; then the robot stands."""
    while True:
        ready, _, _ = select.select([link, guard], [], [], node.watch())
        try:
            if guard in ready:
                guard.receive()  # it says nothing more, so it is gone
            if link in ready:
                message = link.receive()
                if isinstance(message, End):
                    break
                node.take(message)
        except EOFError:
            if guard in ready:
                link.send(Note("The guard of the robot node has ended.", fatal=True))
            break
    node.stop()
    while node.watch() <= _BEAT:
        sleep(_BEAT)


def guard_robot(commands: Commands, link: Link, timeout: float) -> None:
    """Stop the robot when the robot node is gone, or silent for a time [s], while the robot moves."""
    last, zeros = Beat(-math.inf, False), 0
    while True:
        until = now() + _BEAT if zeros else last.sent + timeout if last.moves else None
        try:
            message = link.receive(None if until is None else max(until - now(), 0.0))
        except EOFError:
            for _ in range(_ZEROS):
                commands.stop(last.hold)
                sleep(_BEAT)
            return
        if isinstance(message, End):
            return
        if isinstance(message, Beat):
            last, zeros = message, 0
        else:
            commands.stop(last.hold)
            zeros = zeros - 1 if zeros else _ZEROS - 1
            last = msgspec.structs.replace(last, moves=False)


def main() -> None:
    """Run the node, or its guard, at the end of a link whose file descriptor is named."""
    role, descriptor = sys.argv[1:]
    link = Link(socket.socket(fileno=int(descriptor)))
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the skill ends first, and says what is next
    with suppress(OSError, AttributeError):  # where a user may: a busy machine does not make the robot stop
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
    try:
        wiring = link.receive().wiring
        run_guard(link, wiring) if role == "guard" else run_node(link, wiring)
    except EOFError:
        pass  # before anything has moved
    except KineverseError as error:
        link.send(Note(str(error), fatal=True))


def run_guard(link: Link, wiring: Wiring) -> None:
    """Guard a robot until the end of its node."""
    ros = import_ros()
    ros.rclpy.init(args=[], signal_handler_options=ros.NO_SIGNALS)
    commands = Commands(ros, ros.rclpy.create_node("kineverse_robot_guard"), wiring)
    link.send(Beat(now(), False))
    guard_robot(commands, link, wiring.timeout)
    ros.rclpy.shutdown()


def run_node(link: Link, wiring: Wiring) -> None:
    """Run the node until the end of the skill."""
    own, other = Link.pair()
    guard = start_process("guard", other, sys.executable)
    own.send(Start(wiring))
    ros = import_ros()
    words = ["--ros-args", "-p", f"use_sim_time:={str(wiring.use_sim_time).lower()}"]
    ros.rclpy.init(args=words, signal_handler_options=ros.NO_SIGNALS)
    node = ros.rclpy.create_node("kineverse_robot")
    robot = RobotNode(ros, node, wiring, link.send, own.send)
    own.receive()  # the guard is there
    link.send(Beat(now(), False))
    executor = ros.Executor()
    executor.add_node(node)
    over, due = threading.Event(), 0.0

    def serve() -> None:
        serve_skill(robot, link, own)
        own.send(End())
        over.set()

    threading.Thread(target=serve, daemon=True, name="skill").start()
    # An executor takes a millisecond for each message, so it is there for timers and /clock alone.
    while not over.wait(_POLL):
        robot.hear()
        if wiring.use_sim_time or now() >= due:
            executor.spin_once(timeout_sec=0.0)
            due = now() + _SPIN
    ros.rclpy.shutdown()
    guard.wait()


def start_process(role: str, end: socket.socket, python: str) -> subprocess.Popen[bytes]:
    """Start the node or its guard by a Python, in a session of its own, at the end of a link."""
    environment = dict(os.environ)
    if python != sys.executable:  # wheels of ROS set these for the Python that they are installed in
        for name in ("_ROS_WHEELS_BOOTSTRAP_COMPLETE", "LD_LIBRARY_PATH"):
            environment.pop(name, None)
    with end:
        words = [python, "-c", _PROGRAM, role, str(end.fileno())]
        return subprocess.Popen(
            words, pass_fds=[end.fileno()], env=environment, stdin=subprocess.DEVNULL, start_new_session=True
        )
