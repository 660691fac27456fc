"""Tasks that unlock: boxes open without a plan, by trends, demand and margins."""

from itertools import pairwise
from operator import mul

import pytest

import kineverse as kv
from kineverse.control import Controller, unlock
from kineverse.control.unlocking import find_lock_sides
from kineverse.errors import InvalidValueError, UnknownNameError
from kineverse.gallery.lockboxes import THESIS, draw_lockbox, make_lockbox_model

DT = 0.19


def run(model, goal, tasks, steps, state=None):
    """Return the steps until the goal, None if it is not reached, the trace, and the largest violation."""
    controller = Controller(model, tasks, dt=DT, smooth=1e-3, posture=0.0, tier="interpreter")
    state = model.default_state().updated(state or {})
    trace = [state]
    for step in range(steps):
        if all(abs(state[kv.position(name)] - value) < 0.01 for name, value in goal.items()):
            return step, trace
        state = model.integrate(state, controller.step(state).speeds, DT)
        assert not model.violations(state) or max(v.excess for v in model.violations(state)) < 1e-6
        trace.append(state)
    return None, trace


def open_lockbox(box, steps=400, tasks=None, **options):
    model = make_lockbox_model(box)
    goal = {f"lockbox/{name}": value for name, value in box.goal.items()}
    return run(model, goal, unlock(model, goal, **options)[:tasks], steps)


def first_moves(trace, least=0.1):
    order = dict.fromkeys(str(s) for state in trace for s in state if state[s] > least)
    return [name[-1] for name in order]


def reversals(trace, name):
    """Return how often a coordinate turned round."""
    ways = [b > a for a, b in pairwise([state[kv.position(name)] for state in trace]) if abs(b - a) > 1e-9]
    return sum(a != b for a, b in pairwise(ways))


def test_unlock_opens_the_thesis_box_in_its_order():
    steps, trace = open_lockbox(THESIS, 200)
    assert steps is not None
    order = first_moves(trace)
    assert order[:3] == ["f", "e", "d"]
    assert order[-1] == "a"
    assert all(reversals(trace, f"lockbox/{name}") == 0 for name in "abcde")
    assert trace[-1]["lockbox/f"] < 1.5  # it stops where nothing needs it any more


def test_without_trends_nothing_moves():
    steps, trace = open_lockbox(THESIS, 100, tasks=1)
    assert steps is None
    assert max(trace[-1].values()) < 1e-9


def test_with_the_product_rule_two_unmet_conditions_have_no_trend():
    model, goal = make_lockbox_model(THESIS, join=mul), {"lockbox/a": 1.2}
    steps, trace = run(model, goal, unlock(model, goal, demand=False), 200)
    assert steps is None
    assert first_moves(trace) == ["f", "e", "d"]
    # Demand is passed on along trends, so it ends here at once.
    assert first_moves(run(model, goal, unlock(model, goal), 50)[1]) == []


@pytest.mark.parametrize(
    ("parts", "seeds"),
    [
        (5, range(3)),
        (12, range(1)),
        pytest.param(12, range(1, 3), marks=pytest.mark.long),
        pytest.param(25, range(3), marks=pytest.mark.long),
    ],
)
def test_unlock_opens_monotone_boxes(parts, seeds):
    for seed in seeds:
        assert open_lockbox(draw_lockbox(parts, seed), 40 * parts)[0] is not None, seed


@pytest.mark.long
def test_unlock_opens_a_large_box():
    assert open_lockbox(draw_lockbox(60, 3), 2400)[0] is not None


@pytest.mark.parametrize("seeds", [range(2), pytest.param(range(2, 5), marks=pytest.mark.long)])
def test_unlock_opens_boxes_with_negations(seeds):
    for seed in seeds:
        assert open_lockbox(draw_lockbox(10, seed, negated=0.5), 400)[0] is not None, seed


def test_demand_is_needed_where_a_key_has_to_be_on_both_sides():
    """c moves only while b is below .2; a needs b above .4 and c above .6 (from the prototype)."""
    a, b, c = (kv.position(name) for name in "abc")
    model = kv.Model()
    with model.edit() as edit:
        for q in (a, b, c):
            edit.constrain(f"{q} range", 0, q, 1)
        edit.constrain("b speed", -0.1, b.derivative(), 0.1)
        edit.constrain("a lock", -0.1, a.derivative(), 0.1 * ((b > 0.4) & (c > 0.6)))
        edit.constrain("c lock", -0.1 * (b < 0.2), c.derivative(), 0.1 * (b < 0.2))
    goal = {"a": 1.0}
    for start in (0.0, 0.5):
        steps, trace = run(model, goal, unlock(model, goal), 400, {"b": start})
        assert steps is not None
        assert reversals(trace, "b") <= 2
    assert run(model, goal, unlock(model, goal, demand=False), 400, {"b": 0.5})[0] is None


@pytest.mark.parametrize(
    ("name", "goal"), [("latch", "gate/door"), ("microwave", "oven/door"), ("garage_door", "garage/door")]
)
def test_unlock_opens_doors_of_the_gallery(name, goal):
    model = kv.load(f"articulations/{name}", "it")
    assert run(model, {f"it/{goal}": 1.2}, unlock(model, {f"it/{goal}": 1.2}), 400)[0] is not None


def test_tasks_have_names_and_no_weight_once_open():
    model = make_lockbox_model(THESIS)
    tasks = unlock(model, {"lockbox/a": 1.2})
    assert [task.name for task in tasks[:2]] == ["reach lockbox/a", "unlock lockbox/a/velocity upper"]
    opened = {"lockbox/b": 0.7, "lockbox/c": 0.8, "lockbox/d": 0.9, "lockbox/e": 1.1, "lockbox/f": 2.0}
    state = model.default_state().updated(opened)
    assert all(float(task.weight(state)) == 0 for task in tasks[1:-1])
    shut = model.default_state()
    weights = {task.name: float(task.weight(shut)) for task in tasks[1:-1]}
    assert weights.pop("unlock lockbox/a/velocity lower") == 0  # nobody wants a to go back
    assert set(weights.values()) == {1.0}


def test_find_lock_sides_follows_the_chain_only():
    model = make_lockbox_model(THESIS)
    assert {str(side.coordinate)[-1] for side in find_lock_sides(model, [kv.position("lockbox/e")])} == {"e"}


@pytest.mark.parametrize(
    ("goal", "options", "error", "text"),
    [
        ({}, {}, InvalidValueError, "Unlocking has a goal"),
        ({"lockbox/x": 1}, {}, UnknownNameError, "'lockbox/x' is no degree of freedom"),
        ({"lockbox/a": float("inf")}, {}, InvalidValueError, "finite number"),
        ({"lockbox/a": 1}, {"rate": 0}, InvalidValueError, "rate of unlocking is a positive"),
        ({"lockbox/a": 1}, {"margin": float("nan")}, InvalidValueError, "margin of unlocking"),
    ],
)
def test_unlock_refuses_bad_input(goal, options, error, text):
    with pytest.raises(error, match=text):
        unlock(make_lockbox_model(THESIS), goal, **options)
