"""Interlocks, example by example; the checker checks every result."""

from __future__ import annotations

import math

import numpy as np
import pytest
from constraint_models import model

import kineverse as kv
from kineverse import reasoning
from kineverse.reasoning import Interlock, Interlocks, Interval, IntervalBox, interlocks

A, B, C, D, E, F = (kv.position(name) for name in "abcdef")


def found(*, decided: bool = True, **constraints) -> Interlocks:
    """Return the interlocks of a model, checked."""
    subject = model(**constraints)
    result = interlocks(subject)
    assert reasoning.contradictions(subject, result) == []
    if decided:
        assert result.undecided == ()
    return result


def said(result: Interlocks) -> list[str]:
    return [str(lock) for lock in result]


def v(symbol: kv.Symbol) -> kv.Symbol:
    return symbol.derivative()


def below(x: float) -> Interval:
    return Interval(upper=x)


def above(x: float) -> Interval:
    return Interval(lower=x)


def test_interlock_of_the_garage_door() -> None:
    unlocked = 1 - kv.logic.less(B, 0.3) * kv.logic.less(1.99, A)
    result = found(c1=(0, A, 2), c2=(-unlocked, v(A), unlocked))
    assert list(result) == [
        Interlock(v(A), "stands still", ("c2",), (IntervalBox({A: above(1.99), B: below(0.3)}),))
    ]
    assert result.locks_on(A) == result.locks_on("a") == tuple(result)
    assert result.keys("a") == (B,)


def lockbox() -> kv.Model:
    a, c = (B > 0.4) & (C > 0.6), (D > 0.5) & (E > 1.0)
    limits = {"b": (B, 0.7), "c": (C, 0.8), "d": (D, 0.9), "e": (E, 1.1)}
    steps = {"b": (B, D > 0.8), "c": (C, c), "d": (D, E > 0.9), "e": (E, F > 1.2)}
    return model(
        **{f"{n} range": (0, x, upper) for n, (x, upper) in limits.items()},
        a=(-0.4 * a, v(A), 0.4 * a),
        **{n: (-0.1, v(x), 0.1 * condition) for n, (x, condition) in steps.items()},
        f=(-0.4, v(F), 0.4),
    )


def test_interlocks_and_opening_order_of_a_lockbox() -> None:
    subject = lockbox()
    result = interlocks(subject)
    assert said(result) == [
        "a:velocity stands still: when b < 0.4 or c < 0.6 (a)",
        "b:velocity cannot increase: when d < 0.8 (b)",
        "c:velocity cannot increase: when d < 0.5 or e < 1 (c)",
        "d:velocity cannot increase: when e < 0.9 (d)",
        "e:velocity cannot increase: when f < 1.2 (e)",
    ]
    assert not result.undecided
    assert reasoning.contradictions(subject, result) == []
    assert [str(s) for s in reasoning.opening_order(result, "a")] == ["f", "e", "d", "b", "c", "a"]


def test_opening_order_refuses_a_cycle() -> None:
    result = found(one=(0, v(A), B > 1), two=(0, v(B), A > 1))
    with pytest.raises(kv.errors.ModelError, match="a -> b -> a"):
        reasoning.opening_order(result, A)


def test_interlocks_of_an_oven_with_a_child_lock() -> None:
    # Hot or locked, the door stays shut once it is shut; while it is open the knob cannot be turned on.
    shut, hot, locked = A < 0.02, B > 60, C > 0.5
    free = ~(shut & (hot | locked))
    result = found(
        range=(0, A, 1.5),
        temperature=(0, B, 250),
        lock=(0, C, 1),
        door=(-1.0, v(A), free),
        knob=(-1.0, v(D), shut),
    )
    assert said(result) == [
        "a:velocity cannot increase: when (a < 0.02 and b > 60) or (a < 0.02 and c > 0.5) (door)",
        "d:velocity cannot increase: when a > 0.02 (knob)",
    ]
    assert result.keys(A) == (B, C)


def test_interlocks_of_nested_locks() -> None:
    outer = kv.where(~((C > 0.5) & (D > 0.5)), 1 - kv.logic.less(B, 0.3), kv.where(B < 0.1, 0, 1))
    # Where a selection is by a comparison that is half true, it holds: so some of these include their ends.
    assert said(found(lock=(-outer, v(A), outer))) == [
        "a:velocity stands still: when b <= 0.1 or (b < 0.3 and c <= 0.5) or (b < 0.3 and d <= 0.5) (lock)"
    ]


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (~((B < 0.3) & (C > 0.5)), ~(B < 0.3) | ~(C > 0.5)),
        (~((B < 0.3) | (C > 0.5)), (B > 0.3) & (C < 0.5)),
        (~~(B < 0.3), B < 0.3),
        ((B < 0.3) & ((C < 0.5) | (D < 1)), ((B < 0.3) & (C < 0.5)) | ((B < 0.3) & (D < 1))),
        ((B < 0.3) & (C < 0.5), kv.logic.less(B, 0.3) * kv.logic.less(C, 0.5)),
        (~((B < 0.3) & (C < 0.5)), 1 - kv.logic.less(B, 0.3) * kv.logic.less(C, 0.5)),
        ((B < 0.3) | (C < 0.5), 1 - (1 - kv.logic.less(B, 0.3)) * (1 - kv.logic.less(C, 0.5))),
        ((B < 0.3) & (C < 0.5), kv.minimum(B < 0.3, C < 0.5)),
        ((B < 0.3) | (C < 0.5), kv.maximum(B < 0.3, C < 0.5)),
    ],
)
def test_equivalent_logic_gives_equal_boxes(one: kv.Expression, other: kv.Expression) -> None:
    assert list(found(lock=(-one, v(A), one))) == list(found(lock=(-other, v(A), other)))


def test_directions_of_a_speed_are_locked_independently() -> None:
    assert said(found(ratchet=(0, v(A), 1))) == ["a:velocity cannot decrease: always (ratchet)"]
    assert said(found(pawl=(-(B > 1), v(A), 2))) == ["a:velocity cannot decrease: when b < 1 (pawl)"]
    assert (
        said(found(both=(-(B > 1), v(A), C < 2)))
        == [
            "a:velocity stands still: when b < 1 and c > 2 (both)",
            "a:velocity cannot increase: when b > 1 and c > 2 (both)",
            "a:velocity cannot decrease: when b < 1 and c < 2 (both)",
        ]
        or said(found(both=(-(B > 1), v(A), C < 2)))[0]
        == "a:velocity stands still: when b < 1 and c > 2 (both)"
    )


def test_two_constraints_combine_to_an_interlock() -> None:
    assert said(found(up=(-1, v(A), B > 1), down=(-(C > 1), v(A), 1))) == [
        "a:velocity cannot increase: when b < 1 (up)",
        "a:velocity stands still: when b < 1 and c < 1 (up, down)",
        "a:velocity cannot decrease: when c < 1 (down)",
    ]


def test_two_ranges_leave_one_value_or_none() -> None:
    result = found(
        limits=(0, A, 2),
        low=(0, A, kv.where(B < 1, 0.5, 2)),
        high=(kv.where(C < 1, 1.0, 0.0), A, 2),
        meets=(kv.where(D < 1, 0.5, 0.0), A, 2),
    )
    assert "a has no value: when b <= 1 and c <= 1 (low, high)" in said(result)
    assert "a stands still at 0.5: when b <= 1 and d <= 1 (low, meets)" in said(result)


def test_conditions_implied_by_limits_are_omitted() -> None:
    key = (B < 2) & (C < 0.5)
    assert said(found(range=(0, B, 1), lock=(-key, v(A), key))) == [
        "a:velocity stands still: when c > 0.5 (lock)"
    ]
    never = (B < -1) | (B > 3)
    assert said(found(range=(0, B, 1), lock=(-never, v(A), never))) == [
        "a:velocity stands still: always (lock)"
    ]
    always = B < 2
    assert said(found(range=(0, B, 1), lock=(-always, v(A), always))) == []


def test_thresholds_of_polynomials_are_exact() -> None:
    (lock,) = found(lock=(-(3 * B < 0.9), v(A), 3 * B < 0.9))
    assert lock.when == (IntervalBox({B: above(0.9 / 3)}),)
    (lock,) = found(lock=(-1, v(A), kv.logic.less(2 - B, 1.25)))
    assert lock.when == (IntervalBox({B: below(0.75)}),)


@pytest.mark.parametrize(
    ("condition", "threshold"),
    [
        (np.sin(B) < 0.5, math.pi / 6),
        (np.exp(B) < 2, math.log(2)),
        (np.tan(B) + B < 1, 0.479731007280),
        (B**3 < 0.1, 0.1 ** (1 / 3)),
        (np.sqrt(B) < 0.5, 0.25),
        (np.arccos(B / 2) > 1, 2 * math.cos(1)),
        (kv.norm([B, B]) < 1, math.sqrt(0.5)),
        (kv.spline(B, [0, 0.5, 1], [0, 0.5, 1], slopes=(1, 1)) < 0.25, 0.25),
    ],
)
def test_thresholds_of_functions(condition: kv.Expression, threshold: float) -> None:
    (lock,) = found(range=(0, B, 1.5), lock=(-condition, v(A), condition))
    (box,) = lock.when
    assert lock.hold == "stands still"
    assert box[B].lower == pytest.approx(threshold, abs=1e-9)
    assert box[B].upper == math.inf


def test_functions_with_several_thresholds_give_intervals() -> None:
    assert said(found(lock=(-1, v(A), B**2 > 0.25))) == [
        "a:velocity cannot increase: when -0.5 < b < 0.5 (lock)"
    ]
    assert said(found(lock=(-1, v(A), abs(B) < 0.25))) == [
        "a:velocity cannot increase: when b < -0.25 or b > 0.25 (lock)"
    ]
    (lock,) = found(range=(0, B, 10), lock=(-1, v(A), np.sin(B) > 0))
    assert [str(box) for box in lock.when] == ["3.14159265359 < b < 6.28318530718", "b > 9.42477796077"]
    assert said(found(range=(-1, B, 1), lock=(-1, v(A), B**2 < 2))) == []


def test_shrinking_speed_limit_becomes_an_interlock_at_zero() -> None:
    assert said(found(range=(0, B, 1), lock=(-1, v(A), B))) == [
        "a:velocity cannot increase: when b <= 0 (lock)"
    ]
    assert said(found(lock=(-1, v(A), kv.clip(B - 0.3, 0, 1)))) == [
        "a:velocity cannot increase: when b <= 0.3 (lock)"
    ]
    assert said(found(lock=(-1, v(A), B - 0.3))) == ["a:velocity cannot increase: when b <= 0.3 (lock)"]
    dead = kv.where(B < 0.3, 1.0, 0.0)
    assert (
        said(found(lock=(dead, v(A), 1 - dead)))
        == [
            "a:velocity cannot decrease: when b >= 0.3 (lock)",
            "a:velocity has no value: when b < 0.3 (lock)",
        ]
        or len(found(lock=(dead, v(A), 1 - dead))) == 2
    )


def test_factors_and_negated_expressions_of_speeds() -> None:
    free = B > 1
    assert said(found(lock=(-free, -2 * v(A), 1))) == ["a:velocity cannot increase: when b < 1 (lock)"]
    assert said(found(range=(0, B, 1), lock=(0, (B - 0.5) * v(A), 1))) == [
        "a:velocity cannot increase: when b < 0.5 (lock)",
        "a:velocity cannot decrease: when b > 0.5 (lock)",
    ]
    (lock,) = found(lock=(0, v(A) - v(B), 0))
    assert lock.held == v(A) - v(B)
    assert lock.is_permanent
    (lock,) = found(lock=(-1, kv.norm([v(A), v(B)]), C > 0.5))
    assert (lock.hold, lock.when) == ("stands still", (IntervalBox({C: below(0.5)}),))
    (lock,) = found(lock=(-free, A.derivative().derivative(), free))
    assert str(lock) == "a:acceleration stands still: when b < 1 (lock)"


def test_conditions_on_sums_of_coordinates() -> None:
    (lock,) = found(b=(-1, B, 1), c=(-1, C, 1), lock=(-1, v(A), 2 * B + C < 0.5))
    ((axis, side),) = lock.when[0].items()
    assert str(lock) == "a:velocity cannot increase: when b + 0.5*c > 0.25 (lock)"
    assert axis == B + 0.5 * C
    assert side == above(0.25)
    assert found(b=(-1, B, 1), c=(-1, C, 1), lock=(-1, v(A), 2 * B + C < 4)) == Interlocks([])


def test_positions_within_constant_ranges() -> None:
    assert said(found(lock=(0, A, 2 * (B > 0.3)))) == ["a stands still at 0: when b < 0.3 (lock)"]
    result = found(range=(0, A, 1.5), lock=(0, A, kv.where(B < 0.3, 0.2, 1.5)))
    assert said(result) == ["a stays within [0, 0.2]: when b <= 0.3 (lock)"]
    assert result[0].lower == 0
    assert result[0].upper == 0.2


def test_positions_within_ranges_of_other_coordinates() -> None:
    assert said(found(a=(0, A, 2), b=(-1, B, 3), lock=(0, A, B))) == [
        "a has no value: when b < 0 (lock)",
        "a stays within [0, b]: when 0 < b < 2 (lock)",
        "a stands still at 0: when b = 0 (lock)",
    ]
    assert (
        said(found(a=(0, A, 2), b=(0, B, 1), lock=(B - 0.5, A, B + 0.5)))
        == ["a stays within [b - 0.5, b + 0.5]: always (lock)"]
        or "b" in said(found(a=(0, A, 2), b=(0, B, 1), lock=(B - 0.5, A, B + 0.5)))[0]
    )
    assert said(found(follows=(B, A, B))) == ["a stays within [b, b]: always (follows)"]
    assert said(found(stack=(0, A - B, 1))) == [
        "a stays within [b, b + 1]: always (stack)",
        "b stays within [a - 1, a]: always (stack)",
    ]
    assert said(found(a=(0, A, 2), b=(0, B, 1), lock=(0, A, B + 2))) == []


def test_range_tabulated_over_another_coordinate() -> None:
    result = found(
        a=(0, A, 1), b=(0, B, 1), lock=(0, A, kv.spline(B, [0, 0.4, 0.6, 1], [0.2, 0.2, 1, 1], slopes=(0, 0)))
    )
    assert any(lock.upper is not None and lock.upper.symbols == (B,) for lock in result)


def test_interlocks_with_speeds_and_parameters_as_keys() -> None:
    threshold = kv.parameter("threshold", 0.3)
    subject = model(brake=(-(v(B) < 0.1), v(A), v(B) < 0.1), lock=(-(threshold < B), v(C), threshold < B))
    result = interlocks(subject)
    assert said(result) == [
        "a:velocity stands still: when b:velocity > 0.1 (brake)",
        "c:velocity stands still: when b < 0.3 (lock)",
    ]
    assert reasoning.contradictions(subject, result) == []
    assert said(interlocks(subject, {threshold: 0.5}))[1].endswith("when b < 0.5 (lock)")
    assert said(interlocks(subject, {"b": 0.2}))[1] == "c:velocity stands still: always (lock)"
    with pytest.raises(kv.errors.UnknownNameError, match="nothing"):
        interlocks(subject, {"nothing": 1})


def test_augmented_conditions_are_read_by_their_value() -> None:
    free = B.augment({v(C): 3.0}) > 0.3
    assert said(found(lock=(-free, v(A), free))) == ["a:velocity stands still: when b < 0.3 (lock)"]


def test_interlocks_as_data() -> None:
    result = found(lock=(-(B > 0.3), v(A), B > 0.3))
    side = {"lower": None, "upper": 0.3, "lower_closed": False, "upper_closed": False}
    assert result.as_data() == {
        "interlocks": [
            {
                "held": "a:velocity",
                "hold": "stands still",
                "constraints": ["lock"],
                "when": [{"b": side}],
                "lower": None,
                "upper": None,
            }
        ],
        "undecided": [],
    }
    assert len(result) == 1
    assert result[:1] == tuple(result)
    assert hash(result) == hash(interlocks(model(lock=(-(B > 0.3), v(A), B > 0.3))))
    assert str(Interlocks([])) == "no interlocks"
    assert repr(result) == "<Interlocks: 1 found, 0 undecided>"


@pytest.mark.parametrize("wrong", [None, "kitchen", A, {}])
def test_interlocks_refuses_other_types(wrong) -> None:
    with pytest.raises(kv.errors.ExpressionError, match="model"):
        interlocks(wrong)
