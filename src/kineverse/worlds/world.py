"""The interface of worlds: robot speeds go in, sensor readings come out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from kineverse.lie import Array
from kineverse.model.model_view import ModelView
from kineverse.state import State, StateLike
from kineverse.symbols import Symbol


@dataclass(frozen=True, slots=True, eq=False)
class Contact:
    """Touching bodies.

    Attributes
    ----------
    a, b
        Frames of the bodies; a is of the robot, unless neither is.
    point
        Point of contact in the world (3,) [m].
    normal
        Unit vector from a to b (3,).
    distance
        Gap [m], negative for penetration.
    force
        Size of the force [N]; NaN in a world without forces.
    """

    a: str
    b: str
    point: Array
    normal: Array
    distance: float
    force: float


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
    """

    stamp: float
    joints: Mapping[Symbol, float]
    poses: Mapping[str, Array] = field(default_factory=dict)
    touching: frozenset[str] = frozenset()


class World(Protocol):
    """A world with one robot and its furniture.

    Attributes
    ----------
    name
        ``"kinematic"`` or ``"mujoco"``.
    model
        Model of the robot and of everything that moves.
    robot
        Prefix of the robot: coordinates and bodies below it are the robot's.
    remarks
        What was added to the model or left out of it.
    timeout
        Time after which a command no longer acts [s].
    """

    name: str
    model: ModelView
    robot: str
    remarks: tuple[str, ...]
    timeout: float

    @property
    def time(self) -> float:
        """Time since the last reset [s]."""

    @property
    def state(self) -> State:
        """True values of all coordinates; its stamp is the time [s]."""

    @property
    def held(self) -> str | None:
        """Frame of the body in the robot's gripper; None if it holds nothing."""

    def reset(self, state: StateLike) -> None:
        """Start again from a state, at time 0, with nothing in the gripper."""

    def apply(self, speeds: StateLike, duration: float, *, stamp: float | None = None) -> None:
        """Advance by a duration with speeds of the robot.

        Speeds of anything else are not read. Fingers keep closing with the world's grip force once they
        touch. A missing speed is zero, but that of fingers keeps the last value.

        Parameters
        ----------
        speeds
            Speeds of the robot by symbol or name [m/s], [rad/s]; an empty mapping stops it.
        duration
            Time [s].
        stamp
            Time of the state from which the speeds were computed [s]: stale ones are refused, and the robot
            stops. None for speeds without a stamp, which are not refused.

        Raises
        ------
        InvalidValueError
            For speeds that are not finite, and a duration that is not positive.
        """

    def contacts(self) -> Sequence[Contact]:
        """Return the bodies of the robot that touch something else, and those of furniture that collide."""

    def observe(self) -> Observation:
        """Return the latest sensor readings that have arrived."""
