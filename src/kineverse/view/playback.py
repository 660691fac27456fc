"""Playback of a trajectory on the page: a clock with speed, repetition and a slider for the time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from kineverse._checks import check_flag, finite_number
from kineverse.errors import InvalidValueError
from kineverse.planning.trajectories.trajectory import Trajectory

_STEPS = 1000
"""Steps of the slider of the time."""

_DIGITS = 3
"""Decimals of the time on the page."""

_SHORTEST = 1e-3
"""Shortest range of the slider [s], for a trajectory of no duration."""


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
        # Values set by this program come back as events without a client.
        self._running.on_update(
            lambda event: on_run(event.target.value) if event.client is not None else None
        )
        self._slider.on_update(
            lambda event: on_seek(float(event.target.value)) if event.client is not None else None
        )

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
