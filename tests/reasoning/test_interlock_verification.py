"""The checker: it reports wrong claims, missing claims, and boxes that are too large or too small."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from constraint_models import model

import kineverse as kv
from kineverse import reasoning
from kineverse.reasoning import (
    Interlock,
    Interlocks,
    Interval,
    IntervalBox,
    Undecided,
    interlock_verification,
    interlocks,
)

A, B = kv.position("a"), kv.position("b")
SPEED = A.derivative()
SHUT = IntervalBox({A: Interval(lower=1.99), B: Interval(upper=0.3)})


def garage() -> kv.Model:
    unlocked = ~((B < 0.3) & (A > 1.99))
    return model(
        range=(0, A, 2), bolt=(0, B, 0.6), free=(-1, B.derivative(), 1), lock=(-unlocked, SPEED, unlocked)
    )


def lock(*boxes: IntervalBox, hold: str = "stands still", held: kv.Symbol = SPEED) -> Interlock:
    return Interlock(held, hold, ("lock",), boxes)  # type: ignore[arg-type]


def test_contradictions_accepts_the_right_interlocks() -> None:
    assert reasoning.contradictions(garage(), Interlocks([lock(SHUT)])) == []
    assert interlocks(garage()) == Interlocks([lock(SHUT)])


@pytest.mark.parametrize(
    "wrong",
    [
        [],
        [lock(IntervalBox({}))],
        [lock(SHUT, hold="cannot increase")],
        [lock(SHUT, hold="cannot decrease")],
        [lock(IntervalBox({A: Interval(lower=1.99)}))],
        [lock(IntervalBox({B: Interval(upper=0.3)}))],
        [lock(IntervalBox({A: Interval(lower=1.98), B: Interval(upper=0.3)}))],
        [lock(IntervalBox({A: Interval(lower=1.995), B: Interval(upper=0.3)}))],
        [lock(IntervalBox({A: Interval(lower=1.99), B: Interval(upper=0.31)}))],
        [lock(IntervalBox({A: Interval(lower=1.99), B: Interval(upper=0.29)}))],
        [lock(IntervalBox({A: Interval(lower=1.99), B: Interval(0.1, 0.3)}))],
        [lock(IntervalBox({A: Interval(upper=1.99), B: Interval(upper=0.3)}))],
        [lock(SHUT, IntervalBox({B: Interval(lower=0.5)}))],
        [lock(SHUT), lock(IntervalBox({A: Interval(lower=1)}), held=B.derivative())],
    ],
)
def test_contradictions_reports_wrong_interlocks(wrong: list[Interlock]) -> None:
    assert reasoning.contradictions(garage(), Interlocks(wrong))


def test_contradictions_accepts_undecided_constraints() -> None:
    assert reasoning.contradictions(garage(), Interlocks([], [Undecided("lock", "of tiredness")])) == []
    elsewhere = Undecided("lock", "of tiredness", (IntervalBox({B: Interval(lower=0.3)}),))
    assert reasoning.contradictions(garage(), Interlocks([], [elsewhere]))


def kept(lower: kv.Expression | float, upper: kv.Expression | float, *boxes: IntervalBox) -> Interlock:
    bounds = (kv.array(lower), kv.array(upper))
    return Interlock(A, "stays within", ("lock",), boxes or (IntervalBox({}),), *bounds)


def test_ranges() -> None:
    subject = model(range=(0, A, 2), other=(0, B, 1), lock=(0, A, 0.5 + B))
    assert reasoning.contradictions(subject, Interlocks([kept(0, B + 0.5)])) == []
    assert reasoning.contradictions(subject, Interlocks([kept(0, B + 0.51)]))
    assert reasoning.contradictions(subject, Interlocks([kept(0, 0.5)]))
    assert reasoning.contradictions(
        subject, Interlocks([kept(0, B + 0.5, IntervalBox({B: Interval(upper=0.5)}))])
    )
    assert reasoning.contradictions(subject, Interlocks([]))
    nothing = Interlock(A, "has no value", ("lock",), (IntervalBox({B: Interval(upper=0.1)}),))
    assert reasoning.contradictions(subject, Interlocks([kept(0, B + 0.5), nothing]))


EXAMPLES = re.compile(r"\n\n *Examples\n *-{8}\n.*?(?=\"\"\")", re.DOTALL)


def test_checker_is_short_and_independent() -> None:
    text = EXAMPLES.sub("", Path(interlock_verification.__file__).read_text(encoding="utf-8"))
    assert len([line for line in text.splitlines() if line.strip()]) < 100
    own = {line.split()[1] for line in text.splitlines() if line.startswith("from .")}
    assert own == {".boxes", ".constraint_evaluation", ".interlock_records"}


def test_contradictions_checks_claims_of_undecided_constraints() -> None:
    """Some of a constraint may be known: what is told of it has to be true all the same."""
    subject = model(lock=(0, SPEED, np.sin(B * B) > 0.5))
    found = interlocks(subject)
    assert found.undecided[0].where == (IntervalBox({}),)
    assert reasoning.contradictions(subject, found) == []
    for hold in ("stands still", "cannot increase", "has no value"):
        wrong = Interlocks([lock(IntervalBox({}), hold=hold)], found.undecided)
        assert reasoning.contradictions(subject, wrong) == [f"a:velocity {hold}: not so by lock"]


def test_contradictions_reports_no_value_claimed_for_a_speed_of_zero() -> None:
    assert reasoning.contradictions(garage(), Interlocks([lock(SHUT, hold="has no value")]))


def test_contradictions_distinguishes_a_sum_of_speeds_from_a_norm() -> None:
    """Their sum happens to be 0 as often as not where both are at one of their ends."""
    subject = model(lock=(0, SPEED + B.derivative(), kv.position("c") > 0.5))
    for seed in range(5):
        assert reasoning.contradictions(subject, interlocks(subject), seed=seed) == []


def test_constraints_that_exclude_each_other_have_no_value() -> None:
    """Nothing stands still there: no speed is allowed at all."""
    subject = model(moves=(0.5, SPEED, 1), lock=(-1, SPEED, B > 0.3))
    found = interlocks(subject)
    pair = [(k.hold, k.when) for k in found if k.constraints == ("moves", "lock")]
    assert pair == [("has no value", (IntervalBox({B: Interval(upper=0.3)}),))]
    assert reasoning.contradictions(subject, found) == []
    still = Interlock(SPEED, "stands still", ("moves", "lock"), (IntervalBox({B: Interval(upper=0.3)}),))
    rest = [k for k in found if k.hold != "has no value"]
    assert reasoning.contradictions(subject, Interlocks([*rest, still]))
