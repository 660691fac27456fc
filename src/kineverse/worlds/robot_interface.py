"""The interface of a robot: speeds go in, sensor readings come out. Skills use nothing else."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

from kineverse.lie import Array
from kineverse.model.model_view import ModelView
from kineverse.state import State, StateLike
from kineverse.symbols import Symbol

from .robot import Robot


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """Sensor readings at one time.

    Attributes
    ----------
    stamp
        Time of the readings [s].
    joints
        Encoders of the robot: positions by symbol [m], [rad]; a mobile base is read by its odometry.
    poses
        Observed poses world_T_frame (4, 4) of marked frames [m], the visible ones alone.
    touching
        Frames of the robot that a touch sensor reports.
    seen
        Time of the poses where it is another one, as cameras are slower than encoders [s].

    See Also
    --------
    kineverse.worlds.SensorSampler
    """

    stamp: float
    joints: Mapping[Symbol, float]
    poses: Mapping[str, Array] = field(default_factory=dict)
    touching: frozenset[str] = frozenset()
    seen: float | None = None

    @property
    def picture_stamp(self) -> float:
        """Time of the poses [s]."""
        return self.stamp if self.seen is None else self.seen


class RobotInterface(Protocol):
    """A robot that takes speeds and reports readings, be it simulated, in another process, or real.

    Attributes
    ----------
    name
        What the robot acts in, such as ``"kinematic"``, ``"mujoco"`` or ``"ros"``.
    model
        Model of the robot and of everything that moves around it.
    robot
        The robot in the model.
    remarks
        What users should know of it, such as what a simulation has added to the model or left out of it.
    timeout
        Time after which a command no longer acts [s].

    See Also
    --------
    kineverse.worlds.KinematicWorld
    """

    name: str
    model: ModelView
    robot: Robot
    remarks: tuple[str, ...]
    timeout: float

    @property
    def time(self) -> float:
        """The present time, in that of the stamps of readings [s]."""

    def apply(self, speeds: StateLike, duration: float, *, stamp: float | None = None) -> None:
        """Let the robot move with speeds for a duration, and return when it is over.

        Speeds of anything else are not read. A missing speed is zero, but that of fingers keeps the last
        value: a stop keeps the force of the gripper. Fingers that hold something press it until they are
        opened. Others stop where they are once no command has come for the time-out.

        Parameters
        ----------
        speeds
            Speeds of the robot by symbol or name [m/s], [rad/s]; an empty mapping stops it.
        duration
            Time [s].
        stamp
            Time of the state from which the speeds were computed [s]: those older than the time-out are
            refused, and the robot stops. None for speeds without a stamp, which are not refused.

        Raises
        ------
        InvalidValueError
            For speeds that are not finite, and a duration that is not positive.
        SimulationError
            If a simulation is not to be trusted any more.
        """

    def observe(self) -> Observation:
        """Return the latest sensor readings that have arrived."""


class PlannedContact(NamedTuple):
    """Contact that a skill plans: the depth of these bodies is no overlap.

    See Also
    --------
    kineverse.manipulation.push
    """

    pusher: tuple[str, ...]  # bodies of the robot
    pushed: tuple[str, ...]  # bodies of the object
    touching: bool  # whether the skill believes that they touch


class SkillStep(Protocol):
    """Step of a skill, as a :class:`kineverse.manipulation.Session` has it: it is recorded and measured."""

    time: float  # time of the robot after the step [s]
    phase: str  # name of the present phase
    state: State  # the believed state
    observation: Observation
    contact: PlannedContact | None  # the contact that is planned; None without any
    # Vectors of the controller by name, each after its origin in the world [m].
    vectors: Mapping[str, tuple[Array, Array]]

    @property
    def commands(self) -> Mapping[Any, float]:
        """The speeds of the step."""
