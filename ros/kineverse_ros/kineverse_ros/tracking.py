"""Poses that cameras and markers report, as readings of the coordinates that move the frames they see."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Mapping
from functools import partial
from typing import Any

from kineverse.errors import InvalidValueError, KineverseError, UnknownNameError, suggest
from kineverse.estimation import ObservedPose, Tracker, pose_covariance
from kineverse.lie import Array
from kineverse.model.model_view import ModelView

from .inputs import SECOND, Complaints, Readings, StampCheck, Topics
from .names import TF, NameMap
from .transforms import TransformTree, nanoseconds, to_matrix, to_numbers

_LAG = 0.3  # time by which the poses of one camera may be later than those of another [s]


class PoseTracking:
    """Estimate of coordinates from observed poses of frames of a model.

    The tracker is made when poses come in, since they tell what they are relative to, and anew when that
    changes, or when coordinates are read that it had estimated.

    Parameters
    ----------
    deviations
        Standard deviations of the poses [m], [rad].
    """

    def __init__(self, model: ModelView, deviations: tuple[float, float]) -> None:
        self._model, self._covariance = model, pose_covariance(*deviations)
        self._references: dict[str, str] = {}
        self._inputs: frozenset[str] = frozenset()
        self._tracker: Tracker | None = None

    def forget(self) -> None:
        """Begin again, as when the clock was set back."""
        self._tracker = None

    def follow(self, model: ModelView) -> None:
        """Take over an edited model; recent poses are used again."""
        self._model = model
        if self._tracker is not None:
            try:
                self._tracker = self._tracker.rebuild(model)
            except KineverseError:  # what was observed is not there any more
                self._tracker = None

    def observe(
        self, frame: str, reference: str, pose: Array, stamp: int, measured: Mapping[str, float]
    ) -> Readings | None:
        """Return what a pose of a frame in another one tells, with values of what is measured elsewhere.

        None if that is all that moves the frame.
        """
        moved_by = set(map(str, self._model.symbols_of(frame, reference)))
        inputs = self._inputs | (moved_by & measured.keys())
        if moved_by <= inputs:
            return None
        if self._tracker is None or self._references.get(frame) != reference or inputs != self._inputs:
            self._references[frame], self._inputs = reference, inputs
            self._tracker = Tracker(
                self._model,
                [
                    ObservedPose(one, relative_to=other, covariance=self._covariance)
                    for one, other in self._references.items()
                ],
                outliers=True,
                inputs=sorted(inputs),
                lag=_LAG,
            )
        values = {name: measured[name] for name in inputs}
        estimate = self._tracker.update({frame: pose}, at=stamp / SECOND, inputs=values)
        found = {str(symbol): estimate.state[symbol] for symbol in self._tracker.symbols}
        return Readings(stamp, {name: value for name, value in found.items() if name in moved_by}, {})


class PoseInputs:
    """Subscriptions of observed poses, by topics of PoseStamped and by frames of TF.

    Parameters
    ----------
    observed
        Source of the pose of each observed frame: a topic, or a frame of TF after ``tf:``.
    now
        Function that returns the time [ns].
    take
        Function that is given a frame, what its pose is relative to, the pose, the stamp [ns] and the source.
    """

    def __init__(
        self,
        ros: Any,
        topics: Topics,
        observed: Mapping[str, str],
        complaints: Complaints,
        now: Callable[[], int],
        take: Callable[[str, str, Array, int], object],
    ) -> None:
        self._observed, self._complaints, self._now, self._take = observed, complaints, now, take
        self._stamps, self._tree = StampCheck(complaints), TransformTree()
        self._frames, self._ancestors = NameMap((), {}), frozenset[str]()
        self._by_transform = {
            source.removeprefix(TF): frame for frame, source in observed.items() if source.startswith(TF)
        }
        for frame, source in observed.items():
            if not source.startswith(TF):
                topics.subscribe(ros.PoseStamped, source, partial(self._hear_pose, frame), ros.QUEUED)
        self._missing = set(self._by_transform)  # frames of TF that have not come
        if self._by_transform:
            topics.subscribe(ros.TFMessage, "/tf", self._hear_transforms, ros.QUEUED)
            topics.subscribe(ros.TFMessage, "/tf_static", self._hear_static, ros.STATIC)

    def follow(self, frames: NameMap, known: Iterable[str], published: Container[str]) -> None:
        """Take over the frames of an edited model: all, and those that this node publishes.

        An observed frame that is not there is an UnknownNameError, and one of TF that this node publishes
        itself an InvalidValueError.
        """
        names = list(known)
        for frame in self._observed:
            if frame not in names:
                raise UnknownNameError(
                    f"There is no frame '{frame}' to be observed. {suggest(frame, names, 'frame')}"
                )
        for name in self._by_transform:
            if (own := frames.to_model(name)) is not None and own in published:
                raise InvalidValueError(
                    f"'{name}' cannot be observed in TF, where this node publishes it. Omit that frame."
                )
        # A frame of the model that is observed itself does not end the way to what it is relative to.
        own_names = frozenset(frames.to_ros(name) for name in names)
        self._frames, self._ancestors = frames, own_names - self._by_transform.keys()

    def name_missing(self) -> None:
        """Say which frames of TF have not come."""
        for name in sorted(self._missing):
            self._complaints.add_once(f"'{name}' does not come on /tf, where it is to be observed.")

    def _hear_pose(self, frame: str, message: Any, source: str) -> None:
        pose = to_matrix(to_numbers(message.pose.position, message.pose.orientation))
        self._hear(frame, message.header.frame_id, pose, nanoseconds(message.header.stamp), source)

    def _hear_static(self, message: Any, source: str) -> None:
        for transform in message.transforms:
            self._tree.put(transform, static=True)

    def _hear_transforms(self, message: Any, source: str) -> None:
        for transform in message.transforms:
            self._tree.put(transform, static=False)
        for transform in message.transforms:
            name = transform.child_frame_id
            if name not in self._by_transform:
                continue
            self._missing.discard(name)
            found = self._tree.find(name, self._ancestors)
            if found is None:
                text = f"'{name}' in TF hangs on no frame of the model, or has no numbers: it is not used."
                self._complaints.add(f"tree {name}", text, self._now())
                continue
            reference, _, pose = found
            stamp = nanoseconds(transform.header.stamp)
            self._hear(self._by_transform[name], reference, pose, stamp, f"'{name}' in {source}")

    def _hear(self, frame: str, name: str, pose: Array | None, stamp: int, source: str) -> None:
        now = self._now()
        self._stamps.follow_clock(now)
        reference = self._frames.to_model(name)
        if pose is None:
            text = f"A pose of {source} is not used: it has no numbers, or a quaternion that is none."
        elif reference is None:
            text = f"A pose of {source} is not used: its frame_id '{name}' is no frame of the model."
        elif self._stamps.accepts(source, stamp, now):
            try:
                self._take(frame, reference, pose, stamp)
                return
            except KineverseError as error:
                text = f"A pose of {source} is not used: {error}"
        else:
            return
        self._complaints.add(f"pose {source}", text, now)
