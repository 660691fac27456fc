"""The controls of the scene that lives, and what it says in words and numbers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from kineverse.view.hypertext import BREAK, Html, HtmlBox, element, join_html

from .identify import Thought
from .report import table_of_learning, table_of_tracking
from .sensor import Sight
from .simulation import Life
from .unknown_mechanisms import STRANGERS

WRONG, MISSING = 0.2, 0.5
"""The parts of the observations that are wrong, and that are hidden, when that is switched on."""

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
"""Of families, in the order in which they are listed."""

WIDTH, HEIGHT, SHOWN = 300, 64, 40
"""The size of the picture of probabilities [pixels], and how many thoughts it shows."""

INTRODUCTION = join_html(
    element("b", "Left: the truth"),
    ", with the markers as they are seen, through noise.",
    BREAK,
    element("b", "Right: what is believed"),
    " from the markers. Bars: ± 2σ; blue is sure, orange not.",
    BREAK,
    element("b", "In front: a stranger"),
    ". Nobody says how it moves; that is learned.",
)


class Panel:
    """The controls of a life.

    Parameters
    ----------
    gui
        The gui of a viser server.
    life
        What is described.
    meet
        Called with the name of the stranger that somebody wants to see learned, from the beginning.
    """

    def __init__(self, gui: Any, life: Life, meet: Callable[[str], None]) -> None:
        self._life = life
        HtmlBox(gui, _box(INTRODUCTION))
        self._paused = gui.add_checkbox("pause", False)
        self._speed = gui.add_slider("speed", 0.25, 3.0, 0.25, 1.0)
        with gui.add_folder("What is seen"):
            self._noise = gui.add_slider("noise [cm]", 0.5, 10.0, 0.5, 100.0 * life.sight.noise)
            self._wrong = gui.add_checkbox(f"{WRONG:.0%} outliers", False)
            self._hidden = gui.add_checkbox(f"{MISSING:.0%} hidden", False)
        with gui.add_folder("The kitchen, tracked"):
            self._kitchen = HtmlBox(gui, Html())
        with gui.add_folder("The stranger, learned"):
            names = list(STRANGERS)
            self._stranger = gui.add_dropdown("stranger", names, initial_value=life.stranger.name)
            again = gui.add_button("Forget, and learn again")
            self._learned = HtmlBox(gui, Html())
        self._stranger.on_update(lambda event: self._choose(event.target.value))
        again.on_click(lambda _: meet(self._stranger.value))
        self._meet = meet
        self.update()

    def _choose(self, stranger: str) -> None:
        # The list also changes when another one has come by itself, which is no wish.
        if stranger != self._life.stranger.name:
            self._meet(stranger)

    @property
    def speed(self) -> float:
        """How fast time passes; 0 while it is stopped."""
        return 0.0 if self._paused.value else float(self._speed.value)

    @property
    def sight(self) -> Sight:
        """How well things are to be seen."""
        return Sight(
            float(self._noise.value) / 100.0,
            WRONG if self._wrong.value else 0.0,
            MISSING if self._hidden.value else 0.0,
        )

    def update(self) -> None:
        """Say how it is now."""
        self._kitchen.show(kitchen_report(self._life))
        self._learned.show(stranger_report(self._life))
        if self._stranger.value != self._life.stranger.name:
            self._stranger.value = self._life.stranger.name


def kitchen_report(life: Life) -> Html:
    """Return HTML: how far markers and the belief are off, how honest it is, and what it costs."""
    now = life.figures
    rejected = len(life.following.estimate.outliers)
    _, rows = table_of_tracking(life, now)
    there = life.seen.there
    rows.append(("seen now", f"{int(there.sum())} of {len(there)} markers, {rejected} not believed"))
    return _box(_table(rows))


def stranger_report(life: Life) -> Html:
    """Return HTML: what is thought of the stranger, how that came about, and how far it is off."""
    learner, found = life.learner, life.learner.found
    if found is None:
        return _box(element("b", "looking …"))
    # Families have bars, and the words say what comes of them.
    elsewhere = {fit.family for fit in found} | {"conclusion"}
    rows = [row for row in table_of_learning(life)[1] if row[0] not in elsewhere]
    return _box(element("b", str(found)), _table(rows), _bars(learner.thoughts), *_history(learner.thoughts))


def _bars(thoughts: Sequence[Thought]) -> Html:
    """Return a bar for each family that is not out of the question."""
    lines = []
    for family, color in COLORS.items():
        share = thoughts[-1].probabilities.get(family, 0.0)
        if share < 0.005:
            continue
        lines.append(
            element(
                "div",
                element("span", family, style="width:5.5em"),
                element("span", style=f"background:{color};height:0.7em;width:{150 * share:.0f}px"),
                element("span", f"{share:.2f}"),
                style="display:flex;align-items:center;gap:6px",
            )
        )
    return element("div", *lines, style="margin:4px 0")


def _history(thoughts: Sequence[Thought]) -> list[Html]:
    """Return a picture of probabilities over time, and what it is."""
    shown = thoughts[-SHOWN:]
    if len(shown) < 2:
        return []
    begin, end = shown[0].time, shown[-1].time
    lines = []
    for family, color in COLORS.items():
        values = [thought.probabilities.get(family, 0.0) for thought in shown]
        if max(values) < 0.05:
            continue
        points = " ".join(
            f"{WIDTH * (thought.time - begin) / (end - begin):.1f},{2 + (HEIGHT - 4) * (1.0 - value):.1f}"
            for thought, value in zip(shown, values, strict=True)
        )
        lines.append(element("polyline", points=points, fill="none", stroke=color, stroke_width=2))
    size = {"viewBox": f"0 0 {WIDTH} {HEIGHT}", "width": "100%", "height": HEIGHT}
    white = "background:#fff;border:1px solid #dee2e6"
    return [
        element("svg", *lines, style=white, preserveAspectRatio="none", **size),
        element("div", f"probabilities over the last {end - begin:.0f} s"),
    ]


def _table(rows: Sequence[tuple[str, str]]) -> Html:
    left = "padding-right:10px;color:#868e96"
    cells = [element("tr", element("td", name, style=left), element("td", value)) for name, value in rows]
    return element("table", *cells, style="font-variant-numeric:tabular-nums")


def _box(*content: str) -> Html:
    return element("div", *content, style="font-size:0.8em;line-height:1.4;padding:2px 10px 8px")
