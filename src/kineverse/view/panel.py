"""Controls of the page: a slider for each degree of freedom, the constraint report, and switches."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from kineverse._rich_display import Html, element
from kineverse.model.constraint import Constraint

from .animation import VelocityDrive
from .dragging import FrameDrag
from .html import HtmlBox, format_missing_meshes, format_significant, format_violations
from .proximity_panel import ProximityPanel
from .scene import ViewerScene
from .sliders import (
    DisplayUnits,
    QuaternionAngles,
    Ranges,
    choose_slider_range,
    choose_slider_step,
    on_input,
)

BEYOND = 0.2  # fraction of their range by which sliders are widened on demand, to violate limits
MOST_UNFOLDED = 100  # with at most so many degrees of freedom all groups are unfolded at first

STYLE = """
.mantine-Slider-markLabel { display: none }
.mantine-Flex-root:has(> div > p > label):has(.mantine-Slider-root) { display: block }
.mantine-Flex-root:has(> div > p > label):has(.mantine-Slider-root) > div:first-child {
  width: auto !important }
.mantine-Flex-root:has(.mantine-Slider-root) > div > p > label {
  display: block; white-space: pre; overflow: hidden; text-overflow: ellipsis }
.mantine-Flex-root:has(> div > p > label):has(.mantine-Checkbox-root) > div:first-child {
  width: auto !important; min-width: 6.5em; white-space: nowrap }
@media (max-width: 36em) {
  div:has(> .mantine-Paper-root[style*="position: fixed"]) { flex-direction: column }
  .mantine-Paper-root[style*="position: fixed"] {
    position: static !important; flex-shrink: 0; width: 100% !important; max-height: 40% !important }
  .mantine-Paper-root[style*="position: fixed"] .mantine-ScrollArea-content > div { width: 100% !important }
}
"""
"""Sliders below their names, which include the range; on a phone the panel is a sheet below the scene."""


class Panel:
    """Controls of one model."""

    def __init__(
        self,
        gui: Any,
        scene: ViewerScene,
        proximity: ProximityPanel,
        ranges: Ranges,
        quaternions: QuaternionAngles,
        drive: VelocityDrive,
        units: Mapping[str, str],
        values: Mapping[str, float],
        drag: FrameDrag,
        *,
        on_move: Callable[[str, float], None],
        on_drive: Callable[[str, float], None],
        on_reset: Callable[[], None],
        on_play: Callable[[bool], None],
        on_convert: Callable[[], None],
        display: DisplayUnits,
        sliders: bool = True,
    ) -> None:
        self._gui, self._ranges, self._units, self._on_move = gui, ranges, dict(units), on_move
        self._on_convert = on_convert
        self._shown: Mapping[str, float] = {**values, **quaternions.angles}
        self._locked: dict[str, bool] = {}
        # Events of the page and the motion of the model come from different threads.
        self._changing = threading.RLock()
        self._display = display
        self._quaternions, self._drive, self._proximity, self._drag = quaternions, drive, proximity, drag
        self._limits = {**ranges.limits_at(values), **quaternions.limits}
        self._sliders: dict[str, Any] = {}
        self._speeds: dict[str, Any] = {}
        self._folders: dict[str, Any] = {}
        self._root = gui.add_folder(None)
        with self._root:
            HtmlBox(gui, element("style", Html(STYLE)))
            self._status = HtmlBox(gui, format_violations(()) if sliders else Html(""))
            proximity.add_folder(gui)
            self._has_sliders = sliders
            tabs = gui.add_tab_group()
            # Without sliders the tab is empty, and hidden.
            with tabs.add_tab("Move") if sliders else gui.add_folder(None, visible=False):
                self._add_controls(on_reset, on_play)
                if sliders:
                    drag.add_controls(gui)
                    self._add_sliders({**values, **quaternions.angles})
                if sliders and drive.speeds:
                    self._add_speeds(on_drive)
                self._lock(values)
            with tabs.add_tab("Show"):
                self._add_switches(scene)

    def remove(self) -> None:
        """Remove the panel from the page."""
        self._proximity.forget_folder()
        self._drag.forget_controls()
        self._root.remove()

    def show(self, status: Html) -> None:
        """Show HTML above the sliders: the violated constraints, or a failure."""
        self._status.show(status)

    def update(self, values: Mapping[str, float], set_by_program: Iterable[str] = ()) -> None:
        """Set the ranges of all sliders for a state, and the values of some of them."""
        if not self._has_sliders:
            return
        with self._changing:
            self._update({**values, **self._quaternions.angles}, values, set_by_program)

    @property
    def beyond(self) -> bool:
        """True if limits and locks may be violated."""
        return bool(self._beyond.value)

    def _update(
        self, shown: Mapping[str, float], values: Mapping[str, float], set_by_program: Iterable[str]
    ) -> None:
        self._shown = shown
        for name in self._quaternions.slider_names(set_by_program):
            slider = self._sliders.get(name)
            if slider is not None:
                if not slider.min <= self._to_shown(name, shown[name]) <= slider.max:
                    self._fit(name, shown[name])
                slider.value = self._to_shown(name, shown[name])
        if self._ranges.varying:
            self._limits.update(self._ranges.limits_at(values))
            for name in self._ranges.varying:
                self._fit(name, self._value(name))
        self._lock(values)
        for name, speed in self._drive.speeds.items():
            if self._speeds[name].value != self._to_shown(name, speed):
                self._speeds[name].value = self._to_shown(name, speed)

    def _add_controls(self, on_reset: Callable[[], None], on_play: Callable[[bool], None]) -> None:
        gui = self._gui
        find = gui.add_text("find", "", hint="Show only the sliders whose name contains this.")
        find.on_update(lambda event: self._find(event.target.value))
        gui.add_button("Reset", hint="Back to the state at the start.").on_click(lambda _: on_reset())
        self._beyond = gui.add_checkbox(
            "beyond limits",
            False,
            hint=f"Widen all sliders by {BEYOND:.0%}, and ignore locks, to see limits violated.",
        )
        self._beyond.on_update(lambda _: self._widen())
        degrees = gui.add_checkbox(
            "degrees", self._display.degrees, hint="Show angles in degrees instead of radians."
        )
        degrees.on_update(lambda event: self._convert(degrees=event.target.value))
        centimetres = gui.add_checkbox(
            "centimetres", self._display.centimetres, hint="Show lengths in centimetres instead of metres."
        )
        centimetres.on_update(lambda event: self._convert(centimetres=event.target.value))
        self.playing = gui.add_checkbox("play", False, hint="Move everything through its range.")
        on_input(self.playing, on_play)

    def _add_sliders(self, values: Mapping[str, float]) -> None:
        groups: dict[str, list[str]] = {}
        for name in self._quaternions.slider_names(self._ranges.names):
            groups.setdefault(name.rpartition("/")[0], []).append(name)
        few = len(self._ranges.names) <= MOST_UNFOLDED
        for number_, (group, names) in enumerate(groups.items()):
            folder = self._gui.add_folder(group or "model", expand_by_default=few or number_ == 0)
            self._folders[group] = folder
            with folder:
                for name in names:
                    range_ = self._range(name, values[name])
                    self._sliders[name] = self._add_slider(
                        name, values[name], self._limits, range_, self._on_move
                    )

    def _add_speeds(self, on_drive: Callable[[str, float], None]) -> None:
        """Add a slider for each speed, which acts until it is 0 again."""
        gui, limits = self._gui, self._drive.limits
        with gui.add_folder("drive"):
            for name in self._drive.speeds:
                path = name.removesuffix(":velocity")
                self._units[name] = f"{self._units[path]}/s" if self._units.get(path) else ""
                self._speeds[name] = self._add_slider(name, 0.0, limits, limits[name], on_drive)

            def stop(_: Any) -> None:
                for name in self._speeds:
                    on_drive(name, 0.0)

            gui.add_button("Stop", hint="Set all speeds to 0.").on_click(stop)

    def _add_slider(
        self,
        name: str,
        value: float,
        limits: Mapping[str, tuple[float, float]],
        range_: tuple[float, float],
        call: Callable[[str, float], None],
    ) -> Any:
        low, high = (self._to_shown(name, end) for end in range_)
        label, hint = self._describe(name, limits[name])
        slider = self._gui.add_slider(
            label,
            min=low,
            max=high,
            step=choose_slider_step((low, high)),
            initial_value=self._to_shown(name, value),
            hint=hint,
        )
        slider.precision = _count_digits(low, high)

        def move(shown: float) -> None:
            value = float(shown) / self._factor(name)
            # A limit that is converted between units and back changes by rounding, and would be violated.
            near = [limit for limit in limits[name] if abs(value - limit) < 1e-12]
            call(name, near[0] if near else value)

        on_input(slider, move)
        return slider

    def _describe(self, name: str, limits: tuple[float, float], locked: bool = False) -> tuple[str, str]:
        """Return label and hint of a slider, with unit and limits; the hint has the whole name."""
        factor, unit = self.scale(name)
        low, high = (format_significant(factor * end) for end in limits)
        path = name.removesuffix(":velocity")
        label = f"{path.rpartition('/')[2]}{f' [{unit}]' if unit else ''}   {low} to {high}"
        hint = f"{name}, limits {low} to {high} {unit}".rstrip()
        if path != name:
            hint += "; it goes on until this is 0"
        return (f"{label} · locked", f"{hint}, locked") if locked else (label, hint)

    def scale(self, name: str) -> tuple[float, str]:
        """Return the factor from the unit of the model to the one shown of a coordinate, and its name."""
        return self._display.scale(self._units.get(name, ""))

    def scale_constraint(self, constraint: Constraint) -> tuple[float, str]:
        """Return factor and unit, as :meth:`scale`, of a constraint on a sum or difference of coordinates.

        They are 1 and empty for coordinates of different units, and for other expressions.
        """
        slopes = constraint.expression.gradient(heuristic=False).values()
        units = {self._units.get(str(symbol), "") for symbol in constraint.expression.symbols}
        # Another factor than ±1 may have a unit itself, such as the lead of a screw.
        if len(units) != 1 or not all(not s.symbols and abs(float(s)) == 1.0 for s in slopes):
            return 1.0, ""
        return self._display.scale(units.pop())

    def _factor(self, name: str) -> float:
        return self.scale(name)[0]

    def _to_shown(self, name: str, value: float) -> float:
        return float(value) * self._factor(name)

    def _value(self, name: str) -> float:
        return float(self._sliders[name].value) / self._factor(name)

    def _lock(self, values: Mapping[str, float]) -> None:
        """Mark the coordinates that are locked at these values, and disable their sliders."""
        if not self._has_sliders:
            return
        for name, directions in self._ranges.locked_directions(values).items():
            locked, slider = all(directions), self._sliders[name]
            self._locked[name] = locked
            self._relabel(name)
            if slider.disabled != (locked and not self.beyond):
                slider.disabled = locked and not self.beyond

    def _relabel(self, name: str) -> None:
        _set_text(
            self._sliders[name],
            *self._describe(name, self._limits[name], self._locked.get(name, False)),
        )

    def _range(self, name: str, value: float) -> tuple[float, float]:
        beyond = BEYOND if self.beyond else 0.0
        return choose_slider_range(self._limits[name], value, self._units.get(name, ""), beyond)

    def _fit(self, name: str, value: float) -> None:
        _set_range(self._sliders[name], *(self._to_shown(name, end) for end in self._range(name, value)))
        self._relabel(name)

    def _widen(self) -> None:
        with self._changing:
            for name, slider in self._sliders.items():
                self._fit(name, self._value(name))
                if self.beyond:
                    slider.disabled = False

    def _convert(self, **units: bool) -> None:
        """Show numbers in other units."""
        with self._changing:
            for name, wanted in units.items():
                setattr(self._display, name, wanted)
            for name, slider in self._sliders.items():
                self._fit(name, self._shown[name])
                slider.value = self._to_shown(name, self._shown[name])
            for name, slider in self._speeds.items():
                _set_range(slider, *(self._to_shown(name, limit) for limit in self._drive.limits[name]))
                slider.value = self._to_shown(name, self._drive.speeds[name])
                _set_text(slider, *self._describe(name, self._drive.limits[name]))
        self._on_convert()

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
    return max(0, len(f"{choose_slider_step((low, high)):.9f}".rstrip("0").partition(".")[2]))


def _set_range(slider: Any, low: float, high: float) -> None:
    if (slider.min, slider.max) != (low, high):
        slider.min, slider.max, slider.step = low, high, choose_slider_step((low, high))
        slider.precision = _count_digits(low, high)


def _set_text(slider: Any, label: str, hint: str) -> None:
    if slider.label != label:
        slider.label = label
    if slider.hint != hint:
        slider.hint = hint
