"""Controls and reports of the simulation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from html import escape
from typing import Any

from .identify import FamilyProbabilities
from .report import tabulate_identification, tabulate_tracking
from .sensor import SensorModel
from .simulation import Simulation
from .unknown_mechanisms import MECHANISMS

WRONG, MISSING = 0.2, 0.5
"""Fractions of outliers and of hidden readings, if switched on."""

COLORS = {
    "rigid": "#868e96",
    "prismatic": "#1971c2",
    "revolute": "#c2255c",
    "screw": "#e8590c",
    "cylindrical": "#f08c00",
    "spherical": "#2f9e44",
    "planar": "#0c8599",
    "free": "#6741d9",
}
"""Colours of families, in the order in which they are listed."""

WIDTH, HEIGHT, SHOWN = 300, 64, 40
"""Size of the plot of probabilities [pixels], and the number of identifications it shows."""

INTRODUCTION = """
<b>Left: the truth</b>, with noisy markers.<br>
<b>Right: the estimate</b> from the markers. Bars: ± 2σ; blue is certain, orange is not.<br>
<b>In front: a stranger</b>, a mechanism of unknown type. It is identified, then tracked.
"""


class Panel:
    """Controls of a simulation.

    Parameters
    ----------
    gui
        The gui of a viser server.
    simulation
        The simulation to report on.
    change_mechanism
        Called with the name of the mechanism that a user selects or restarts.
    """

    def __init__(self, gui: Any, simulation: Simulation, change_mechanism: Callable[[str], None]) -> None:
        self._simulation = simulation
        gui.add_html(_box(INTRODUCTION))
        self._paused = gui.add_checkbox("pause", False)
        self._speed = gui.add_slider("speed", 0.25, 3.0, 0.25, 1.0)
        with gui.add_folder("Sensor"):
            self._noise = gui.add_slider("noise [cm]", 0.5, 10.0, 0.5, 100.0 * simulation.sensor.noise)
            self._wrong = gui.add_checkbox(f"{WRONG:.0%} outliers", False)
            self._hidden = gui.add_checkbox(f"{MISSING:.0%} hidden", False)
        with gui.add_folder("The kitchen, tracked"):
            self._kitchen = gui.add_html("")
        with gui.add_folder("The stranger, learned"):
            names = list(MECHANISMS)
            self._choice = gui.add_dropdown("stranger", names, initial_value=simulation.mechanism.name)
            again = gui.add_button("Forget, and learn again")
            self._learned = gui.add_html("")
        self._choice.on_update(lambda event: self._choose(event.target.value))
        again.on_click(lambda _: change_mechanism(self._choice.value))
        self._change_mechanism = change_mechanism
        self.update()

    def _choose(self, mechanism: str) -> None:
        # The list also changes when the simulation replaces the mechanism, which is no request.
        if mechanism != self._simulation.mechanism.name:
            self._change_mechanism(mechanism)

    @property
    def speed(self) -> float:
        """Simulated time per real time; 0 during a pause."""
        return 0.0 if self._paused.value else float(self._speed.value)

    @property
    def sensor(self) -> SensorModel:
        """The selected sensor model."""
        return SensorModel(
            float(self._noise.value) / 100.0,
            WRONG if self._wrong.value else 0.0,
            MISSING if self._hidden.value else 0.0,
        )

    def update(self) -> None:
        """Update the reports."""
        self._kitchen.content = format_kitchen(self._simulation)
        self._learned.content = format_mechanism(self._simulation)
        if self._choice.value != self._simulation.mechanism.name:
            self._choice.value = self._simulation.mechanism.name


def format_kitchen(simulation: Simulation) -> str:
    """Return HTML: errors of markers and of the track, its consistency, and the duration of an update."""
    quality = simulation.average_quality
    rejected = len(simulation.kitchen_tracker.estimate.outliers)
    _, rows = tabulate_tracking(simulation, quality)
    visible = simulation.readings.visible
    rows.append(("seen now", f"{int(visible.sum())} of {len(visible)} markers, {rejected} rejected"))
    return _box(_table(rows))


def format_mechanism(simulation: Simulation) -> str:
    """Return HTML: the probabilities of families so far, the identified joint, and its error."""
    learner, found = simulation.learner, simulation.learner.result
    if found is None:
        return _box("<b>looking …</b>")
    # Families have bars instead of rows.
    elsewhere = {fit.family for fit in found} | {"conclusion"}
    rows = [row for row in tabulate_identification(simulation)[1] if row[0] not in elsewhere]
    return _box(
        f"<b>{escape(str(found))}</b>{_table(rows)}{_bars(learner.history)}{_history(learner.history)}"
    )


def _bars(history: Sequence[FamilyProbabilities]) -> str:
    """Return a bar for each family with a noticeable probability."""
    lines = []
    for family, color in COLORS.items():
        share = history[-1].probabilities.get(family, 0.0)
        if share < 0.005:
            continue
        bar = f"background:{color};height:0.7em;width:{150 * share:.0f}px"
        parts = f'<span style="width:5.5em">{family}</span><span style="{bar}"></span>{share:.2f}'
        lines.append(f'<div style="display:flex;align-items:center;gap:6px">{parts}</div>')
    return f'<div style="margin:4px 0">{"".join(lines)}</div>'


def _history(history: Sequence[FamilyProbabilities]) -> str:
    """Return a plot of probabilities over time, and its caption."""
    shown = history[-SHOWN:]
    if len(shown) < 2:
        return ""
    begin, end = shown[0].time, shown[-1].time
    lines = []
    for family, color in COLORS.items():
        values = [entry.probabilities.get(family, 0.0) for entry in shown]
        if max(values) < 0.05:
            continue
        points = " ".join(
            f"{WIDTH * (entry.time - begin) / (end - begin):.1f},{2 + (HEIGHT - 4) * (1.0 - value):.1f}"
            for entry, value in zip(shown, values, strict=True)
        )
        lines.append(f'<polyline points="{points}" fill="none" stroke="{color}" stroke-width="2"/>')
    box = f'viewBox="0 0 {WIDTH} {HEIGHT}" width="100%" height="{HEIGHT}" preserveAspectRatio="none"'
    style = "background:#fff;border:1px solid #dee2e6"
    caption = f"<div>probabilities over the last {end - begin:.0f} s</div>"
    return f'<svg {box} style="{style}">{"".join(lines)}</svg>{caption}'


def _table(rows: Sequence[tuple[str, str]]) -> str:
    left = "padding-right:10px;color:#868e96"
    lines = [f'<tr><td style="{left}">{escape(a)}</td><td>{escape(b)}</td></tr>' for a, b in rows]
    return f'<table style="font-variant-numeric:tabular-nums">{"".join(lines)}</table>'


def _box(content: str) -> str:
    return f'<div style="font-size:0.8em;line-height:1.4;padding:2px 10px 8px">{content}</div>'
