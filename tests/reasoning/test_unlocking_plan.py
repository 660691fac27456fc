"""Plans of moves are right where exhaustive search finds one, and refuted exactly where it finds none."""

import json
from dataclasses import replace

import pytest
from lockbox_oracle import box_graph

import kineverse as kv
from kineverse.errors import InvalidValueError, UnknownNameError
from kineverse.gallery.lockboxes import (
    THESIS,
    draw_lockbox,
    draw_tangled_lockbox,
    make_lockbox_model,
    make_rings,
)
from kineverse.reasoning import Interval, interlocks, plan_unlocking, plan_violations, refutation_gaps
from kineverse.reasoning.move_search import MoveSearch
from kineverse_studies.experiments.lockbox.unknown_locks import can_be_opened
from sliders import A, B, C, goal_of, three_sliders


def test_plan_of_thesis_box_gives_its_order_with_reasons():
    model = make_lockbox_model(THESIS)
    plan = plan_unlocking(model, goal_of(THESIS))
    assert plan.verdict == "found"
    assert str(plan).splitlines() == [
        "1. raise lockbox/f above 1.2: it holds lockbox/e",
        "2. raise lockbox/e above 1: it holds lockbox/d and lockbox/c",
        "3. raise lockbox/d above 0.8: it holds lockbox/b and lockbox/c",
        "4. raise lockbox/b above 0.4: it holds lockbox/a",
        "5. raise lockbox/c above 0.6: it holds lockbox/a",
        "6. raise lockbox/a to 1.2: it is the goal",
    ]
    assert plan_violations(model, plan) == []


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5])
def test_plan_of_rings_is_the_shortest(count):
    model = make_lockbox_model(make_rings(count))
    plan = plan_unlocking(model, goal_of(make_rings(count)))
    assert plan.shortest or count == 1
    assert len(plan.steps) == (2 ** (count + 1) - 1) // 3
    assert plan_violations(model, plan) == []


def test_search_of_twelve_rings_takes_2730_moves():
    result = MoveSearch(box_graph(make_rings(12))).run()
    assert (result.verdict, result.shortest, len(result.moves)) == ("found", True, 2730)


@pytest.mark.parametrize("parts", [3, 5, 6, 7])
def test_search_agrees_with_exhaustive_search(parts):
    """Both strategies are asked, and a refutation is never wrong."""
    refuted = 0
    for seed in range(120):
        box = draw_tangled_lockbox(parts, seed)
        graph, expected = box_graph(box), can_be_opened(box)
        search = MoveSearch(graph)
        for result in (search.run(), search.search_best_first(), search.search_breadth_first()):
            assert (result.verdict == "found") == expected, seed
            state = graph.start
            for move in result.moves:
                state = graph.apply(state, move)
                assert state is not None, seed
            assert result.verdict != "found" or graph.is_goal(state), seed
        refuted += not expected
    assert refuted > 5


@pytest.mark.parametrize("blocks", ["forward", "both"])
def test_plan_from_model_agrees_with_exhaustive_search(blocks):
    """Reading, planning and the independent checker together, on boxes with negations and circles."""
    for seed in range(4):
        for box in (draw_tangled_lockbox(5, 1000 + seed), draw_lockbox(6, seed, negated=0.6, blocks=blocks)):
            model = make_lockbox_model(box)
            plan = plan_unlocking(model, goal_of(box))
            assert (plan.verdict == "found") == can_be_opened(box)
            assert plan.verdict != "undecided"
            assert plan_violations(model, plan) == []


def test_plan_of_large_monotone_box_has_no_superfluous_move():
    box = draw_lockbox(15, 3)
    model = make_lockbox_model(box)
    plan = plan_unlocking(model, goal_of(box))
    assert plan.verdict == "found"
    assert plan_violations(model, plan) == []
    for n in range(len(plan.steps)):
        assert plan_violations(model, replace(plan, steps=plan.steps[:n] + plan.steps[n + 1 :])), n


def test_plan_violations_reports_wrong_order():
    model = make_lockbox_model(THESIS)
    plan = plan_unlocking(model, goal_of(THESIS))
    swapped = replace(plan, steps=(plan.steps[1], plan.steps[0], *plan.steps[2:]))
    assert plan_violations(model, swapped) == ["move 1, lockbox/e: lockbox/e/velocity"]
    short = replace(plan, steps=plan.steps[:-1])
    assert plan_violations(model, short) == ["lockbox/a ends at 0, and not at 1.2"]


def test_plan_with_position_lock():
    model = kv.load("articulations/latch", "gate")
    door, bolt = "gate/gate/door", "gate/gate/bolt"
    plan = plan_unlocking(model, {door: 1.9, bolt: 0.0})
    assert [(str(step.coordinate), step.target > step.start) for step in plan.steps] == [
        (bolt, True),
        (door, True),
        (bolt, False),
    ]
    assert plan_violations(model, plan) == []
    back = plan_unlocking(model, {door: 0.0}, {door: 1.0})
    assert [str(step) for step in back.steps] == ["lower gate/gate/door to 0: it is the goal"]
    assert plan_violations(model, back, {door: 1.0}) == []


def test_bolt_does_not_spring_out_under_the_door():
    """A key may not move where that violates the range of another coordinate."""
    model = kv.Model()
    with model.edit() as edit:
        edit.constrain("a range", 0, A, 1)
        edit.constrain("b range", 0, B, 1)
        edit.constrain("shut", -1, A, kv.where(B < 0.5, 0.2, 2.0))
    plan = plan_unlocking(model, {"b": 0.0}, {"a": 0.8, "b": 1.0})
    assert [str(step.coordinate) for step in plan.steps] == ["a", "b"]
    assert plan.steps[0].target <= 0.2
    assert plan_violations(model, plan, {"a": 0.8, "b": 1.0}) == []


def test_plan_refutes_circle():
    plan = plan_unlocking(three_sliders(a=B > 0.5, b=(C > 0.3) & (C < 0.9), c=A > 0.1), {A: 1})
    assert plan.verdict == "refuted"
    assert plan.is_circle
    assert [lock.constraints for lock in plan.blocking] == [("lock a",), ("lock b",), ("lock c",)]
    assert "lock each other in a circle" in str(plan)


def test_plan_refutes_conflict_by_exhaustion():
    """The key has to be on both sides at once, at the same time as it may be on either side."""
    model = three_sliders(a=(B > 0.5) & (C > 0.5), c=B < 0.4, b=C < 0.4)
    with model.edit() as edit:
        edit.constrain("c stays", -(B < 0.4), C.derivative(), 1)
        edit.constrain("b stays", -(C < 0.4), B.derivative(), 1)
        edit.constrain("d range", 0, kv.position("d"), 1)
        edit.constrain("a also", -1, A.derivative(), kv.position("d") > 0.5)
    plan = plan_unlocking(model, {A: 1})
    assert plan.verdict == "refuted"
    assert not plan.is_circle
    assert {lock.constraints for lock in plan.blocking} == {
        ("lock a",),
        ("lock b", "b stays"),
        ("lock c", "c stays"),
    }
    for lock in plan.blocking:
        fewer = model.copy()
        with fewer.edit() as edit:
            for name in lock.constraints:
                edit.remove(f"constraint {name}")
        assert plan_unlocking(fewer, {A: 1}).verdict == "found", lock


def test_circle_is_named_where_another_way_is_stuck():
    """Child lock: the lever moves while the door is open; the outer handle does not move."""
    door, outer, lever = (kv.position(name) for name in ("door", "outer", "lever"))
    model = kv.Model()
    with model.edit() as edit:
        for q in (door, outer, lever):
            edit.constrain(f"{q} range", 0, q, 1)
        edit.constrain("latch", -1, door.derivative(), (outer > 0.5) | (lever > 0.5))
        edit.constrain("lever lock", -1, lever.derivative(), door > 0.5)
    plan = plan_unlocking(model, {door: 1}, fixed=[outer])
    assert plan.is_circle
    assert [lock.constraints for lock in plan.blocking] == [("latch",), ("lever lock",)]
    assert [str(step.coordinate) for step in plan_unlocking(model, {door: 1}).steps] == ["outer", "door"]


def test_plan_without_what_does_not_move():
    model = three_sliders(a=(B > 0.5) | (C > 0.5))
    first = plan_unlocking(model, {A: 1}).steps[0].coordinate
    assert {first, plan_unlocking(model, {A: 1}, fixed=[first]).steps[0].coordinate} == {B, C}
    refuted = plan_unlocking(model, {A: 1}, fixed=[B, C])
    assert refuted.verdict == "refuted"
    assert str(refuted).startswith("a = 1: cannot be reached without b and c")


def test_unreadable_lock_is_shut_and_named():
    model = three_sliders(a=B * C > 0.5, b=C > 0.3)
    plan = plan_unlocking(model, {A: 1})
    assert plan.verdict == "undecided"
    assert [lock.constraint for lock in plan.unread] == ["lock a"]
    assert "could not be read" in str(plan)
    beside = plan_unlocking(model, {B: 1})
    assert beside.verdict == "found"
    assert not beside.unread


def test_range_that_depends_on_another_coordinate_is_shut_and_named():
    model = three_sliders()
    with model.edit() as edit:
        edit.constrain("table", 0, C, B + 0.2)
    plan = plan_unlocking(model, {C: 1})
    assert plan.verdict == "undecided"
    assert [str(lock) for lock in plan.unread] == ["c stays within [0, b + 0.2]: when b < 0.8 (table)"]


def test_coordinate_retreats_before_it_gets_to_its_goal():
    """The goal would serve the other coordinate too, but there is no way there yet."""
    model = kv.Model()
    with model.edit() as edit:
        edit.constrain("a range", 0, A, 1)
        edit.constrain("b range", 0, B, 1)
        edit.constrain("a lock", -1, A.derivative(), (B > 0.15) & (B < 0.35))
        edit.constrain("b lock", -((A < 0.15) | (A > 0.9)), B.derivative(), 1)
    start = {"a": 0.3, "b": 1.0}
    plan = plan_unlocking(model, {"a": 1}, start)
    assert [(str(s.coordinate), s.target > s.start) for s in plan.steps] == [("a", 0), ("b", 0), ("a", 1)]
    assert plan_violations(model, plan, start) == []
    assert 0.15 < plan.steps[1].target < 0.35


@pytest.mark.parametrize(("way", "goal"), [(-1, 1.0), (-1, 0.5), (1, 1.0)])
def test_key_stops_before_its_own_latch(way, goal):
    """The key could not come back from beyond the latch, and need not go there."""
    model = kv.Model()
    with model.edit() as edit:
        edit.constrain("a range", 0, A, 1)
        edit.constrain("b range", -1, B, 1)
        edit.constrain("a lock", -1, A.derivative(), way * B > 0)
        free = way * B < 0.4
        edit.constrain("b latch", -free, B.derivative(), free)
    plan = plan_unlocking(model, {"a": goal}, {"b": -way})
    assert 0 < way * plan.steps[0].target < 0.4
    assert plan_violations(model, plan, {"b": -way}) == []


def test_goal_on_the_threshold_of_two_locks_is_reached():
    plan = plan_unlocking(three_sliders(b=A > 0.5, c=A < 0.5), {A: 0.5})
    assert [str(step) for step in plan.steps] == ["raise a to 0.5: it is the goal"]


def test_plan_from_beyond_a_limit_begins_where_the_coordinate_is():
    model = three_sliders(a=B > 0.5)
    plan = plan_unlocking(model, {A: 1}, {"b": -1e-3})
    assert plan.steps[0].start == -1e-3
    assert plan_violations(model, plan, {"b": -1e-3}) == []


def test_plan_violations_sees_what_lies_between_samples():
    """A catch of 2 mm on a way of a metre, and the last millimetre of a move."""
    model = three_sliders()
    with model.edit() as edit:
        edit.constrain("catch", -1, A.derivative(), ~((A > 0.6131) & (A < 0.6151)))
        edit.constrain("end", -1, B.derivative(), B < 0.999)
    found = plan_unlocking(three_sliders(), {A: 1, B: 1})
    assert sorted(plan_violations(model, found)) == ["move 1, a: catch", "move 2, b: end"]


def test_refutation_names_positions_that_no_move_leaves():
    model = three_sliders(a=B > 0.5, b=(C > 0.3) & (C < 0.9), c=A > 0.1)
    plan = plan_unlocking(model, {A: 1})
    assert plan.verdict == "refuted"
    assert refutation_gaps(model, plan) == []
    assert dict(zip(plan.invariant.coordinates, plan.invariant.cells, strict=True))[A][0] == Interval(
        0.0, 0.1, True, True
    )


def test_refutation_gaps_finds_each_flaw():
    model = three_sliders(a=B > 0.5, b=C > 0.3, c=A > 0.1)
    plan = plan_unlocking(model, {A: 1})
    known = plan.invariant
    assert refutation_gaps(three_sliders(a=B > 0.5, c=A > 0.1), plan) == ["b may get to 0.5 < b <= 1"]
    assert refutation_gaps(model, replace(plan, goal={A: 0.05})) == ["the goal is inside"]
    assert refutation_gaps(model, plan, {"b": 0.9}) == ["the start is outside"]
    short = replace(known, cells=(known.cells[0][:1], *known.cells[1:]), rests=((True,), *known.rests[1:]))
    assert "the intervals of a do not cover its range" in refutation_gaps(
        model, replace(plan, invariant=short)
    )
    assert "the intervals of a do not cover its range" in refutation_gaps(
        model, replace(plan, invariant=replace(known, rests=((True, False), *known.rests[1:])))
    )
    assert refutation_gaps(model, replace(plan, invariant=None)) != []


def test_start_on_a_threshold_is_neither_used_nor_refuted():
    """There the comparison is 0.5, which lets the goal move at half of its speed."""
    model = three_sliders(a=B > 0.5)
    plan = plan_unlocking(model, {A: 1}, {B: 0.5})
    assert [str(step.coordinate) for step in plan.steps] == ["b", "a"]
    assert plan_unlocking(model, {A: 1}, {B: 0.5}, fixed=[B]).verdict == "undecided"
    assert plan_unlocking(model, {A: 1}, {B: 0.499}, fixed=[B]).verdict == "refuted"


def test_wrong_interlocks_are_not_believed():
    """Plans and refutations by interlocks of another model are checked by the constraints."""
    open_, shut = three_sliders(a=B > 0.5), three_sliders(a=B > 2)
    assert plan_unlocking(shut, {A: 1}, found=interlocks(open_)).verdict == "undecided"
    plan = plan_unlocking(open_, {A: 1}, found=interlocks(three_sliders(a=(B > 0.5) & (B < 0.4))))
    assert plan.verdict == "undecided"
    assert plan.reason.startswith("the constraints do not confirm the answer: a may get to")


def test_refutation_does_not_depend_on_a_lock_that_could_not_be_read():
    model = three_sliders(a=(B > 0.5) & (B < 0.4), b=A * C > 0.5)
    with model.edit() as edit:
        edit.constrain("a also", -1, A.derivative(), B * C > 0.5)
    plan = plan_unlocking(model, {A: 1})
    assert plan.verdict == "refuted"
    assert "a also" in [lock.constraint for lock in plan.unread]


def test_conditions_that_contradict_each_other_keep_a_goal_out_of_reach():
    model = three_sliders(a=(B > 0.2) & (B < 0.4) & (C > 0.5) & (B > 0.6))
    assert plan_unlocking(model, {A: 1}).verdict == "refuted"


def test_plan_after_its_budget_is_undecided():
    box = draw_lockbox(30, 0, negated=0.5)
    plan = plan_unlocking(make_lockbox_model(box), goal_of(box), budget=1e-9)
    assert plan.verdict == "undecided"
    assert not plan.steps
    assert "undecided, since the budget was spent after" in str(plan)


def test_plan_of_a_goal_that_is_reached():
    plan = plan_unlocking(three_sliders(a=B > 0.5), {A: 0.0})
    assert (plan.verdict, plan.steps, str(plan)) == ("found", (), "nothing has to move")


def test_goal_in_the_interval_of_the_start_has_to_be_reached():
    model = three_sliders(a=B > 0.5)
    plan = plan_unlocking(model, {A: 0.7}, {A: 0.2})
    assert [str(step.coordinate) for step in plan.steps] == ["b", "a"]
    assert plan.steps[-1].target == 0.7
    assert plan_violations(model, plan, {A: 0.2}) == []


def test_known_interlocks_are_used():
    model = three_sliders(a=B > 0.5)
    assert plan_unlocking(model, {A: 1}, found=interlocks(model)) == plan_unlocking(model, {A: 1})


def test_coordinates_without_limits_or_locks():
    door, model = kv.position("door"), kv.Model()
    with model.edit() as edit:
        edit.constrain("lock", -1, door.derivative(), A > 3)
    assert [str(step) for step in plan_unlocking(model, {door: 2}).steps] == [
        "raise a above 3: it holds door",
        "raise door to 2: it is the goal",
    ]


def test_plan_is_data_for_json():
    model = make_lockbox_model(THESIS)
    data = json.loads(json.dumps(plan_unlocking(model, goal_of(THESIS)).as_data(), allow_nan=False))
    assert data["verdict"] == "found"
    assert data["steps"][0] == {
        "coordinate": "lockbox/f",
        "from": 0.0,
        "to": 1.25,
        "threshold": 1.2,
        "releases": ["lockbox/e/velocity"],
        "reason": "it holds lockbox/e",
    }


@pytest.mark.parametrize("value", [0.1, 1.5])
def test_a_parameter_has_no_other_value_at_the_start(value):
    model = three_sliders(a=kv.parameter("threshold", 0.7) < B)
    plan = plan_unlocking(model, {"a": 1}, {"threshold": 0.7})
    assert plan.verdict == "found"
    for ask in (
        lambda state: plan_unlocking(model, {"a": 1}, state),
        lambda state: plan_violations(model, plan, state),
    ):
        with pytest.raises(InvalidValueError, match=f"is 0.7 in the model and {value} in the state"):
            ask({"threshold": value})


@pytest.mark.parametrize(
    ("goal", "options", "error", "text"),
    [
        ({}, {}, InvalidValueError, "A plan has a goal"),
        ({"d": 1}, {}, UnknownNameError, "'d' is no degree of freedom"),
        ({"a": 2}, {}, InvalidValueError, "beyond its limits"),
        ({"a": float("nan")}, {}, InvalidValueError, "finite number"),
        ({"a": 1}, {"budget": 0}, InvalidValueError, "positive time"),
        ({"a": 1}, {"fixed": ["z"]}, UnknownNameError, "no symbol 'z'"),
        ({"a": 1}, {"state": {"z": 1}}, UnknownNameError, "z"),
    ],
)
def test_bad_input_is_refused(goal, options, error, text):
    with pytest.raises(error, match=text):
        plan_unlocking(three_sliders(a=B > 0.5), goal, **options)
