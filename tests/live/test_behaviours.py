"""Behaviours in lock step with a world: a hand that floats before a door, a drawer and sliders."""

import sys
from itertools import pairwise
from pathlib import Path

import pytest
from lock_step import LockStep

import kineverse as kv
from kineverse.errors import UnknownNameError
from kineverse.live import behaviours
from kineverse.live.behaviours import Closer, OpenByName, Tour
from kineverse.worlds import KinematicWorld, TrueBelief

sys.path.insert(0, str(Path(__file__).parents[1] / "worlds"))
from pusher import pusher

DRAWER = "room/drawer"


WORLD = KinematicWorld(pusher(), "robot")  # with all that is made once for its model


def make(**values):
    world = WORLD
    start = world.model.default_state().updated({"robot/finger": 0.05, "robot/z": 2.0, "robot/x": 0.2})
    world.reset(start.updated({name.replace("__", "/"): v for name, v in values.items()}))
    return world, LockStep(world, TrueBelief(world))


def run_until(behaviour, is_there, most=60):
    """Step a behaviour until something is so, and return what it said it did, each once."""
    said = [""]
    for _ in range(most):
        behaviour.step()
        if said[-1] != behaviour.note.doing:
            said.append(behaviour.note.doing)
        if is_there():
            return said[1:]
    raise AssertionError(f"{said}: {behaviour.note.why} {behaviour.note.last}")


def is_watching(behaviour):
    return lambda: behaviour.note.doing == "watches"


def test_a_closer_closes_what_people_open_again_and_again():
    world, sessions = make(room__drawer=0.3)
    notes = []
    closer = Closer(sessions, patterns=[DRAWER], report=lambda note: notes.append((note.doing, note.phase)))
    said = run_until(closer, is_watching(closer))
    assert said == [f"closes '{DRAWER}'", "watches"]
    assert world.state[DRAWER] == pytest.approx(0.0, abs=0.02)
    assert closer.note.why == "All is shut."
    assert (f"closes '{DRAWER}'", "move") in notes
    world.displace({DRAWER: 0.35})
    run_until(closer, lambda: closer.note.done == 2)
    run_until(closer, is_watching(closer))
    assert world.state[DRAWER] == pytest.approx(0.0, abs=0.02)
    (first, second) = closer.note.results
    assert (
        (first.what, first.skill, first.done)
        == (second.what, second.skill, second.done)
        == (DRAWER, "close", True)
    )
    assert not closer.is_done
    assert sessions.opened == 1


def test_a_behaviour_that_begins_with_the_hand_at_a_handle_lets_go_first():
    world, sessions = make()

    class Killed(BaseException):
        pass

    def kill(session):
        if session.phase == "move" and world.state[DRAWER] > 0.1:
            raise Killed

    sessions.on_step = kill
    with pytest.raises(Killed):
        OpenByName(sessions, patterns=[DRAWER]).step()
        OpenByName(sessions, patterns=[DRAWER], far=0.9).run()
    assert world.held is not None
    sessions.on_step = lambda session: None
    again = OpenByName(sessions, patterns=[DRAWER])  # it keeps nothing of the one that died
    said = run_until(again, lambda: again.is_done)
    assert said[:2] == ["lets go", f"opens '{DRAWER}'"]
    assert world.held is None
    assert world.state[DRAWER] == pytest.approx(0.4, abs=0.02)
    assert again.note.why == "1 of 1 done."


@pytest.mark.parametrize("cause", ["stop", "edit"])
def test_a_stop_and_an_edit_interrupt_a_skill_and_all_is_planned_anew(cause):
    world, sessions = make(room__drawer=0.3)
    closer = Closer(sessions, patterns=[DRAWER])

    def interrupt(session):
        if session.phase == "move" and world.state[DRAWER] < 0.2:
            sessions.on_step = lambda session: None
            if cause == "edit":
                sessions.version += 1
            else:
                sessions.problem = "The robot is stopped: emergency stop."

    sessions.on_step = interrupt
    run_until(closer, lambda: closer.note.why.startswith("It was interrupted"))
    assert not closer.note.results
    if cause == "stop":
        closer.step()
        assert (closer.note.doing, closer.note.why) == ("waits", sessions.problem)
        at = world.state[DRAWER]
        closer.step()
        assert world.state[DRAWER] == at
        sessions.problem = ""
    said = run_until(closer, is_watching(closer))
    assert said == ["lets go", f"closes '{DRAWER}'", "watches"]
    assert world.state[DRAWER] == pytest.approx(0.0, abs=0.02)
    assert sessions.opened == (2 if cause == "edit" else 1)
    assert [one.done for one in closer.note.results] == [True]


def test_what_fails_is_tried_again_after_growing_pauses_and_pushed_in_between(monkeypatch):
    import kineverse.live.behaviours as behaviours

    world, sessions = make(room__drawer=0.3)
    tried = []

    def fail(how):
        def skill(session, what, **options):
            tried.append((how, session.time))
            return kv.manipulation.Outcome(False, 0.3, "It is jammed.", "kinematic", 0.0, 0)

        return skill

    monkeypatch.setattr(behaviours, "open_object", fail("grasp"))
    monkeypatch.setattr(behaviours, "push", fail("push"))
    closer = Closer(sessions, patterns=[DRAWER])
    run_until(closer, lambda: len(tried) == 4, 500)
    assert [how for how, _ in tried] == ["grasp", "push", "grasp", "push"]
    pauses = [after - before for (_, before), (_, after) in pairwise(tried)]
    assert pauses == pytest.approx([5.0, 10.0, 20.0], abs=0.5)
    run_until(closer, is_watching(closer))
    assert "tried again in" in closer.note.why
    assert "It is jammed." in closer.note.why
    world.displace({DRAWER: 0.2})  # what people move is worth another try at once
    closer.step()
    assert len(tried) == 5


def test_what_is_not_seen_is_not_believed():
    world, sessions = make(room__drawer=0.3)
    closer = Closer(sessions, patterns=[DRAWER])
    sessions.belief.seen = {}
    closer.step()
    closer.step()
    assert (closer.note.doing, closer.note.why) == ("watches", f"'{DRAWER}' has not been seen yet")
    sessions.belief.seen = {world.model.symbol(DRAWER): 0.0}
    sessions.rest(closer.session, 11.0)
    closer.step()
    assert "has not been seen for 11 s" in closer.note.why
    opener = OpenByName(sessions, patterns=[DRAWER])
    run_until(opener, lambda: opener.is_done, 200)
    (result,) = opener.note.results
    assert not result.done
    assert "has not been seen" in result.reason
    assert world.state[DRAWER] == 0.3


def test_a_tour_opens_and_closes_each_as_often_as_wanted_and_goes_on_as_closer():
    world, sessions = make()
    tour = Tour(sessions, patterns=[DRAWER], rounds=2, far=0.5)
    highest = []
    sessions.on_step = lambda session: highest.append(world.state[DRAWER])
    run_until(tour, is_watching(tour))
    assert [(one.skill, one.done) for one in tour.note.results] == [("open", True), ("close", True)] * 2
    assert max(highest) == pytest.approx(0.2, abs=0.02)
    assert tour.note.behaviour == "closer"
    assert not tour.is_done


def test_an_object_that_an_edit_takes_away_is_told_and_the_behaviour_goes_on(monkeypatch):
    _, sessions = make(room__door=1.5)
    opening = OpenByName(sessions, patterns=[DRAWER, "room/door"])
    found = behaviours.find_articulated_objects

    def take_away(session):
        if session.phase == "move" and not sessions.version:
            sessions.version += 1
            without = lambda *a: [one for one in found(*a) if str(one.coordinate) != DRAWER]  # noqa: E731
            monkeypatch.setattr(behaviours, "find_articulated_objects", without)

    sessions.on_step = take_away
    run_until(opening, lambda: opening.is_done)
    assert sessions.version
    told = [(one.what, one.done, one.reason) for one in opening.note.results]
    assert told[0] == (DRAWER, False, "The model has it no longer.")
    assert [what for what, *_ in told] == [DRAWER, "room/door"]


def test_names_that_are_missing_are_left_out_if_that_is_wanted():
    _, sessions = make()
    closer = Closer(sessions, patterns=["room/lid", DRAWER], missing_ok=True)
    run_until(closer, is_watching(closer))
    assert [*closer.scene.names] == [DRAWER]
    without = Closer(sessions, patterns=["room/lid"], missing_ok=True)
    run_until(without, is_watching(without))
    assert without.note.why == "The model has none of the objects that were asked for."


def test_a_robot_that_is_away_is_waited_for_and_a_wrong_name_is_not():
    _, sessions = make(room__drawer=0.3)
    sessions.offline = "No world moves the robot."
    closer = Closer(sessions, patterns=[DRAWER])
    closer.step()
    assert (closer.note.doing, closer.note.why) == ("waits", sessions.offline)
    sessions.offline = ""
    run_until(closer, is_watching(closer))
    with pytest.raises(UnknownNameError, match="There is no door, drawer or other object 'room/lid'"):
        Closer(sessions, patterns=["room/lid"]).step()
