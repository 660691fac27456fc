"""Trajectories: timed motions of coordinates as values, and goals that let a controller follow them.

Files of trajectories are JSON, plain data with names, exact to the last bit::

    {"format": "kineverse trajectory", "version": 1, "coordinates": ["kitchen/fridge_door", ...],
     "times": [0.0, ...], "positions": [[0.0, ...], ...], "velocities": [[0.0, ...], ...]}

Times are in [s], positions and velocities in [rad], [m] and per second, one row for each time.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np
import numpy.typing as npt

from kineverse._checks import finite_number
from kineverse._names import answer_foreign_names
from kineverse._rich_display import draw_curves, element, html_table, picture_element
from kineverse._synonyms import TRAJECTORY_SYNONYMS
from kineverse.errors import ExpressionError, FormatError, InvalidValueError, ShapeError
from kineverse.expressions.expression import ExpressionLike
from kineverse.expressions.printing import format_number
from kineverse.formats.files import read_file, replace_file
from kineverse.lie import Array
from kineverse.model.model_view import ModelView
from kineverse.state import State
from kineverse.symbols import Symbol, parse_symbol_name

if TYPE_CHECKING:
    from kineverse.control import Controller

_JUMP = 1e-6  # largest difference of positions [rad], [m] and velocities where two are joined
_SAMPLES = 200  # number of points of a drawn curve: two pixels apart
_GAIN, _WEIGHT = 5.0, 100.0  # gain [1/s] and weight of the goals of a follower


@answer_foreign_names("A trajectory", TRAJECTORY_SYNONYMS)
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

    Examples
    --------
    >>> q = kv.position("door")
    >>> motion = kv.planning.time_parameterize([[0.0], [1.0]], 1.0, 2.0, symbols=[q])
    >>> motion.duration, motion.at(0.75)
    (1.5, State({door: 0.5}, stamp=0.75))
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
        k, u, _ = self._locate(times)
        about_end = u >= 0.5
        polynomials = self._polynomials[about_end[..., 0].astype(int), k]
        return np.asarray(np.einsum("...i,...in->...n", (u - about_end) ** np.arange(4), polynomials))

    @cached_property
    def _polynomials(self) -> Array:
        """Coefficients (2, T - 1, 4, n) of the cubics in the intervals, about their beginnings and ends.

        Hermite polynomials about the nearer end meet knots exactly. One knot is an interval without length.
        """
        count = max(len(self.times) - 1, 1)
        dt = (self.times[-count:] - self.times[:count])[:, None]
        p, q = self.positions[:count], self.positions[-count:]
        v, w = self.velocities[:count] * dt, self.velocities[-count:] * dt
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
        return np.asarray(np.array((1.0, u, u * u, u * u * u)) @ self._polynomials[int(about_end), k])

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
        check_trajectory_name(path)
        names = [str(symbol) for symbol in self.symbols]
        document = {"format": FORMAT, "version": VERSION, "coordinates": names}
        document |= {key: getattr(self, key).tolist() for key in _ARRAYS}
        replace_file(Path(path), json.dumps(document, allow_nan=False).encode())

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
        source, (names, *arrays) = Path(path).name, _read_file(Path(path))
        if model is None:
            symbols = tuple(_parse_coordinate(name, source) for name in names)
        else:
            symbols = tuple(model.symbol(name) for name in names)
        try:
            return Trajectory(symbols, *arrays)
        except (InvalidValueError, ShapeError) as error:
            raise FormatError(f"{source}: {error}") from None

    def __len__(self) -> int:
        return len(self.times)

    def __iter__(self) -> Iterator[State]:
        for time, values in zip(self.times.tolist(), self.positions.tolist(), strict=True):
            yield State(dict(zip(self.symbols, values, strict=True)), stamp=time)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Trajectory):
            return NotImplemented
        return self.symbols == other.symbols and all(map(np.array_equal, self._arrays, other._arrays))

    def __hash__(self) -> int:
        return hash((self.symbols, *(values.tobytes() for values in self._arrays)))

    def __repr__(self) -> str:
        names = ", ".join(map(str, self.symbols[:4])) + (", ..." if len(self.symbols) > 4 else "")
        size = f"{len(self)} knots, {len(self.symbols)} coordinates"
        return f"<Trajectory: {self.duration:g} s, {size}: {names}>"

    def _repr_html_(self) -> str:
        names = [str(symbol) for symbol in self.symbols]
        times = np.linspace(0.0, self.duration, _SAMPLES)
        curves = draw_curves(times, self.positions_at(times), names)
        rows = [
            (name, *map(format_number, (*column[[0, -1]], column.min(), column.max(), np.abs(speed).max())))
            for name, column, speed in zip(names, self.positions.T, self.velocities.T, strict=True)
        ]
        caption = f"trajectory of {self.duration:.3g} s, {len(self)} knots [rad], [m]"
        header = ("coordinate", "begin", "end", "least", "largest", "largest speed")
        table = html_table(caption, header, rows)
        return element("div", *([] if curves is None else [picture_element(curves, caption)]), table)

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

    Examples
    --------
    >>> model = kv.load("kitchen")
    >>> door = model.symbol("kitchen/fridge_door")
    >>> motion = kv.planning.time_parameterize([[0.0], [1.0]], 1.0, 2.0, symbols=[door])
    >>> follower = kv.planning.TrajectoryFollower(motion)
    >>> controller = kv.control.Controller(model, follower.tasks, dt=0.02, tier="interpreter")
    >>> follower.set(controller, 0.75)
    >>> command = controller.step(motion.at(0.75))
    >>> round(command.speeds[door.derivative()], 2)
    1.0
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


FORMAT = "kineverse trajectory"
VERSION = 1
_ARRAYS = "times", "positions", "velocities"


def check_trajectory_name(path: str | os.PathLike[str]) -> None:
    """Check that a file name ends in .json, or has no suffix."""
    suffix = Path(path).suffix
    if suffix.lower() not in ("", ".json"):
        raise FormatError(
            f"Trajectories are written as .json, not {suffix}: '{Path(path).with_suffix('.json')}'."
        )


def _read_file(path: Path) -> tuple[list[str], Array, Array, Array]:
    """Read names (n,), times (T,), positions and velocities (T, n), and check their types and shapes."""
    source = path.name

    def refuse(text: str) -> NoReturn:
        raise FormatError(f"{source}: {text} is not a number.")

    try:
        document = json.loads(read_file(path), parse_constant=refuse)
    except (ValueError, RecursionError) as error:
        if isinstance(error, FormatError):
            raise
        raise FormatError(f"{source}: not JSON: {str(error)[:200]}.") from None
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise FormatError(f'{source}: not a trajectory, which is an object with "format": "{FORMAT}".')
    if document.get("version") != VERSION:
        raise FormatError(
            f"{source}: version {document.get('version')!r:.40} of the format; this version reads {VERSION}."
        )
    missing = [key for key in ("coordinates", *_ARRAYS) if key not in document]
    if missing:
        raise FormatError(f"{source}: there is no {missing[0]!r}.")
    names = document["coordinates"]
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise FormatError(f"{source}: 'coordinates' is a list of names.")
    times = _numbers(document["times"], "times", source)
    shape = (times.size, len(names))
    positions, velocities = (_table(document[key], key, shape, source) for key in _ARRAYS[1:])
    return names, times, positions, velocities


def _parse_coordinate(name: str, source: str) -> Symbol:
    try:
        path, order = parse_symbol_name(name)
        symbol = Symbol(path, order)
    except ExpressionError as error:
        raise FormatError(f"{source}: {name!r:.80} is not the name of a coordinate: {error}") from None
    if order:
        raise FormatError(f"{source}: {name!r:.80} is a derivative; the columns are positions.")
    return symbol


def _numbers(values: Any, key: str, source: str) -> Array:
    """Read a list of numbers as an array; texts, truth values and nested lists are refused."""
    if not isinstance(values, list):
        raise FormatError(f"{source}: '{key}' is a list of numbers, not {values!r:.40}.")
    for value in values:
        if type(value) not in (int, float):
            raise FormatError(f"{source}: {value!r:.40} in '{key}' is not a number.")
    try:
        return np.array(values, dtype=float)
    except OverflowError:
        raise FormatError(f"{source}: '{key}' has a number that is too large.") from None


def _table(rows: Any, key: str, shape: tuple[int, int], source: str) -> Array:
    if not isinstance(rows, list) or len(rows) != shape[0]:
        raise FormatError(f"{source}: '{key}' is a list of {shape[0]} rows, one for each time.")
    table = np.empty(shape)
    for k, row in enumerate(rows):
        numbers = _numbers(row, key, source)
        if len(numbers) != shape[1]:
            raise FormatError(
                f"{source}: row {k} of '{key}' has {len(numbers)} numbers, and there are {shape[1]} "
                "coordinates."
            )
        table[k] = numbers
    return table
