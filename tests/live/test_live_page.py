"""The page of a live system, drawn from its streams, without a browser."""

from __future__ import annotations

import json
import urllib.error
import urllib.request

import numpy as np
import pytest
from furnished_room import CUPBOARD, DRAWER, FINGER, make_room

pytest.importorskip("zenoh")
pytest.importorskip("viser", reason="the page needs the extra 'view'")

import kineverse as kv
from kineverse.errors import InvalidValueError
from kineverse.live.live_page import LivePage, choose_pause, find_robot_prefix, read_step, read_truth
from kineverse.live.people import Place, move_furniture
from kineverse.live.streams import (
    ACTIVITY,
    LEARNER,
    ROBOT,
    SUPERVISOR,
    TRACKER,
    TRUTH,
    ActivityNote,
    LearnerNote,
    ProcessRow,
    ProposalRow,
    RobotNote,
    SupervisorNote,
    answer_by,
    encode,
)
from kineverse.view import view

WAY = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.2, 0.0, 0.1]])


class Streams:
    """Stand-in for the processes of a live system: it publishes what it is told."""

    def __init__(self, live):
        self._live, self._sources, self._told = live, {}, {}
        self.asked, self.stopped, self._number = [], "", 0

    def put(self, source, values=None, note=None):
        values, handlers = values or {}, {"stop": self._stop, "release": self._release, "move": self._move}
        handlers |= {"accept": lambda tag: self.asked.append(tag)}
        if source not in self._sources:
            self._sources[source] = self._live.exchange.publisher(source, values, answer=answer_by(handlers))
        self._told[source] = list(values.values()), b"" if note is None else encode(note)
        self.repeat()

    def repeat(self):
        """Publish again what was told last, for readers that are new."""
        for source, (values, note) in list(self._told.items()):
            self._number += 1
            self._sources[source].put(values, 100.0 + self._number, note)

    def put_robot(self):
        self.put(ROBOT, {FINGER: 0.3}, RobotNote("kinematic", 0.04, [], self.stopped, 5.0, ticks=100))

    def close(self, source):
        del self._told[source]
        self._sources.pop(source).close()

    def _stop(self):
        self.asked.append("stop")
        self.stopped = "emergency stop"
        self.put_robot()

    def _release(self):
        self.asked.append("release")
        self.stopped = ""
        self.put_robot()

    def _move(self, coordinate, value):
        raise InvalidValueError(f"{coordinate} is held by the robot.")


@pytest.fixture
def home(sockets):
    """The served model, and stand-ins for the processes that publish its state."""
    served = kv.exchange.serve(make_room(), name="home")
    with served, kv.load("live:home") as live, kv.load("live:home") as other:
        yield live, Streams(other)


@pytest.fixture
def shown(home):
    """A page that is drawn step by step, with the streams and the served model."""
    live, streams = home
    with view(live, port=0) as page, pytest.MonkeyPatch.context() as patch:
        patch.setattr(LivePage, "_work", lambda self: None)
        with LivePage(page, live) as system:
            yield system, page, streams, live


def wait_for(reader, streams, *sources):
    """Wait until a reader has news of sources."""
    for _ in range(400):
        if {*sources} <= reader.age.keys():
            return
        streams.repeat()
        reader.wait(0.05)
    pytest.fail(f"there are only {[*reader.age]}")


def drawn(system, streams, until):
    """Draw until something is so, as news take a moment."""
    for _ in range(400):
        streams.repeat()
        if system._run is not None:
            system._run._drawn = system._tabled = -1.0
        system.step()
        if system._run is not None and system._page.settled() and until():
            return
        system.reader.wait(0.05)
    pytest.fail(f"waited in vain: {system._run and system._run._layer._text.content}")


def text(system):
    return system._run._layer._text.content


def test_truth_belief_activity_and_processes_are_shown(shown):
    system, page, streams, _ = shown
    assert not system.step()  # nothing is there yet
    streams.put_robot()
    streams.put(TRUTH, {FINGER: 0.31, DRAWER: 0.2})
    streams.put(TRACKER, {FINGER: 0.3, DRAWER: 0.1})
    note = ActivityNote(
        "closer",
        "close room/drawer",
        "it is open",
        "pull",
        WAY.tobytes(),
        np.eye(4).tobytes(),
        {"pull": np.eye(2, 3).tobytes()},
    )
    streams.put(ACTIVITY, note=note)
    streams.put(SUPERVISOR, note=SupervisorNote([ProcessRow("track", 77, "running", 2, 0.12)]))
    drawn(system, streams, lambda: "closer" in text(system) and system._run._layer._arrows)
    assert page.values[DRAWER] == 0.2
    assert page.values[FINGER] == 0.31
    shown_ghosts = {frame for frame, node in system._run._layer._ghosts.items() if node.visible}
    assert shown_ghosts == {"robot/tip", DRAWER, "room/handle"}
    assert system._run._layer._way is not None
    for line in ("closer: close room/drawer", "why: it is open", "phase: pull", "force 5 N"):
        assert line in text(system)
    drawn(system, streams, lambda: "12%" in system._run._layer._table.content)
    assert "supervisor" in system._run._layer._table.content
    assert page._panel._sliders == {}
    # A source that has ended is gone.
    streams.close(TRACKER)
    drawn(system, streams, lambda: ">gone<" in system._run._layer._table.content)


def test_without_a_true_state_the_page_shows_encoders_and_what_is_believed(home):
    live, streams = home
    with live.exchange.reader() as reader:
        assert read_truth(reader) == {}
        streams.put_robot()
        streams.put(TRACKER, {FINGER: 0.1, DRAWER: 0.1})
        wait_for(reader, streams, ROBOT, TRACKER)
        truth = read_truth(reader)
        assert truth == {FINGER: 0.3, DRAWER: 0.1}
        step = read_step(reader, truth, 100.0)
        assert step.state == {FINGER: 0.1, DRAWER: 0.1}
        assert (step.reference.ahead, step.vectors) == (None, {})
        assert step.time > 0.0
        assert find_robot_prefix(reader.newest(ROBOT)) == "robot"
        # What does not fit is left out.
        streams.put(ACTIVITY, note=ActivityNote("a", way=b"123", wanted=bytes(16), vectors={"v": bytes(8)}))
        wait_for(reader, streams, ACTIVITY)
        step = read_step(reader, truth, 100.0)
        assert (step.reference.ahead, step.reference.pose, step.vectors) == (None, None, {})


def test_edits_are_followed_and_people_are_answered(shown):
    system, page, streams, live = shown
    streams.put_robot()
    streams.put(TRUTH, {FINGER: 0.3, DRAWER: 0.2})
    streams.put(TRACKER, {FINGER: 0.3, DRAWER: 0.1})
    drawn(system, streams, lambda: system._run is not None and system._run._layer._ghosts)
    people = system._people
    assert tuple(people._door.options) == (DRAWER,)
    assert people._opening.max == 0.4
    people._move_door(0.3)
    drawn(system, streams, lambda: "held by the robot" in people._answer.content)
    people._x.value, people._y.value, people._angle.value = 2.0, 1.0, 0.0
    people._move_piece()
    drawn(system, streams, lambda: f"{CUPBOARD} to 2, 1, 0" in people._answer.content)
    drawn(system, streams, lambda: Place(live, CUPBOARD).x == pytest.approx(2.0))
    expected = kv.compile(live.fk(DRAWER))({DRAWER: 0.1})
    drawn(system, streams, lambda: DRAWER in system._run._layer._ghosts)
    drawn(system, streams, lambda: np.allclose(system._run._layer._ghosts[DRAWER].position, expected[:3, 3]))
    np.testing.assert_allclose(page.pose(CUPBOARD)[:2, 3], (2.0, 1.0), atol=1e-9)
    move_furniture(live, CUPBOARD, 3.0, 1.0, 0.0)
    drawn(system, streams, lambda: people._x.value == 3.0)


@pytest.mark.parametrize(
    ("rate", "spent", "is_urgent", "expected"),
    [
        (60.0, 0.001, False, 1 / 30),
        (4.0, 0.001, False, 0.25),
        (60.0, 0.2, False, 0.2),
        (0.0, 0.0, False, 1.0),
        (0.0, 0.0, True, 0.1),
        (60.0, 0.001, True, 1 / 30),
    ],
)
def test_the_page_gives_way_to_a_slow_browser_and_to_others(rate, spent, is_urgent, expected):
    assert choose_pause(rate, spent, is_urgent=is_urgent) == pytest.approx(expected)


def test_a_proposal_of_the_learner_is_accepted(shown):
    system, _, streams, _ = shown
    streams.put_robot()
    streams.put(LEARNER, note=LearnerNote(proposals=[ProposalRow("joint door", "a hinge")]))
    drawn(system, streams, lambda: "proposed: a hinge" in text(system))
    drawn(system, streams, lambda: not system._people._accept.disabled)
    system._people._accept_proposal()
    drawn(system, streams, lambda: "accepted: joint door" in system._people._answer.content)
    assert streams.asked == ["joint door"]


def test_a_browser_that_is_behind_gets_nothing_more(shown, monkeypatch):
    system, page, streams, _ = shown
    streams.put_robot()
    drawn(system, streams, lambda: system.drawn)
    monkeypatch.setattr(type(page.server), "is_behind", True)
    before = system.drawn
    assert not system.step()
    assert system.drawn == before


def request(page, what, **headers):
    asked = urllib.request.Request(f"{page.address}/robot/{what}", headers=headers)
    with urllib.request.urlopen(asked, timeout=10.0) as answer:
        return json.loads(answer.read())


def test_scripts_of_the_page_stop_the_robot_also_without_the_server(sockets):
    with kv.exchange.serve(make_room(), name="home") as server:
        live, other = kv.load("live:home"), kv.load("live:home")
        streams = Streams(other)
        with view(live, port=0) as page, LivePage(page, live) as system:
            assert not request(page, "state", **{"X-Kineverse": "-"})["robot"]
            streams.put_robot()
            wait_for(system.reader, streams, ROBOT)
            server.close()
            answer = request(page, "stop", **{"X-Kineverse": "30"})
            assert answer == {"robot": True, "stopped": "emergency stop", "problem": ""}
            assert not request(page, "release", **{"X-Kineverse": "30"})["stopped"]
            with pytest.raises(urllib.error.HTTPError):  # another page of the browser cannot send the header
                request(page, "stop")
            with pytest.raises(urllib.error.HTTPError):
                request(page, "stop", **{"X-Kineverse": "30", "Origin": "http://elsewhere.example"})
            assert streams.asked == ["stop", "release"]
            with urllib.request.urlopen(page.address, timeout=10.0) as answer:
                assert b'<div id="kineverse-stop"' in answer.read()
        for model in (live, other):
            model.close()
