"""Belief about a part of unknown motion: where its marker is seen, and how a hand holds it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from kineverse.compilation import compile
from kineverse.estimation import PlausibilityMonitor, pose_covariance
from kineverse.lie import Array, inverse, pose_difference, retract, skew
from kineverse.model.frame import WORLD
from kineverse.state import State
from kineverse.symbols import Symbol
from kineverse.worlds import Observation, Robot, Sensors

from .unmodelled_joint import JointPath, UnknownPart

_FLOOR = 2e-4, 2e-4  # least noise of poses [m], [rad]: no camera is exact
_HELD_LOOKS, _STATIC_LOOKS = 16.0, 60.0
"""Number of looks that a mean is worth: of the part in the hand, which slips, and of what stands still."""
_NEAR, _TURNED = 0.06, 0.35  # distance [m] and angle [rad] from the believed pose that make an outlier
_FIRST = 5  # number of first looks of which the largest cluster is believed
_LOST_LOOKS = 6  # outliers in a row after which a part is not where it was believed


@dataclass(slots=True, eq=False)
class PoseMean:
    """Running mean of poses that leaves outliers out."""

    looks: float  # number of looks that the mean is worth at most
    pose: Array | None = None  # mean (4, 4); None before the first pose
    count: int = 0  # number of poses in the mean
    missed: int = 0  # number of outliers in a row
    _first: list[Array] = field(default_factory=list)

    def add(self, pose: Array) -> bool:
        """Add a pose, and return False if it is an outlier."""
        if self.pose is not None and len(self._first) == _FIRST:
            if not is_near(pose, self.pose):
                self.missed += 1
                return False
            self.count, self.missed = self.count + 1, 0
            step = pose_difference(pose, self.pose) / min(self.count, self.looks)
            self.pose = retract(self.pose, step)
            return True
        self._first.append(pose)
        clusters = [[b for b in self._first if is_near(b, a)] for a in self._first]
        best = max(clusters, key=len)
        self.pose = retract(best[0], pose_difference(np.array(best), best[0]).mean(axis=0))
        self.count = len(best)
        return is_near(pose, self.pose)


def is_near(a: Array, b: Array) -> bool:
    """Return whether two poses (4, 4) of a part are as near as looks at the same pose."""
    error = pose_difference(a, b)
    return bool(np.linalg.norm(error[:3]) <= _NEAR and np.linalg.norm(error[3:]) <= _TURNED)


class PartBelief:
    """Belief in which the robot is read by its encoders, and a part of unknown motion is seen.

    Before a hand holds the part, it stands where the mean of all looks is. In a hand it is where the hand is,
    times the mean of the last looks at the part in the hand. So the estimate does not lag behind the motion,
    and looks that are far from it are outliers.

    ``looks`` has the others since the part was held: poses (4, 4) relative to what it moves in, and the
    covariances (6, 6) of their errors; None if the noise is not stated.
    """

    def __init__(
        self,
        unknown: UnknownPart,
        robot: Robot,
        state: State,
        hand: str,
        markers: Sequence[str],
        ancestors: Sequence[str],
        sensors: Sensors | None,
    ) -> None:
        model = unknown.model
        self._is_stated, sensors = sensors is not None, sensors or Sensors()
        self.unknown, self.sensors = unknown, sensors
        self.monitor: PlausibilityMonitor | None = None
        self.seen: dict[str, None] = {}
        self._symbols = {s for s in model.symbols if not s.order}
        self._camera = compile(model.fk(sensors.camera or robot.camera or robot.frames[0]))
        self._hand = compile(model.fk(hand))
        self._state = model.default_state().updated({s: v for s, v in state.items() if s in self._symbols})
        self._marker_T_part = {name: np.asarray(model.fk(unknown.frame, name)({})) for name in markers}
        self._world_T_parent = np.asarray(model.fk(unknown.parent)(self._state))
        self._before = self._world_T_parent @ unknown.origin
        self.held: PoseMean | None = None
        self.still = PoseMean(_STATIC_LOOKS)
        self.looks: list[tuple[Array, Array | None]] = []
        self.path: JointPath | None = None
        self._references = {name: PoseMean(_STATIC_LOOKS) for name in ancestors}
        self._beside: str | None = None
        self._world_T_hand = np.eye(4)
        self._looked = -math.inf  # stamp of the latest poses [s]

    @property
    def is_seen(self) -> bool:
        """Presence of the part, and of what it moves in: True if they were seen often enough."""
        mean = self._references.get(self._beside or WORLD)
        return self.still.count >= _FIRST and (mean is None or mean.count >= _FIRST)

    @property
    def beside(self) -> str:
        """Frame in which the part moves: the nearest one above it that was seen, or the world."""
        seen = (name for name, mean in self._references.items() if mean.count >= _FIRST)
        return next(seen, WORLD) if self._beside is None else self._beside

    def slip(self, part_T_hand: Array, point: Array) -> float:
        """Return the distance [m] of a point (3,) from its place in the hand; infinite if it is not seen."""
        if self.held is None or self.held.pose is None or self.held.missed >= _LOST_LOOKS:
            return math.inf
        place = np.append(point, 1.0)
        return float(np.linalg.norm((self.held.pose - inverse(part_T_hand)) @ place))

    @property
    def pose(self) -> Array:
        """Believed pose world_T_part (4, 4)."""
        if self.held is not None and self.held.pose is not None:
            pose = self._world_T_hand @ self.held.pose
            return pose if self.path is None else self.reference_pose @ self.path.pose(self.path.value)
        if self.still.pose is not None:
            return self.still.pose
        return self._before

    @property
    def relative_pose(self) -> Array:
        """Believed pose (4, 4) of the part relative to what it moves in."""
        return inverse(self.reference_pose) @ self.pose

    @property
    def reference_pose(self) -> Array:
        """Believed pose (4, 4) of what the part moves in."""
        mean = self._references.get(self.beside)
        return np.eye(4) if mean is None or mean.pose is None else mean.pose

    @property
    def hand_pose(self) -> Array:
        """Pose world_T_hand (4, 4) by the encoders."""
        return self._world_T_hand

    def hold(self) -> None:
        """Believe that the part is in the hand, from now on."""
        self._beside = self.beside
        believed = inverse(self._world_T_hand) @ self.pose
        self.held, self.looks = PoseMean(_STATIC_LOOKS, believed, _first=[believed] * _FIRST), []

    def begin_motion(self) -> None:
        """Let later looks count more, as the part may slip while it is moved."""
        assert self.held is not None
        self.held.looks = _HELD_LOOKS

    def release(self) -> None:
        """Believe that the part stands still: at first where it was, then where it is seen."""
        self._before = self.pose
        self.held, self.path, self.still = None, None, PoseMean(_STATIC_LOOKS)

    def update(self, observation: Observation, time: float, commands: State | None = None) -> State:
        """Return the state of the model of the part by the latest readings.

        Readings that are as old as the sensors' delay say are of the present. Poses with the stamp of the
        last ones are the same again.
        """
        joints = {s: v for s, v in observation.joints.items() if s in self._symbols}
        self._state = self._state.updated(joints)
        self._world_T_hand = self._hand(self._state.vector(self._hand.inputs))
        if observation.poses and observation.picture_stamp > self._looked:
            self._looked = observation.picture_stamp
            self._look(observation)
        if self.path is not None and self.held is not None and self.held.pose is not None:
            self.path.project(inverse(self.reference_pose) @ self._world_T_hand @ self.held.pose)
        part = self.unknown.values(inverse(self._world_T_parent) @ self.pose)
        self._state = self._state.updated(part)
        stamp = min(time, observation.stamp + self.sensors.delay)
        return State(self._state, stamp=stamp, source="looks")

    def deviation(self, coordinate: Symbol) -> float:
        """Return 0: only coordinates of the robot are used, and its encoders are exact enough."""
        return 0.0

    def _look(self, seen: Observation) -> None:
        """Take new poses of the part, of what it moves in, and of what a test of its joint reads."""
        self.seen |= dict.fromkeys(seen.poses)
        for name, mean in self._references.items():
            if name in seen.poses:
                mean.add(seen.poses[name])
        if self.monitor is not None:
            known = {name: pose for name, pose in seen.poses.items() if name in self.monitor.frames}
            self.monitor.update(known, at=seen.picture_stamp)
        if any(name in seen.poses for name in self._marker_T_part):
            self._look_at_part(seen)

    def _look_at_part(self, seen: Observation) -> None:
        """Take a look at the part; several markers are weighted by their information."""
        looks: list[tuple[Array, Array]] = []
        believed = self.held.pose if self.held is not None else self.still.pose
        frame = self._world_T_hand if self.held is not None else np.eye(4)
        for name, marker_T_part in self._marker_T_part.items():
            if (world_T_marker := seen.poses.get(name)) is not None:
                pose = world_T_marker @ marker_T_part
                looks.append((pose, self._covariance(world_T_marker, pose)))
        near = [
            look for look in looks if believed is not None and is_near(inverse(frame) @ look[0], believed)
        ]
        # One that is nowhere near is for the mean to count as an outlier.
        pose, covariance = _fuse(near or looks[:1])
        if self.held is None:
            self.still.add(pose)
        elif self.held.add(inverse(frame) @ pose):
            relative = inverse(self.reference_pose)
            turn = np.kron(np.eye(2), relative[:3, :3])
            self.looks.append((relative @ pose, turn @ covariance @ turn.T if self._is_stated else None))

    def _covariance(self, world_T_marker: Array, world_T_part: Array) -> Array:
        """Return the covariance (6, 6) of an observed pose of the part in the world."""
        camera = self._camera(self._state.vector(self._camera.inputs))
        distance = np.linalg.norm(camera[:3, 3] - world_T_marker[:3, 3])
        noise = pose_covariance(*self.sensors.pose_noise(distance, *_FLOOR))
        # An error of the marker's orientation displaces the part by the lever between both.
        moved = np.eye(6)
        moved[:3, 3:] = -skew(world_T_part[:3, 3] - world_T_marker[:3, 3])
        return moved @ noise @ moved.T


def _fuse(looks: Sequence[tuple[Array, Array]]) -> tuple[Array, Array]:
    """Return the mean of poses weighted by their information, and its covariance (6, 6)."""
    first, covariance = looks[0]
    if len(looks) == 1:
        return first, covariance
    informations = [np.linalg.inv(covariance) for _, covariance in looks]
    errors = [pose_difference(pose, first) for pose, _ in looks]
    whole = np.linalg.inv(sum(informations))
    step = whole @ sum(info @ error for info, error in zip(informations, errors, strict=True))
    return retract(first, step), whole
