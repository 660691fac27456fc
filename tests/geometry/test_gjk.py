"""Support functions and the search for the widest gap, against closed forms."""

import itertools

import numpy as np
import pytest
from convex_shapes import KINDS, gap, random_pose, random_shape

from kineverse.geometry.gjk import directional_gaps, find_widest_gap, smoothed_support
from kineverse.geometry.narrowphase import Narrowphase

PAIRS = list(itertools.combinations_with_replacement(KINDS, 2))


def two(one, other, seed, spread):
    rng = np.random.default_rng([seed, KINDS.index(one), KINDS.index(other)])
    shapes = random_shape(one, rng), random_shape(other, rng)
    poses = np.stack([random_pose(rng, spread), random_pose(rng, spread)])
    ways = rng.normal(size=(20, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    return shapes, poses, ways


def placed(shapes, poses):
    return [(shape.solid, pose[:, :3], pose[:, 3]) for shape, pose in zip(shapes, poses, strict=True)]


@pytest.mark.parametrize(("one", "other"), PAIRS)
def test_directional_gaps_match_the_support_functions(one, other):
    shapes, poses, ways = two(one, other, 0, 0.3)
    found = directional_gaps(*placed(shapes, poses), ways)
    np.testing.assert_allclose(found, gap(*shapes, poses, ways), rtol=0, atol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_support_point_lies_on_the_solid_and_on_the_support_plane(kind):
    (shape, _), poses, ways = two(kind, "box", 1, 0.3)
    solid = placed([shape], poses[:1])[0]
    ways = np.concatenate([ways, poses[0, :, :3].T, -poses[0, :, :3].T])  # along the axes there are faces
    for way in ways:
        point = smoothed_support(solid, way)
        assert way @ point == pytest.approx(shape.support(way, poses[0]), abs=1e-12)
        assert (ways @ point <= shape.support(ways, poses[0]) + 1e-6).all()


@pytest.mark.sampled(2)
@pytest.mark.parametrize(("one", "other"), PAIRS)
def test_widest_gap_equals_the_distance(one, other):
    """In each other there may be several summits, of which the highest may be missed."""
    for seed, spread in itertools.product(range(3), (0.05, 0.5)):
        shapes, poses, ways = two(one, other, seed, spread)
        found, normal = find_widest_gap(*placed(shapes, poses), ways[:1])
        distance = Narrowphase([shape.solid for shape in shapes], poses).distance(0, 1)
        assert gap(*shapes, poses, normal) == pytest.approx(found, abs=1e-12)
        assert distance - (1e-5 if distance > 0 else 5e-3) < found < distance + 5e-6
