"""Trajectories: timed motions of coordinates as values, and goals that let a controller follow them."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from kineverse._checks import finite_number
from kineverse.errors import FormatError, InvalidValueError, ShapeError
from kineverse.expressions.expression import ExpressionLike
from kineverse.lie import Array
from kineverse.model.model_view import ModelView
from kineverse.state import State
from kineverse.symbols import Symbol

from .trajectory_file import TrajectoryData, parse_coordinates, read_trajectory_file, write_trajectory_file

if TYPE_CHECKING:
    from kineverse.control import Controller

_JUMP = 1e-6  # largest difference of positions [rad], [m] and velocities where two are joined
_GAIN, _WEIGHT = 5.0, 100.0  # gain [1/s] and weight of the goals of a follower


@dataclass(frozen=True, eq=False, repr=False)
class Trajectory:
    """Motion of coordinates over time: knots with positions and velocities, and cubics between them.

    Trajectories are immutable values. The arrays are copies and cannot be written.

    Attributes
    ----------
    symbols
        Coordinates (n,), the columns of the arrays.
    times
        Times of the knots (T,) [s], from 0, increasing.
    positions
        Positions at the knots (T, n) [rad], [m].
    velocities
        Velocities at the knots (T, n) [rad/s], [m/s].

    Raises
    ------
    InvalidValueError
        For times that do not begin at 0 or do not increase, numbers that are not finite, a symbol that is
        there twice, or one that is no coordinate.
    """

    symbols: tuple[Symbol, ...]
    times: Array
    positions: Array
    velocities: Array

    def __post_init__(self) -> None:
        symbols = tuple(self.symbols)
        times, positions, velocities = (
            np.array(values, dtype=float) for values in (self.times, self.positions, self.velocities)
        )
        shape = (times.size, len(symbols))
        if times.ndim != 1 or not times.size or positions.shape != shape or velocities.shape != shape:
            raise ShapeError(
                f"A trajectory of {len(symbols)} coordinates has times (T,) with T >= 1, and positions and "
                f"velocities (T, {len(symbols)}); these have the shapes {times.shape}, {positions.shape} and "
                f"{velocities.shape}."
            )
        if not all(np.isfinite(values).all() for values in (times, positions, velocities)):
            raise InvalidValueError("The numbers of a trajectory are finite; there is a NaN or an infinity.")
        if times[0] != 0 or (np.diff(times) <= 0).any():
            raise InvalidValueError("The times of a trajectory begin at 0 and increase from knot to knot.")
        for symbol in symbols:
            if not isinstance(symbol, Symbol) or symbol.order or symbol.role != "dof":
                raise InvalidValueError(f"A trajectory is about coordinates of a model, not {symbol!r}.")
        if len(set(symbols)) < len(symbols):
            twice = next(s for s in symbols if symbols.count(s) > 1)
            raise InvalidValueError(f"The trajectory has two columns for '{twice}'.")
        for name, values in (("times", times), ("positions", positions), ("velocities", velocities)):
            values.flags.writeable = False
            object.__setattr__(self, name, values)
        object.__setattr__(self, "symbols", symbols)

    @property
    def duration(self) -> float:
        """Time of the last knot [s]."""
        return float(self.times[-1])

    def at(self, time: float) -> State:
        """Return the state at a time [s], with the time as its stamp.

        Before the beginning it is the first state, and after the end the last one.
        """
        values = self.positions_at(_time(time))
        return State(dict(zip(self.symbols, values.tolist(), strict=True)), stamp=float(time))

    def positions_at(self, times: npt.ArrayLike) -> Array:
        """Return the positions at times of shape (...), with the shape (..., n) [rad], [m].

        Before the beginning they are the first ones, and after the end the last ones.
        """
        if isinstance(times, float) and math.isfinite(times):
            return self._position_at(times)
        k, u, dt = self._locate(times)
        p, q = self.positions[k], self.positions[k + 1 - self._single]
        v, w = self.velocities[k] * dt, self.velocities[k + 1 - self._single] * dt
        # Cubic Hermite polynomial, about the nearer end so that knots are met exactly.
        change = q - p
        near = p + u * (v + u * ((3 * change - 2 * v - w) + u * (v + w - 2 * change)))
        r = u - 1
        far = q + r * (w + r * ((2 * w + v - 3 * change) + r * (v + w - 2 * change)))
        return np.asarray(np.where(u < 0.5, near, far))

    @cached_property
    def _polynomials(self) -> Array:
        """Coefficients (2, T - 1, 4, n) of the cubics in the intervals, about their beginnings and ends."""
        dt = np.diff(self.times)[:, None]
        p, q = self.positions[:-1], self.positions[1:]
        v, w = self.velocities[:-1] * dt, self.velocities[1:] * dt
        change = q - p
        cubic = v + w - 2 * change
        begins = p, v, 3 * change - 2 * v - w, cubic
        ends = q, w, 2 * w + v - 3 * change, cubic
        return np.array([np.stack(rows, axis=1) for rows in (begins, ends)])

    def _position_at(self, time: float) -> Array:
        """Return the position (n,) at one time: as :meth:`positions_at`, ten times as fast."""
        last = len(self.times) - 1
        k = int(self.times.searchsorted(time, side="right")) - 1
        if k < 0 or k >= last:
            return np.array(self.positions[max(k, 0)])
        start = self.times.item(k)
        u = (time - start) / (self.times.item(k + 1) - start)
        about_end = u >= 0.5
        u -= about_end
        powers = np.array((1.0, u, u * u, u * u * u))
        return np.asarray(powers @ self._polynomials[int(about_end), k])

    def velocities_at(self, times: npt.ArrayLike) -> Array:
        """Return the velocities at times of shape (...), with the shape (..., n) [rad/s], [m/s].

        Before the beginning and after the end they are 0.
        """
        given = np.asarray(times, dtype=float)
        k, u, dt = self._locate(given)
        p, q = self.positions[k], self.positions[k + 1 - self._single]
        v, w = self.velocities[k], self.velocities[k + 1 - self._single]
        mean = (q - p) / np.where(dt > 0, dt, 1.0)
        speed = (1 - u) * (1 - 3 * u) * v + u * (3 * u - 2) * w + 6 * u * (1 - u) * mean
        outside = (given < 0) | (given > self.duration)
        return np.where(outside[..., None], 0.0, speed)

    def sample(self, rate: float) -> Trajectory:
        """Return the trajectory with knots at a rate [Hz], and one at the end.

        Raises
        ------
        InvalidValueError
            For a rate that is not positive.
        """
        number = finite_number(rate)
        if number is None or number <= 0:
            raise InvalidValueError(f"A rate is a positive number of knots per second, not {rate!r}.")
        count = int(np.floor(self.duration * number * (1 - 1e-12)))
        times = np.append(np.arange(count + 1) / number, self.duration) if self.duration else self.times
        return self._at_knots(times)

    def between(self, start: float, end: float) -> Trajectory:
        """Return the part between two times [s]; its times begin at 0.

        Raises
        ------
        InvalidValueError
            Unless ``0 <= start <= end <= duration``.
        """
        first, last = _time(start), _time(end)
        if not 0 <= first <= last <= self.duration:
            raise InvalidValueError(
                f"A part is between two times from 0 to {self.duration:g} s, the first one first; not "
                f"between {start!r} and {end!r}."
            )
        inner = self.times[(self.times > first) & (self.times < last)]
        return self._at_knots(np.concatenate(([first], inner, [last] if last > first else [])))

    def then(self, other: Trajectory) -> Trajectory:
        """Return this motion with another one after it.

        Raises
        ------
        InvalidValueError
            If the other one is about other coordinates, or begins at another position or velocity.
        """
        if self.symbols != other.symbols:
            missing = [str(s) for s in {*self.symbols} ^ {*other.symbols}]
            about = f": '{missing[0]}' is in one of them" if missing else ", in another order"
            raise InvalidValueError(f"Trajectories that are joined have the same coordinates{about}.")
        for noun, end, begin in (
            ("position", self.positions[-1], other.positions[0]),
            ("velocity", self.velocities[-1], other.velocities[0]),
        ):
            jump = np.abs(end - begin)
            if jump.max(initial=0.0) > _JUMP:
                k = int(jump.argmax())
                raise InvalidValueError(
                    f"The {noun} of '{self.symbols[k]}' would jump from {end[k]:g} to {begin[k]:g}. "
                    "Plan from the state at the end of the first trajectory."
                )
        return Trajectory(
            self.symbols,
            np.concatenate([self.times, self.duration + other.times[1:]]),
            np.concatenate([self.positions, other.positions[1:]]),
            np.concatenate([self.velocities, other.velocities[1:]]),
        )

    def reversed(self) -> Trajectory:
        """Return the motion backwards in time."""
        return Trajectory(
            self.symbols, self.duration - self.times[::-1], self.positions[::-1], -self.velocities[::-1]
        )

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the trajectory to a JSON file; all numbers are exact."""
        names = [str(symbol) for symbol in self.symbols]
        write_trajectory_file(path, TrajectoryData(names, self.times, self.positions, self.velocities))

    @staticmethod
    def load(path: str | os.PathLike[str], model: ModelView | None = None) -> Trajectory:
        """Read a trajectory from a JSON file.

        Parameters
        ----------
        model
            Model to which the coordinates belong; None to accept all names.

        Raises
        ------
        FormatError
            If the file cannot be read or is no trajectory; the message says what is wrong.
        """
        data, source = read_trajectory_file(path), Path(path).name
        if model is None:
            symbols = parse_coordinates(data.names, source)
        else:
            symbols = tuple(model.symbol(name) for name in data.names)
        try:
            return Trajectory(symbols, *data[1:])
        except (InvalidValueError, ShapeError) as error:
            raise FormatError(f"{source}: {error}") from None

    def __len__(self) -> int:
        return len(self.times)

    def __iter__(self) -> Iterator[State]:
        """Yield the states at the knots, with their times as stamps."""
        for time, values in zip(self.times.tolist(), self.positions.tolist(), strict=True):
            yield State(dict(zip(self.symbols, values, strict=True)), stamp=time)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Trajectory):
            return NotImplemented
        return self.symbols == other.symbols and all(
            np.array_equal(a, b) for a, b in zip(self._arrays, other._arrays, strict=True)
        )

    def __hash__(self) -> int:
        return hash((self.symbols, *(values.tobytes() for values in self._arrays)))

    def __repr__(self) -> str:
        names = ", ".join(map(str, self.symbols[:4])) + (", ..." if len(self.symbols) > 4 else "")
        return (
            f"<Trajectory: {self.duration:g} s, {len(self)} knots, {len(self.symbols)} coordinates: {names}>"
        )

    @property
    def _arrays(self) -> tuple[Array, Array, Array]:
        # Adding 0 makes -0.0 and 0.0, which are equal, the same bytes.
        return self.times + 0.0, self.positions + 0.0, self.velocities + 0.0

    @property
    def _single(self) -> int:
        return int(len(self.times) == 1)

    def _locate(self, times: npt.ArrayLike) -> tuple[npt.NDArray[np.intp], Array, Array]:
        """Return the knots before times, and the fractions and lengths of their intervals (..., 1)."""
        t = np.clip(np.asarray(times, dtype=float), 0.0, self.duration)
        if np.isnan(t).any():
            raise InvalidValueError("A time of a trajectory is a number, not NaN.")
        k = np.clip(np.searchsorted(self.times, t, side="right") - 1, 0, max(len(self.times) - 2, 0))
        dt = self.times[k + 1 - self._single] - self.times[k]
        u = np.divide(t - self.times[k], dt, out=np.zeros_like(t), where=dt > 0)
        return k, np.asarray(u)[..., None], np.asarray(dt)[..., None]

    def _at_knots(self, times: Array) -> Trajectory:
        return Trajectory(self.symbols, times - times[0], self.positions_at(times), self.velocities_at(times))


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
        # For start-up time: a trajectory alone imports no controllers.
        from kineverse.control.tasks import Goal, Target

        self._trajectory = trajectory
        self._position = Target(f"{name}/position", trajectory.positions[0])
        self._speed = Target(f"{name}/speed", 0 * trajectory.positions[0])
        targets, rates = self._position.expression, self._speed.expression
        self.tasks = tuple(
            Goal(s, targets[k], rate=rates[k], gain=gain, weight=weight, name=f"{name}/{s}")
            for k, s in enumerate(trajectory.symbols)
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

    def set(self, controller: Controller, time: float, *, pace: float = 1.0) -> None:
        """Set the targets of a controller for its step at a time of the trajectory [s].

        The rate is the mean one of the coming control period, so that a motion without disturbances stays
        on the trajectory. It is less for a pace below 1, at which the time of the trajectory goes on. After
        the end, the goals hold the last position.
        """
        dt, trajectory = controller.dt, self._trajectory
        now, later = trajectory.positions_at(float(time)), trajectory.positions_at(float(time) + pace * dt)
        controller.set(self._position, now)
        controller.set(self._speed, (later - now) / dt)


def _time(value: float) -> float:
    number = finite_number(value)
    if number is None:
        raise InvalidValueError(f"A time is a finite number of seconds, not {value!r}.")
    return number
