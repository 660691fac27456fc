"""Sequences of distance results, whose entries are made on access."""

import numpy as np
import pytest
from scene_models import arm_among_boxes, random_state

from kineverse.geometry import DistanceResult, DistanceResults, Scene


@pytest.fixture(scope="module")
def scene():
    model = arm_among_boxes()
    scene = Scene(model)
    scene.update(random_state(model, np.random.default_rng(0)))
    return scene


def test_distance_results_are_a_sequence(scene):
    found = scene.pairs_within(0.5)
    assert isinstance(found, DistanceResults)
    assert len(found) == len(list(found)) > 5
    assert all(isinstance(pair, DistanceResult) for pair in found[1:4])
    assert found[-1].distance == found.distances[-1]
    with pytest.raises(IndexError):
        found[len(found)]
    assert not scene.pairs_within(0.0)[:0]


def test_arrays_of_distance_results_match_the_entries(scene):
    found = scene.pairs_within(0.5)
    order = {name: k for k, name in enumerate(scene.bodies)}
    for k, pair in enumerate(found):
        assert order[pair.a] < order[pair.b]
        assert pair.distance == found.distances[k]
        np.testing.assert_array_equal(pair.normal, found.normals[k])
        assert pair.normal @ (found.points_b[k] - found.points_a[k]) == pytest.approx(pair.distance, abs=1e-7)
        alone = scene.distance(pair.a, pair.b)
        assert alone.distance == pair.distance
        np.testing.assert_array_equal(alone.point_a, pair.point_a)


def test_distance_results_stay_valid_after_an_update(scene):
    found = scene.pairs_within(0.5)
    before = found.distances.copy(), found.normals.copy(), [str(pair) for pair in found]
    scene.update(random_state(scene.model, np.random.default_rng(1)))
    scene.pairs_within(0.5)
    np.testing.assert_array_equal(found.distances, before[0])
    np.testing.assert_array_equal(found.normals, before[1])
    assert [str(pair) for pair in found] == before[2]


def test_repr_of_distance_results_lists_the_nearest(scene):
    found = scene.pairs_within(0.5)
    text = repr(found).splitlines()
    assert text[0] == f"<{len(found)} pairs"
    assert text[1].strip() == str(found[0])
    assert len(text) <= 14
