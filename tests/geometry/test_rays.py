"""Rays against MuJoCo and trimesh, points against the definition of a distance."""

import mujoco
import numpy as np
import pytest
import trimesh
from convex_shapes import KINDS, MujocoPairs, random_pose, random_shape
from scene_models import arm_among_boxes, body, random_state

import kineverse as kv
from kineverse.geometry import Scene
from kineverse.geometry.narrowphase import distance_to_point
from kineverse.geometry.rays import intersect_ray
from kineverse.geometry.shapes import _triangle_solid
from kineverse.model.body import Box, Cylinder, Sphere


@pytest.mark.parametrize("kind", KINDS)
def test_ray_hits_match_mujoco(kind):
    rng = np.random.default_rng(KINDS.index(kind))
    shapes = [random_shape(kind, rng) for _ in range(4)]
    pairs = MujocoPairs(shapes)
    tolerance = 1e-3 if kind == "cone" else 1e-9  # theirs is a pyramid of 256 sides
    normal, hits, number = np.zeros(3), 0, np.zeros(1, dtype=np.int32)
    for _ in range(300):
        k, pose = int(rng.integers(4)), random_pose(rng, 0.3)
        pairs._place(k, pose)
        # Only one of them is in the way.
        for other in range(4):
            if other != k:
                pairs._data.geom_xpos[other] = [100, 100, 100]
        origin, way = rng.normal(size=3), rng.normal(size=3) * 0.1
        way = pose[:, 3] - origin + way
        way /= np.linalg.norm(way)
        rotation = pose[:, :3]
        ours = intersect_ray(shapes[k].solid, rotation.T @ (origin - pose[:, 3]), rotation.T @ way)
        inside = distance_to_point(shapes[k].solid, pose, origin)[0] < 0
        if inside:
            assert ours is not None
            assert ours[0] == 0
            continue
        theirs = mujoco.mj_ray(pairs._model, pairs._data, origin, way, None, 1, -1, number, normal)
        assert (ours is None) == (theirs < 0)
        if ours is not None:
            hits += 1
            assert ours[0] == pytest.approx(theirs, abs=max(tolerance, 1e-6 if kind == "hull" else 0))
            if kind != "cone":
                np.testing.assert_allclose(rotation @ ours[1], normal, atol=1e-5)
            assert ours[1] @ rotation.T @ way < 0
    assert hits > 100


def test_ray_hits_on_triangles_match_trimesh():
    rng = np.random.default_rng(0)
    mesh = trimesh.creation.torus(0.5, 0.15, major_sections=24, minor_sections=12)
    solid = _triangle_solid(np.array(mesh.vertices), np.array(mesh.faces))
    intersector = trimesh.ray.ray_triangle.RayMeshIntersector(mesh)
    hits = 0
    for _ in range(200):
        origin, way = rng.normal(size=3), rng.normal(size=3)
        way = rng.normal(size=3) * 0.3 - origin
        way /= np.linalg.norm(way)
        ours = intersect_ray(solid, origin, way)
        points, *_ = intersector.intersects_location([origin], [way])
        assert (ours is None) == (len(points) == 0)
        if ours is not None:
            hits += 1
            assert ours[0] == pytest.approx(np.linalg.norm(points - origin, axis=1).min(), abs=1e-9)
    assert hits > 30


@pytest.mark.parametrize("kind", KINDS)
def test_point_distance_matches_the_support_function(kind):
    """The largest of all gaps between a plane at the point and the shape."""
    rng = np.random.default_rng(3)
    directions = rng.normal(size=(4000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for _ in range(30):
        shape, pose = random_shape(kind, rng), random_pose(rng, 0.2)
        point = rng.normal(size=3) * 0.3
        distance, nearest, normal = distance_to_point(shape.solid, pose, point)
        assert np.linalg.norm(normal) == pytest.approx(1, abs=1e-6)
        assert normal @ (point - nearest) == pytest.approx(distance, abs=1e-6)
        assert normal @ point - shape.support(normal, pose) == pytest.approx(distance, abs=1e-5)
        assert (directions @ point - shape.support(directions, pose)).max() <= distance + 1e-5


def test_ray_returns_the_first_of_several_hits():
    model = arm_among_boxes()
    scene, rng = Scene(model), np.random.default_rng(2)
    hits = 0
    for _ in range(10):
        state = random_state(model, rng)
        scene.update(state)
        origin = rng.normal(size=3) * 2
        way = 0.2 * rng.normal(size=3) - origin
        hit, near = scene.ray(origin, way, 5.0), scene.point(origin + 0.5 * way)
        assert near is not None
        assert (near.distance < 0) == near.inside
        alone = []
        for name in scene.bodies:
            single = Scene(model, leave_out=[other for other in scene.bodies if other != name])
            single.update(state)
            if (found := single.ray(origin, way, 5.0)) is not None:
                alone.append((found.distance, found.body))
            nearest = single.point(origin + 0.5 * way, near.distance + 1e-6 if near.distance > 0 else 1.0)
            assert nearest is None or nearest.distance >= near.distance - 1e-9
        assert (hit is None) == (not alone)
        if hit is not None:
            hits += 1
            assert (hit.distance, hit.body) == min(alone)
    assert hits > 3


def test_ray_and_point_queries_of_a_simple_scene():
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("wall", "world", kv.translation(2, 0, 0), body(Box((0.2, 4, 4))))
        edit.add_frame("post", "world", kv.translation(1, 0, 0), body(Cylinder(0.1, 2)))
        edit.add_frame("ball", "world", kv.translation(0, 0, 0), body(Sphere(0.5)))
    scene = Scene(model)
    hit = scene.ray((0.6, 0, 0), (3, 0, 0))
    assert (hit.body, hit.distance) == ("post", pytest.approx(0.3))
    np.testing.assert_allclose(hit.normal, [-1, 0, 0], atol=1e-12)
    assert scene.ray((0.6, 0, 0), (1, 0, 0), 0.2) is None
    assert scene.ray((0.6, 0.5, 0), (1, 0, 0)).body == "wall"
    assert scene.ray((0.1, 0, 0), (1, 0, 0)).distance == 0  # from inside the ball
    near = scene.point((0.2, 0, 0))
    assert (near.body, near.distance, near.inside) == ("ball", pytest.approx(-0.3), True)
    np.testing.assert_allclose(near.point, [0.5, 0, 0], atol=1e-6)
    assert scene.point((0, 0, 5), 1.0) is None


@pytest.mark.parametrize("origin", [(0, 0), (0, 0, np.nan), "here"])
def test_ray_refuses_an_invalid_origin(origin):
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("wall", "world", np.eye(4), body(Box((1, 1, 1))))
    scene = Scene(model)
    for ask in (lambda: scene.ray(origin, (1, 0, 0)), lambda: scene.point(origin)):
        with pytest.raises((kv.errors.ShapeError, kv.errors.InvalidValueError)):
            ask()
    with pytest.raises(kv.errors.InvalidValueError, match="direction"):
        scene.ray((0, 0, 0), (0, 0, 0))


def test_ray_takes_directions_of_any_length_and_far_origins():
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("speck", "world", kv.translation(1.0, 0, 0), body(Sphere(1e-4)))
    scene = Scene(model)
    scene.update({})
    for size in (1e-300, 1e-160, 1e160, 1e300):
        assert scene.ray((0, 0, 0), (size, 0, 0)).distance == pytest.approx(1 - 1e-4)
    for away in (1e3, 1e5, 1e7):
        way = np.array([0.6, 0.48, 0.64])
        assert scene.ray((1, 0, 0) - away * way, way).body == "speck"
        assert scene.ray((1, 0, 2e-4) - away * way, way) is None
    for ask in (lambda: scene.point((1e200, 0, 0)), lambda: scene.ray((0, 1e200, 0), (1, 0, 0))):
        with pytest.raises(kv.errors.InvalidValueError, match="further than"):
            ask()
