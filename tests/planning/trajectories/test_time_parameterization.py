"""Time along a path: limits hold, ends are exact and at rest, and it is not possible faster."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

import kineverse as kv
from hypothesis_profiles import attempts
from kineverse.errors import InvalidValueError, ShapeError
from kineverse.lie import Array
from kineverse.planning import BlendedPath, Trajectory, round_corners, time_parameterize

seeds = st.integers(0, 2**32 - 1)


def names(n: int) -> tuple[kv.Symbol, ...]:
    return tuple(kv.position(f"q{k}") for k in range(n))


def case(seed: int, count: int, n: int) -> tuple[Array, Array, Array]:
    rng = np.random.default_rng(seed)
    return rng.normal(size=(count, n)), rng.uniform(0.3, 2, n), rng.uniform(0.5, 8, n)


def accelerations(t: Trajectory) -> tuple[Array, Array]:
    """Return the accelerations at the beginnings and ends of the cubics between knots."""
    dt = np.diff(t.times)[:, None]
    mean, v, w = np.diff(t.positions, axis=0) / dt, t.velocities[:-1], t.velocities[1:]
    return (6 * mean - 4 * v - 2 * w) / dt, (2 * v + 4 * w - 6 * mean) / dt


def check_limits(t: Trajectory, velocity: Array, acceleration: Array, tolerance: float = 1e-6) -> None:
    dense = np.linspace(0, t.duration, 5001)
    assert (np.abs(t.velocities_at(dense)) <= velocity * (1 + tolerance)).all()
    step = np.diff(t.positions_at(dense), axis=0) / dense[1]
    assert (np.abs(step) <= velocity * (1 + tolerance) + 1e-9).all()
    bend = np.diff(step, axis=0) / dense[1]
    # A difference of positions has an error of some 1e-15, divided by the square of the step.
    rounding = 1e-14 / dense[1] ** 2
    assert (np.abs(bend) <= acceleration * (1 + tolerance) + rounding).all()


@settings(max_examples=attempts(60))
@given(seeds, st.integers(2, 9), st.integers(1, 9), st.sampled_from([0.0, 1e-3, 0.05, 10.0]))
@example(1, 3, 30, 0.05)
@example(2, 30, 1, 0.05)
def test_limits_hold_and_ends_are_exact_and_at_rest(seed: int, count: int, n: int, deviation: float) -> None:
    points, velocity, acceleration = case(seed, count, n)
    t = time_parameterize(points, velocity, acceleration, names(n), deviation=deviation)
    check_limits(t, velocity, acceleration)
    np.testing.assert_array_equal(t.positions[[0, -1]], points[[0, -1]])
    assert not t.velocities[[0, -1]].any()
    assert (np.diff(t.times) > 0).all()


@given(seeds, st.integers(1, 8), st.floats(1e-4, 100))
def test_on_a_line_the_profile_is_the_trapezoid(seed: int, n: int, length: float) -> None:
    _, velocity, acceleration = case(seed, 2, n)
    direction = np.random.default_rng(seed + 1).normal(size=n)
    direction /= np.linalg.norm(direction)
    v, a = (velocity / np.abs(direction)).min(), (acceleration / np.abs(direction)).min()
    expected = 2 * np.sqrt(length / a) if length < v**2 / a else length / v + v / a
    t = time_parameterize([0 * direction, length * direction], velocity, acceleration, names(n))
    assert t.duration == pytest.approx(expected, rel=1e-12)
    assert len(t) in (3, 4)
    middle = time_parameterize(
        np.outer([0, 0.3, 0.31, 1], length * direction), velocity, acceleration, names(n)
    )
    assert middle.duration == pytest.approx(expected, rel=1e-6)  # points on a line are no corners


def test_where_a_blend_may_not_deviate_the_motion_stops() -> None:
    t = time_parameterize([[0, 0], [1, 0], [1, 1]], 1.0, 2.0, names(2))
    assert t.duration == pytest.approx(3.0)
    np.testing.assert_allclose(t.positions_at(1.5), [1, 0], atol=1e-12)
    np.testing.assert_allclose(t.velocities_at(1.5), 0, atol=1e-12)
    assert time_parameterize([[0, 0], [1, 0], [1, 1]], 1.0, 2.0, names(2), deviation=0.02).duration < 2.8


@settings(max_examples=attempts(30))
@given(seeds, st.floats(0.1, 10))
def test_scaled_limits_scale_the_time(seed: int, factor: float) -> None:
    points, velocity, acceleration = case(seed, 5, 3)
    one = time_parameterize(points, velocity, acceleration, names(3), deviation=0.1)
    other = time_parameterize(points, factor * velocity, factor**2 * acceleration, names(3), deviation=0.1)
    assert other.duration * factor == pytest.approx(one.duration, rel=1e-9)
    u = np.linspace(0, 1, 20)
    np.testing.assert_allclose(
        other.positions_at(u * other.duration), one.positions_at(u * one.duration), atol=1e-6
    )


@settings(max_examples=attempts(30))
@given(seeds)
def test_backwards_takes_as_long(seed: int) -> None:
    points, velocity, acceleration = case(seed, 5, 4)
    one = time_parameterize(points, velocity, acceleration, names(4), deviation=0.1)
    other = time_parameterize(points[::-1], velocity, acceleration, names(4), deviation=0.1)
    # A difference comes from the cubics between the knots alone.
    assert other.duration == pytest.approx(one.duration, rel=1e-2)


def fastest(path: BlendedPath, velocity: Array, acceleration: Array, steps: int) -> float:
    """Return the duration of the fastest motion, by linear programs on an even grid (Pham & Pham 2018)."""
    ends, parts = np.concatenate(([0.0], path.reach, [0.0])), []
    for k, length in enumerate(path.lengths):
        parts.append((length - ends[k] - ends[k + 1], path.directions[k], 0 * path.directions[k]))
        if k < len(path.reach):
            change = path.directions[k + 1] - path.directions[k]
            parts.append((2 * path.reach[k], path.directions[k], change / (2 * path.reach[k])))
    cells = []
    for length, direction, bend in parts:
        if length < 1e-9:
            continue
        h = length / steps
        cells += [(h, direction + bend * h * i, direction + bend * h * (i + 1), bend) for i in range(steps)]

    def rows(cell: tuple[float, Array, Array, Array]) -> tuple[Array, Array]:
        h, first, last, bend = cell
        p = np.concatenate([bend - first / (2 * h), -last / (2 * h)])
        A = np.stack([p, np.concatenate([first / (2 * h), bend + last / (2 * h)])], axis=1)
        return np.concatenate([A, -A]), np.tile(acceleration, 4)

    x = np.zeros(len(cells) + 1)
    for i in range(len(cells) - 1, 0, -1):
        cap = ((velocity / np.abs(cells[i][1])) ** 2).min()
        found = linprog([-1, 0], *rows(cells[i]), bounds=[(0, cap), (0, x[i + 1])])
        x[i] = found.x[0]
    for i, cell in enumerate(cells):
        found = linprog([0, -1], *rows(cell), bounds=[(x[i], x[i]), (0, x[i + 1])])
        x[i + 1] = found.x[1]
    roots = np.sqrt(x)
    return float(sum(2 * c[0] / (a + b) for c, a, b in zip(cells, roots, roots[1:], strict=False)))


@pytest.mark.parametrize("seed", [0, pytest.param(2, marks=pytest.mark.long)])
def test_it_is_not_possible_faster(seed: int) -> None:
    points, velocity, acceleration = case(seed, 4, 3)
    path = round_corners(points, 0.3)
    best = fastest(path, velocity, acceleration, 40)
    few = time_parameterize(path, velocity, acceleration, names(3))
    many = time_parameterize(path, velocity, acceleration, names(3), cells=1000)
    assert many.duration == pytest.approx(best, rel=1e-2)
    assert many.duration <= few.duration <= 1.05 * many.duration


def test_coordinates_that_do_not_move_need_no_limits() -> None:
    t = time_parameterize([[0, 3], [1, 3]], [1, 0], [2, 0], names(2))
    assert t.duration == pytest.approx(1.5)
    np.testing.assert_array_equal(t.positions[:, 1], 3)
    np.testing.assert_array_equal(t.velocities[:, 1], 0)


def test_paths_without_length_take_no_time() -> None:
    for points in ([[1, 2]], [[1, 2], [1, 2], [1, 2]]):
        t = time_parameterize(points, 1, 1, names(2), deviation=0.1)
        assert t.duration == 0
        assert t.at(0)["q1"] == 2


def test_repeated_points_change_nothing() -> None:
    points, velocity, acceleration = case(0, 4, 3)
    once = time_parameterize(points, velocity, acceleration, names(3), deviation=0.1)
    assert (
        time_parameterize(np.repeat(points, 3, axis=0), velocity, acceleration, names(3), deviation=0.1)
        == once
    )


def test_speeds_may_be_unlimited() -> None:
    assert time_parameterize([[0.0], [8.0]], np.inf, 2.0, names(1)).duration == pytest.approx(4.0)


def test_a_turn_of_one_coordinate_is_followed() -> None:
    assert time_parameterize([[0.0], [1.0], [0.0]], 1.0, 2.0, names(1)).duration == pytest.approx(3.0)
    rounded = time_parameterize([[0.0], [1.0], [0.0]], 1.0, 2.0, names(1), deviation=0.1)
    assert rounded.positions.max() == pytest.approx(0.9, abs=1e-3)
    check_limits(rounded, np.ones(1), 2 * np.ones(1))


@settings(max_examples=attempts(30))
@given(seeds, st.floats(-12, 3))
def test_lengths_of_all_magnitudes(seed: int, exponent: float) -> None:
    points, velocity, acceleration = case(seed, 5, 3)
    points[2:] = points[1] + 10**exponent * points[2:]
    t = time_parameterize(points, velocity, acceleration, names(3), deviation=0.1)
    check_limits(t, velocity, acceleration, 1e-4)


@settings(max_examples=attempts(40))
@given(seeds, st.sampled_from([0.0, 1e-9, 1e-4, 0.1, np.inf]))
def test_limits_and_ranges_of_all_magnitudes(seed: int, deviation: float) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(6, 3)) * 10 ** rng.uniform(-5, 2, 3)
    points[2] = points[0]
    velocity, acceleration = 10 ** rng.uniform(-3, 3, (2, 3))
    t = time_parameterize(points, velocity, acceleration, names(3), deviation=deviation)
    assert (np.abs(t.velocities_at(np.linspace(0, t.duration, 2000))) <= velocity * (1 + 1e-6)).all()
    dt = np.diff(t.times)[:, None]
    change = np.abs(np.diff(t.velocities, axis=0)) / dt
    # Velocities have a relative error of some 1e-15, and times one relative to the last of them.
    tolerance = 1e-6 + 1e-14 * t.duration / dt
    rounding = 1e-14 * np.abs(t.velocities).max() / dt
    assert (change <= acceleration * (1 + tolerance) + rounding).all()


@pytest.mark.parametrize(
    ("velocity", "acceleration", "error", "what"),
    [
        ([1, 0], 1, InvalidValueError, "speed limit of 'q1', which moves, is positive, not 0"),
        (1, np.inf, InvalidValueError, "acceleration limit of 'q0', which moves, is positive and finite"),
        (1, [1, -1], InvalidValueError, "'q1'"),
        (np.nan, 1, InvalidValueError, "'q0'"),
        ([1, 1, 1], 1, ShapeError, "a number or 2 numbers"),
    ],
)
def test_limits_that_are_none_are_refused(
    velocity: object, acceleration: object, error: type[Exception], what: str
) -> None:
    with pytest.raises(error, match=what):
        time_parameterize([[0, 0], [1, 1]], velocity, acceleration, names(2))  # type: ignore[arg-type]
    with pytest.raises(ShapeError, match="2 columns"):
        time_parameterize([[0, 0], [1, 1]], 1, 1, names(3))


@settings(max_examples=attempts(25), deadline=None)
@given(seed=seeds, blended=st.booleans())
@example(seed=0, blended=False)
def test_points_within_rounding_of_others_or_of_a_segment_do_not_change_the_duration(
    seed: int, blended: bool
) -> None:
    rng = np.random.default_rng(seed)
    scale, n = 10.0 ** rng.integers(-3, 4), int(rng.integers(1, 5))
    points = (
        rng.normal(size=(int(rng.integers(2, 6)), n)) + rng.normal(size=n) * 10.0 ** rng.integers(0, 3)
    ) * scale
    limits = rng.uniform(0.3, 2, n) * scale, rng.uniform(0.5, 8, n) * scale
    rounding = np.abs(points).max() * 10.0 ** rng.uniform(-16, -12.5)
    more = [points[0]]
    for before, after in itertools.pairwise(points):
        fraction = rng.choice([rng.uniform(), 10.0 ** rng.uniform(-13, -2)])
        more += [before, before + rounding * rng.normal(size=n), before + fraction * (after - before), after]
    durations = [
        time_parameterize(p, *limits, names(n), deviation=0.05 * scale * blended).duration
        for p in (points, more)
    ]
    assert durations[1] == pytest.approx(durations[0], rel=1e-8)


def test_waypoints_that_differ_by_rounding_do_not_stop_the_motion() -> None:
    # 1 unit in each direction at a speed of 1, without ramps worth mentioning.
    path = [[0.0], [1.0], [1.0 + 1e-13], [2.0]]
    assert time_parameterize(path, 1.0, 1e3, names(1)).duration == pytest.approx(2.001, abs=1e-6)
