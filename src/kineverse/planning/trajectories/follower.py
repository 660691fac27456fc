"""Goals that let a controller follow a trajectory."""

from __future__ import annotations

from kineverse.control import Controller, Goal, Target
from kineverse.errors import InvalidValueError
from kineverse.expressions.expression import ExpressionLike

from .trajectory import Trajectory

_GAIN = 5.0
_WEIGHT = 100.0


class TrajectoryFollower:
    """Goals for the coordinates of a trajectory, whose targets and feed-forward rates are parameters.

    ::

        follower = kv.planning.TrajectoryFollower(trajectory)
        controller = kv.control.Controller(model, follower.tasks, dt=0.02)
        follower.set(controller, time)
        command = controller.step(state)

    A trajectory of the same coordinates can take the place of another one at any time, without another
    compilation: ``follower.trajectory = other``.

    Parameters
    ----------
    trajectory
        The trajectory.
    gain
        Rate at which errors decay [1/s], at most 1/dt of the controller.
    weight
        Weight of the goals; with a large one, other goals give way.
    name
        Path of the parameters.

    Attributes
    ----------
    tasks
        One goal for each coordinate.
    """

    def __init__(
        self,
        trajectory: Trajectory,
        *,
        gain: ExpressionLike = _GAIN,
        weight: ExpressionLike = _WEIGHT,
        name: str = "trajectory",
    ) -> None:
        self._trajectory = trajectory
        self._position = Target(f"{name}/position", trajectory.positions[0])
        self._speed = Target(f"{name}/speed", 0 * trajectory.positions[0])
        self.tasks = tuple(
            Goal(
                symbol,
                self._position.expression[k],
                rate=self._speed.expression[k],
                gain=gain,
                weight=weight,
                name=f"{name}/{symbol}",
            )
            for k, symbol in enumerate(trajectory.symbols)
        )

    @property
    def trajectory(self) -> Trajectory:
        """The trajectory that is followed; another one has the same coordinates."""
        return self._trajectory

    @trajectory.setter
    def trajectory(self, other: Trajectory) -> None:
        if other.symbols != self._trajectory.symbols:
            raise InvalidValueError(
                "The goals are about the coordinates of the first trajectory, and another one has the same, "
                "in the same order. For others make another follower and controller."
            )
        self._trajectory = other

    def set(self, controller: Controller, time: float) -> None:
        """Set the targets of a controller for its step at a time of the trajectory [s].

        The rate is the mean one of the coming control period, so that a motion without disturbances stays
        on the trajectory. After the end, the goals hold the last position.
        """
        dt, trajectory = controller.dt, self._trajectory
        now, later = trajectory.positions_at(float(time)), trajectory.positions_at(float(time) + dt)
        controller.set(self._position, now)
        controller.set(self._speed, (later - now) / dt)
