"""Distances in C: certain by themselves, equal to coal's, and the same as the slow way in a scene."""

from __future__ import annotations

import numpy as np
import pytest
from convex_shapes import EXACT, KINDS, gap, random_pose, random_shape
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import arm_among_boxes, brute_force, by_names, random_state

from attempts import attempts
from kineverse.geometry import Scene, sweep
from kineverse.geometry.narrow import Narrow
from kineverse.geometry.sweep_native import SweepLibrary, sweep_library
from kineverse.geometry.table import Table

pytestmark = pytest.mark.compiler

CORED = [kind for kind in KINDS if kind != "cone"]
kinds = st.sampled_from(CORED)
seeds = st.integers(0, 10**6)


@pytest.fixture(scope="module", autouse=True)
def library():
    assert sweep_library.prepare(wait=True)
    return sweep_library


def placed(shapes, poses):
    """Return the table of two pieces that stand at (3, 4) poses."""
    table = Table(2, np.arange(2, dtype=np.int32), 1 - np.eye(2, dtype=np.uint8))
    for k, shape in enumerate(shapes):
        solid = shape.solid
        table.give_solid(k, solid.centre, solid.half, solid.radius, solid.core)
    sweep.place(table, np.stack(poses))
    return table


def measured(table, limit=np.inf):
    distances, witnesses = sweep_library.measure(table, np.array([[0, 1]], dtype=np.int32), limit)
    return float(distances[0]), witnesses[0].reshape(3, 3)


@settings(max_examples=attempts(200))
@given(kind=kinds, other=kinds, seed=seeds, spread=st.sampled_from([0.05, 0.3, 1.0, 30.0]))
def test_a_distance_is_certain(kind, other, seed, spread):
    """The points are of the bodies and so no nearer; the normal shows a gap, so that nothing is nearer."""
    rng = np.random.default_rng(seed)
    shapes = random_shape(kind, rng), random_shape(other, rng)
    poses = [random_pose(rng, spread) for _ in shapes]
    distance, (point_a, point_b, normal) = measured(placed(shapes, poses))
    slow = Narrow([shape.solid for shape in shapes], np.stack(poses)).distance(0, 1)
    if np.isnan(distance):
        assert slow < 1e-4  # only what touches is left to coal
        return
    exact = kind in EXACT and other in EXACT
    assert distance == pytest.approx(slow, abs=(2e-8 if exact else 1e-6) * (1 + spread))
    assert np.linalg.norm(normal) == pytest.approx(1.0, abs=1e-12)
    assert normal @ (point_b - point_a) == pytest.approx(distance, abs=1e-12 * (1 + spread))
    np.testing.assert_allclose(np.cross(normal, point_b - point_a), 0.0, atol=1e-12 * (1 + spread))
    a, b = shapes
    small = (2e-9 if exact else 2e-8) * (1 + spread)
    assert gap(a, b, np.stack(poses), normal) == pytest.approx(distance, abs=small)
    # Each point is on the plane that holds its body.
    assert a.support(normal, poses[0]) == pytest.approx(normal @ point_a, abs=small)


@settings(max_examples=attempts(100))
@given(kind=kinds, other=kinds, seed=seeds)
def test_the_other_way_round_it_is_the_same(kind, other, seed):
    rng = np.random.default_rng(seed)
    shapes = random_shape(kind, rng), random_shape(other, rng)
    poses = [random_pose(rng, 0.4) for _ in shapes]
    there, _ = measured(placed(shapes, poses))
    back, _ = measured(placed(shapes[::-1], poses[::-1]))
    assert np.isnan(there) == np.isnan(back)
    if not np.isnan(there):
        assert there == pytest.approx(back, abs=2e-9)


@settings(max_examples=attempts(100))
@given(kind=kinds, other=kinds, seed=seeds, limit=st.sampled_from([0.0, 0.1, 0.5]))
def test_a_limit_changes_no_distance_within_it(kind, other, seed, limit):
    rng = np.random.default_rng(seed)
    shapes = random_shape(kind, rng), random_shape(other, rng)
    poses = [random_pose(rng, 0.4) for _ in shapes]
    distance, witness = measured(placed(shapes, poses))
    table = placed(shapes, poses)
    limited, same = measured(table, limit)
    if distance <= limit:
        assert limited == distance
        np.testing.assert_array_equal(same, witness)
    elif not np.isnan(distance):
        assert limited > limit
        # What is kept is a bound, and a good one.
        low = table.bounds[0, 1] - table.travel.sum()
        assert limit + (distance - limit) / 2 - 1e-9 <= low <= distance + 1e-9


@pytest.mark.parametrize("kind", KINDS)
def test_only_cones_are_left_to_coal_where_nothing_touches(kind):
    rng = np.random.default_rng(0)
    for other in CORED:
        shapes = random_shape(kind, rng), random_shape(other, rng)
        poses = [random_pose(rng, 0.05), random_pose(rng, 0.05)]
        poses[1][0, 3] += 2.0
        assert np.isnan(measured(placed(shapes, poses))[0]) == (kind == "cone")


def test_parallel_faces_edges_and_what_touches():
    rng = np.random.default_rng(1)
    box, other = random_shape("box", rng), random_shape("box", rng)
    upright = np.eye(4)[:3]
    for shift in (0.2, 1e-3, 2e-5):
        pose = upright.copy()
        pose[2, 3] = box.sizes[2] + other.sizes[2] + shift
        distance, (_, _, normal) = measured(placed((box, other), (upright, pose)))
        assert distance == pytest.approx(shift, abs=1e-9)
        np.testing.assert_allclose(normal, [0, 0, 1], atol=1e-4)
    pose[2, 3] -= shift
    assert np.isnan(measured(placed((box, other), (upright, pose)))[0])
    assert np.isnan(measured(placed((box, other), (upright, upright)))[0])


@settings(max_examples=attempts(12))
@given(seed=seeds, radius=st.sampled_from([0.0, 0.1, 0.4]))
def test_a_scene_finds_the_same_with_c_and_without_and_by_brute_force(seed, radius):
    model, rng = arm_among_boxes(seed=seed % 7), np.random.default_rng(seed)
    quick, slow = Scene(model), Scene(model)
    state = random_state(model, rng)
    for _ in range(3):
        state = state.updated({s: v + float(rng.normal(scale=0.01)) for s, v in state.items()})
        quick.update(state)
        slow.update(state)
        found = quick.within(radius)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(sweep_library, "_code", None)
            other = slow.within(radius)
        expected = {frozenset(k): d for k, d in brute_force(quick, state).items() if d <= radius}
        for answer in (found, other):
            distances = by_names(answer)
            missing = {k: d for k, d in expected.items() if k not in distances}
            assert all(d > radius - 1e-6 for d in missing.values())
            assert all(expected.get(k, radius) == pytest.approx(d, abs=1e-6) for k, d in distances.items())
            assert list(answer.distances) == sorted(answer.distances)


@settings(max_examples=attempts(60))
@given(seed=seeds, count=st.integers(0, 40), radius=st.sampled_from([0.0, 0.5, np.inf]))
def test_ranks_in_numpy_and_c_agree(seed, count, radius):
    rng = np.random.default_rng(seed)
    body = rng.integers(5, size=12).astype(np.int32)
    table = Table(6, body, np.ones((5, 5), dtype=np.uint8))
    pairs = np.sort(rng.integers(12, size=(count, 2)).astype(np.int32), axis=1)
    pairs = np.unique(pairs, axis=0)[rng.permutation(len(np.unique(pairs, axis=0)))] if count else pairs
    pairs = np.ascontiguousarray(pairs)
    distances = rng.choice([-0.1, 0.0, 0.3, 0.4, 0.7, np.inf], size=len(pairs))
    order = sweep.rank(table, pairs, distances, radius)
    np.testing.assert_array_equal(order, sweep_library.rank(table, pairs, distances, radius))
    assert (distances[order] <= radius).all()
    owners = [frozenset(pair) for pair in body[pairs[order]].tolist()]
    assert len(set(owners)) == len(owners)
    assert distances[order].tolist() == sorted(distances[order].tolist())


def test_without_a_compiler_coal_measures_everything():
    library = SweepLibrary()
    rng = np.random.default_rng(0)
    table = placed([random_shape("box", rng)] * 2, [random_pose(rng, 1.0) for _ in range(2)])
    distances, _ = library.measure(table, np.array([[0, 1]], dtype=np.int32), 1.0)
    assert np.isnan(distances).all()
