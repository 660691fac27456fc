"""Distances against Bullet, which keeps a margin of a millimetre around or inside most of its shapes."""

import itertools

import numpy as np
import pytest
from convex_shapes import random_pose, random_shape
from scipy.spatial.transform import Rotation

from kineverse.geometry.narrowphase import Narrowphase

bullet = pytest.importorskip("pybullet")

MARGIN = 1e-3
FURTHER = {
    "sphere": (0.0, 0.0),
    "capsule": (0.0, 0.0),
    "box": (0.0, (3**0.5 - 1) * MARGIN),  # corners and edges are rounded, within the box
    "cylinder": (0.0, (2**0.5 - 1) * MARGIN),
    "hull": (-MARGIN, -0.85 * MARGIN),  # the margin goes on top
    "cone": (-MARGIN, -0.85 * MARGIN),
}
"""Largest excess of Bullet's distances over the true ones [m]; it has no ellipsoids."""

PAIRS = list(itertools.combinations_with_replacement(FURTHER, 2))
SLACK = 1e-4
EACH, SAMPLES, RADIUS = 3, 60, 0.1


@pytest.fixture(scope="module")
def shapes():
    """Shapes by their kind, each with its number in Bullet."""
    rng, client = np.random.default_rng(5), bullet.connect(bullet.DIRECT)
    yield {
        kind: [(shape, body_of(shape, client)) for shape in (random_shape(kind, rng) for _ in range(EACH))]
        for kind in FURTHER
    }
    bullet.disconnect(client)


def body_of(shape, client):
    x, y, _ = shape.sizes.tolist()
    kind, sizes = {
        "box": (bullet.GEOM_BOX, {"halfExtents": shape.sizes.tolist()}),
        "sphere": (bullet.GEOM_SPHERE, {"radius": x}),
        "capsule": (bullet.GEOM_CAPSULE, {"radius": x, "height": 2 * y}),
        "cylinder": (bullet.GEOM_CYLINDER, {"radius": x, "height": 2 * y}),
    }.get(shape.kind) or (bullet.GEOM_MESH, {"vertices": shape.mesh_points().tolist()})
    number = bullet.createCollisionShape(kind, physicsClientId=client, **sizes)
    return bullet.createMultiBody(1.0, number, physicsClientId=client)


@pytest.mark.sampled(2)
@pytest.mark.parametrize(("one", "other"), PAIRS)
def test_distances_match_bullet_within_its_margins(one, other, shapes):
    rng = np.random.default_rng([list(FURTHER).index(kind) for kind in (one, other)])
    least, most = np.add(FURTHER[one], FURTHER[other])
    signs = []
    for k in range(SAMPLES):
        (a, number_a), (b, number_b) = shapes[one][k % EACH], shapes[other][(k + 1) % EACH]
        poses = np.stack([random_pose(rng, 0.25), random_pose(rng, 0.25)])
        for number, pose in ((number_a, poses[0]), (number_b, poses[1])):
            turn = Rotation.from_matrix(pose[:, :3]).as_quat()
            bullet.resetBasePositionAndOrientation(number, pose[:, 3].tolist(), turn.tolist())
        distance = Narrowphase([a.solid, b.solid], poses).distance(0, 1)
        theirs = min(contact[8] for contact in bullet.getClosestPoints(number_a, number_b, 10.0))
        assert least - SLACK <= theirs - distance <= most + SLACK
        near = {contact[2] for contact in bullet.getClosestPoints(number_a, number_b, RADIUS)}
        if not RADIUS - most - SLACK < distance < RADIUS - least + SLACK:
            assert near == ({number_b} if distance < RADIUS else set())
        signs.append(distance > 0)
    assert set(signs) == {True, False}
