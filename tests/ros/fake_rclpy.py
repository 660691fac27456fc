"""Small ROS 2 in this process, with what the nodes use of rclpy: topics, timers, a clock, parameters.

``FakeRos()`` stands for the namespace that ``kineverse_ros.ros.import_ros`` returns. Time passes in ``advance``
alone, which delivers messages and calls timers. Messages are copied, latched ones are kept for subscriptions
that come later.
"""

from __future__ import annotations

import copy
import inspect
from collections.abc import Callable, Mapping
from itertools import count
from types import SimpleNamespace
from typing import Any

SECOND = 1_000_000_000


class Message:
    """Message with the fields of its class, each a copy of the default there."""

    FIELDS: Mapping[str, Any] = {}

    def __init__(self, **values: Any) -> None:
        unknown = set(values) - set(self.FIELDS)
        assert not unknown, f"{type(self).__name__} has no {unknown}"
        for name, default in self.FIELDS.items():
            setattr(self, name, values[name] if name in values else copy.deepcopy(default))

    def __setattr__(self, name: str, value: Any) -> None:
        assert name in self.FIELDS, f"{type(self).__name__} has no '{name}'"
        object.__setattr__(self, name, value)

    def __eq__(self, other: object) -> bool:
        return type(other) is type(self) and vars(other) == vars(self)

    __hash__ = None


def _message(package: str, kind: str, constants: Mapping[str, int] = {}, /, **fields: Any) -> Any:
    return type(kind, (Message,), {"FIELDS": fields, "__module__": f"{package}.msg", **constants})


Time = _message("builtin_interfaces", "Time", sec=0, nanosec=0)
Duration = _message("builtin_interfaces", "Duration", sec=0, nanosec=0)
Header = _message("std_msgs", "Header", stamp=Time(), frame_id="")
Vector3 = _message("geometry_msgs", "Vector3", x=0.0, y=0.0, z=0.0)
Point = _message("geometry_msgs", "Point", x=0.0, y=0.0, z=0.0)
Quaternion = _message("geometry_msgs", "Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
Transform = _message("geometry_msgs", "Transform", translation=Vector3(), rotation=Quaternion())
TransformStamped = _message(
    "geometry_msgs", "TransformStamped", header=Header(), child_frame_id="", transform=Transform()
)
Pose = _message("geometry_msgs", "Pose", position=Point(), orientation=Quaternion())
ColorRGBA = _message("std_msgs", "ColorRGBA", r=0.0, g=0.0, b=0.0, a=0.0)
MESSAGES = (
    Time,
    Point,
    Transform,
    TransformStamped,
    _message("geometry_msgs", "PoseStamped", header=Header(), pose=Pose()),
    _message("geometry_msgs", "Twist", linear=Vector3(), angular=Vector3()),
    _message("rcl_interfaces", "ParameterDescriptor", description="", read_only=False, type=0),
    _message("sensor_msgs", "JointState", header=Header(), name=[], position=[], velocity=[], effort=[]),
    _message("std_msgs", "Float64MultiArray", data=[]),
    _message("std_msgs", "String", data=""),
    _message("tf2_msgs", "TFMessage", transforms=[]),
    _message("trajectory_msgs", "JointTrajectory", header=Header(), joint_names=[], points=[]),
    _message(
        "trajectory_msgs",
        "JointTrajectoryPoint",
        positions=[],
        velocities=[],
        accelerations=[],
        effort=[],
        time_from_start=Duration(),
    ),
    _message(
        "visualization_msgs",
        "Marker",
        {name: i for i, name in enumerate(("ARROW", "CUBE", "SPHERE", "CYLINDER"))}
        | {"LINE_STRIP": 4, "TRIANGLE_LIST": 11, "MESH_RESOURCE": 10, "ADD": 0, "DELETE": 2, "DELETEALL": 3},
        header=Header(),
        ns="",
        id=0,
        type=0,
        action=0,
        pose=Pose(),
        scale=Vector3(),
        color=ColorRGBA(),
        lifetime=Duration(),
        frame_locked=False,
        points=[],
        colors=[],
        text="",
        mesh_resource="",
        mesh_use_embedded_materials=False,
    ),
    _message("visualization_msgs", "MarkerArray", markers=[]),
)


class FakeRos(SimpleNamespace):
    """Namespace of ROS, with one clock that begins at a time [s], and one set of parameters for all nodes."""

    def __init__(self, parameters: Mapping[str, Any] | None = None, start: float = 1000.0) -> None:
        super().__init__(
            **{kind.__name__: kind for kind in MESSAGES},
            LATCHED=SimpleNamespace(depth=1, latched=True),
            STATIC=SimpleNamespace(depth=100, latched=True),
            QUEUED=SimpleNamespace(depth=100, latched=False),
            STEADY=None,
            serialize=lambda message: None,
        )
        self.parameters = dict(parameters or {})
        self.nanoseconds = round(start * SECOND)
        self.nodes: list[FakeNode] = []
        self.topics: dict[str, SimpleNamespace] = {}
        self.gids = count(1)
        self.rclpy = SimpleNamespace(create_node=lambda name, **options: FakeNode(self, name))

    def topic(self, name: str) -> SimpleNamespace:
        found = SimpleNamespace(publishers=[], subscriptions=[])
        return self.topics.setdefault(f"/{name.lstrip('/')}", found)

    def advance(self, seconds: float = 0.0) -> None:
        """Deliver what was published, and let time pass: timers are called in their order."""
        end = self.nanoseconds + round(seconds * SECOND)
        self.deliver()
        while True:
            timers = [timer for node in self.nodes for timer in node.timers]
            first = min(timers, key=lambda timer: timer.due, default=None)
            if first is None or first.due > end:
                break
            self.nanoseconds = max(self.nanoseconds, first.due)
            first.due += first.period
            first.callback()
            self.deliver()
        self.nanoseconds = end

    def deliver(self) -> None:
        while True:
            waiting = [s for topic in self.topics.values() for s in topic.subscriptions if s.queue]
            if not waiting:
                return
            for subscription in waiting:
                subscription.take()


class FakePublisher:
    def __init__(self, node: FakeNode, kind: Any, topic: str, quality: Any) -> None:
        self.node, self.kind, self.topic_name, self.quality = node, kind, f"/{topic.lstrip('/')}", quality
        self.endpoint_gid = list(next(node.ros.gids).to_bytes(16, "little"))
        self.node_name, self.node_namespace = node.name, "/"
        self.topic_type = f"{kind.__module__.partition('.')[0]}/msg/{kind.__name__}"
        self.kept: list[Any] = []
        self.count = 0
        node.ros.topic(topic).publishers.append(self)

    def publish(self, message: Any) -> None:
        assert type(message) is self.kind, f"{self.topic_name} has {self.kind.__name__}, not {message!r}"
        self.count += 1
        if getattr(self.quality, "latched", False):
            self.kept = [copy.deepcopy(message)]
        for subscription in self.node.ros.topic(self.topic_name).subscriptions:
            subscription.put(self, message)

    def get_subscription_count(self) -> int:
        return len(self.node.ros.topic(self.topic_name).subscriptions)


class FakeSubscription:
    def __init__(self, node: FakeNode, kind: Any, topic: str, callback: Callable[..., Any]) -> None:
        self.node, self.kind, self.topic_name, self.callback = node, kind, f"/{topic.lstrip('/')}", callback
        self.queue: list[Any] = []
        needed = [p for p in inspect.signature(callback).parameters.values() if p.default is p.empty]
        self._with_info = len(needed) == 2
        node.ros.topic(topic).subscriptions.append(self)
        for publisher in node.ros.topic(topic).publishers:
            for message in publisher.kept:
                self.put(publisher, message)

    def put(self, publisher: FakePublisher, message: Any) -> None:
        if publisher.kind is self.kind:  # as in ROS, others are never received
            info = {
                "publisher_gid": {"data": bytes(publisher.endpoint_gid)},
                "publication_sequence_number": publisher.count,
            }
            self.queue.append((copy.deepcopy(message), info))

    def take(self) -> None:
        messages, self.queue = self.queue, []
        for message, info in messages:
            self.callback(message, info) if self._with_info else self.callback(message)


class FakeNode:
    """Node; ``logged`` has the pairs of level and text of its logger."""

    def __init__(self, ros: FakeRos, name: str) -> None:
        self.ros, self.name = ros, name
        self.timers: list[SimpleNamespace] = []
        self.parameters = {key: SimpleNamespace(value=value) for key, value in ros.parameters.items()}
        self.logged: list[tuple[str, str]] = []
        ros.nodes.append(self)

    def get_name(self) -> str:
        return self.name

    def get_logger(self) -> SimpleNamespace:
        levels = ("debug", "info", "warning", "error")
        log = {level: lambda text, level=level: self.logged.append((level, text)) for level in levels}
        return SimpleNamespace(**log)

    def get_clock(self) -> SimpleNamespace:
        return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=self.ros.nanoseconds))

    def declare_parameter(self, name: str, value: Any, descriptor: Any = None) -> SimpleNamespace:
        return self.parameters.setdefault(name, SimpleNamespace(value=value))

    def describe_parameter(self, name: str) -> SimpleNamespace:
        return SimpleNamespace(type=0)

    def set_descriptor(self, name: str, descriptor: Any) -> None:
        self.parameters[name].descriptor = descriptor

    def has_parameter(self, name: str) -> bool:
        return name in self.parameters

    def get_parameter(self, name: str) -> SimpleNamespace:
        return self.parameters[name]

    def get_parameters_by_prefix(self, prefix: str) -> dict[str, SimpleNamespace]:
        return dict(self.parameters)

    def resolve_topic_name(self, topic: str) -> str:
        return f"/{topic.lstrip('/')}"

    def create_publisher(self, kind: Any, topic: str, quality: Any) -> FakePublisher:
        return FakePublisher(self, kind, topic, quality)

    def create_subscription(
        self, kind: Any, topic: str, callback: Callable[..., Any], quality: Any
    ) -> FakeSubscription:
        return FakeSubscription(self, kind, topic, callback)

    def create_timer(self, period: float, callback: Callable[[], Any], clock: None = None) -> SimpleNamespace:
        step = round(period * SECOND)
        timer = SimpleNamespace(due=self.ros.nanoseconds + step, period=step, callback=callback)
        timer.reset = lambda: setattr(timer, "due", self.ros.nanoseconds + step)
        self.timers.append(timer)
        return timer

    def get_publishers_info_by_topic(self, topic: str) -> list[FakePublisher]:
        return list(self.ros.topic(topic).publishers)

    def destroy_publisher(self, publisher: FakePublisher) -> None:
        self.ros.topic(publisher.topic_name).publishers.remove(publisher)

    def destroy_subscription(self, subscription: FakeSubscription) -> None:
        self.ros.topic(subscription.topic_name).subscriptions.remove(subscription)

    def destroy_timer(self, timer: SimpleNamespace) -> None:
        self.timers.remove(timer)

    def destroy_node(self) -> None:
        self.ros.nodes.remove(self)
        for topic in self.ros.topics.values():
            topic.publishers = [p for p in topic.publishers if p.node is not self]
            topic.subscriptions = [s for s in topic.subscriptions if s.node is not self]
