"""The estimator of a model: what it learns, doubts and leaves alone, by poses with noise and outliers."""

from __future__ import annotations

import numpy as np
import pytest
from watched_kitchenette import (
    BOX,
    CUPBOARD,
    DOOR,
    HANDLE,
    HINGE,
    SHELF,
    Camera,
    Watch,
    make_served,
    make_truth,
)

pytest.importorskip("zenoh")

import kineverse as kv
from kineverse.errors import KineverseError
from kineverse.lie import pose_difference
from kineverse.live.model_estimator import ModelEstimator


def opening(t: float) -> float:
    """Return a door's angle that begins to open at 1.5 s, and ends at 1 rad [rad]."""
    return float(np.clip(0.5 * (t - 1.5), 0.0, 1.0))


def error(model: kv.Model, truth: kv.Model, value: float, frame: str = HANDLE) -> tuple[float, float]:
    """Return the distance [m] and angle [rad] between where two models have a frame."""
    (own,), (true,) = model.fk(frame).symbols, truth.fk(frame).symbols
    off = pose_difference(model.fk(frame)({own: value}), truth.fk(frame)({true: value}))
    return float(np.linalg.norm(off[:3])), float(np.linalg.norm(off[3:]))


@pytest.mark.parametrize(
    "attached",
    ["frame", *(pytest.param(one, marks=pytest.mark.long) for one in ("joint", "floating"))],
)
def test_the_joint_of_a_part_is_learned_however_the_part_was_attached(attached):
    truth, watch = make_truth(), Watch(make_truth(), make_served(attached))
    begin = watch.camera.time
    watch.look(4.5, opening)
    model = watch.model
    (coordinate,) = model.fk(DOOR).symbols
    assert model.limits(coordinate) == (-np.inf, np.inf)  # what was seen are no limits
    assert model.default_state()[coordinate] == 0.0
    for value in (0.0, 1.0):  # zero is where it was, and open is positive; what is on it follows
        distance, turn = error(model, truth, value)
        assert distance < 0.02
        assert turn < 0.03
    # Nothing is sure before 4°, and one edit a second is the most.
    times = [time for time, _ in watch.written]
    assert times[0] - begin > 1.5 + 0.07 / 0.5
    assert min(np.diff(times), default=2.0) >= 1.0
    assert 1 <= len(times) <= 5
    watch.look(1.5, lambda _: 1.0)
    edits, poses = watch.note.edits, watch.note.watched[0].poses
    watch.look(2.0, lambda _: 1.0)
    assert (watch.note.edits, watch.note.watched[0].poses) == (edits, poses)  # nothing moves, nothing is new
    (row,) = watch.note.watched
    assert (row.frame, row.parent, row.state, row.family) == (DOOR, CUPBOARD, "written", "revolute")
    assert row.turn == pytest.approx(1.0, abs=0.04)


def test_nothing_is_learned_of_what_stands_still():
    watch = Watch(make_truth(), make_served("joint"))
    watch.look(10.0)
    assert not watch.written
    assert watch.note.watched == []
    assert watch.note.alarms == {}


@pytest.mark.long
def test_a_part_that_is_hidden_in_mid_motion_is_learned_nevertheless():
    truth, watch = make_truth(), Watch(make_truth(), make_served("joint"), parts=[DOOR])
    watch.look(2.0, opening)
    watch.camera.hidden = {DOOR}
    watch.look(1.2, lambda t: opening(2.0 + t))
    assert [(row.frame, row.state) for row in watch.note.watched] == [(DOOR, "hidden")]
    assert not watch.written
    watch.camera.hidden = {SHELF}
    watch.look(2.5, lambda t: opening(2.0 + t))
    assert error(watch.model, truth, 1.0)[0] < 0.03


@pytest.mark.long
def test_what_is_carried_along_has_no_joint():
    watch = Watch(make_truth(), make_served("joint"))
    watch.look(2.0)
    for k in range(16):
        step = kv.translation(0.02 * k, 0.0, 0.0)()
        watch.camera.moved = {CUPBOARD: step, DOOR: step}
        watch.look(0.2)
    watch.look(6.0)
    (_, moved), *more = watch.written
    assert moved.frame == CUPBOARD  # the furniture stands elsewhere
    assert not any(proposal.frame == DOOR for _, proposal in more)
    there = watch.model.fk(CUPBOARD)({})[:3, 3]
    assert np.linalg.norm(there - [1.3, 0.4, 0.8]) < 0.01


def test_what_is_taken_back_waits_to_be_accepted_and_what_others_wrote_stays():
    watch = Watch(make_truth(), make_served("joint"))
    before = watch.model.history.operation(HINGE)
    watch.look(4.2, opening)
    assert watch.note.edits >= 1
    with watch.model.edit() as edit:
        edit.replace(HINGE, before)
    watch.look(1.2, lambda t: 1.0 - 0.4 * t)
    assert watch.model.history.operation(HINGE) == before
    (row,) = watch.note.proposals
    assert row.tag == HINGE
    assert "taken back" in row.waits
    proposal = watch.estimator.proposals[HINGE]
    watch.estimator.accept(HINGE)
    watch.write()
    assert len(watch.model.fk(DOOR).symbols) == 1
    others = make_truth().history.operation(HINGE)
    with watch.model.edit() as edit:
        edit.replace(HINGE, others)
    with watch.model.edit() as edit:
        assert not proposal.write(edit, watch.model)
    watch.estimator.refuse(proposal, "somebody else has changed that")
    watch.look(1.0, lambda t: 0.5 + 0.4 * t)
    assert watch.model.history.operation(HINGE) == others
    assert watch.note.proposals == []
    assert "somebody else" in watch.note.last


def swinging(t: float) -> float:
    """Return a door's angle that goes there and back [rad]."""
    return abs(float(np.sin(0.5 * max(0.0, t - 2.0))))


def test_a_known_joint_that_is_implausible_is_replaced_after_a_while():
    truth = make_truth(aside=0.06)
    watch = Watch(truth, make_truth(), settling=1.0)
    watch.look(7.0, swinging)
    assert [proposal.tag for _, proposal in watch.written] == [HINGE]
    assert error(watch.model, truth, 1.0)[0] < 0.02
    assert [float(limit) for limit in watch.model.limits(DOOR)] == pytest.approx([0.0, 1.5], abs=0.06)
    assert HINGE not in watch.note.alarms


@pytest.mark.long
def test_a_cautious_estimator_waits_until_what_it_proposes_is_accepted():
    watch = Watch(make_truth(), make_truth(), settling=1.0, asks=True)
    watch.look(2.0)
    step = kv.translation(0.0, 0.3, 0.0)()
    watch.camera.moved = dict.fromkeys([SHELF, BOX], step)
    watch.look(5.0)
    assert not watch.written
    ((tag, why),) = watch.note.alarms.items()
    assert why.startswith(f"'{SHELF}' stands 30 cm and 0° from where it was")
    assert [(row.tag, row.waits) for row in watch.note.proposals] == [(tag, "it has to be accepted")]
    with pytest.raises(KineverseError, match="Nothing is proposed"):
        watch.estimator.accept(HINGE)
    watch.estimator.accept(tag)
    watch.write()
    np.testing.assert_allclose(watch.model.fk(SHELF)({})[:3, 3], [1.0, -0.2, 0.6], atol=0.01)


@pytest.mark.long
def test_a_door_that_was_taken_for_a_drawer_becomes_one_that_is_shut_at_zero():
    truth = make_truth()
    watch = Watch(truth, make_truth("prismatic"))
    watch.look(9.0, swinging)
    assert watch.model.articulations[DOOR].kind == "revolute"
    for value in (0.0, 1.0):
        assert error(watch.model, truth, value)[0] < 0.02


@pytest.mark.long
def test_if_most_furniture_stands_elsewhere_the_robot_is_lost_and_nothing_is_moved():
    watch = Watch(make_truth(), make_truth())
    watch.look(2.0)
    step = kv.translation(0.2, 0.0, 0.0)()
    watch.camera.moved = dict.fromkeys([CUPBOARD, DOOR, SHELF, BOX], step)
    watch.look(5.0)
    assert not watch.written
    assert len(watch.note.alarms) == 2
    assert all("is the robot elsewhere?" in why for why in watch.note.alarms.values())
    watch.camera.moved = {}
    watch.look(3.0)
    assert watch.note.alarms == {}


def test_joints_that_are_as_the_model_has_them_raise_no_alarm():
    watch = Watch(make_truth(), make_truth())
    watch.look(8.0, swinging, lambda t: 0.2 + 0.2 * np.sin(t))
    assert not watch.written
    assert watch.note.alarms == {}


def test_only_named_parts_are_watched_if_any_are_named():
    watch = Watch(make_truth(), make_served("joint"), parts=["room/b*"])
    watch.look(3.0, opening)
    assert not watch.written
    assert watch.note.watched == []  # the box has a joint, and the door was not named


def test_pictures_of_the_past_and_of_other_things_are_ignored():
    camera, model = Camera(make_truth()), make_served("joint")
    estimator = ModelEstimator(model)
    poses = camera.look()
    estimator.add(poses, 5.0)
    estimator.add(poses, 5.0)
    estimator.add(poses, 4.0)
    estimator.add({"somewhere/else": np.eye(4)}, 6.0)
    estimator.add({}, 7.0)
    estimator.think()
    assert estimator.seen_at == 5.0
    assert set(estimator.tracks.names) == {CUPBOARD, DOOR, SHELF, BOX}
