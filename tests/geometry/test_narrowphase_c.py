"""Distances in C: bounded by their witnesses, equal to coal's, and to brute force in a scene."""

import itertools

import numpy as np
import pytest
from convex_shapes import EXACT, KINDS, Convex, gap, random_pose, random_shape
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scene_models import arm_among_boxes, brute_force, by_names, random_state
from scipy.spatial import ConvexHull

from hypothesis_profiles import attempts
from kineverse.geometry import Scene, broadphase
from kineverse.geometry.bindings import CollisionLibrary, collision_library
from kineverse.geometry.broadphase import ObjectTable
from kineverse.geometry.narrowphase import Narrowphase
from kineverse.geometry.shapes import _hull_solid, thicken_flat

pytestmark = pytest.mark.compiler

CORNERS = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
kinds = st.sampled_from(KINDS)
seeds = st.integers(0, 10**6)


@pytest.fixture(scope="module", autouse=True)
def library():
    assert collision_library.prepare(wait=True)
    return collision_library


def placed(shapes, poses):
    """Return a table of two objects at (3, 4) poses."""
    table = ObjectTable(2, np.arange(2, dtype=np.int32), 1 - np.eye(2, dtype=np.uint8))
    for k, shape in enumerate(shapes):
        solid = shape.solid
        table.set_solid(k, solid.centre, solid.half, solid.radius, solid.core)
    broadphase.place_objects(table, np.stack(poses))
    return table


def measured(table, limit=np.inf):
    distances, witnesses = collision_library.measure(table, np.array([[0, 1]], dtype=np.int32), limit)
    return float(distances[0]), witnesses[0].reshape(3, 3)


@settings(max_examples=attempts(200))
@given(kind=kinds, other=kinds, seed=seeds, spread=st.sampled_from([0.05, 0.3, 1.0, 30.0]))
def test_witness_points_and_normal_bound_the_distance(kind, other, seed, spread):
    """The points are of the bodies and so no nearer; the normal shows a gap, so that nothing is nearer.

    In each other, moving them by the depth along the normal separates them, and no other way is shorter.
    """
    rng = np.random.default_rng(seed)
    shapes = random_shape(kind, rng), random_shape(other, rng)
    poses = [random_pose(rng, spread) for _ in shapes]
    distance, (point_a, point_b, normal) = measured(placed(shapes, poses))
    slow = Narrowphase([shape.solid for shape in shapes], np.stack(poses)).distance(0, 1)
    exact = kind in EXACT and other in EXACT
    if np.isnan(distance):
        # Only what touches is left to coal, and one in thousands that are round and deep in each other.
        assert slow < 1e-4
        assert not exact or slow > -1e-4
        return
    # Depths of round bodies are certain to 1e-7 m here, and coal's iterations stop at 1e-6 m.
    deep = distance < 0.0 and not exact
    assert distance == pytest.approx(slow, abs=(4e-6 if deep else 2e-8 if exact else 1e-6) * (1 + spread))
    assert np.linalg.norm(normal) == pytest.approx(1.0, abs=1e-12)
    assert normal @ (point_b - point_a) == pytest.approx(distance, abs=1e-12 * (1 + spread))
    np.testing.assert_allclose(np.cross(normal, point_b - point_a), 0.0, atol=1e-12 * (1 + spread))
    a, b = shapes
    small = (2e-7 if deep else 2e-9 if exact else 2e-8) * (1 + spread)
    assert gap(a, b, np.stack(poses), normal) == pytest.approx(distance, abs=small)
    # Each point is on the plane that holds its body.
    assert a.support(normal, poses[0]) == pytest.approx(normal @ point_a, abs=small)


@settings(max_examples=attempts(100))
@given(kind=kinds, other=kinds, seed=seeds)
@example(kind="sphere", other="cylinder", seed=61795)
def test_distance_is_symmetric(kind, other, seed):
    rng = np.random.default_rng(seed)
    shapes = random_shape(kind, rng), random_shape(other, rng)
    poses = [random_pose(rng, 0.4) for _ in shapes]
    there, _ = measured(placed(shapes, poses))
    back, _ = measured(placed(shapes[::-1], poses[::-1]))
    assert np.isnan(there) == np.isnan(back)
    if not np.isnan(there):
        # Depths of round bodies are certain to 1e-7 m.
        deep = there < 0.0 and not (kind in EXACT and other in EXACT)
        assert there == pytest.approx(back, abs=2e-7 if deep else 2e-9)


@settings(max_examples=attempts(100))
@given(kind=kinds, other=kinds, seed=seeds, limit=st.sampled_from([0.0, 0.1, 0.5]))
def test_limit_changes_no_distance_within_it(kind, other, seed, limit):
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


def test_distances_of_parallel_faces_edges_and_contacts():
    rng = np.random.default_rng(1)
    box, other = random_shape("box", rng), random_shape("box", rng)
    upright = np.eye(4)[:3]
    for shift in (0.2, 1e-3, 2e-5, 5e-6, 1e-6, 3e-8, 0.0, -1e-7, -1e-3, -0.02):
        pose = upright.copy()
        pose[2, 3] = box.sizes[2] + other.sizes[2] + shift
        distance, (_, _, normal) = measured(placed((box, other), (upright, pose)))
        assert distance == pytest.approx(shift, abs=1e-9)
        np.testing.assert_allclose(normal, [0, 0, 1], atol=1e-4)


@settings(max_examples=attempts(100))
@given(kind=kinds, other=kinds, seed=seeds, turned=st.booleans(), apart=st.sampled_from([9e-6, 1e-6, 3e-7]))
def test_distances_of_solids_that_nearly_touch(kind, other, seed, turned, apart):
    """Moved together along the normal, two convex solids are as far apart as is left of their distance."""
    rng = np.random.default_rng(seed)
    shapes = random_shape(kind, rng), random_shape(other, rng)
    poses = [random_pose(rng, 0.6) for _ in shapes]
    if not turned:
        poses[1][:, :3] = poses[0][:, :3]  # parallel faces
    distance, (_, _, normal) = measured(placed(shapes, poses))
    if not distance > 1e-3:
        return
    poses[1][:, 3] -= (distance - apart) * normal
    found, (point_a, point_b, normal) = measured(placed(shapes, poses))
    if np.isnan(found):  # is left to coal
        assert not {kind, other} <= set(EXACT)
        assert apart < 1e-6
        return
    assert found == pytest.approx(apart, abs=1e-9)
    assert normal @ (point_b - point_a) == pytest.approx(found, abs=1e-12)
    assert gap(*shapes, np.stack(poses), normal) == pytest.approx(found, abs=1e-8)


@pytest.mark.parametrize("kind", ["box", "ellipsoid"])
def test_depth_of_concentric_solids(kind):
    """The origin is the centre of the difference, and all beginnings of the search are degenerate."""
    shape, upright = random_shape(kind, np.random.default_rng(3)), np.eye(4)[:3]
    distance, (point_a, point_b, normal) = measured(placed((shape, shape), (upright, upright)))
    assert distance == pytest.approx(-2 * shape.sizes.min(), abs=1e-7)
    assert normal @ (point_b - point_a) == pytest.approx(distance, abs=1e-9)


@settings(max_examples=attempts(100))
@given(
    seed=seeds,
    kinds=st.tuples(*[st.sampled_from(["box", "hull"])] * 2),
    spread=st.sampled_from([0.0, 0.05, 0.1]),
)
def test_depth_of_polytopes_matches_their_minkowski_difference(seed, kinds, spread):
    """The depth is how far the origin is from the nearest face of the hull of all differences of corners."""
    rng = np.random.default_rng(seed)
    shapes = [random_shape(kind, rng) for kind in kinds]
    poses = [random_pose(rng, spread) for _ in shapes]
    corners = [
        (shape.points if shape.kind == "hull" else CORNERS * shape.sizes) @ pose[:, :3].T + pose[:, 3]
        for shape, pose in zip(shapes, poses, strict=True)
    ]
    heights = -ConvexHull((corners[1][None] - corners[0][:, None]).reshape(-1, 3)).equations[:, 3]
    distance, _ = measured(placed(shapes, poses))
    if heights.min() > 1e-6:
        assert distance == pytest.approx(-heights.min(), abs=1e-8)
    else:
        assert not distance < -1e-6


@pytest.mark.parametrize("thickness", [1e-3, 1e-5, 1e-7])
@pytest.mark.parametrize("kind", KINDS)
def test_distances_of_a_flat_hull_are_bounded(kind, thickness):
    rng = np.random.default_rng(7)
    for _ in range(8):
        shape = random_shape(kind, rng)
        points = rng.normal(size=(9, 3)) * [0.3, 0.3, thickness]
        flat = Convex("hull", _hull_solid(points), shape.sizes, thicken_flat(points))
        poses = [random_pose(rng, 0.2), random_pose(rng, 0.2)]
        distance, (point_a, point_b, normal) = measured(placed((shape, flat), poses))
        assert gap(shape, flat, np.stack(poses), normal) == pytest.approx(distance, abs=1e-7)
        assert normal @ (point_b - point_a) == pytest.approx(distance, abs=1e-9)


def test_static_pairs_are_not_measured_again():
    """Neither is it another distance, where the memory of C gives way or is cleared."""
    model = arm_among_boxes()
    state = random_state(model, np.random.default_rng(0))
    scene, fresh = Scene(model), Scene(model)
    for s in (scene, fresh):
        s.update(state)
    found, memory = scene.pairs_within(0.3), scene.collision_world.table.memory
    assert (memory["pair"] > 0).sum() >= len(found) > 5
    memory["numbers"][:, 2] += 1.0
    np.testing.assert_allclose(
        scene.pairs_within(2.0).distances[: len(found)], found.distances + 1.0, atol=1.0
    )
    memory[:] = 0
    for again in (scene.pairs_within(0.3), fresh.pairs_within(0.3)):
        np.testing.assert_array_equal(again.distances, found.distances)
        np.testing.assert_array_equal(again.normals, found.normals)
    moved = state.updated({symbol: value + 0.01 for symbol, value in state.items()})
    for s in (scene, Scene(model)):
        s.update(moved)
        s.update(state)
        np.testing.assert_array_equal(s.pairs_within(0.3).distances, found.distances)


@settings(max_examples=attempts(12))
@given(seed=seeds, radius=st.sampled_from([0.0, 0.1, 0.4]))
def test_scene_agrees_with_c_with_coal_and_with_brute_force(seed, radius):
    model, rng = arm_among_boxes(seed=seed % 7), np.random.default_rng(seed)
    quick, slow = Scene(model), Scene(model)
    state = random_state(model, rng)
    for _ in range(3):
        state = state.updated({s: v + float(rng.normal(scale=0.01)) for s, v in state.items()})
        quick.update(state)
        slow.update(state)
        found = quick.pairs_within(radius)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(collision_library, "_code", None)
            other = slow.pairs_within(radius)
        expected = {frozenset(k): d for k, d in brute_force(quick, state).items() if d <= radius}
        for answer in (found, other):
            distances = by_names(answer)
            missing = {k: d for k, d in expected.items() if k not in distances}
            assert all(d > radius - 1e-6 for d in missing.values())
            assert all(expected.get(k, radius) == pytest.approx(d, abs=1e-6) for k, d in distances.items())
            assert list(answer.distances) == sorted(answer.distances)


@settings(max_examples=attempts(60))
@given(seed=seeds, count=st.integers(0, 40), radius=st.sampled_from([0.0, 0.5, np.inf]))
def test_rank_pairs_agrees_in_numpy_and_c(seed, count, radius):
    rng = np.random.default_rng(seed)
    body = rng.integers(5, size=12).astype(np.int32)
    table = ObjectTable(6, body, np.ones((5, 5), dtype=np.uint8))
    pairs = np.sort(rng.integers(12, size=(count, 2)).astype(np.int32), axis=1)
    pairs = np.unique(pairs, axis=0)[rng.permutation(len(np.unique(pairs, axis=0)))] if count else pairs
    pairs = np.ascontiguousarray(pairs)
    distances = rng.choice([-0.1, 0.0, 0.3, 0.4, 0.7, np.inf], size=len(pairs))
    order = broadphase.rank_pairs(table, pairs, distances, radius)
    np.testing.assert_array_equal(order, collision_library.rank(table, pairs, distances, radius))
    assert (distances[order] <= radius).all()
    owners = [frozenset(pair) for pair in body[pairs[order]].tolist()]
    assert len(set(owners)) == len(owners)
    assert distances[order].tolist() == sorted(distances[order].tolist())


def test_measure_without_a_compiler_leaves_all_pairs_to_coal():
    library, rng = CollisionLibrary(), np.random.default_rng(0)
    table = placed([random_shape("box", rng)] * 2, [random_pose(rng, 1.0) for _ in range(2)])
    distances, _ = library.measure(table, np.array([[0, 1]], dtype=np.int32), 1.0)
    assert np.isnan(distances).all()


@pytest.fixture(scope="module")
def narrower():
    """Return the same C for a processor that takes two corners at a time."""
    library = CollisionLibrary()
    library.flags = (*library.flags, "-U__AVX512F__", "-U__AVX2__")
    assert library.prepare(wait=True)
    return library


@settings(max_examples=attempts(15))
@given(counts=st.tuples(*[st.integers(8, 90)] * 2), seed=seeds, spread=st.sampled_from([0.0, 0.3, 2.0]))
def test_support_of_many_corners_is_independent_of_the_vector_width(narrower, counts, seed, spread):
    """Each corner is the furthest one in its direction: a ball of them leaves none out of what is measured."""
    rng, solids = np.random.default_rng(seed), []
    for count in counts:
        points = rng.normal(size=(count, 3))
        solids.append(_hull_solid(np.round(points / np.linalg.norm(points, axis=1)[:, None], 1 + seed % 8)))
    poses = np.stack([random_pose(rng, spread) for _ in solids])
    pair, found = np.array([[0, 1]], dtype=np.int32), []
    for library in (collision_library, narrower):
        table = ObjectTable(2, np.arange(2, dtype=np.int32), 1 - np.eye(2, dtype=np.uint8))
        for k, solid in enumerate(solids):
            table.set_solid(k, solid.centre, solid.half, solid.radius, solid.core)
        broadphase.place_objects(table, poses)
        found.append(library.measure(table, pair, np.inf))
    (distance, witness), (same, same_witness) = found
    slow = Narrowphase(solids, poses).distance(0, 1)
    assert distance == pytest.approx(slow, abs=1e-8) or (np.isnan(distance) and abs(slow) < 1e-4)
    np.testing.assert_array_equal(distance, same)
    np.testing.assert_array_equal(witness, same_witness)
