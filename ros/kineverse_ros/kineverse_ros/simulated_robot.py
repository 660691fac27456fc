"""A simulated world behind the topics of a robot, in real time, for trials of skills without a robot.

It says what a robot says: joint states, odometry in TF, and poses of marked frames as a camera would. It
takes a Twist, speeds of velocity controllers, and paths. Like most velocity controllers it keeps the last
command for ever.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from time import monotonic
from typing import Any, Literal

import numpy as np

from kineverse.cli.plan_arguments import parse_robot
from kineverse.compilation import compile
from kineverse.errors import KineverseError, UnknownNameError
from kineverse.lie import Array
from kineverse.manipulation import place_robot
from kineverse.model.frame import WORLD
from kineverse.model.model import Model
from kineverse.planning.trajectories.trajectory import Trajectory
from kineverse.symbols import Symbol
from kineverse.worlds import KinematicWorld, Observation, Robot, Sensors, SimulatedWorld

from .inputs import SECOND, Complaints
from .robot_settings import RobotConnection, RobotSettings, connect_names, read_settings
from .ros import import_ros
from .transforms import from_matrix, make_transform, nanoseconds, to_stamp

_PERIOD = 0.01  # time between two joint states [s]
_LONGEST = 0.05  # longest step: a world that is slower than that per step is slower than real time [s]
_WORLDS = ("kinematic", "mujoco")


class SimulatedRobot:
    """World behind topics; :meth:`step` lets time pass.

    Parameters
    ----------
    ros
        Namespace of ROS.
    node
        Node of rclpy.
    world
        The world, in the state of the start.
    names
        The robot in terms of topics.
    """

    def __init__(self, ros: Any, node: Any, world: SimulatedWorld, names: RobotConnection) -> None:
        self._ros, self._node, self._world, self._names = ros, node, world, names
        self._complaints = Complaints(node.get_logger().warning)
        wiring, robot, model = names.wiring, world.robot, world.model
        self._speeds: dict[Symbol, float] = dict.fromkeys(robot.speeds, 0.0)
        self._twist: Array = np.zeros(3)
        self._path: tuple[Trajectory, float] | None = None  # with the time of the world at which it began
        self._read = [model.symbol(name) for name in wiring.read]
        self._moved = {str(v.position): v.position for group in names.controllers for v in group}
        self._joint_names = [names.joints.to_ros(name) for name in wiring.read]
        self._joints = node.create_publisher(ros.JointState, wiring.joint_states, ros.QUEUED)
        self._frames = {frame: name for name, frame in wiring.frames.items()}
        self._transforms = None
        if wiring.odometry is not None or wiring.transforms:
            self._transforms = node.create_publisher(ros.TFMessage, "/tf", ros.QUEUED)
        self._seen_in_tf = {frame: name for name, frame in wiring.transforms.items()}
        self._poses = {
            frame: node.create_publisher(ros.PoseStamped, topic, ros.QUEUED)
            for frame, topic in wiring.poses.items()
        }
        if robot.base is not None:
            parent, frame = robot.base.parent, names.base_frame
            self._place = compile(model.fk(frame, relative_to=parent))
            jacobian = model.jacobian(frame, relative_to=parent, form="body", symbols=names.base_speeds)
            self._jacobian = compile(jacobian)
        if wiring.command is not None:
            node.create_subscription(ros.Twist, wiring.command, self._take_twist, 1)
        for (topic, _), speeds in zip(wiring.controllers, names.controllers, strict=True):
            node.create_subscription(
                ros.Float64MultiArray, topic, partial(self._take_speeds, topic, speeds), 1
            )
        node.create_subscription(ros.JointTrajectory, wiring.trajectory, self._take_path, 1)

    # -- what is commanded ---------------------------------------------------------------------------------

    def _refuse(self, text: str) -> None:
        self._complaints.add(text, text, self._now())

    def _now(self) -> int:
        return int(self._node.get_clock().now().nanoseconds)

    def _take_twist(self, message: Any) -> None:
        twist = np.array([message.linear.x, message.linear.y, message.angular.z])
        if not np.isfinite(twist).all():
            self._refuse("A Twist is not finite, and refused.")
            return
        self._twist = twist

    def _take_speeds(self, topic: str, speeds: Sequence[Symbol], message: Any) -> None:
        values = list(message.data)
        if len(values) != len(speeds) or not all(map(math.isfinite, values)):
            self._refuse(f"{topic} takes {len(speeds)} finite speeds; others are refused.")
            return
        self._speeds |= dict(zip(speeds, values, strict=True))

    def _take_path(self, message: Any) -> None:
        joints = [self._names.joints.to_model(name) for name in message.joint_names]
        symbols = tuple(self._moved[name] for name in joints if name in self._moved)
        times = [nanoseconds(point.time_from_start) / SECOND for point in message.points]
        rest, now = [0.0] * len(symbols), self._world.state
        points = [(list(one.positions), list(one.velocities) or rest) for one in message.points]
        positions, velocities = zip(([now[s] for s in symbols], rest), *points, strict=True)
        if len(symbols) < len(joints) or any(len(row) != len(symbols) for row in (*positions, *velocities)):
            self._refuse("A path is refused: it has joints that no controller moves, or not their numbers.")
            return
        try:
            path = Trajectory(symbols, np.array([0.0, *times]), np.array(positions), np.array(velocities))
        except KineverseError as error:
            self._refuse(f"A path is refused: {error}")
            return
        self._path = path, self._world.time

    # -- time ----------------------------------------------------------------------------------------------

    def step(self, duration: float) -> None:
        """Let the world move for a duration [s], and publish what the robot says then."""
        speeds, world = dict(self._speeds), self._world
        state = world.state
        base = self._names.base_speeds
        if base:
            jacobian = self._jacobian(state.vector(self._jacobian.inputs))[[0, 1, 5]]
            moved = np.linalg.lstsq(jacobian, self._twist, rcond=None)[0]
            speeds |= dict(zip(base, moved.tolist(), strict=True))
        if self._path is not None:
            path, begin = self._path
            wanted = path.positions_at(world.time - begin + duration)
            speeds |= {
                s.derivative(): (float(to) - state[s]) / duration
                for s, to in zip(path.symbols, wanted, strict=True)
            }
            if world.time - begin >= path.duration:
                self._path = None
        world.apply(speeds, duration)
        self.publish()

    def publish(self) -> None:
        """Publish what the robot says now."""
        seen = self._world.observe()
        now = self._now()
        stamp = to_stamp(self._ros, now)
        transforms = []
        if self._names.wiring.odometry is not None:
            fixed, moving = self._names.wiring.odometry
            place = self._place(np.array([seen.joints[s] for s in self._place.inputs]))
            transforms.append(make_transform(self._ros, (fixed, moving), now, from_matrix(place)))
        transforms += self._publish_poses(seen, now, stamp)
        if transforms and self._transforms is not None:
            self._transforms.publish(self._ros.TFMessage(transforms=transforms))
        joints = self._ros.JointState(name=self._joint_names)
        joints.header.stamp = stamp
        joints.position = [seen.joints[s] for s in self._read]
        self._joints.publish(joints)

    def _publish_poses(self, seen: Observation, now: int, stamp: Any) -> list[Any]:
        """Publish poses that are seen on their topics, and return those that belong into TF."""
        transforms, world = [], self._frames[WORLD]
        for frame, pose in seen.poses.items():
            if frame in self._poses:
                if not self._poses[frame].get_subscription_count():
                    continue  # a message takes longer than the look
                message = self._ros.PoseStamped()
                message.header.stamp, message.header.frame_id = stamp, world
                place, turn = message.pose.position, message.pose.orientation
                place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w = from_matrix(pose)
                self._poses[frame].publish(message)
            elif frame in self._seen_in_tf:
                name = self._seen_in_tf[frame]
                transforms.append(make_transform(self._ros, (world, name), now, from_matrix(pose)))
        return transforms


def make_world(
    model: Model,
    robot: str,
    *,
    world: str = "kinematic",
    noise: str | None = None,
) -> SimulatedWorld:
    """Put a robot, ``ROBOT`` or ``ROBOT@X,Y,ANGLE``, into a model, and return a world of both."""
    if world not in _WORLDS:
        raise UnknownNameError(f"There is no world '{world}'; there are {' and '.join(_WORLDS)}.")
    source, at = parse_robot(robot)
    placed = place_robot(model, source, at)
    start, _ = placed.find_free_start(model, placed.start_state(model))
    sensors = Sensors() if noise is None else Sensors.parse(noise)
    own = Robot.of(model, placed.name)
    result: SimulatedWorld
    if world == "mujoco":
        from kineverse.worlds import MujocoWorld  # for start-up time

        result = MujocoWorld(model, own, sensors=sensors)
    else:
        result = KinematicWorld(model, own, sensors=sensors)
    result.reset(start)
    return result


def simulate_robot(
    model: Model,
    robot: str,
    *,
    world: Literal["kinematic", "mujoco"] | str = "kinematic",
    noise: str | None = None,
    settings: str | None = None,
    say: Callable[[str], object] = print,
) -> None:
    """Run a simulated robot in a model behind its topics until Ctrl-C.

    The model is that of the furniture. The robot is named as for ``kineverse open``, and so is the noise of
    its sensors. The settings are a TOML file. Lines on what there is go to ``say``.
    """
    simulated = make_world(model, robot, world=world, noise=noise)
    given = RobotSettings() if settings is None else read_settings(settings)
    names = connect_names(simulated.robot, given, simulated.robot.markers)
    ros = import_ros()
    ros.rclpy.init(args=[], signal_handler_options=ros.NO_SIGNALS)
    node = ros.rclpy.create_node("simulated_robot")
    simulation = SimulatedRobot(ros, node, simulated, names)
    wiring = names.wiring
    say(f"robot: {simulated.robot.name} in the {simulated.name} world")
    say(f"out: {wiring.joint_states}, /tf, poses of {len(wiring.poses)} frames")
    topics = [topic for topic, _ in wiring.controllers]
    say(f"in: {', '.join(filter(None, [wiring.command, *topics, wiring.trajectory]))}")
    for topic, speeds in zip(topics, names.controllers, strict=True):
        joints = ", ".join(names.joints.to_ros(str(v.position)) for v in speeds)
        say(f"{topic} has the speeds of {joints}")
    try:
        run_in_real_time(ros, node, simulation)
    finally:
        ros.rclpy.try_shutdown()


def run_in_real_time(ros: Any, node: Any, simulation: SimulatedRobot) -> None:
    """Let a simulated robot move by the clock, until something is raised."""
    executor = ros.Executor()
    executor.add_node(node)
    last = due = monotonic()
    while True:
        due = max(due + _PERIOD, monotonic())
        while (left := due - monotonic()) > 0.0:
            executor.spin_once(timeout_sec=left)
        executor.spin_once(timeout_sec=0.0)
        now = monotonic()
        simulation.step(min(now - last, _LONGEST))
        last = now
