"""Rounded corners: how far they deviate, where they join, and how they give way to what is not valid."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kineverse.errors import InvalidValueError, ShapeError
from kineverse.lie import Array
from kineverse.planning import round_corners

seeds = st.integers(0, 2**32 - 1)


def polyline(seed: int, count: int = 6, n: int = 3) -> Array:
    return np.random.default_rng(seed).normal(size=(count, n))


def distance_to_polyline(q: Array, points: Array) -> Array:
    distances = []
    for a, b in pairwise(points):
        u = np.clip(((q - a) @ (b - a)) / ((b - a) @ (b - a)), 0, 1)
        distances.append(np.linalg.norm(q - a - u[:, None] * (b - a), axis=1))
    return np.min(distances, axis=0)


@given(seeds, st.floats(1e-6, 2))
def test_blends_stay_within_the_deviation_and_do_not_overlap(seed: int, deviation: float) -> None:
    points = polyline(seed)
    path = round_corners(points, deviation)
    assert (path.deviation <= deviation * (1 + 1e-12)).all()
    reach = np.concatenate(([0], path.reach, [0]))
    assert (reach[:-1] + reach[1:] <= path.lengths * (1 + 1e-12)).all()
    for k in range(len(path.reach)):
        curve = path.blend(k, 21)
        assert distance_to_polyline(curve, points).max() <= path.deviation[k] * (1 + 1e-9)
        assert np.linalg.norm(curve[10] - points[k + 1]) == pytest.approx(path.deviation[k])
        on_segment = points[k + 1] - path.reach[k] * path.directions[k]
        np.testing.assert_allclose(curve[0], on_segment, atol=1e-12)


def test_each_corner_has_a_deviation_of_its_own() -> None:
    path = round_corners([[0, 0], [1, 0], [1, 1], [2, 1]], [9, 0.01, 0.0, 9])
    np.testing.assert_allclose(path.deviation, [0.01, 0.0])
    assert path.turns.all()


def test_equal_points_count_once_and_straight_ones_are_no_corners() -> None:
    path = round_corners([[0, 0], [0, 0], [1, 0], [1, 0], [2, 0], [2, 0]], 0.1)
    np.testing.assert_array_equal(path.points, [[0, 0], [1, 0], [2, 0]])
    assert not path.turns.any()
    assert not path.reach.any()
    assert len(round_corners([[1.0, 2.0]] * 3).points) == 1


def test_points_that_count_once_or_lie_on_a_line_keep_their_deviation() -> None:
    corner, same = [1, 0], [1 + 1e-13, 0]
    for points, deviation in (
        ([[0, 0], corner, same, [1, 1], [2, 1]], [0, 0.2, 0.0, 0.2, 0]),
        ([[0, 0], [0.9, 0], corner, [1, 1], [2, 1]], [0, 0.0, 0.2, 0.2, 0]),
    ):
        path = round_corners(points, deviation)
        away = np.linalg.norm(path.points - points[deviation.index(0.0, 1)], axis=1)
        assert away.min() < 1e-9
        assert path.reach[away.argmin() - 1] == 0
    # A deviation beside the end is no reason to stop before it.
    path = round_corners([[0, 0], corner, [1, 1], [1, 1 + 1e-13], [1, 1]], [0, 0.2, 0, 0, 0])
    np.testing.assert_allclose(path.deviation, [0.2])


def test_blends_are_halved_until_they_are_valid() -> None:
    points = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    asked: list[int] = []

    def valid(q: Array) -> np.ndarray:
        asked.append(len(q))
        return np.linalg.norm(q - points[1], axis=1) >= 0  # everything

    free = round_corners(points, 0.2, valid)
    np.testing.assert_array_equal(free.reach, round_corners(points, 0.2).reach)
    assert len(asked) == 1

    tight = round_corners(points, 0.2, lambda q: (q[:, 0] - q[:, 1] > 0.95) | (q[:, 1] > 0.3))
    assert 0 < tight.reach[0] < free.reach[0]
    assert tight.reach[1] == free.reach[1]
    assert (tight.blend(0, 500) @ [1, -1] > 0.9).all()

    none = round_corners(points, 0.2, lambda q: q[:, 1] > 0.3)
    assert none.reach[0] == 0
    assert none.turns[0]


@pytest.mark.parametrize(
    ("points", "deviation", "error"),
    [
        ([], 0, ShapeError),
        ([1, 2], 0, ShapeError),
        ([[0, np.nan]], 0, InvalidValueError),
        ([[0], [1]], -1, InvalidValueError),
        ([[0], [1]], np.nan, InvalidValueError),
        ([[0], [1]], [0.1], ShapeError),
    ],
)
def test_nonsense_is_refused(points: object, deviation: object, error: type[Exception]) -> None:
    with pytest.raises(error):
        round_corners(points, deviation)  # type: ignore[arg-type]


def test_a_function_with_too_few_flags_is_refused() -> None:
    with pytest.raises(ShapeError, match="a flag for each"):
        round_corners([[0, 0], [1, 0], [1, 1]], 0.1, lambda q: np.ones(1, dtype=bool))
