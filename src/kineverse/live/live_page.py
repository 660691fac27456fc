"""Page of a live system: truth, belief, plan, processes, and what people may do, from the streams alone.

The page gives way before anything else does: it draws at most 30 times a second, no faster than the browser
does, and only what is newest; while nobody looks, once a second.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

from kineverse._rich_display import element
from kineverse._runtime import Closing
from kineverse.exchange import LiveModel
from kineverse.exchange.state import Newest, StateReader
from kineverse.lie import Array
from kineverse.model.commits.follower import Follower, follow
from kineverse.model.model_view import ModelView
from kineverse.view.run_overlay import LiveRun, RunDrawing
from kineverse.view.viewer import PERIOD, Viewer
from kineverse.worlds import Contact, Observation

from .emergency_stop import OVERLAY, EmergencyStop
from .live_status import HEAD, describe_all, list_processes
from .people_panel import Choices, PeoplePanel
from .streams import (
    ACTIVITY,
    LEARNER,
    ROBOT,
    SUPERVISOR,
    TRACKER,
    TRUTH,
    ActivityNote,
    LearnerNote,
    SupervisorNote,
    as_array,
    read_note,
)

logger = logging.getLogger(__name__)

_TABLE = 0.5  # time between two tables [s]
_STOPPING = 0.1  # longest time between two looks after a stop was asked for [s]
_UNWATCHED = 1.0  # time between two drawings while nobody looks [s]
_SHOWN = (TRUTH, ROBOT, TRACKER)  # sources that place the bodies, the best first


@dataclass
class StreamWorld:
    """True world as far as streams tell of it, for :class:`.LiveRun`."""

    state: Mapping[str, float] = field(default_factory=dict)

    def contacts(self) -> Sequence[Contact]:
        """Return no contacts: no stream has them."""
        return ()


@dataclass
class StreamStep:
    """Step that the streams tell of, as :class:`.SkillStep`."""

    time: float
    state: Mapping[str, float]  # the believed one
    vectors: Mapping[str, tuple[Array, Array]]
    reference: Any  # way and pose of the hand, as ``ahead`` and ``pose``
    phase: str = ""  # which stands with what else is done
    contact: None = None
    commands: Mapping[Any, float] = field(default_factory=dict)
    observation: Observation = field(default_factory=lambda: Observation(0.0, {}))


def read_truth(reader: StateReader) -> dict[str, float]:
    """Return the true state by name: that of a simulated world, else encoders, and what is believed."""
    found: dict[str, float] = {}
    for source in reversed(_SHOWN):
        newest = reader.newest(source)
        if newest is not None:
            found.update(newest.named)
    return found


def read_step(reader: StateReader, truth: Mapping[str, float], begin: float) -> StreamStep:
    """Return the step that the streams tell of, with its time since a stamp [s].

    Without a tracker the belief is the truth.
    """
    activity = read_note(reader, ACTIVITY, ActivityNote) or ActivityNote("")
    latest = max((n.stamp for n in map(reader.newest, _SHOWN) if n is not None), default=begin)
    belief, tracked = truth, reader.newest(TRACKER)
    if tracked is not None:
        belief = dict(truth) | tracked.named
    reference = SimpleNamespace(ahead=activity.read_way(), pose=as_array(activity.wanted, (4, 4)))
    return StreamStep(latest - begin, belief, activity.read_vectors(), reference)


def choose_pause(rate: float, spent: float, *, is_urgent: bool = False) -> float:
    """Return the time until the next drawing [s].

    The browser draws at a rate [Hz], 0 if none looks, and the last drawing has taken some time [s], as long
    as which is left to others. It is urgent while a stop is asked for.
    """
    pause = max(PERIOD, 1.0 / rate if rate else _UNWATCHED, spent)
    return min(pause, _STOPPING) if is_urgent else pause


def find_robot_prefix(newest: Newest | None) -> str:
    """Return the prefix of a robot's names, from the coordinates that it reports; empty without any."""
    names = () if newest is None else newest.names
    prefix = names[0].rpartition("/")[0] if names else ""
    while prefix and not all(name.startswith(f"{prefix}/") for name in names):
        prefix = prefix.rpartition("/")[0]
    return prefix


class LivePage(Closing):
    """Live system on a page of its served model, from when there are streams until it is closed.

    The emergency stop is there at once; everything else comes with the first news of a robot.

    Parameters
    ----------
    page
        Page of the served model.
    live
        The served model.

    See Also
    --------
    kineverse.live.WorldProcess
    """

    def __init__(self, page: Viewer, live: LiveModel) -> None:
        self._page, self._live = page, live
        self.reader = live.exchange.reader()
        self.stop = EmergencyStop(self.reader)
        page.server.add_html(OVERLAY)
        for path, function in self.stop.answers().items():
            page.server.add_answer(path, function)
        self._world = StreamWorld()
        self._run: LiveRun | None = None
        self._people: PeoplePanel | None = None
        self._follower: Follower[tuple[RunDrawing, Choices]] | None = None
        self._version, self._begin, self._tabled = -1, 0.0, 0.0
        self._known: set[str] = set()
        self._error, self.drawn = "", 0
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._work, name="kineverse-live-page", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Follow the streams no longer. A second call has no effect."""
        self._closed.set()
        self._thread.join(timeout=5.0)
        if self._people is not None:
            self._people.close()
        if self._follower is not None:
            self._follower.close()
        self.reader.close()

    def _work(self) -> None:
        due = PERIOD
        while not self._closed.wait(due):
            begin = time.monotonic()
            try:
                self.stop.watch()
                self.step()
            except Exception as error:
                # The thread survives any error at one step, and the emergency stop with it.
                if str(error) != self._error:
                    logger.exception("the live system could not be shown")
                self._error = str(error)
            spent = time.monotonic() - begin
            due = choose_pause(self.stop.slowest_rate, spent, is_urgent=self.stop.wanted)

    def step(self) -> bool:
        """Draw what is newest; return False if there is nothing, or a browser has not taken the last one."""
        truth = read_truth(self.reader)
        if not truth:
            return False
        if self._run is None:
            self._set_up()
        self._follow()
        self._show_table(truth)
        if self._run is None or self._page.server.is_behind:
            return False
        self._world.state = truth
        step = read_step(self.reader, truth, self._begin)
        self._run.captions = _emphasize(describe_all(self.reader))
        self._run(step)  # type: ignore[arg-type]
        self.drawn += 1
        return True

    def _set_up(self) -> None:
        def build(model: ModelView) -> tuple[RunDrawing, Choices]:
            return RunDrawing(model), Choices.of(model, prefix)

        prefix = find_robot_prefix(self.reader.newest(ROBOT))
        self._begin = max(n.stamp for n in map(self.reader.newest, _SHOWN) if n is not None)
        self._follower = follow(self._live, build)
        (drawing, choices), self._version = self._follower.current
        self._page.hide_sliders()
        self._run = LiveRun(self._page, self._world, speed=0.0, drawing=drawing)
        self._people = PeoplePanel(self._page.server.gui, self._live, self.reader)
        self._people.offer(choices)

    def _follow(self) -> None:
        """Go on with the drawing of an edited model, once it is made."""
        if self._follower is None or self._follower.version == self._version:
            return
        (drawing, choices), self._version = self._follower.current
        if self._run is not None and self._people is not None:
            self._run.exchange(drawing)
            self._people.offer(choices)

    def _show_table(self, truth: Mapping[str, float]) -> None:
        now = time.monotonic()
        if self._run is None or self._people is None or now - self._tabled < _TABLE:
            return
        self._tabled = now
        ages, note = self.reader.age, read_note(self.reader, SUPERVISOR, SupervisorNote)
        self._known |= ages.keys()
        found = list_processes(ages, note, known=self._known, is_online=self._live.exchange.is_online)
        wrapped = "white-space:normal;min-width:8em"
        rows = [
            (p.name, _mark(p.state, p.is_well), p.load, p.starts, element("div", p.news, style=wrapped))
            for p in found
        ]
        self._run.show_table(HEAD, rows)
        names = [] if note is None else [row.name for row in note.rows if row.pid]
        learner = read_note(self.reader, LEARNER, LearnerNote)
        self._people.update(truth, names, [] if learner is None else [row.tag for row in learner.proposals])


def _emphasize(lines: Sequence[str]) -> list[str]:
    """Return lines of which the first, and those about what stops the robot, stand out."""
    return [
        element("b", line, style="color:#c92a2a" if line.startswith("stopped") else "")
        if k == 0 or line.startswith("stopped")
        else line
        for k, line in enumerate(lines)
    ]


def _mark(state: str, is_well: bool) -> str:
    return state if is_well else element("b", state, style="color:#c92a2a")
