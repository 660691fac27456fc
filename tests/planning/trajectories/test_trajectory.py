"""Trajectories: values between knots, joined and cut ones, files."""

from __future__ import annotations

import copy
import json
import pickle
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicHermiteSpline

import kineverse as kv
from hypothesis_profiles import attempts
from kineverse.errors import FormatError, InvalidValueError, ShapeError, UnknownNameError
from kineverse.planning import Trajectory

A, B = kv.position("arm/a"), kv.position("arm/b")


def make(count: int = 5, seed: int = 0, duration: float = 2.0) -> Trajectory:
    rng = np.random.default_rng(seed)
    times = np.concatenate(([0.0], np.sort(rng.uniform(0, duration, count - 2)), [duration]))
    velocities = rng.normal(size=(count, 2))
    velocities[[0, -1]] = 0
    return Trajectory((A, B), times, rng.normal(size=(count, 2)), velocities)


seeds = st.integers(0, 2**32 - 1)


@given(seeds)
def test_it_is_the_cubic_hermite_spline_of_its_knots(seed: int) -> None:
    t = make(7, seed)
    spline = CubicHermiteSpline(t.times, t.positions, t.velocities)
    times = np.random.default_rng(seed).uniform(0, t.duration, (4, 3))
    np.testing.assert_allclose(t.positions_at(times), spline(times), atol=1e-12)
    largest = np.abs(spline.derivative()(times)).max()
    np.testing.assert_allclose(t.velocities_at(times), spline.derivative()(times), atol=1e-12 * largest)
    np.testing.assert_array_equal(t.positions_at(t.times), t.positions)
    alone = [*times.ravel().tolist(), -0.1, 99.0]
    np.testing.assert_allclose([t.positions_at(x) for x in alone], t.positions_at(alone), atol=1e-12)
    np.testing.assert_array_equal([t.positions_at(x) for x in t.times.tolist()], t.positions)
    np.testing.assert_allclose(t.velocities_at(t.times), t.velocities, atol=1e-12 * largest)


def test_states_have_names_and_stamps_and_stay_at_the_ends() -> None:
    t = make()
    assert t.at(0.0) == next(iter(t))
    assert t.at(99.0)["arm/b"] == t.positions[-1, 1]
    assert t.at(99.0).stamp == 99.0
    assert [state.stamp for state in t] == t.times.tolist()
    np.testing.assert_array_equal(t.velocities_at([-1.0, 99.0]), 0)
    np.testing.assert_array_equal(t.positions_at(-1.0), t.positions[0])


def test_one_knot_is_a_motion_of_no_duration() -> None:
    t = Trajectory((A,), [0.0], [[0.5]], [[0.0]])
    assert t.duration == 0
    assert t.at(3.0)[A] == 0.5
    assert t.sample(10.0) == t == t.reversed() == t.between(0, 0) == t.then(t)


@given(seeds, st.floats(0, 2), st.floats(0, 2))
def test_parts_joined_are_the_whole(seed: int, x: float, y: float) -> None:
    t, (first, last) = make(6, seed), sorted((x, y))
    parts = [t.between(0, first), t.between(first, last), t.between(last, 2.0)]
    assert sum(part.duration for part in parts) == pytest.approx(2.0)
    again = parts[0].then(parts[1]).then(parts[2]) if min(p.duration for p in parts) > 1e-6 else t
    times = np.linspace(0, 2, 30)
    np.testing.assert_allclose(again.positions_at(times), t.positions_at(times), atol=1e-6)


@given(seeds)
def test_reversed_is_its_own_inverse_and_goes_back(seed: int) -> None:
    t = make(5, seed)
    back, times = t.reversed(), np.linspace(0, t.duration, 17)
    np.testing.assert_allclose(back.positions_at(times), t.positions_at(t.duration - times), atol=1e-9)
    np.testing.assert_allclose(
        back.velocities_at(times)[1:-1], -t.velocities_at(t.duration - times)[1:-1], atol=1e-6
    )
    np.testing.assert_allclose(back.reversed().times, t.times, atol=1e-12)
    assert t.then(back).duration == 2 * t.duration


@pytest.mark.parametrize("rate", [0.3, 7.0, 1000.0])
def test_samples_are_at_a_rate_and_at_the_end(rate: float) -> None:
    t = make()
    sampled = t.sample(rate)
    assert sampled.duration == t.duration
    np.testing.assert_allclose(np.diff(sampled.times)[:-1], 1 / rate)
    np.testing.assert_array_equal(sampled.positions[-1], t.positions[-1])
    np.testing.assert_array_equal(sampled.positions, t.positions_at(sampled.times))
    assert len(t.sample(5.0)) == 11  # no knot right before the end


def test_trajectories_are_values() -> None:
    t, other = make(), make(seed=1)
    assert t == make()
    assert hash(t) == hash(make())
    assert t != other
    assert t != "t"
    assert pickle.loads(pickle.dumps(t)) == copy.deepcopy(t) == t
    with pytest.raises(ValueError, match="read-only"):
        t.positions[0] = 1
    assert repr(t) == "<Trajectory: 2 s, 5 knots, 2 coordinates: arm/a, arm/b>"


def test_the_arrays_are_copies() -> None:
    positions = np.zeros((2, 1))
    t = Trajectory((A,), [0, 1], positions, positions)
    positions[:] = 1
    assert not t.positions.any()


@pytest.mark.parametrize(
    ("arguments", "error", "what"),
    [
        (((A,), [0, 1], [[0], [1]], [[0]]), ShapeError, "have the shapes"),
        (((A,), [], np.zeros((0, 1)), np.zeros((0, 1))), ShapeError, "T >= 1"),
        (((A,), [0, 0], [[0], [1]], [[0], [0]]), InvalidValueError, "increase"),
        (((A,), [1, 2], [[0], [1]], [[0], [0]]), InvalidValueError, "begin at 0"),
        (((A,), [0, 1], [[0], [np.nan]], [[0], [0]]), InvalidValueError, "NaN"),
        (((A, A), [0], [[0, 0]], [[0, 0]]), InvalidValueError, "two columns for 'arm/a'"),
        (((kv.velocity("a"),), [0], [[0]], [[0]]), InvalidValueError, "a:velocity"),
        ((("a",), [0], [[0]], [[0]]), InvalidValueError, "'a'"),
    ],
)
def test_nonsense_is_refused(arguments: tuple[object, ...], error: type[Exception], what: str) -> None:
    with pytest.raises(error, match=what):
        Trajectory(*arguments)  # type: ignore[arg-type]


def test_wrong_times_and_rates_are_refused() -> None:
    t = make()
    for start, end in ((-1, 1), (1, 0.5), (0, 3), (np.nan, 1)):
        with pytest.raises(InvalidValueError):
            t.between(start, end)
    for rate in (0, -1, np.inf, "a"):
        with pytest.raises(InvalidValueError, match="rate"):
            t.sample(rate)  # type: ignore[arg-type]
    with pytest.raises(InvalidValueError):
        t.at(np.nan)
    with pytest.raises(InvalidValueError):
        t.positions_at([0.0, np.nan])


def test_a_jump_is_refused() -> None:
    t = make()
    with pytest.raises(InvalidValueError, match=r"position of 'arm/\w' would jump"):
        t.then(make(seed=1))
    moving = Trajectory((A, B), [0, 1], t.positions[[-1, -1]], [[1, 0], [0, 0]])
    with pytest.raises(InvalidValueError, match="velocity of 'arm/a' would jump"):
        t.then(moving)
    with pytest.raises(InvalidValueError, match="'arm/b' is in one of them"):
        t.then(Trajectory((A,), [0], [[0]], [[0]]))


@settings(max_examples=attempts(10))
@given(seeds)
def test_files_are_exact(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    path, t = tmp_path_factory.getbasetemp() / "t.json", make(4, seed)
    t.save(path)
    assert Trajectory.load(path) == t


def test_names_in_a_file_are_those_of_a_model(tmp_path: Path) -> None:
    model = kv.load("shelf_door")
    t = Trajectory((kv.position("shelf_door/door"),), [0, 1], [[0], [1]], [[0], [0]])
    t.save(tmp_path / "t.json")
    assert Trajectory.load(tmp_path / "t.json", model) == t
    make().save(tmp_path / "u.json")
    with pytest.raises(UnknownNameError, match="arm/a"):
        Trajectory.load(tmp_path / "u.json", model)


GOOD = {
    "format": "kineverse trajectory",
    "version": 1,
    "coordinates": ["a"],
    "times": [0, 1],
    "positions": [[0], [1]],
    "velocities": [[0], [0]],
}


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"format": "other"}, '"format": "kineverse trajectory"'),
        ({"version": 2}, "version 2"),
        ({"times": None}, "'times' is a list"),
        ({"times": [0, True]}, "True in 'times'"),
        ({"times": [0, "1"]}, "'1' in 'times'"),
        ({"times": [0, 10**400]}, "no number|too large"),
        ({"times": [0, -1]}, "increase"),
        ({"times": [0, float("nan")]}, "NaN is not a number"),
        ({"positions": [[0]]}, "2 rows"),
        ({"positions": [[0], [1, 2]]}, "row 1 of 'positions' has 2 numbers"),
        ({"coordinates": "a"}, "list of names"),
        ({"coordinates": ["a:velocity"]}, "derivative"),
        ({"coordinates": ["a//b"]}, "not the name of a coordinate"),
    ],
)
def test_files_that_are_no_trajectories_are_refused(
    tmp_path: Path, changes: dict[str, object], what: str
) -> None:
    path = tmp_path / "t.json"
    path.write_text(json.dumps(GOOD | changes))
    with pytest.raises(FormatError, match=what) as info:
        Trajectory.load(path)
    assert "t.json" in str(info.value)


@pytest.mark.parametrize(
    "text",
    ["", "[1, 2", "[1]", "[" * 100_000, "\ufeff{}", '{"format": "kineverse trajectory", "version": 1}'],
)
def test_other_texts_are_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "t.json"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(FormatError):
        Trajectory.load(path)
    with pytest.raises(FormatError):
        Trajectory.load(tmp_path / "none.json")
