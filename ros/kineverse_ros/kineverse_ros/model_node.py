"""Node that publishes any model, and moves it by what others publish.

It takes the place of robot_state_publisher and joint_state_publisher, also for models that no URDF can
describe. A live model is followed through its edits.
"""

from __future__ import annotations

import signal
import sys
import threading
import time
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

import kineverse as kv
from kineverse.cli.output import format_count, join_lines
from kineverse.errors import (
    DuplicateNameError,
    InvalidValueError,
    KineverseError,
    OfflineError,
    UnknownNameError,
    list_some,
    suggest,
)
from kineverse.formats.document import to_json
from kineverse.lie import Array
from kineverse.model.frame import WORLD

from .description import describe, make_markers
from .inputs import PATIENCE, SECOND, Complaints, JointStateFilter, Readings, Topics
from .model_output import ModelOutput, Stamps
from .model_settings import ModelSettings, Value, declare_settings
from .names import NameMap, covers
from .ros import import_ros
from .tracking import PoseInputs, PoseTracking
from .transforms import TransformPublisher, from_matrix, make_transform, nanoseconds, to_stamp

if TYPE_CHECKING:
    from kineverse.exchange import Connection, StatePublisher, StateReader

JOINT_STATES, ALL_JOINT_STATES = "joint_states", "joint_states/all"
DESCRIPTION, DOCUMENT, MARKERS = "robot_description", "kineverse_document", "visualization_marker_array"

_FRESH = SECOND  # age up to which a reading is said again with others
_BEFORE = 1  # stamp of what was read before the clock was set back: it is older than all that comes [ns]
_LOOK = 0.05  # longest time between two looks for messages [s]
_SPIN = 0.2  # time between two looks at what is not read in each period, such as services [s]
_IDLE = 4.0  # time without another look at an edited model, in times of what the last one took


@dataclass
class _Tables:
    """Output and names of one version of a model."""

    model: kv.Model
    output: ModelOutput
    frames: NameMap
    joints: NameMap

    @classmethod
    def build(cls, model: kv.Model, settings: ModelSettings) -> _Tables:
        """Build the tables of a model, which is not edited any more."""
        names = (WORLD, *(name for name in model.frames if name != WORLD))
        for key in settings.omit:
            if not any(covers(key, name) for name in names):
                raise UnknownNameError(f"omit has '{key}', which names nothing. {suggest(key, names)}")
        output = ModelOutput(model, settings.omit)
        joints = dict.fromkeys([*output.joints, *model.articulations])
        if settings.robot and not any(covers(f"{settings.robot.rstrip('/')}/", name) for name in joints):
            raise UnknownNameError(
                f"robot is '{settings.robot}', and no joint of the model is below that name. The robot is "
                f"one of the models: kineverse ros kitchen {settings.robot} --robot {settings.robot}."
            )
        return cls(
            model,
            output,
            NameMap(names, settings.frame_names, settings.frame_prefix),
            NameMap(joints, settings.joint_names),
        )

    @property
    def shown(self) -> frozenset[str]:
        """Frames whose shapes are shown."""
        return frozenset((WORLD, *self.output.parents))


class CoordinateValues:
    """Newest values of coordinates, speeds and stamps; home, and the stamp 0, where nothing was read."""

    def __init__(self, output: ModelOutput, before: CoordinateValues | None = None) -> None:
        count = len(output.coordinates)
        self.places = {name: place for place, name in enumerate(output.coordinates)}
        self.values, self.speeds = output.start.copy(), np.full(count, np.nan)
        self.stamps: Stamps = np.zeros(count, dtype=np.int64)
        if before is None:
            return
        for name, own in self.places.items():
            place = before.places.get(name)
            if place is not None and before.stamps[place]:
                self.values[own], self.speeds[own] = before.values[place], before.speeds[place]
                # One nanosecond later, since TF keeps the first of two transforms with one stamp.
                stamp = before.stamps[place]
                self.stamps[own] = stamp if stamp == _BEFORE else stamp + 1

    def take(self, readings: Readings) -> None:
        """Take over readings; older ones than there are have no effect."""
        for name, value in readings.positions.items():
            place = self.places.get(name)
            if place is not None and readings.stamp >= self.stamps[place]:
                self.values[place], self.stamps[place] = value, readings.stamp
                self.speeds[place] = readings.velocities.get(name, np.nan)


class ModelNode:
    """Node of one model.

    Parameters
    ----------
    ros
        Namespace of ROS, see :func:`.import_ros`.
    node
        Node of rclpy.
    model
        The model. A live one is followed.

    Attributes
    ----------
    inputs
        Subscriptions, with the numbers of messages that came in and were lost.

    Raises
    ------
    UnknownNameError, DuplicateNameError, InvalidValueError
        If settings do not fit the model, or nothing is published.
    """

    def __init__(self, ros: Any, node: Any, model: kv.Model, settings: ModelSettings) -> None:
        self._ros, self._node, self._model, self._settings = ros, node, model, settings
        self._last_now = self._sent_joints = 0
        self._complaints = Complaints(node.get_logger().warning)
        self.inputs = Topics(node, self._complaints, self._now, ros.STEADY)
        connection: Connection | None = getattr(model, "exchange", None)
        self._version, self._look = model.version, 0.0
        self._tables = _Tables.build(model.copy(), settings)
        output = self._tables.output
        if not output.parents and connection is None:
            raise InvalidValueError(
                "There is nothing to publish: the model has no frames, or all are omitted."
            )
        if settings.share and connection is None:
            raise InvalidValueError("share is for a live model: there is no server to give readings to.")
        self._values = CoordinateValues(output)
        self._measured: set[str] = set()  # coordinates that were read, and are not to be estimated from poses
        self._filter = JointStateFilter(self._tables.joints, output.coordinates, self._complaints)
        self._tracking = PoseTracking(self._tables.model, settings.deviations)
        self._poses = PoseInputs(
            ros, self.inputs, settings.observed, self._complaints, self._now, self._observe
        )
        self._poses.follow(self._tables.frames, (WORLD, *self._tables.model.frames), output.parents)
        node.create_timer(PATIENCE, self._poses.name_missing, clock=ros.STEADY)
        self.joint_topic = self._subscribe(settings.sources)
        self._tf = node.create_publisher(ros.TFMessage, "/tf", ros.QUEUED)
        self._joint_states = node.create_publisher(ros.JointState, self.joint_topic, ros.QUEUED)
        self._static_tf = node.create_publisher(ros.TFMessage, "/tf_static", ros.LATCHED)
        self._description = node.create_publisher(ros.String, DESCRIPTION, ros.LATCHED)
        self._document = node.create_publisher(ros.String, DOCUMENT, ros.LATCHED)
        self._markers = node.create_publisher(ros.MarkerArray, MARKERS, ros.LATCHED)
        self._exchange: _ServerState | None = None
        if connection is not None:
            self._exchange = _ServerState(connection, settings.share, self._tables.joints)
        self._describing: threading.Thread | None = None
        self._described: _Tables | None = None
        self._publish_tables()

    @property
    def summary(self) -> str:
        """Line about the frames and joints that are published."""
        output = self._tables.output
        parts = (
            (len(output.moving), "moving frame"),
            (len(output.static), "static frame"),
            (len(output.joints), "joint"),
        )
        counts = ", ".join(format_count(count, what) for count, what in parts)
        return f"{', '.join(self._settings.model)}: {counts}"

    @property
    def topics(self) -> list[str]:
        """Names of all topics that are published."""
        publishers = (
            self._tf,
            self._static_tf,
            self._joint_states,
            self._description,
            self._markers,
            self._document,
        )
        return [publisher.topic_name for publisher in publishers]

    def join(self) -> None:
        """Wait until all that follows from the last edit is published."""
        while self._describing is not None:
            self._describing.join()
            self._describe_anew()

    # -- what comes in -------------------------------------------------------------------------------------

    def _subscribe(self, sources: Sequence[str]) -> str:
        """Subscribe to topics of joint states, and return the one on which all joints go out."""
        resolve = self._node.resolve_topic_name
        names = [resolve(topic) for topic in sources]
        own = ALL_JOINT_STATES if resolve(JOINT_STATES) in names else JOINT_STATES
        if len(set(names)) < len(names):
            raise DuplicateNameError("sources: a topic is there twice.")
        if resolve(own) in names:
            raise InvalidValueError(f"sources has {resolve(own)}, where this node says itself what it reads.")
        for topic in sources:
            self.inputs.subscribe(self._ros.JointState, topic, self._hear, self._ros.QUEUED)
        return own

    def _now(self) -> int:
        """Return the time [ns]; begin anew if the clock was set back."""
        now = int(self._node.get_clock().now().nanoseconds)
        if now < self._last_now:
            self._sent_joints = 0
            self._values.stamps = np.minimum(self._values.stamps, _BEFORE)
            self._sent[:] = _BEFORE
            self._tracking.forget()
        self._last_now = now
        return now

    def _hear(self, message: Any, source: str) -> None:
        stamp = nanoseconds(message.header.stamp)
        readings = self._filter.accept(
            source, stamp, message.name, message.position, message.velocity, self._now()
        )
        if readings is not None:
            self._measured.update(readings.positions)
            self._take(readings)

    def _observe(self, frame: str, reference: str, pose: Array, stamp: int) -> None:
        places, values = self._values.places, self._values.values
        measured = {name: float(values[places[name]]) for name in self._measured & places.keys()}
        readings = self._tracking.observe(frame, reference, pose, stamp, measured)
        if readings is not None:
            self._take(readings)

    def _take(self, readings: Readings) -> None:
        self._values.take(readings)
        if self._exchange is not None:
            self._exchange.share(readings)

    def _read_server(self, now: int) -> None:
        if self._exchange is None:
            return
        uses_own_time = bool(self._node.get_parameter("use_sim_time").value)
        for source, stamp, names, positions, velocities in self._exchange.read():
            found = self._filter.accept(
                source, now if uses_own_time else stamp, names, positions, velocities, now
            )
            if found is not None:
                self._measured.update(found.positions)
                self._values.take(found)

    # -- what goes out -------------------------------------------------------------------------------------

    def tick(self) -> None:
        """Publish what is new; called in each period."""
        now = self._now()
        if now == 0:
            return
        self._follow_model()
        self._read_server(now)
        self._publish_state(now)

    def _publish_state(self, now: int) -> None:
        output, values = self._tables.output, self._values
        newest, of_joints = output.newest(values.stamps)
        # What nobody reads stands at home, at the present.
        stamps = np.where(newest == 0, now, newest)
        due = stamps > self._sent
        joint_stamp = self._find_joint_stamp(now)
        if not due.any() and joint_stamp is None:
            return
        is_placed = output.evaluate(values.values, values.speeds)
        if output.problem:
            self._complaints.add("loop", output.problem, now)
        places = np.flatnonzero(due & is_placed)
        self._transforms.publish(places, stamps[places], output.poses[places])
        self._sent[places] = stamps[places]
        if joint_stamp is not None:
            # Without those whose source is silent, and those of loops that are not closed.
            is_said = ((of_joints == 0) | (of_joints >= now - _FRESH)) & np.isfinite(output.positions)
            self._publish_joints(joint_stamp, np.flatnonzero(is_said))

    def _find_joint_stamp(self, now: int) -> int | None:
        """Return the stamp of joint states if there is something new to say."""
        stamps = self._values.stamps
        newest = int(stamps.max(initial=0))
        if newest > self._sent_joints and now - newest <= _FRESH:
            return newest
        return now if now > self._sent_joints and not stamps.all() else None

    def _publish_joints(self, stamp: int, places: npt.NDArray[np.intp]) -> None:
        output, message = self._tables.output, self._joint_message
        velocities = output.velocities[places]
        is_moving = bool(np.isfinite(velocities).all())
        message.header.stamp = to_stamp(self._ros, stamp)
        message.name = [self._joint_names[place] for place in places.tolist()]
        message.position = array("d", output.positions[places].tobytes())
        message.velocity = array("d", velocities.tobytes() if is_moving else b"")
        self._sent_joints = stamp
        self._joint_states.publish(message)

    # -- edits ---------------------------------------------------------------------------------------------

    def _follow_model(self) -> None:
        """Build the tables anew after an edit; they take no more than a part of the time."""
        self._describe_anew()
        if self._model.version == self._version or time.monotonic() < self._look:
            return
        start, self._version = time.monotonic(), self._model.version
        try:
            tables = _Tables.build(self._model.copy(), self._settings)
            self._poses.follow(tables.frames, (WORLD, *tables.model.frames), tables.output.parents)
        except KineverseError as error:
            self._complaints.add_once(f"Revision {self._version} is not published: {error}")
        else:
            self._tables = tables
            self._values = CoordinateValues(tables.output, self._values)
            self._filter.follow(tables.joints, tables.output.coordinates)
            self._tracking.follow(tables.model)
            if self._exchange is not None:
                self._exchange.joints = tables.joints
            self._publish_tables()
        self._look = time.monotonic() + _IDLE * (time.monotonic() - start)

    def _publish_tables(self) -> None:
        """Publish what is static, and prepare messages of what moves."""
        tables, ros = self._tables, self._ros
        output, frames = tables.output, tables.frames
        self._sent: Stamps = np.full(len(output.moving), _BEFORE, dtype=np.int64)
        names = {
            child: (frames.to_ros(parent), frames.to_ros(child)) for child, parent in output.parents.items()
        }
        self._transforms = TransformPublisher(ros, self._tf, [names[child] for child in output.moving])
        self._joint_names = [tables.joints.to_ros(name) for name in output.joints]
        self._joint_message = ros.JointState()
        now, static = self._now(), []
        for child, pose in output.static.items():
            static.append(make_transform(ros, names[child], now, from_matrix(pose)))
        self._static_tf.publish(ros.TFMessage(transforms=static))
        self._markers.publish(make_markers(ros, tables.model, frames, tables.shown))
        self._describe_anew()

    def _describe_anew(self) -> None:
        """Have a thread publish URDF and document of the newest tables, which takes long for large models."""
        if self._describing is not None and self._describing.is_alive():
            return
        self._describing = None
        if self._described is not self._tables:
            self._described = self._tables
            self._describing = threading.Thread(target=self._describe, args=(self._tables,), daemon=True)
            self._describing.start()

    def _describe(self, tables: _Tables) -> None:
        self._document.publish(self._ros.String(data=to_json(tables.model)))
        try:
            text, remarks = describe(tables.model, tables.frames, tables.joints, tables.shown)
        except KineverseError as error:
            self._complaints.add_once(f"There is no {DESCRIPTION}. {error}")
            return
        if remarks:
            self._node.get_logger().info(f"{DESCRIPTION}: {list_some(remarks, 3)}")
        self._description.publish(self._ros.String(data=text))


class _ServerState:
    """State of the sources of a model server, and one source there with what this node reads."""

    def __init__(self, connection: Connection, share: str, joints: NameMap) -> None:
        self.joints = joints
        self._connection, self._own = connection, share
        self._reader: StateReader = connection.reader()
        self._seen: dict[str, int] = {}
        self._shared: dict[str, tuple[float, int]] = {}  # values and stamps
        self._publisher: StatePublisher | None = connection.publisher(share, ()) if share else None

    def read(self) -> Iterable[tuple[str, int, list[str], list[float], list[float]]]:
        """Yield what is new: source, stamp [ns], names of ROS, positions and velocities."""
        if not self._reader.wait(0.0):
            return
        received, state = self._reader.received, self._reader.state
        stamp = round((state.stamp or 0.0) * SECOND)
        for source in self._connection.sources:
            count = received.get(source.source, 0)
            if source.source == self._own or count == self._seen.get(source.source, 0):
                continue
            self._seen[source.source] = count
            values = {name: state[name] for name in source.coordinates if name in state}
            positions = {name: value for name, value in values.items() if ":" not in name}
            speeds = [values.get(f"{name}:velocity", np.nan) for name in positions]
            names = [self.joints.translate(name) for name in positions]
            yield f"source '{source.source}' of the server", stamp, names, [*positions.values()], speeds

    def share(self, readings: Readings) -> None:
        """Give readings to the server, with the others of the last second."""
        if self._publisher is None:
            return
        fresh = {name: item for name, item in self._shared.items() if item[1] >= readings.stamp - _FRESH}
        fresh |= {name: (value, readings.stamp) for name, value in readings.positions.items()}
        try:
            if fresh.keys() != self._shared.keys():
                self._publisher.set_coordinates(fresh)
            else:
                fresh = {name: fresh[name] for name in self._shared}  # in the order of the source
            self._publisher.put([value for value, _ in fresh.values()], readings.stamp / SECOND)
        except OfflineError:
            self._publisher = None
        self._shared = fresh


def load_model(sources: Sequence[str]) -> kv.Model:
    """Load a model, or several into one; a live one stays connected.

    Raises
    ------
    InvalidValueError
        For a live model and others.
    """
    if len(sources) == 1:
        return kv.load(sources[0])
    if any(source.startswith("live:") for source in sources):
        raise InvalidValueError("A live model is published alone; its server has others with it.")
    model = kv.Model()
    with model.edit() as edit:
        for source in sources:
            edit.include(source)
    return model


def run_model_node(
    given: Mapping[str, Value], ros_arguments: Sequence[str], started: Callable[[ModelNode], object]
) -> None:
    """Run the node until it is interrupted.

    Parameters
    ----------
    given
        Settings, in place of the defaults.
    ros_arguments
        Arguments of ROS, from ``--ros-args`` on.
    started
        Is called with the node when it runs.
    """
    ros = import_ros()
    try:
        try:
            # Ctrl-C is an exception, as in any command.
            ros.rclpy.init(args=[*ros_arguments], signal_handler_options=ros.NO_SIGNALS)
            node = ros.rclpy.create_node(
                "kineverse_model", automatically_declare_parameters_from_overrides=True
            )
        except Exception as error:  # of its C code, of several classes; a list that is empty has no type
            raise InvalidValueError(
                f"ROS refuses its arguments, or a parameter without a value: {join_lines(error)}"
            ) from None
        settings = declare_settings(ros, node, given)
        model_node = ModelNode(ros, node, load_model(settings.model), settings)
        started(model_node)
        _spin(ros, node, model_node, settings.rate)
        model_node.join()
    finally:
        ros.rclpy.try_shutdown()


def _spin(ros: Any, node: Any, model_node: ModelNode, rate: float) -> None:
    """Run until a signal: an executor would take a millisecond for each message."""
    executor = ros.Executor()
    executor.add_node(node)
    is_simulated = bool(node.get_parameter("use_sim_time").value)
    due = spin_due = time.monotonic()
    with _ending_signals() as is_over:
        while not is_over():
            model_node.inputs.drain()
            if (now := time.monotonic()) >= due:
                model_node.tick()
                due = max(due + 1.0 / rate, time.monotonic())
            if is_simulated or now >= spin_due:  # /clock is read by the executor
                executor.spin_once(timeout_sec=0.0)
                spin_due = now + _SPIN
            time.sleep(min(max(due - time.monotonic(), 0.0), _LOOK))


@contextmanager
def _ending_signals() -> Iterator[Callable[[], bool]]:
    """Have Ctrl-C and SIGTERM make a function true, as exceptions do not pass through C code of rclpy."""
    arrived: list[int] = []
    before = {
        number: signal.signal(number, lambda number, _: arrived.append(number))
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield lambda: bool(arrived)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def main() -> int:
    """Run the node with ROS parameters alone, as an executable of a workspace."""
    arguments = sys.argv[1:]
    try:
        run_model_node({}, arguments, lambda node: None)
    except KeyboardInterrupt:
        return 0
    except KineverseError as error:
        print(f"model_node: {error}", file=sys.stderr)
        return 2
    return 0
