"""Random lockboxes are as they are documented, and loaded by name."""

import math
from operator import mul

import pytest

import kineverse as kv
from kineverse.errors import InvalidValueError, UnknownNameError
from kineverse.gallery.lockboxes import THESIS, draw_lockbox, make_lockbox_model, make_rings


def longest_chain(box):
    """Return the longest chain of locks that have to be opened one after the other."""
    length: dict[str, int] = {}
    for name, part in box.parts.items():
        alone = [group[0] for group in part.groups if len(group) == 1 and group[0].beyond]
        length[name] = 1 + max((length.get(c.part, 0) for c in alone), default=0)
    return max(length.values())


@pytest.mark.parametrize("negated", [0.0, 0.4])
@pytest.mark.parametrize("parts", [3, 5, 17, 60, 100])
def test_draw_lockbox_is_shut_and_has_a_long_chain(parts, negated):
    for seed in range(10):
        box = draw_lockbox(parts, seed, negated=negated)
        assert len(box.parts) == parts
        assert longest_chain(box) >= math.ceil(parts / 3)
        for part in list(box.parts.values())[1:]:
            assert any(not any(not c.beyond for c in group) for group in part.groups)
            assert all(0.0 < c.threshold < 1.0 for group in part.groups for c in group)


def test_draw_lockbox_conditions_are_drawn_as_asked():
    conditions = [
        (c.beyond, len(group) > 1)
        for seed in range(20)
        for part in draw_lockbox(40, seed, negated=0.5).parts.values()
        for group in part.groups[1:]
        for c in group
    ]
    negated = sum(not beyond for beyond, _ in conditions) / len(conditions)
    assert 0.4 < negated < 0.65
    assert any(either for _, either in conditions)
    monotone = draw_lockbox(40, 7)
    place = {name: k for k, name in enumerate(monotone.parts)}
    every = [(n, c) for n, part in monotone.parts.items() for group in part.groups for c in group]
    assert all(c.beyond and place[c.part] < place[n] for n, c in every)


def test_draw_lockbox_depends_on_the_seed_alone():
    assert draw_lockbox(30, 4) == draw_lockbox(30, 4)
    assert draw_lockbox(30, 4) != draw_lockbox(30, 5)


def test_load_lockbox_by_name():
    thesis = kv.load("lockboxes/thesis")
    assert [str(s) for s in thesis.degrees_of_freedom] == [f"lockbox/{name}" for name in "abcdef"]
    assert set(thesis.frames) == {f"lockbox/{name}" for name in "abcdef"}
    assert len(kv.load("lockboxes/rings-3", prefix="puzzle").degrees_of_freedom) == 3
    assert kv.load("lockboxes/17").degrees_of_freedom == kv.load("lockboxes/17").degrees_of_freedom
    for name in ("rings-0", "rings-100", "rings-x", "-3", "007", "nothing"):
        with pytest.raises(UnknownNameError, match="lockboxes"):
            kv.load(f"lockboxes/{name}")


def test_thesis_lock_rates():
    model = make_lockbox_model(THESIS)
    shut, speed = model.default_state(), kv.position("lockbox/a").derivative()
    limits = model.constraints["lockbox/a/velocity"]
    assert (float(limits.lower(shut)), float(limits.upper(shut))) == (0.0, 0.0)
    opened = {**shut, kv.position("lockbox/b"): 0.5, kv.position("lockbox/c"): 0.7}
    assert (float(limits.lower(opened)), float(limits.upper(opened))) == (-0.4, 0.4)
    assert limits.expression == speed


def test_product_rule_has_no_trend_where_two_conditions_fail():
    speeds = {name: kv.velocity(f"lockbox/{name}") for name in "bc"}
    for join, expected in ((None, 0.4), (mul, 0.0)):
        model = make_lockbox_model(THESIS) if join is None else make_lockbox_model(THESIS, join=join)
        trend = model.constraints["lockbox/a/velocity"].upper.gradient()
        shut = model.default_state()
        for speed in speeds.values():
            assert float(trend[speed](shut)) == pytest.approx(expected)


def test_bad_sizes_are_refused():
    with pytest.raises(InvalidValueError, match="at least 3 parts"):
        draw_lockbox(2, 0)
    with pytest.raises(InvalidValueError, match="share of negations"):
        draw_lockbox(5, 0, negated=1.5)
    with pytest.raises(InvalidValueError, match="at least one ring"):
        make_rings(0)
