import gc

import numpy as np
import pytest

from kineverse_studies.bench import DisagreementError, Measurement
from kineverse_studies.bench.harness import (
    Bar,
    Comparison,
    Contender,
    bound_median,
    check_equal,
    compare_speed,
    time_calls,
    time_contenders,
)


def silent(items, what, unit):
    return items


def test_contenders_take_turns_in_changing_order():
    order = []

    def contender(name):
        return Contender(name, lambda: order.append(name) or float(len(order)))

    measured = time_contenders("game", [contender(name) for name in "abc"], 3, silent)
    assert "".join(order) == "abc" + "abc" + "bca" + "cab"  # the first turns do not count
    assert list(measured) == ["a", "b", "c"]
    assert measured["a"].samples == (4.0, 9.0, 11.0)


def test_progress_counts_rounds():
    seen = []

    def watch(items, what, unit):
        seen.append((list(items), what, unit))
        return items

    time_contenders("game", [Contender("a", lambda: 1.0)], 4, watch)
    assert seen == [([0, 1, 2, 3], "game", "round")]


def test_garbage_collection_is_off_during_samples_only():
    during = []
    time_contenders("game", [Contender("a", lambda: during.append(gc.isenabled()) or 1.0)], 2, silent)
    assert during[1:] == [False, False]
    assert gc.isenabled()


def test_disagreeing_contenders_are_not_timed():
    timed_ones = []

    def contender(name, *arrays):
        return Contender(name, lambda: timed_ones.append(name) or 1.0, lambda: [np.array(a) for a in arrays])

    right, close = contender("a", [1.0, 2.0], [3.0]), contender("b", [1.0, 2.0], [3.0 + 1e-12])
    time_contenders("game", [right, close], 1, silent)
    timed_ones.clear()
    with pytest.raises(DisagreementError, match=r"'game'.*'c' and 'a' differ by 1e-06 in result 1"):
        time_contenders("game", [right, contender("c", [1.0, 2.0], [3.0 + 1e-6])], 1, silent)
    assert timed_ones == []


@pytest.mark.parametrize(
    ("found", "message"),
    [
        ([np.zeros((2, 3))], "shapes"),
        ([np.zeros((2, 2)), np.zeros(1)], "shapes"),
        ([np.full((2, 2), np.nan)], "differ by nan"),
    ],
)
def test_check_equal_refuses_other_shapes_and_nan(found, message):
    with pytest.raises(DisagreementError, match=message):
        check_equal("game", [("a", [np.zeros((2, 2))]), ("b", found)])


def test_a_nonfinite_reference_is_an_error():
    with pytest.raises(DisagreementError, match="not finite"):
        check_equal("game", [("a", [np.array([np.nan])]), ("b", [np.array([np.nan])])])


def test_a_time_is_that_of_one_piece_and_leaves_preparation_out(monkeypatch):
    clock = [0.0]
    monkeypatch.setattr("kineverse_studies.bench.harness.perf_counter", lambda: clock[0])

    def prepare():
        clock[0] += 100.0
        return 6.0

    def run(seconds):
        clock[0] += seconds

    assert time_calls(run, 3, prepare)() == pytest.approx(2.0)
    assert time_calls(lambda: run(1.0))() == pytest.approx(1.0)


def test_ratios_are_taken_round_by_round():
    # The machine was slow in the second round, for both; a ratio of medians would be 3.
    measured = {
        "ours": Measurement("ours", "s", (1.0, 10.0, 1.0)),
        "theirs": Measurement("theirs", "s", (2.0, 20.0, 3.0)),
    }
    comparison = compare_speed(measured, "ours", "theirs", 2.0)
    assert (comparison.value, comparison.status) == (2.0, "met")
    assert compare_speed(measured, "ours", "theirs", 2.1).status == "missed"
    assert compare_speed(measured, "ours", "theirs").status == "no bar"


def test_a_missing_peer_is_in_the_comparison():
    comparison = compare_speed({"ours": Measurement("ours", "s", (1.0,))}, "ours", "theirs", 2.0)
    assert (comparison.value, comparison.status) == (None, "missing")
    assert "theirs" in comparison.name


def test_bars_are_inclusive_limits():
    measurement = Measurement("load", "s", (0.1, 0.3, 0.2))
    assert (measurement.median, measurement.best) == (0.2, 0.1)
    assert bound_median(measurement, 0.2).status == "met"
    assert bound_median(measurement, 0.15).status == "missed"
    assert Comparison("ratio", 2.0, "x", Bar(2.0, at_least=True)).status == "met"
    assert Comparison("ratio", 1.9, "x", Bar(2.0, at_least=True)).status == "missed"
