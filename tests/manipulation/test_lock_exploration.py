"""Exploration opens boxes of unknown locks, is certain only of what is true, and takes few tries."""

from statistics import mean

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import kineverse as kv
from hypothesis_profiles import attempts
from kineverse.errors import InvalidValueError, UnknownNameError
from kineverse.gallery.lockboxes import (
    THESIS,
    Condition,
    Lockbox,
    Slider,
    draw_lockbox,
    draw_tangled_lockbox,
    make_lockbox_model,
    remove_locks,
)
from kineverse.manipulation import PartMover, Session, explore_locks
from kineverse.manipulation.unlocking.lock_hypothesis import Enclosure, KeySide, LockHypothesis
from kineverse.reasoning import plan_unlocking
from kineverse.worlds import MechanismWorld
from kineverse_studies.experiments.lockbox.unknown_locks import (
    LockboxTrials,
    can_be_opened,
    count_systematic_tries,
    permute_parts,
)
from robot_interface_proxy import InterfaceOnly

COUNT = 4
LIMITS = Enclosure((0.0,) * COUNT, (1.0,) * COUNT)


def explore(box, **options):
    model, trials = make_lockbox_model(remove_locks(box), None), LockboxTrials(box)
    return model, trials, explore_locks(model, box.goal, lambda s, x: trials.move(str(s), x), **options)


def true_conditions(box, name):
    """Return the conditions of a lock without alternatives, None for one with alternatives."""
    groups = box.parts[name].groups
    return None if any(len(group) > 1 for group in groups) else {group[0] for group in groups}


@st.composite
def locks_with_tries(draw):
    """Draw a conjunction over the coordinates but the first one, and configurations in which it is tried."""
    numbers = st.integers(0, 10).map(lambda n: n / 10)
    sides = {k: draw(st.sampled_from([0, 1, -1])) for k in range(1, COUNT)}
    lock = {KeySide(k, side): draw(st.integers(0, 9)) / 10 + 0.05 for k, side in sides.items() if side}
    return lock, draw(st.lists(st.tuples(*[numbers] * COUNT), min_size=1, max_size=25))


def opens(lock, q):
    return all(s.side * (q[s.key] - t) > 0 for s, t in lock.items())


@settings(max_examples=attempts(80, long=150))
@given(locks_with_tries())
def test_hypothesis_of_a_conjunction_is_never_wrong(drawn):
    """Each statement that is certain agrees with the true lock, after every try."""
    lock, tries = drawn
    known = LockHypothesis(0, LIMITS, (0.0,) * COUNT)
    for n, q in enumerate(tries):
        for other in tries[n:]:
            chance = known.probability(other)
            assert chance < 1 or opens(lock, other)
            assert chance > 0 or not opens(lock, other)
        known.observe(q, opens(lock, q))
        assert known.is_conjunction
        for s, (low, high) in known.necessary().items():
            assert low <= lock[s] <= high
    for conditions, box in zip(known.sufficient(), known.boxes, strict=True):
        assert set(lock) <= set(conditions)
        assert opens(lock, box.lower) or any(s.side < 0 for s in lock)


def test_alternatives_are_noticed():
    """b or c: no box has both ways to open it and not the refusal, so nothing is certain any more."""
    known = LockHypothesis(0, LIMITS, (0.0,) * COUNT)
    for q, moved in (((0, 0, 0, 0), False), ((0, 1, 0, 0), True), ((0, 0, 1, 0), True)):
        known.observe(tuple(map(float, q)), moved)
    assert not known.is_conjunction
    assert known.necessary() == {}
    assert len(known.boxes) == 2
    assert not known.is_erratic


def test_part_that_moves_and_does_not_is_erratic():
    known = LockHypothesis(0, LIMITS, (0.0,) * COUNT)
    known.observe((0.0,) * COUNT, False)
    assert not known.is_erratic
    known.observe((1.0, 0.0, 0.0, 0.0), True)
    assert known.is_erratic
    assert known.necessary() == {}


def test_thesis_box_is_opened_and_its_locks_are_learned():
    model, trials, done = explore(THESIS)
    assert done
    assert len(done.tries) == trials.tries <= 20
    assert [str(t.coordinate) for t in done.tries if t.moved][:3] == ["f", "e", "d"]
    plan = plan_unlocking(model, THESIS.goal)
    assert [str(step.coordinate) for step in plan.steps][:3] == ["f", "e", "d"]
    assert "e can increase if f > 0 to 10" in "\n".join(map(str, done.locks))


def test_thesis_box_takes_at_most_half_the_tries_of_systematic_search():
    boxes = [permute_parts(THESIS, seed) for seed in range(5)]
    own = [len(explore(box)[2].tries) for box in boxes]
    for order in ("depth", "breadth"):
        assert mean(own) <= 0.5 * mean(count_systematic_tries(box, order) for box in boxes)


def test_published_order_takes_at_most_half_the_tries_of_systematic_search():
    """It suits systematic search; the goal, once refused, waits for the parts that never moved."""
    tries = [explore(THESIS, seed=seed)[2].tries for seed in range(4)]
    assert mean(map(len, tries)) <= 0.5 * count_systematic_tries(THESIS)
    assert all(sum(str(one.coordinate) == "a" for one in own) <= 2 for own in tries)


def drawn_boxes():
    for seed in range(4):
        yield permute_parts(draw_lockbox(6, seed), seed)
        yield permute_parts(draw_lockbox(5, seed, negated=0.4), seed)
        yield draw_tangled_lockbox(5, 70 + seed)


@pytest.mark.parametrize(
    "box",
    [
        pytest.param(box, marks=pytest.mark.long if number > 4 else ())
        for number, box in enumerate(box for box in drawn_boxes() if can_be_opened(box))
    ],
)
def test_random_boxes_are_opened_and_certain_conditions_are_true(box):
    model, _, done = explore(box, most=300)
    assert done
    for lock in done.locks:
        known = true_conditions(box, str(lock.coordinate))
        if known is None or (lock.way < 0 and box.parts[str(lock.coordinate)].blocks == "forward"):
            continue
        assert lock.is_conjunction
        for key, side, (low, high) in lock.certain:
            assert any(
                c.part == str(key) and c.beyond == (side > 0) and low <= c.threshold <= high for c in known
            )
    # What was learned suffices to open the box again.
    plan = plan_unlocking(model, box.goal)
    assert plan.verdict == "found"
    again = LockboxTrials(box)
    if all(true_conditions(box, name) is not None for name in box.parts):
        for step in plan.steps:
            assert again.move(str(step.coordinate), step.target) == step.target


def test_exploration_in_a_world_by_the_controller():
    box = draw_lockbox(5, 3)
    model, world = make_lockbox_model(remove_locks(box), None), MechanismWorld(make_lockbox_model(box, None))
    mover = PartMover(model.snapshot(), Session(InterfaceOnly(world), dt=0.05))
    assert explore_locks(model, box.goal, mover.move)
    (goal,) = box.goal
    assert world.state[kv.position(goal)] == pytest.approx(box.goal[goal], abs=2e-4)
    assert plan_unlocking(model, box.goal).verdict == "found"


def test_box_that_cannot_be_opened_is_given_up():
    circle = {name: Slider(groups=((Condition(key, 0.5),),)) for name, key in (("a", "b"), ("b", "a"))}
    model, _, done = explore(Lockbox(circle, {"a": 1.0}))
    assert not done
    assert len(done.tries) == 2
    assert plan_unlocking(model, {"a": 1.0}).verdict == "refuted"


@pytest.mark.parametrize(
    "box",
    [
        pytest.param(permute_parts(draw_lockbox(7, 7, negated=0.5), 7), marks=pytest.mark.long),
        draw_tangled_lockbox(6, 4),
        pytest.param(draw_tangled_lockbox(6, 10), marks=pytest.mark.long),
    ],
)
def test_exploration_ends_where_hypotheses_leave_no_plan(box):
    """The plans by hypotheses are refuted on the way; what is left to try decides."""
    assert bool(explore(box, most=300)[2]) == can_be_opened(box)


def test_erratic_part_is_left_out():
    """The part c moves every second time; a is reached through b."""
    box = Lockbox({"a": Slider(groups=((Condition("b", 0.5),),)), "b": Slider(), "c": Slider()}, {"a": 1.0})
    trials, rng = LockboxTrials(box), np.random.default_rng(0)
    model = make_lockbox_model(remove_locks(box), None)

    def move(symbol, target):
        if str(symbol) == "c" and rng.random() < 0.5:
            return trials.positions["c"]
        return trials.move(str(symbol), target)

    assert explore_locks(model, box.goal, move, most=50)


def test_number_of_tries_is_bounded():
    _, trials, done = explore(draw_lockbox(8, 1), most=3)
    assert not done
    assert trials.tries == 3


@pytest.mark.parametrize(
    ("goal", "options", "error", "text"),
    [
        ({"z": 1.0}, {}, UnknownNameError, "'z' is no degree of freedom"),
        ({"a": 5.0}, {}, InvalidValueError, "beyond its limits"),
        ({"a": 1.0}, {"most": 0}, InvalidValueError, "most="),
    ],
)
def test_bad_input_is_refused(goal, options, error, text):
    with pytest.raises(error, match=text):
        explore_locks(make_lockbox_model(remove_locks(THESIS), None), goal, lambda s, x: x, **options)


def test_coordinate_without_limits_is_refused():
    model, q = kv.Model(), kv.position("q")
    with model.edit() as edit:
        edit.constrain("speed", -1, q.derivative(), 1)
    with pytest.raises(InvalidValueError, match="'q' has no limits"):
        explore_locks(model, {"q": 1.0}, lambda s, x: x)
