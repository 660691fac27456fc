"""Commands of speeds to a world: checks of its arguments, and the command that acts at a time."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from kineverse._checks import as_positive, finite_number
from kineverse.errors import InvalidValueError, UnknownNameError, suggest
from kineverse.lie import Array
from kineverse.state import State, StateLike
from kineverse.symbols import Symbol

ROUNDING = 1e-9  # difference of times that counts as none [s]
SpeedColumns = Mapping[Symbol | str, int | None]  # by symbol and name; None for a speed that is not read


class _Command(NamedTuple):
    speeds: Array
    start: float
    end: float
    silent: float  # time from which the fingers stop, too


class SpeedCommands:
    """Speeds (n,) that were commanded to a robot, each with the time in which it acts [s].

    After its end everything stops but the fingers. These keep their last speed until no command has come for
    the time-out: a hand whose controller is gone must not go on closing.
    """

    def __init__(
        self,
        columns: SpeedColumns,
        fingers: npt.NDArray[np.bool_],
        timeout: float,
        delay: float,
        report: Callable[[str], object],
    ) -> None:
        self._columns, self._fingers, self._report = columns, fingers, report
        self._timeout, self._delay = timeout, delay
        self.reset()

    def reset(self) -> None:
        """Forget all commands."""
        self.refused = 0
        self._last = self._active = _Command(np.zeros(len(self._fingers)), 0.0, 0.0, 0.0)
        self._coming: deque[_Command] = deque()

    def take_over(self, other: SpeedCommands) -> None:
        """Go on with the commands of another world, whose robot has the same speeds or some of them."""
        names = [n for n, k in self._columns.items() if k is not None and other._columns.get(n) is not None]
        mine, theirs = (
            np.array([columns[n] for n in names], dtype=int) for columns in (self._columns, other._columns)
        )

        def carry(command: _Command) -> _Command:
            vector = np.zeros(len(self._fingers))
            vector[mine] = command.speeds[theirs]
            return command._replace(speeds=vector)

        self.refused, self._last, self._active = other.refused, carry(other._last), carry(other._active)
        self._coming = deque(map(carry, other._coming))

    def take(self, speeds: StateLike, duration: float, stamp: float | None, now: float) -> float:
        """Take speeds for a duration [s], and return its end; those with a stale stamp stop the robot."""
        until = end = now + as_positive(duration, "A duration", "number of seconds")
        taken = None if stamp is None else finite_number(stamp)
        if stamp is not None and taken is None:
            raise InvalidValueError(f"The stamp of speeds is a time in seconds, not {stamp!r}.")
        vector = parse_speeds(
            speeds, self._columns, self._stop(self._last, now <= self._last.silent + ROUNDING)
        )
        silent = now + self._timeout
        if taken is None:
            silent = max(silent, end)
        elif now - self._timeout <= taken + ROUNDING <= now + 2 * ROUNDING:
            until = min(end, taken + self._timeout)
        else:
            self.refused += 1
            self._report(f"speeds with the stamp {taken:g} s are refused")
            vector, until, silent = self._last.speeds, now, self._last.silent
        self._last = _Command(vector, now, until, silent)
        shift = self._delay
        self._coming.append(_Command(vector, now + shift, until + shift, silent + shift))
        return end

    def acting(self, time: float) -> Array:
        """Return the speeds that act at a time [s], which is not before that of the last call."""
        while self._coming and self._coming[0].start <= time + ROUNDING:
            self._active = self._coming.popleft()
        active = self._active
        if time < active.end - ROUNDING:
            return active.speeds
        return self._stop(active, time < active.silent - ROUNDING)

    def next_change(self, time: float) -> float:
        """Return the time after another one at which other speeds may act [s]; infinite if none is known."""
        changes = self._active.end, self._active.silent, *(command.start for command in self._coming)
        return min((t for t in changes if t > time + ROUNDING), default=np.inf)

    def _stop(self, command: _Command, keeps_fingers: bool) -> Array:
        """Return the speeds (n,) from the end of a command on."""
        return np.where(self._fingers & keeps_fingers, command.speeds, 0.0)


def parse_speeds(speeds: StateLike, columns: SpeedColumns, vector: Array) -> Array:
    """Write speeds into a vector (n,) of all columns, and return it."""
    if not isinstance(speeds, Mapping):
        raise InvalidValueError(f"Speeds are a mapping from symbols or names to numbers, not {speeds!r}.")
    for key, value in speeds.items():
        if key not in columns:
            if isinstance(speeds, State):
                continue  # a state may have further values
            names = [name for name in columns if isinstance(name, str)]
            raise UnknownNameError(
                f"The model has no free speed '{key}'. {suggest(str(key), names, 'speed')}"
            )
        if (column := columns[key]) is not None:
            number = finite_number(value)
            if number is None:
                raise InvalidValueError(f"The speed '{key}' is {value!r}; it must be finite.")
            vector[column] = number
    return vector


def check_settings(positive: Mapping[str, Any], others: Mapping[str, Any]) -> None:
    """Raise InvalidValueError for a setting of a world that is no positive number, or none from 0 on."""
    for name, value in (*positive.items(), *others.items()):
        number = finite_number(value)
        if number is None or number < 0 or (name in positive and not number):
            kind = "positive number" if name in positive else "number from 0 on"
            raise InvalidValueError(f"'{name}' of a world is a {kind}, not {value!r}.")
