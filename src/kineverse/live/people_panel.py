"""Panel of a page by which people act on a live system. What is refused is said, with the reason."""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from kineverse._rich_display import element
from kineverse.errors import KineverseError
from kineverse.exchange import LiveModel
from kineverse.exchange.state import StateReader
from kineverse.model.frame import is_of_robot
from kineverse.model.kinematics import infer_units
from kineverse.model.model_view import ModelView
from kineverse.view.html import FONT, HtmlBox
from kineverse.view.sliders import choose_slider_range, choose_slider_step, on_input

from .people import (
    NOISES,
    Errands,
    Place,
    cut_process,
    find_carried,
    list_furniture,
    move_furniture,
)
from .streams import LEARNER, ROBOT, ask

_TOUCHED = 1.5  # time after which a slider that was moved follows the truth again [s]
_NOTHING = "–"
_ALL = "all"


@dataclass(frozen=True)
class Choices:
    """Things to choose from in a version of a model."""

    moved: Mapping[str, tuple[float, float]] = field(
        default_factory=dict
    )  # limits of furniture's coordinates
    units: Mapping[str, str] = field(default_factory=dict)
    carried: Mapping[str, Sequence[str]] = field(default_factory=dict)  # frames by the coordinate
    frames: Sequence[str] = ()  # all that are not the robot's
    places: Mapping[str, Place] = field(default_factory=dict)

    @classmethod
    def of(cls, model: ModelView, robot: str) -> Choices:
        """Return the choices in a model with a robot of this prefix; empty if it is not known."""
        free = [s for s in model.degrees_of_freedom if not (robot and is_of_robot(s.path, robot))]
        values = {str(s): float(v) for s, v in model.default_state().items()}
        names = [str(s) for s in free]
        owned = {name for name in model.frames if robot and is_of_robot(name, robot)}
        return cls(
            {str(s): choose_slider_range(model.limits(s), values[str(s)], "") for s in free},
            infer_units(model, values, names),
            {str(s): find_carried(model, s) for s in free},
            [name for name in model.frames if name not in owned],
            {name: Place(model, name) for name in list_furniture(model, owned)},
        )


class PeoplePanel:
    """Controls by which people move things, hide markers, add noise, cut processes, and accept proposals."""

    def __init__(self, gui: Any, live: LiveModel, reader: StateReader) -> None:
        self._gui, self._live, self._reader = gui, live, reader
        self._choices = Choices()
        self._touched = 0.0
        self._truth: Mapping[str, float] = {}
        self._errands = Errands(self._tell)
        self._folder = gui.add_folder("people", order=-0.8)
        with self._folder:
            self._answer = HtmlBox(gui, element("div"))
            tabs = gui.add_tab_group()
            with tabs.add_tab("Doors"):
                self._add_doors()
            with tabs.add_tab("Furniture"):
                self._add_furniture()
            with tabs.add_tab("Camera"):
                self._add_camera()
            with tabs.add_tab("Processes"):
                self._add_processes()

    # -- what the page calls ---------------------------------------------------------------------------------

    def offer(self, choices: Choices) -> None:
        """Offer the choices of an edited model."""
        self._choices = choices
        _set_options(self._door, choices.moved)
        _set_options(self._hidden, [_NOTHING, _ALL, *choices.moved])
        _set_options(self._piece, choices.places)
        self._choose_door()
        self._choose_piece()

    def update(
        self, truth: Mapping[str, float], processes: Collection[str], proposals: Collection[str]
    ) -> None:
        """Follow the true state, and offer the processes and proposals that there are."""
        self._truth = truth
        _set_options(self._process, processes)
        _set_options(self._proposal, proposals)
        self._kill.disabled = self._freeze.disabled = not processes
        self._accept.disabled = not proposals
        if time.monotonic() - self._touched > _TOUCHED:
            self._show_truth()

    def close(self) -> None:
        """Take no more wishes."""
        self._errands.close()

    # -- controls --------------------------------------------------------------------------------------------

    def _add_doors(self) -> None:
        gui = self._gui
        self._door = gui.add_dropdown("object", (_NOTHING,), hint="A coordinate of the furniture.")
        self._door.on_update(lambda _: self._choose_door())
        self._opening = gui.add_slider(
            "truth", 0.0, 1.0, 0.01, 0.0, hint="Move it by hand, in the true world."
        )
        on_input(self._opening, self._move_door)

    def _add_furniture(self) -> None:
        gui = self._gui
        self._piece = gui.add_dropdown("piece", (_NOTHING,), hint="A piece that stands in the world.")
        self._piece.on_update(lambda _: self._choose_piece())
        self._x, self._y = (
            gui.add_number(f"{axis} [m]", 0.0, step=0.01, hint="Place in the world.") for axis in "xy"
        )
        self._angle = gui.add_number("angle [rad]", 0.0, step=0.01, hint="About the vertical.")
        gui.add_button("Move it", hint="Edit the model; the world follows.").on_click(
            lambda _: self._move_piece()
        )

    def _add_camera(self) -> None:
        gui = self._gui
        self._noise = gui.add_dropdown(
            "noise", (_NOTHING, *NOISES), hint="Of the poses that the camera sees."
        )
        on_input(self._noise, self._set_noise)
        self._hidden = gui.add_dropdown(
            "hide", (_NOTHING, _ALL), hint="Markers that the camera does not see."
        )
        on_input(self._hidden, self._hide)

    def _add_processes(self) -> None:
        gui = self._gui
        self._process = gui.add_dropdown("process", (_NOTHING,), hint="One that the supervisor has started.")
        self._kill = gui.add_button("Kill it", disabled=True, hint="At once; the supervisor starts it again.")
        self._kill.on_click(lambda _: self._cut(False))
        self._freeze = gui.add_button("Freeze it for 1 s", disabled=True, hint="It stops, and goes on.")
        self._freeze.on_click(lambda _: self._cut(True))
        self._proposal = gui.add_dropdown("proposal", (_NOTHING,), hint="What the learner wants to change.")
        self._accept = gui.add_button("Accept it", disabled=True, hint="The learner edits the model.")
        self._accept.on_click(lambda _: self._accept_proposal())

    def _choose_door(self) -> None:
        lower, upper = self._choices.moved.get(self._door.value, (0.0, 1.0))
        unit = self._choices.units.get(self._door.value, "")
        self._opening.label = f"truth [{unit}]" if unit else "truth"
        self._opening.min, self._opening.max = lower, upper
        self._opening.step = choose_slider_step((lower, upper))
        self._show_truth()

    def _choose_piece(self) -> None:
        place = self._choices.places.get(self._piece.value)
        if place is not None:
            self._x.value, self._y.value = round(place.x, 3), round(place.y, 3)
            self._angle.value = round(place.angle, 3)

    def _show_truth(self) -> None:
        value = self._truth.get(self._door.value)
        if value is not None:
            shown = min(max(value, self._opening.min), self._opening.max)
            if abs(shown - self._opening.value) > self._opening.step / 2:
                self._opening.value = shown

    # -- wishes ----------------------------------------------------------------------------------------------

    def _move_door(self, value: float) -> None:
        self._touched, name = time.monotonic(), self._door.value
        if name in self._choices.moved:
            self._ask_world("move", f"{name} to {value:.3g}", coordinate=name, value=float(value))

    def _move_piece(self) -> None:
        name, place = self._piece.value, (self._x.value, self._y.value, self._angle.value)
        if name in self._choices.places:
            line = f"{name} to {place[0]:.3g}, {place[1]:.3g}, {place[2]:.3g}"
            self._errands.send("edit", line, lambda: move_furniture(self._live, name, *place))

    def _set_noise(self, name: str) -> None:
        if name in NOISES:
            self._ask_world("noise", f"noise: {name}", text=NOISES[name])

    def _hide(self, name: str) -> None:
        choices = self._choices
        frames = [*choices.frames] if name == _ALL else [*choices.carried.get(name, ())]
        self._ask_world("hide", f"hidden: {name}" if frames else "nothing is hidden", frames=frames)

    def _cut(self, freeze: bool) -> None:
        name, what = self._process.value, "frozen for 1 s" if freeze else "killed"
        self._errands.send("cut", f"{name} is {what}", lambda: self._cut_here(name, freeze))

    def _cut_here(self, name: str, freeze: bool) -> None:
        if self._live.exchange.address.endpoint:
            raise KineverseError("Processes are cut on the computer on which they run.")
        cut_process(self._reader, name, freeze)

    def _accept_proposal(self) -> None:
        tag = self._proposal.value
        self._errands.send(
            "accept", f"accepted: {tag}", lambda: ask(self._reader, LEARNER, "accept", tag=tag)
        )

    def _ask_world(self, do: str, line: str, **arguments: Any) -> None:
        self._errands.send(do, line, lambda: ask(self._reader, ROBOT, do, **arguments))

    def _tell(self, line: str, refused: bool) -> None:
        color = "#c92a2a" if refused else "#2b8a3e"
        self._answer.show(element("div", line, style=f"{FONT}padding:0 9px;color:{color}"))


def _set_options(dropdown: Any, names: Collection[str]) -> None:
    """Offer other options, if they differ; what was chosen stays if it is there."""
    options = tuple(names) or (_NOTHING,)
    if tuple(dropdown.options) != options:
        dropdown.options = options
