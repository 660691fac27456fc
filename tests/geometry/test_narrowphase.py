"""Distances of pairs against MuJoCo, and against the definition of a distance."""

import importlib.util
import itertools
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from convex_shapes import EXACT, KINDS, MujocoPairs, gap, random_pose, random_shape
from scipy.spatial.transform import Rotation

from kineverse.geometry.bindings import collision_library
from kineverse.geometry.gjk import directional_gaps, smoothed_support
from kineverse.geometry.narrowphase import Narrowphase
from kineverse.geometry.shapes import _triangle_solid, scale_solid, solid_from_geometry, solid_from_points
from kineverse.model.body import Box, Capsule, Cone, Cylinder, Ellipsoid, Sphere

TOOL = importlib.util.spec_from_file_location(
    "distances", Path(__file__).parents[2] / "tools" / "distances.py"
)
distances = sys.modules["distances"] = importlib.util.module_from_spec(TOOL)
TOOL.loader.exec_module(distances)

EACH = 4
PAIRS = list(itertools.combinations_with_replacement(KINDS, 2))
SAMPLES = 10_000 // len(PAIRS) + 1


@pytest.fixture(scope="module")
def shapes():
    rng = np.random.default_rng(5)
    return {kind: [random_shape(kind, rng) for _ in range(EACH)] for kind in KINDS}


@pytest.fixture(scope="module")
def mujoco_pairs(shapes):
    return MujocoPairs([shape for kind in KINDS for shape in shapes[kind]])


def measured(a, b, poses):
    narrow = Narrowphase([a.solid, b.solid], poses)
    return narrow.distance(0, 1), *narrow.witness()


@pytest.mark.sampled(2)
@pytest.mark.parametrize(("one", "other"), PAIRS)
def test_signed_distances_match_mujoco(one, other, shapes, mujoco_pairs):
    rng = np.random.default_rng([KINDS.index(one), KINDS.index(other)])
    exact = one in EXACT and other in EXACT
    tolerance = 1e-6 if exact else 1e-4
    apart = 0
    for _ in range(SAMPLES):
        i, j = rng.integers(EACH, size=2)
        a, b = shapes[one][i], shapes[other][j]
        if a is b:
            b = shapes[other][j := (j + 1) % EACH]
        poses = np.stack([random_pose(rng, 0.25), random_pose(rng, 0.25)])
        distance, point_a, point_b, normal = measured(a, b, poses)
        assert np.linalg.norm(normal) == pytest.approx(1, abs=1e-9)
        assert normal @ (point_b - point_a) == pytest.approx(distance, abs=1e-9)
        # The normal shows this very gap, so the true distance is not less.
        assert gap(a, b, poses, normal) == pytest.approx(distance, abs=tolerance)
        theirs, way = mujoco_pairs.distance(EACH * KINDS.index(one) + i, EACH * KINDS.index(other) + j, poses)
        if abs(theirs - distance) > tolerance:
            # Not minimal: along its own direction MuJoCo's translation does not separate them.
            assert distance < theirs < 0, (distance, theirs)
            assert {one, other} <= {"box", "capsule", "hull", "cone", "cylinder"}
            assert gap(a, b, poses, way) < theirs - tolerance
        apart += distance > 0
    assert 0.1 * SAMPLES < apart < 0.98 * SAMPLES


@pytest.mark.parametrize(("one", "other"), PAIRS)
def test_depth_is_the_shortest_separating_translation(one, other, shapes):
    rng = np.random.default_rng([2, KINDS.index(one), KINDS.index(other)])
    directions = rng.normal(size=(2000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for _ in range(12):
        a, b = shapes[one][0], shapes[other][1]
        poses = np.stack([random_pose(rng, 0.03), random_pose(rng, 0.03)])
        distance, *_ = measured(a, b, poses)
        assert distance < 0
        assert gap(a, b, poses, directions).max() <= distance + 2e-5


@pytest.mark.parametrize(("one", "other"), PAIRS)
def test_normal_of_touching_solids_is_right(one, other, shapes):
    rng = np.random.default_rng([3, KINDS.index(one), KINDS.index(other)])
    a, b = shapes[one][0], shapes[other][1]
    for wanted in (0.0, 1e-12, 1e-9, 1e-7, 2e-6, -1e-12, -1e-9, -1e-7, -2e-6):
        poses = np.stack([random_pose(rng, 0.3), random_pose(rng, 0.3)])
        distance, _, _, normal = measured(a, b, poses)
        poses[1, :, 3] += (wanted - distance) * normal
        distance, point_a, point_b, normal = measured(a, b, poses)
        assert np.linalg.norm(normal) == pytest.approx(1, abs=1e-9)
        assert distance == pytest.approx(wanted, abs=1e-5)
        assert gap(a, b, poses, normal) == pytest.approx(wanted, abs=2e-5)
        assert normal @ (point_b - point_a) == pytest.approx(distance, abs=1e-9)


@pytest.mark.parametrize(("one", "other"), PAIRS)
def test_normal_of_almost_touching_solids_confirms_the_gap(one, other, shapes):
    rng = np.random.default_rng([6, KINDS.index(one), KINDS.index(other)])
    a, b = shapes[one][0], shapes[other][1]
    for space in (1e-5, 1e-4, 1e-3):
        poses = np.stack([random_pose(rng, 0.1), random_pose(rng, 0.1)])
        way = rng.normal(size=3)
        way /= np.linalg.norm(way)
        point_a, point_b = (
            smoothed_support((shape.solid, pose[:, :3], pose[:, 3]), sign * way)
            for shape, pose, sign in zip((a, b), poses, (1, -1), strict=True)
        )
        poses[1, :, 3] += point_a + space * way - point_b
        distance, _, _, normal = measured(a, b, poses)
        assert distance == pytest.approx(space, abs=2e-7)
        assert gap(a, b, poses, normal) == pytest.approx(distance, abs=2e-7)


@pytest.mark.parametrize("other", [Box((2.0, 0.004, 0.002)), Capsule(0.001, 2.0), Box((0.002, 2.0, 2.0))])
def test_needles_and_plates_touch_with_distance_zero(other):
    rng = np.random.default_rng(7)
    solids = solid_from_geometry(Box((0.0002, 0.11, 0.21))), solid_from_geometry(other)
    for _ in range(60):
        poses = np.stack([random_pose(rng, 0.1), random_pose(rng, 0.1)])
        way = rng.normal(size=3)
        way /= np.linalg.norm(way)
        point_a, point_b = (
            smoothed_support((solid, pose[:, :3], pose[:, 3]), sign * way)
            for solid, pose, sign in zip(solids, poses, (1, -1), strict=True)
        )
        poses[1, :, 3] += point_a - point_b
        narrow = Narrowphase(solids, poses)
        assert narrow.distance(0, 1) == pytest.approx(0.0, abs=1e-6)
        point_a, point_b, _ = narrow.witness()
        np.testing.assert_allclose(point_a, point_b, atol=2e-5)


def test_search_separates_solids_when_coal_fails(shapes, monkeypatch):
    monkeypatch.setattr(Narrowphase, "_is_unit_normal", lambda narrow: False)
    rng = np.random.default_rng(13)
    for one, other in PAIRS:
        a, b = shapes[one][0], shapes[other][1]
        poses = np.stack([random_pose(rng, 0.02), random_pose(rng, 0.02)])
        distance, point_a, point_b, normal = measured(a, b, poses)
        assert distance <= gap(a, b, poses, normal) + 1e-9
        assert distance < 0
        assert normal @ (point_b - point_a) == pytest.approx(distance, abs=1e-9)


@pytest.mark.parametrize(
    ("one", "other", "turn", "position"),
    [
        (
            Cone(0.017881, 0.064586),
            Box((0.0002, 0.04808, 0.0002)),
            2.989989,
            (-0.007736, 0.037628, -0.032351),
        ),
        (Ellipsoid((4.4, 0.0024, 0.0044)), Ellipsoid((0.78, 0.58, 0.0008)), 0.0, (0.0, 0.0, 0.0052)),
    ],
)
def test_depth_of_thin_solids_matches_the_gap_along_the_normal(one, other, turn, position):
    """Here coal has a depth and a normal of length one that have nothing to do with each other."""
    rotation = Rotation.from_rotvec([0, 0, turn]).as_matrix()
    poses = np.stack([np.eye(4)[:3], np.column_stack([rotation, position])])
    solids = solid_from_geometry(one), solid_from_geometry(other)
    narrow = Narrowphase(solids, poses)
    distance = narrow.distance(0, 1)
    point_a, point_b, normal = narrow.witness()
    a, b = ((solid, pose[:, :3], pose[:, 3]) for solid, pose in zip(solids, poses, strict=True))
    assert directional_gaps(a, b, normal[None])[0] == pytest.approx(distance, abs=2e-5)
    assert normal @ (point_b - point_a) == pytest.approx(distance, abs=1e-9)
    assert abs(distance) < 1e-4


@pytest.mark.parametrize(("one", "other"), PAIRS)
def test_concentric_solids_have_a_separating_translation(one, other, shapes):
    a, b = shapes[one][0], shapes[other][1]
    poses = np.stack([np.eye(4)[:3]] * 2)
    distance, point_a, point_b, normal = measured(a, b, poses)
    assert distance < 0  # in full symmetry coal stops where it is nearly flat
    assert np.linalg.norm(normal) == pytest.approx(1, abs=1e-6)
    assert normal @ (point_b - point_a) == pytest.approx(distance, abs=1e-6)
    assert gap(a, b, poses, normal) == pytest.approx(distance, abs=3e-4)


@pytest.mark.parametrize(("one", "other"), PAIRS)
def test_distances_scale_with_the_solids(one, other, shapes):
    rng = np.random.default_rng([4, KINDS.index(one), KINDS.index(other)])
    a, b = shapes[one][0], shapes[other][1]
    for factor in (2.0**-9, 2.0**-7, 2.0**-5, 2.0**10):
        small = [scale_solid(shape.solid, factor) for shape in (a, b)]
        for spread in (0.05, 0.3):
            poses = np.stack([random_pose(rng, spread), random_pose(rng, spread)])
            distance, *_ = measured(a, b, poses)
            narrow = Narrowphase(small, poses * (1, 1, 1, factor))
            assert narrow.distance(0, 1) / factor == pytest.approx(distance, abs=3e-5)
            point_a, point_b, normal = narrow.witness()
            assert normal @ (point_b - point_a) == pytest.approx(factor * distance, abs=3e-5 * factor)
            assert gap(a, b, poses, normal) == pytest.approx(distance, abs=1e-4)


def test_triangle_meshes_have_distances_and_contact_normals():
    box = trimesh.creation.box((1, 1, 1)).subdivide().subdivide()
    surface = _triangle_solid(np.array(box.vertices), np.array(box.faces))
    for solid, reach in (
        (surface, 0.5),
        (solid_from_geometry(Sphere(0.1)), 0.1),
        (solid_from_geometry(Box((0.2, 0.2, 0.2))), 0.1),
    ):
        for at in (2.0, 1.1, 0.7, 0.61, 0.59, 0.55, 0.5):
            poses = np.stack([np.eye(4)[:3]] * 2)
            poses[1, :, 3] = at, 0.02, 0.03
            narrow = Narrowphase([surface, solid], poses)
            distance = narrow.distance(0, 1)
            point_a, point_b, normal = narrow.witness()
            if at - 0.5 - reach > 0:
                assert distance == pytest.approx(at - 0.5 - reach, abs=1e-6)
                np.testing.assert_allclose(normal, [1, 0, 0], atol=1e-5)
            else:
                assert distance <= 0
            assert np.linalg.norm(normal) == pytest.approx(1, abs=1e-6)
            assert normal @ (point_b - point_a) == pytest.approx(distance, abs=1e-6)


def test_distances_of_a_triangle_mesh_match_its_hull(shapes):
    rng, apart = np.random.default_rng(11), 0
    for _ in range(150):
        a, b = shapes["hull"][rng.integers(EACH)], shapes["hull"][rng.integers(EACH)]
        poses = np.stack([random_pose(rng, 0.4), random_pose(rng, 0.4)])
        distance, _, _, normal = measured(a, b, poses)
        if distance < 1e-3:
            continue
        apart += 1
        meshes = [trimesh.Trimesh(shape.points).convex_hull for shape in (a, b)]
        one, other = (_triangle_solid(np.array(mesh.vertices), np.array(mesh.faces)) for mesh in meshes)
        for solids in ((one, other), (one, b.solid), (a.solid, other)):
            narrow = Narrowphase(solids, poses)
            assert narrow.distance(0, 1) == pytest.approx(distance, abs=1e-6)
            point_a, point_b, way = narrow.witness()
            assert way @ (point_b - point_a) == pytest.approx(distance, abs=1e-6)
            np.testing.assert_allclose(way, normal, atol=1e-4)
            assert gap(a, b, poses, way) == pytest.approx(distance, abs=1e-5)
            assert way @ point_a == pytest.approx(a.support(way, poses[0]), abs=1e-5)
    assert apart > 30


STRAYS = [("cone", seed) for seed in (655, 1236, 3656, 3929, 4863)]
STRAYS += [("ellipsoid", seed) for seed in (24, 348, 551, 1693)] + [("cylinder", 1426)]


@pytest.mark.parametrize(("kind", "seed"), STRAYS)
def test_wrong_distances_of_coal_are_corrected(kind, seed):
    """There coal alone says up to a metre less, or touch; of the hull, its triangles, or both."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(9, 3)) * 10 ** rng.uniform(-1.5, 0.2, 3)
    x, y, z = rng.uniform(0.1, 1.2, 3).tolist()
    solid = solid_from_geometry(
        {"cone": Cone(x, y), "cylinder": Cylinder(x, y), "ellipsoid": Ellipsoid((x, y, z))}[kind]
    )
    hull, surface = solid_from_points(points), trimesh.convex.convex_hull(points)
    poses = np.stack([random_pose(rng, 1.0), random_pose(rng, 1.0)])
    for other in (hull, _triangle_solid(np.array(surface.vertices), np.array(surface.faces))):
        for solids, places in (((solid, other), poses), ((other, solid), poses[::-1].copy())):
            narrow = Narrowphase(solids, places)
            distance = narrow.distance(0, 1)
            point_a, point_b, normal = narrow.witness()
            convex = [
                (s if s.is_convex else hull, p[:, :3], p[:, 3]) for s, p in zip(solids, places, strict=True)
            ]
            assert distance > 0.0
            assert directional_gaps(*convex, normal[None])[0] == pytest.approx(distance, abs=1e-5)
            assert normal @ (point_b - point_a) == pytest.approx(distance, abs=1e-6)
            assert np.linalg.norm(normal) == pytest.approx(1.0, abs=1e-6)


CASES = ("any", "flat", "sliver", "small", "far", "touching", "deep", "planar", "aligned")


@pytest.mark.compiler
@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("kind", ["cone", "cylinder", "hull"])
def test_distances_tool_finds_no_errors(kind, case):
    """``python tools/distances.py --pairs 100000 cone hull`` does so at length."""
    assert collision_library.prepare(wait=True)
    for count in distances.check((kind, "hull"), case, 15, seed=1).values():
        assert count.off == 0
        assert count.apart + count.inside + count.unsolved > 0


@pytest.mark.sampled(3)
@pytest.mark.compiler
@pytest.mark.parametrize("case", ["any", "planar", "aligned"])
@pytest.mark.parametrize("swapped", [False, True])
def test_points_are_on_their_bodies_and_slopes_are_theirs(case, swapped):
    assert collision_library.prepare(wait=True)
    for pair in itertools.combinations_with_replacement(KINDS, 2):
        for count in distances.check(pair[::-1] if swapped else pair, case, 2, seed=2, slopes=True).values():
            assert count.off == 0


def test_distances_tool_reports_errors(monkeypatch):
    witness = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.5], [0.0, 0.0, 1.0]])
    monkeypatch.setattr(distances, "by_c", lambda solids, poses: (0.5, witness))
    assert distances.check(("cone", "hull"), "far", 3, seed=1)["C"].off == 3


def test_witness_error_sees_points_beside_their_body():
    """A gap along the normal alone cannot see it."""
    ball, box = solid_from_geometry(Sphere(0.03)), solid_from_geometry(Box((0.06, 0.06, 0.3)))
    poses = np.stack([np.eye(4)[:3]] * 2)
    poses[0, :, 3] = [0.03, 0.0, 0.1]
    witness = np.array([[0.0, 0.0, 0.1], [0.03, 0.0, 0.1], [-1.0, 0.0, 0.0]])
    assert distances.witness_error([ball, box], poses, -0.03, witness) < 1e-12
    beside = witness + np.array([[0.0, 0.0, 0.02], [0.0, 0.0, 0.02], [0.0, 0.0, 0.0]])
    assert distances.witness_error([ball, box], poses, -0.03, beside) > 5e-3
