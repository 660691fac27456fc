"""The controls of the page: a slider a degree of freedom, what is violated, what is shown."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

from kineverse.view.collisions import Collisions
from kineverse.view.driving import Driving
from kineverse.view.orientations import Orientations
from kineverse.view.ranges import Ranges, offered, step
from kineverse.view.scene import Scene
from kineverse.view.violations import number, report

BEYOND = 0.2
"""How much wider sliders get on demand, as a part of their range, so that limits can be crossed."""

OPEN = 100
"""With at most so many degrees of freedom all groups are unfolded at first."""


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
    """

    def __init__(
        self,
        gui: Any,
        scene: Scene,
        collisions: Collisions,
        ranges: Ranges,
        orientations: Orientations,
        driving: Driving,
        units: Mapping[str, str],
        values: Mapping[str, float],
        *,
        moved: Callable[[str, float], None],
        driven: Callable[[str, float], None],
        reset: Callable[[], None],
        play: Callable[[bool], None],
    ) -> None:
        self._gui, self._ranges, self._units, self._moved = gui, ranges, units, moved
        self._orientations, self._driving, self._collisions = orientations, driving, collisions
        self._limits = {**ranges.at(values), **orientations.limits}
        self._sliders: dict[str, Any] = {}
        self._speeds: dict[str, Any] = {}
        self._folders: dict[str, Any] = {}
        self._root = gui.add_folder(None)
        with self._root:
            self._status = gui.add_html(report(()))
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

    def show(self, status: str) -> None:
        """Show a text in HTML above the sliders: what is violated, or what went wrong."""
        if self._status.content != status:
            self._status.content = status

    def update(self, values: Mapping[str, float], driven: Iterable[str] = ()) -> None:
        """Set sliders to values that did not come from them, and all ranges to what the values allow.

        Parameters
        ----------
        values
            The values of all symbols, by name [m], [rad].
        driven
            The names of those that were set by a program.
        """
        shown = {**values, **self._orientations.angles}
        for name in self._orientations.in_place(driven):
            slider = self._sliders.get(name)
            if slider is not None:
                if not slider.min <= shown[name] <= slider.max:
                    self._fit(name, shown[name])
                slider.value = float(shown[name])
        if self._ranges.varying:
            self._limits.update(self._ranges.at(values))
            for name in self._ranges.varying:
                self._fit(name, float(self._sliders[name].value))
        self._lock(values)
        for name, speed in self._driving.speeds.items():
            if self._speeds[name].value != speed:
                self._speeds[name].value = speed

    @property
    def beyond(self) -> bool:
        """Whether limits and locks may be crossed."""
        return bool(self._beyond.value)

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
        self.playing = gui.add_checkbox("play", False, hint="Move everything through its range.")
        self.playing.on_update(lambda event: play(event.target.value) if event.client is not None else None)

    def _add_sliders(self, values: Mapping[str, float]) -> None:
        groups: dict[str, list[str]] = {}
        for name in self._orientations.in_place(self._ranges.names):
            groups.setdefault(name.rpartition("/")[0], []).append(name)
        few = len(self._ranges.names) <= OPEN
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
                low, high = limits[name]
                path = name.removesuffix(":velocity")
                unit = f" [{self._units[path]}/s]" if self._units.get(path) else ""
                slider = gui.add_slider(
                    path.rpartition("/")[2] + unit,
                    min=low,
                    max=high,
                    step=step((low, high)),
                    initial_value=0.0,
                    hint=f"{name}, from {number(low)} to {number(high)}; it goes on until this is 0",
                )
                slider.precision = _digits(low, high)
                slider.on_update(lambda event, name=name: self._set(driven, name, event))
                self._speeds[name] = slider

            def stop(_: Any) -> None:
                for name in self._speeds:
                    driven(name, 0.0)

            gui.add_button("Stop", hint="Set all speeds to 0.").on_click(stop)

    def _slider(self, name: str, value: float) -> Any:
        lower, upper = self._limits[name]
        low, high = self._range(name, value)
        unit = self._units.get(name, "")
        slider = self._gui.add_slider(
            self._label(name),
            min=low,
            max=high,
            step=step((low, high)),
            initial_value=float(value),
            hint=f"{name}, limits {number(lower)} to {number(upper)} {unit}".rstrip(),
        )
        slider.precision = _digits(low, high)
        slider.on_update(lambda event: self._set(self._moved, name, event))
        return slider

    def _label(self, name: str, locked: bool = False) -> str:
        unit = self._units.get(name, "")
        return name.rpartition("/")[2] + (f" [{unit}]" if unit else "") + (" · locked" if locked else "")

    @staticmethod
    def _set(call: Callable[[str, float], None], name: str, event: Any) -> None:
        # Values that this program has set come back without a client.
        if event.client is not None:
            call(name, float(event.target.value))

    def _lock(self, values: Mapping[str, float]) -> None:
        """Show what cannot move at these values, and keep its slider from being moved."""
        for name, held in self._ranges.held(values).items():
            locked, slider = all(held), self._sliders[name]
            if slider.label != self._label(name, locked):
                slider.label = self._label(name, locked)
            if slider.disabled != (locked and not self.beyond):
                slider.disabled = locked and not self.beyond

    def _range(self, name: str, value: float) -> tuple[float, float]:
        beyond = BEYOND if self.beyond else 0.0
        return offered(self._limits[name], value, self._units.get(name, ""), beyond)

    def _fit(self, name: str, value: float) -> None:
        """Give a slider the range it should have now."""
        slider, (low, high) = self._sliders[name], self._range(name, value)
        if (slider.min, slider.max) != (low, high):
            slider.min, slider.max, slider.step = low, high, step((low, high))
            slider.precision = _digits(low, high)

    def _widen(self) -> None:
        for name, slider in self._sliders.items():
            self._fit(name, float(slider.value))
            if self.beyond:
                slider.disabled = False

    def _find(self, text: str) -> None:
        shown = {name: text.lower() in name.lower() for name in self._sliders}
        for name, slider in self._sliders.items():
            slider.visible = shown[name]
        for group, folder in self._folders.items():
            folder.visible = any(shown[name] for name in shown if name.rpartition("/")[0] == group)

    def _add_switches(self, scene: Scene) -> None:
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
            lines = "\n".join(f"- {line}" for line in scene.problems[:10])
            gui.add_markdown(f"**{len(scene.problems)} meshes could not be loaded**\n\n{lines}")


def _digits(low: float, high: float) -> int:
    """Return the decimals shown of a value in a range: as many as its steps have."""
    return max(0, len(f"{step((low, high)):.9f}".rstrip("0").partition(".")[2]))
