"""The controls of the page: a slider a degree of freedom, what is violated, what is shown."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from kineverse.view.drive import VelocityDrive
from kineverse.view.hypertext import Html, HtmlBox, element
from kineverse.view.proximity_panel import ProximityPanel
from kineverse.view.scene import ViewerScene
from kineverse.view.sliders import QuaternionAngles, Ranges, choose_slider_range, choose_slider_step
from kineverse.view.violations import format_missing_meshes, format_significant, format_violations

BEYOND = 0.2
"""How much wider sliders get on demand, as a part of their range, so that limits can be crossed."""

MOST_UNFOLDED = 100
"""With at most so many degrees of freedom all groups are unfolded at first."""

DEGREES = {"rad": ("°", math.degrees(1.0)), "rad/s": ("°/s", math.degrees(1.0))}
"""What angles are shown in on demand: another unit, and how many of it one radian is."""

STYLE = """
.mantine-Slider-markLabel { display: none }
.mantine-Flex-root:has(> div > p > label):has(.mantine-Slider-root) { display: block }
.mantine-Flex-root:has(> div > p > label):has(.mantine-Slider-root) > div:first-child {
  width: auto !important }
.mantine-Flex-root:has(.mantine-Slider-root) > div > p > label {
  display: block; white-space: pre; overflow: hidden; text-overflow: ellipsis }
.mantine-Flex-root:has(> div > p > label):has(.mantine-Checkbox-root) > div:first-child {
  width: auto !important; min-width: 6.5em; white-space: nowrap }
"""
"""Sliders below their names, which do not fit beside them; the names say the range."""


class Panel:
    """The controls of one model.

    Parameters
    ----------
    gui
        The gui of a viser server.
    scene
        What is switched on and off.
    collisions
        What adds a folder of its own.
    ranges
        The limits of the degrees of freedom.
    orientations
        The quaternions among them, in whose place there are sliders of angles.
    driving
        The speeds that have sliders.
    units
        Their units, by name.
    values
        Their values at first, by name.
    moved
        Called with the name and value of a slider that somebody moved.
    driven
        Called with the name and value of a speed that somebody set.
    reset, play
        Called when somebody wants the initial state, or starts (True) and stops (False) the show.
    degrees
        Whether angles are shown in degrees; somebody may switch that.
    """

    def __init__(
        self,
        gui: Any,
        scene: ViewerScene,
        collisions: ProximityPanel,
        ranges: Ranges,
        orientations: QuaternionAngles,
        driving: VelocityDrive,
        units: Mapping[str, str],
        values: Mapping[str, float],
        *,
        moved: Callable[[str, float], None],
        driven: Callable[[str, float], None],
        reset: Callable[[], None],
        play: Callable[[bool], None],
        degrees: bool = False,
    ) -> None:
        self._gui, self._ranges, self._units, self._moved = gui, ranges, dict(units), moved
        self._shown: Mapping[str, float] = {**values, **orientations.angles}
        self._locked: dict[str, bool] = {}
        # Switches on the page and the motion of the model come from different threads.
        self._changing = threading.RLock()
        self._in_degrees = degrees
        self._orientations, self._driving, self._collisions = orientations, driving, collisions
        self._limits = {**ranges.at(values), **orientations.limits}
        self._sliders: dict[str, Any] = {}
        self._speeds: dict[str, Any] = {}
        self._folders: dict[str, Any] = {}
        self._root = gui.add_folder(None)
        with self._root:
            HtmlBox(gui, element("style", Html(STYLE)))
            self._status = HtmlBox(gui, format_violations(()))
            collisions.add_folder(gui)
            tabs = gui.add_tab_group()
            with tabs.add_tab("Move"):
                self._add_controls(reset, play)
                self._add_sliders({**values, **orientations.angles})
                if driving.speeds:
                    self._add_speeds(driven)
                self._lock(values)
            with tabs.add_tab("Show"):
                self._add_switches(scene)

    def remove(self) -> None:
        """Take everything off the page."""
        self._collisions.forget_folder()
        self._root.remove()

    def show(self, status: Html) -> None:
        """Show HTML above the sliders: what is violated, or what went wrong."""
        self._status.show(status)

    def update(self, values: Mapping[str, float], driven: Iterable[str] = ()) -> None:
        """Set sliders to values that did not come from them, and all ranges to what the values allow.

        Parameters
        ----------
        values
            The values of all symbols, by name [m], [rad].
        driven
            The names of those that were set by a program.
        """
        with self._changing:
            self._update({**values, **self._orientations.angles}, values, driven)

    @property
    def beyond(self) -> bool:
        """Whether limits and locks may be crossed."""
        return bool(self._beyond.value)

    @property
    def degrees(self) -> bool:
        """Whether angles are shown in degrees."""
        return self._in_degrees

    def _update(self, shown: Mapping[str, float], values: Mapping[str, float], driven: Iterable[str]) -> None:
        self._shown = shown
        for name in self._orientations.slider_names(driven):
            slider = self._sliders.get(name)
            if slider is not None:
                if not slider.min <= self._to_shown(name, shown[name]) <= slider.max:
                    self._fit(name, shown[name])
                slider.value = self._to_shown(name, shown[name])
        if self._ranges.varying:
            self._limits.update(self._ranges.at(values))
            for name in self._ranges.varying:
                self._fit(name, self._value(name))
        self._lock(values)
        for name, speed in self._driving.speeds.items():
            if self._speeds[name].value != self._to_shown(name, speed):
                self._speeds[name].value = self._to_shown(name, speed)

    def _add_controls(self, reset: Callable[[], None], play: Callable[[bool], None]) -> None:
        gui = self._gui
        find = gui.add_text("find", "", hint="Show only the sliders whose name contains this.")
        find.on_update(lambda event: self._find(event.target.value))
        gui.add_button("Reset", hint="Back to the state at the start.").on_click(lambda _: reset())
        self._beyond = gui.add_checkbox(
            "beyond limits",
            False,
            hint=f"Widen all sliders by {BEYOND:.0%}, and ignore locks, to see limits violated.",
        )
        self._beyond.on_update(lambda _: self._widen())
        degrees = gui.add_checkbox(
            "degrees", self._in_degrees, hint="Show angles in degrees instead of radians."
        )
        degrees.on_update(lambda event: self._convert(event.target.value))
        self.playing = gui.add_checkbox("play", False, hint="Move everything through its range.")
        self.playing.on_update(lambda event: play(event.target.value) if event.client is not None else None)

    def _add_sliders(self, values: Mapping[str, float]) -> None:
        groups: dict[str, list[str]] = {}
        for name in self._orientations.slider_names(self._ranges.names):
            groups.setdefault(name.rpartition("/")[0], []).append(name)
        few = len(self._ranges.names) <= MOST_UNFOLDED
        for number_, (group, names) in enumerate(groups.items()):
            folder = self._gui.add_folder(group or "model", expand_by_default=few or number_ == 0)
            self._folders[group] = folder
            with folder:
                for name in names:
                    self._sliders[name] = self._slider(name, values[name])

    def _add_speeds(self, driven: Callable[[str, float], None]) -> None:
        """Add a slider for each speed: what it moves goes on until it is 0 again."""
        gui, limits = self._gui, self._driving.limits
        with gui.add_folder("drive"):
            for name in self._driving.speeds:
                path = name.removesuffix(":velocity")
                self._units[name] = f"{self._units[path]}/s" if self._units.get(path) else ""
                low, high = (self._to_shown(name, limit) for limit in limits[name])
                slider = gui.add_slider(
                    self._label(name, limits[name]),
                    min=low,
                    max=high,
                    step=choose_slider_step((low, high)),
                    initial_value=0.0,
                    hint=f"{name}, from {format_significant(limits[name][0])} to {format_significant(limits[name][1])} "
                    f"{self._units[name]}; it goes on until this is 0",
                )
                slider.precision = _count_digits(low, high)
                slider.on_update(lambda event, name=name: self._set(driven, name, limits[name], event))
                self._speeds[name] = slider

            def stop(_: Any) -> None:
                for name in self._speeds:
                    driven(name, 0.0)

            gui.add_button("Stop", hint="Set all speeds to 0.").on_click(stop)

    def _slider(self, name: str, value: float) -> Any:
        lower, upper = self._limits[name]
        range_ = self._range(name, value)
        low, high = (self._to_shown(name, end) for end in range_)
        unit = self._units.get(name, "")
        slider = self._gui.add_slider(
            self._label(name, range_),
            min=low,
            max=high,
            step=choose_slider_step((low, high)),
            initial_value=self._to_shown(name, value),
            hint=f"{name}, limits {format_significant(lower)} to {format_significant(upper)} {unit}".rstrip(),
        )
        slider.precision = _count_digits(low, high)
        slider.on_update(lambda event: self._set(self._moved, name, self._limits[name], event))
        return slider

    def _label(self, name: str, range_: tuple[float, float], locked: bool = False) -> str:
        """Return the last part of a name with unit and range, such as ``door [rad]   0 to 1.57``."""
        unit = self._unit(name)
        low, high = (_format_short(self._to_shown(name, end)) for end in range_)
        last = name.removesuffix(":velocity").rpartition("/")[2]
        return f"{last}{f' [{unit}]' if unit else ''}   {low} to {high}{' · locked' if locked else ''}"

    def _unit(self, name: str) -> str:
        unit = self._units.get(name, "")
        return DEGREES[unit][0] if self.degrees and unit in DEGREES else unit

    def _factor(self, name: str) -> float:
        """Return what values are multiplied by to be shown."""
        unit = self._units.get(name, "")
        return DEGREES[unit][1] if self.degrees and unit in DEGREES else 1.0

    def _to_shown(self, name: str, value: float) -> float:
        return float(value) * self._factor(name)

    def _value(self, name: str) -> float:
        """Return what a slider is set to, in the units of the model."""
        return float(self._sliders[name].value) / self._factor(name)

    def _set(
        self, call: Callable[[str, float], None], name: str, limits: tuple[float, float], event: Any
    ) -> None:
        # Values that this program has set come back without a client.
        if event.client is None:
            return
        value = float(event.target.value) / self._factor(name)
        # There and back between units a limit is no longer quite itself, and would be violated.
        near = [limit for limit in limits if abs(value - limit) < 1e-12]
        call(name, near[0] if near else value)

    def _lock(self, values: Mapping[str, float]) -> None:
        """Show what cannot move at these values, and keep its slider from being moved."""
        for name, held in self._ranges.held(values).items():
            locked, slider = all(held), self._sliders[name]
            self._locked[name] = locked
            self._relabel(name)
            if slider.disabled != (locked and not self.beyond):
                slider.disabled = locked and not self.beyond

    def _relabel(self, name: str) -> None:
        slider, factor = self._sliders[name], self._factor(name)
        label = self._label(name, (slider.min / factor, slider.max / factor), self._locked.get(name, False))
        if slider.label != label:
            slider.label = label

    def _range(self, name: str, value: float) -> tuple[float, float]:
        beyond = BEYOND if self.beyond else 0.0
        return choose_slider_range(self._limits[name], value, self._units.get(name, ""), beyond)

    def _fit(self, name: str, value: float) -> None:
        """Give a slider the range it should have now."""
        _set_range(self._sliders[name], *(self._to_shown(name, end) for end in self._range(name, value)))
        self._relabel(name)

    def _widen(self) -> None:
        with self._changing:
            for name, slider in self._sliders.items():
                self._fit(name, self._value(name))
                if self.beyond:
                    slider.disabled = False

    def _convert(self, degrees: bool) -> None:
        """Show angles in degrees or radians."""
        with self._changing:
            self._in_degrees = degrees
            for name, slider in self._sliders.items():
                self._fit(name, self._shown[name])
                slider.value = self._to_shown(name, self._shown[name])
            for name, slider in self._speeds.items():
                _set_range(slider, *(self._to_shown(name, limit) for limit in self._driving.limits[name]))
                slider.value = self._to_shown(name, self._driving.speeds[name])
                slider.label = self._label(name, self._driving.limits[name])

    def _find(self, text: str) -> None:
        shown = {name: text.lower() in name.lower() for name in self._sliders}
        for name, slider in self._sliders.items():
            slider.visible = shown[name]
        for group, folder in self._folders.items():
            folder.visible = any(shown[name] for name in shown if name.rpartition("/")[0] == group)

    def _add_switches(self, scene: ViewerScene) -> None:
        gui = self._gui
        frames = gui.add_checkbox("frames", False, hint="The axes of all frames: x red, y green, z blue.")
        labels = gui.add_checkbox("frame names", False)
        only = gui.add_text("only", "", hint="Only the frames whose name contains this.")

        def show_frames(_: Any) -> None:
            scene.show_frames(frames.value, labels.value, only.value)

        for control in (frames, labels, only):
            control.on_update(show_frames)
        visuals = gui.add_checkbox("bodies", True)
        visuals.on_update(lambda event: scene.show_visuals(event.target.value))
        ground = gui.add_checkbox("floor", True)
        ground.on_update(lambda event: scene.show_ground(event.target.value))
        if scene.problems:
            HtmlBox(gui, format_missing_meshes(scene.problems))


def _count_digits(low: float, high: float) -> int:
    """Return the decimals shown of a value in a range: as many as its steps have."""
    return max(0, len(f"{choose_slider_step((low, high)):.9f}".rstrip("0").partition(".")[2]))


def _set_range(slider: Any, low: float, high: float) -> None:
    if (slider.min, slider.max) != (low, high):
        slider.min, slider.max, slider.step = low, high, choose_slider_step((low, high))
        slider.precision = _count_digits(low, high)


def _format_short(value: float) -> str:
    """Return a number with two decimals, or as many as a small one needs to have two digits."""
    digits = 2 if abs(value) >= 0.1 or value == 0.0 else 1 - math.floor(math.log10(abs(value)))
    text = f"{value:.{digits}f}" if abs(value) < 1e6 else f"{value:.3g}"
    text = text.rstrip("0").rstrip(".") if "." in text and "e" not in text else text
    return text.replace("-", "−")
