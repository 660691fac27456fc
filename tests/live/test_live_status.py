"""What people read of a live system: what is gone or frozen is named, and why nothing moves."""

from __future__ import annotations

import math

import pytest

pytest.importorskip("zenoh")

from kineverse.live.live_status import (
    describe_activity,
    describe_learner,
    describe_robot,
    describe_tracker,
    list_processes,
)
from kineverse.live.streams import (
    ActivityNote,
    LearnerNote,
    ProcessRow,
    ProposalRow,
    RobotNote,
    SkillResult,
    SupervisorNote,
    TrackerNote,
    WatchedPart,
)

FRESH = {"robot": 0.01, "camera": 7.0, "truth": 0.03, "tracker": 0.01, "commands": 9.0}
"""Ages of a well system [s]: a camera that sees nothing, and a robot that rests, are silent."""


def states(*arguments, **options):
    return {one.name: (one.state, one.is_well) for one in list_processes(*arguments, **options)}


def test_what_is_gone_or_frozen_is_named():
    assert states(FRESH) == dict.fromkeys(("world", "track", "behave"), ("running", True))
    assert states(FRESH | {"tracker": 4.4})["track"] == ("frozen for 4 s", False)
    gone = {source: age for source, age in FRESH.items() if source != "tracker"}
    assert "track" not in states(gone)  # it never was there
    assert states(gone, known=FRESH)["track"] == ("gone", False)
    assert states(FRESH, is_online=False)["serve"] == ("gone", False)
    assert "serve" not in states(FRESH)


def test_the_word_of_the_supervisor_counts_unless_the_news_are_old():
    note = SupervisorNote([ProcessRow("track", 7, "starting", 3, 0.25), ProcessRow("view", 8, "running")])
    rows = {row.name: row for row in list_processes(FRESH | {"tracker": 5.0}, note)}
    assert rows["track"][:4] == ("track", "starting", "25%", "4")
    assert not rows["track"].is_well
    assert rows["view"][:5] == ("view", "running", "", "1", "")
    assert rows["world"].news == "robot 10 ms, camera 7 s, truth 30 ms"


def test_the_activity_has_its_reason_and_its_results():
    assert "no behaviour" in describe_activity(None)[0]
    note = ActivityNote(
        "closer", "close a/door", "it is open", "pull", done=2, failed=1, last="a/drawer is shut"
    )
    assert describe_activity(note) == [
        "closer: close a/door",
        "why: it is open",
        "phase: pull",
        "so far 2 done, 1 failed",
        "last: a/drawer is shut",
    ]
    note.results = [SkillResult(name, "close", name != "d", "it slips", 3.2) for name in "abcd"]
    assert describe_activity(note)[4:] == [
        "close d: failed, it slips (3 s)",
        "close c: done (3 s)",
        "close b: done (3 s)",
    ]


def test_the_pace_is_that_of_world_and_control():
    robot = RobotNote(
        "mujoco", 0.04, [], "emergency stop", 12.3, refused=4, late=2, dropped=7, ticks=1000, factor=0.9987
    )
    stopped, pace = describe_robot(robot, ActivityNote("tour", steps=400, late=1))
    assert stopped == "stopped: emergency stop"
    expected = "force 12 N · real-time factor 0.999 · late 0.2% of ticks, 0.2% of control"
    assert pace == f"{expected} · left out 7 · commands too old 4"
    (pace,) = describe_robot(RobotNote("kinematic", 0.04, []))
    assert "force" not in pace  # a world without forces
    assert math.isnan(RobotNote("kinematic", 0.04, []).force)


def test_what_is_not_known_of_places_and_joints_is_said():
    note = TrackerNote(b"", {"a": 9.9, "b": 1.0, "c": 1.0, "d": 1.0, "e": 1.0, "f": 1.0}, ["f"], 1.0)
    assert describe_tracker(note, 10.0) == ["lost: f", "unseen: b, c, d and 1 more"]
    assert "nothing is tracked" in describe_tracker(None, 10.0)[0]
    part = WatchedPart("a/door", "a", "moves", "hinge", 0.93)
    learner = LearnerNote([part], {"a/drawer": "it turns"}, [ProposalRow("t", "a hinge", "to be accepted")])
    assert describe_learner(learner) == [
        "learns a/door: moves, hinge with 93%",
        "implausible: a/drawer: it turns",
        "proposed: a hinge (waits for to be accepted)",
    ]
    assert describe_learner(None) == []
