"""Animations on the page: all coordinates through their ranges, velocity drive, playback of trajectories."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Protocol

from kineverse._checks import check_flag, finite_number
from kineverse.errors import InvalidValueError, KineverseError
from kineverse.model.model_view import ModelView
from kineverse.planning.trajectories.trajectory import Trajectory
from kineverse.state import State

from .sliders import choose_slider_range, on_input

PERIOD = 8.0  # time from one limit to the other and back [s]
FADE_IN = 1.5  # time in which the motion grows from the initial posture [s]


class RangeAnimation:
    """Oscillation of all degrees of freedom between their limits, each a little behind the one before."""

    finished = False

    def __init__(
        self, start: Mapping[str, float], limits: Mapping[str, tuple[float, float]], now: float
    ) -> None:
        self._start = {name: start[name] for name in limits}
        self._limits = dict(limits)
        self._begin = now

    def values_at(self, now: float) -> dict[str, float]:
        """Return the values at a time [s]; continuous, and inside the limits if the start is."""
        elapsed = now - self._begin
        weight = min(elapsed / FADE_IN, 1.0)
        weight *= weight * (3.0 - 2.0 * weight)
        values = {}
        for number, (name, (lower, upper)) in enumerate(self._limits.items()):
            phase = 2.0 * math.pi * elapsed / PERIOD - 0.4 * number
            swing = lower + (upper - lower) * (0.5 - 0.5 * math.cos(phase))
            values[name] = (1.0 - weight) * self._start[name] + weight * swing
        return values


def select_animated(
    model: ModelView,
    limits: Mapping[str, tuple[float, float]],
    angles: Iterable[str],
    values: Mapping[str, float],
    units: Mapping[str, str],
) -> dict[str, tuple[float, float]]:
    """Return the ranges through which an animation moves, by name.

    Coordinates without limits have no range, and a robot would drive off the page. They are animated only if
    nothing else can move.
    """
    found = {name: (low, high) for name, (low, high) in limits.items() if high - low < 1e6}
    if found:
        return found
    rates = {str(symbol) for symbol in model.rates}
    found = dict.fromkeys(angles, (-0.5, 0.5))
    for name in limits.keys() - rates:
        found[name] = choose_slider_range(limits[name], values[name], units[name])
    return found


UNLIMITED_SPEED = 2.0  # the largest speed on offer if the model sets no limit [m/s], [rad/s]
LONGEST_STEP = 0.2  # the longest time step that is integrated [s]; after a pause nothing jumps


class VelocityDrive:
    """Speeds of coordinates with rates: wheels, drives, angular velocities."""

    def __init__(self, model: ModelView) -> None:
        self._model = model
        symbols = {speed for row in model.rates.values() for speed in row}
        ordered = sorted(symbols, key=lambda s: s.sort_key)
        self.speeds = {str(speed): 0.0 for speed in ordered}
        self.limits: dict[str, tuple[float, float]] = {}
        for speed in ordered:
            lower, upper = model.limits(speed)
            self.limits[str(speed)] = (
                lower if math.isfinite(lower) else -UNLIMITED_SPEED,
                upper if math.isfinite(upper) else UNLIMITED_SPEED,
            )

    @property
    def running(self) -> bool:
        """True if any speed is not 0."""
        return any(self.speeds.values())

    def stop(self) -> None:
        """Set all speeds to 0."""
        self.speeds = dict.fromkeys(self.speeds, 0.0)

    def step(self, values: Mapping[str, float], seconds: float) -> dict[str, float]:
        """Integrate values over a time [s]; return those that change, and stop at a violated constraint."""
        try:
            moved = self._model.integrate(State(values), self.speeds, min(seconds, LONGEST_STEP))
            changed = {name: moved[name] for name in values if moved[name] != values[name]}
            broken = {v.name for v in self._model.violations(State({**values, **changed}))}
            stuck = bool(broken) and not broken <= {v.name for v in self._model.violations(State(values))}
        except KineverseError:
            stuck = True
        if stuck:
            self.stop()
            return {}
        return changed


_STEPS = 1000  # steps of the slider of the time
_DIGITS = 3  # decimals of the time on the page
_SHORTEST = 1e-3  # shortest range of the slider [s], for a trajectory of no duration


class PlaybackLayer(Protocol):
    """Further things on the page that depend on the time of a playback."""

    def show(self, time: float) -> None:
        """Show a time of the trajectory [s]."""

    def remove(self) -> None:
        """Remove everything from the page."""


class TrajectoryPlayback:
    """Trajectory that is played, and its controls on the page."""

    def __init__(
        self,
        gui: Any,
        trajectory: Trajectory,
        *,
        speed: float = 1.0,
        loop: bool = False,
        on_seek: Callable[[float], None],
        on_run: Callable[[bool], None],
        layer: PlaybackLayer | None = None,
    ) -> None:
        factor = finite_number(speed)
        if factor is None or factor <= 0:
            raise InvalidValueError(f"speed= is a positive factor on the time, not {speed!r}.")
        check_flag("loop", loop)
        self.trajectory = trajectory
        self._speed, self._loop = factor, loop
        self._time, self._begin = 0.0, 0.0
        self._layer, self._layer_time = layer, -1.0
        longest = max(trajectory.duration, _SHORTEST)
        # Above everything else, where it is in view beside a robot with many sliders.
        self._folder = gui.add_folder("trajectory", order=-1.0)
        with self._folder:
            self._running = gui.add_checkbox(
                "run", False, hint="Play the trajectory, or stop it where it is."
            )
            self._slider = gui.add_slider(
                f"time [s]   0 to {trajectory.duration:.3g}",
                min=0.0,
                max=longest,
                step=longest / _STEPS,
                initial_value=0.0,
                hint="Time of the trajectory.",
            )
            self._slider.precision = _DIGITS
        on_input(self._running, on_run)
        on_input(self._slider, lambda value: on_seek(float(value)))

    @property
    def time(self) -> float:
        """Time of the trajectory that was shown last [s]."""
        return self._time

    @property
    def finished(self) -> bool:
        """True if the end was shown, unless the trajectory begins again there."""
        return self._time >= self.trajectory.duration and not self._loop

    def start(self, now: float) -> None:
        """Go on at a time of the clock [s]; from the beginning after the end."""
        if self._time >= self.trajectory.duration:
            self._time = 0.0
        self._begin = now - self._time / self._speed
        self._running.value = True

    def pause(self) -> None:
        """Show that the trajectory stands still."""
        self._running.value = False

    def seek(self, time: float) -> dict[str, float]:
        """Go to a time of the trajectory [s], and return the values there by name."""
        self._time = min(max(time, 0.0), self.trajectory.duration)
        self._slider.value = round(self._time, _DIGITS)
        values = self.trajectory.positions_at(self._time).tolist()
        return dict(zip(map(str, self.trajectory.symbols), values, strict=True))

    def values_at(self, now: float) -> dict[str, float]:
        """Return the values at a time of the clock [s], by name, and show the time."""
        time = (now - self._begin) * self._speed
        if self._loop and self.trajectory.duration:
            time %= self.trajectory.duration
        return self.seek(time)

    def draw(self) -> None:
        """Show the layer at the present time, unless it is there."""
        if self._layer is not None and self._layer_time != self._time:
            self._layer_time = self._time
            self._layer.show(self._time)

    def remove(self) -> None:
        """Remove the controls and the layer from the page."""
        self._folder.remove()
        if self._layer is not None:
            self._layer.remove()
            self._layer = None
