"""Covers of convex solids by spheres: what they contain, how far they stick out, how many they are."""

from __future__ import annotations

import coal
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kineverse.errors import InvalidValueError
from kineverse.geometry.shapes import Solid, scale_solid, solid_from_geometry, solid_from_points
from kineverse.model.body import Box, Capsule, Cone, Cylinder, Ellipsoid, Sphere
from kineverse.planning.spheres import cover_objects, cover_solid, cover_solids, default_protrusion
from kineverse.planning.spheres.certificate import find_uncovered
from kineverse.planning.spheres.polytope import CoverRegion, bound_solid

KINDS = ("box", "hull", "cylinder", "cone", "ellipsoid", "capsule", "sphere")
sizes = st.floats(0.02, 0.3)


@st.composite
def solids(draw: st.DrawFn) -> Solid:
    """Draw a solid of any kind, whose sizes differ by a factor of up to 15 [m]."""
    kind, a, b, c = draw(st.sampled_from(KINDS)), draw(sizes), draw(sizes), draw(sizes)
    if kind == "hull":
        points = np.random.default_rng(draw(st.integers(0, 1000))).normal(size=(draw(st.integers(4, 40)), 3))
        return solid_from_points(points * (a, b, c) / 3 + (1.0, -2.0, 0.5))
    return solid_from_geometry(
        {
            "box": Box((a, b, c)),
            "cylinder": Cylinder(a / 2, b),
            "cone": Cone(a / 2, b),
            "ellipsoid": Ellipsoid((a / 2, b / 2, c / 2)),
            "capsule": Capsule(a / 2, b),
            "sphere": Sphere(a),
        }[kind]
    )


def sample(solid: Solid, count: int) -> np.ndarray:
    """Return random points of a solid: extreme ones, and between them."""
    random = np.random.default_rng(1)
    directions = random.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    core = solid.core
    if core.corners.shape[1]:
        extreme = core.corners.T[(directions @ core.corners).argmax(axis=1)]
    elif core.tip:
        tip = (0.0, 0.0, core.tip)
        rim = core.radii * directions / np.linalg.norm(directions[:, :2], axis=1, keepdims=True) - tip
        extreme = np.where((directions[:, :1] > 0.3), tip, rim)
    else:
        round_ = core.radii**2 * directions
        lengths = np.linalg.norm(core.radii * directions, axis=1, keepdims=True)
        extreme = np.sign(directions) * core.half + core.radius * directions
        extreme = extreme + round_ / np.where(lengths > 0.0, lengths, 1.0)
    weights = random.dirichlet(np.full(4, 0.3), size=count)
    between = np.einsum("nk,nkj->nj", weights, extreme[random.integers(count, size=(count, 4))])
    return np.concatenate([extreme, between])


def distances_outside(centres: np.ndarray, radii: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return how far each point is outside of all spheres, negative inside."""
    return (np.linalg.norm(points[:, None] - centres, axis=2) - radii).min(axis=1)


def protrusions_by_coal(placed, centres: np.ndarray, radii: np.ndarray, points: np.ndarray) -> float:
    """Return the largest distance from solids at poses of points on spheres, by coal."""

    def distance(solid: Solid, pose: np.ndarray, point: np.ndarray) -> float:
        result, place = (
            coal.DistanceResult(),
            coal.Transform3s(np.eye(3), pose[:3, :3].T @ (point - pose[:3, 3])),
        )
        here, ball = coal.Transform3s.Identity(), coal.Sphere(1e-9)
        coal.distance(solid.engine, here, ball, place, coal.DistanceRequest(), result)
        return result.min_distance

    return max(
        min(distance(solid, pose, point) for solid, pose in placed)
        for centre, radius in zip(centres, radii, strict=True)
        for point in centre + radius * points
    )


def random_directions(count: int) -> np.ndarray:
    """Return random unit vectors (count, 3)."""
    directions = np.random.default_rng(2).normal(size=(count, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


@settings(max_examples=12, deadline=None)
@given(solids(), st.sampled_from([None, 0.01, 0.03]), st.sampled_from([1, 6, 32]))
def test_cover_solid_contains_the_solid_and_keeps_to_its_protrusion(solid, protrusion, most):
    cover, points = cover_solid(solid, protrusion, most), sample(solid, 400)
    assert distances_outside(cover.centres, cover.radii, points).max() <= 1e-9
    reached = protrusions_by_coal([(solid, np.eye(4))], cover.centres, cover.radii, random_directions(6))
    assert reached <= cover.protrusion + 1e-6
    assert len(cover) <= most
    wanted = default_protrusion([(solid, np.eye(4))]) if protrusion is None else protrusion
    # Two spheres may cover a cone as well as six do, and one a stout cylinder.
    fewest = 1 if isinstance(solid.surface, Cylinder) and most == 6 else {1: 1, 6: 2, 32: 20}[most]
    assert cover.protrusion <= wanted + 1e-9 or len(cover) >= fewest


@settings(max_examples=2, deadline=None)
@given(st.integers(0, 100), st.sampled_from([0.25, 8.0]))
def test_cover_solid_scales_with_the_solid(seed, factor):
    solid = solid_from_points(np.random.default_rng(seed).normal(size=(20, 3)) * (0.1, 0.05, 0.08))
    large = scale_solid(solid, factor)
    one, other = cover_solid(solid, 0.05), cover_solid(large, 0.05 * factor)
    assert other.protrusion <= 0.05 * factor * (1 + 1e-9)
    assert abs(len(one) - len(other)) <= 0.25 * len(one) + 1


@settings(max_examples=3, deadline=None)
@given(st.lists(st.tuples(solids(), st.integers(0, 1000)), min_size=2, max_size=3), st.sampled_from([6, 64]))
def test_cover_solids_contains_the_union_and_keeps_to_its_protrusion(drawn, most):
    placed = []
    for solid, seed in drawn:
        pose, random = np.eye(4), np.random.default_rng(seed)
        pose[:3, :3] = np.linalg.qr(random.normal(size=(3, 3)))[0]
        pose[:3, 3] = random.uniform(-0.1, 0.1, 3) - pose[:3, :3] @ solid.centre
        placed.append((solid, pose))
    cover = cover_solids(placed, 0.04, most)
    assert len(cover) <= most
    assert cover.protrusion <= 0.04 + 1e-9 or len(cover) >= 0.6 * most
    for solid, pose in placed:
        points = sample(solid, 300) @ pose[:3, :3].T + pose[:3, 3]
        assert distances_outside(cover.centres, cover.radii, points).max() <= 1e-9
    reached = protrusions_by_coal(placed, cover.centres, cover.radii, random_directions(6))
    assert reached <= cover.protrusion + 1e-6


def test_shapes_inside_of_others_need_no_spheres():
    box = solid_from_geometry(Box((0.2, 0.2, 0.2)))
    inside, aside = solid_from_geometry(Cylinder(0.05, 0.1)), np.eye(4)
    aside[0, 3] = 0.02
    alone, both = (
        cover_solids([(box, np.eye(4))], 0.03),
        cover_solids([(box, np.eye(4)), (inside, aside)], 0.03),
    )
    assert len(both) <= 1.25 * len(alone)
    assert both.protrusion <= 0.03


def test_cover_solid_is_deterministic():
    solid = solid_from_geometry(Cylinder(0.05, 0.1))
    one, other = cover_solid(solid, 0.02), cover_solid(solid, 0.02)
    assert np.array_equal(one.centres, other.centres)
    assert np.array_equal(one.radii, other.radii)


def test_cover_solid_takes_one_sphere_for_a_sphere():
    cover = cover_solid(solid_from_geometry(Sphere(0.1)))
    assert len(cover) == 1
    assert cover.radii[0] == 0.1
    assert cover.protrusion == 0.0


@pytest.mark.parametrize(("length", "most"), [(0.001, 32), (0.05, 32), (0.4, 32), (0.4, 3), (0.4, 1)])
def test_cover_solid_takes_a_chain_for_a_capsule(length, most):
    solid = solid_from_geometry(Capsule(0.04, length))
    cover = cover_solid(solid, 0.005, most)
    assert np.ptp(cover.centres[:, :2]) == 0.0
    assert len(cover) <= most
    assert distances_outside(cover.centres, cover.radii, sample(solid, 2000)).max() <= 1e-12
    assert cover.protrusion <= 0.0051 or len(cover) == most


def test_cover_solid_covers_a_cube_by_few_spheres():
    """Eight spheres in a lattice reach 18.3 mm."""
    assert len(cover_solid(solid_from_geometry(Box((0.1, 0.1, 0.1))), 0.02)) == 8


@pytest.mark.parametrize(
    "points",
    [
        np.array([[0, 0, 0], [0.5, 0, 0], [0, 0.3, 0], [0.5, 0.3, 0]]),
        np.array([[0, 0, 0], [1, 0, 0], [0, 1e-3, 0], [0, 0, 1e-3]]),
        np.array([[0, 0, 0], [1e-4, 0, 0], [0, 1e-4, 0], [0, 0, 1e-4]]),
    ],
    ids=["flat", "needle", "tiny"],
)
def test_cover_solid_covers_degenerate_hulls(points):
    solid = solid_from_points(points.astype(float))
    cover = cover_solid(solid, most=32)
    assert distances_outside(cover.centres, cover.radii, sample(solid, 500)).max() <= 1e-9
    assert len(cover) <= 32


@pytest.mark.parametrize(
    ("settings_", "part"),
    [({"protrusion": 0.0}, "positive"), ({"protrusion": np.nan}, "positive"), ({"most": 0}, "1 to 1024")],
)
def test_cover_solid_refuses_impossible_settings(settings_, part):
    with pytest.raises(InvalidValueError, match=part):
        cover_solid(solid_from_geometry(Box((1.0, 1.0, 1.0))), **settings_)


def test_find_uncovered_finds_a_gap_between_spheres():
    """Two balls about a bar leave its middle; the least growth that closes the gap is known."""
    region = CoverRegion([bound_solid(solid_from_geometry(Box((0.4, 0.02, 0.02))), 0.01)])
    centres, radii = np.array([[-0.1, 0, 0], [0.1, 0, 0]]), np.full(2, 0.09)
    uncovered = find_uncovered(region, centres, radii, 1e-4)
    needed = np.linalg.norm([0.1, 0.01, 0.01]) - 0.09
    assert uncovered.growth.max() >= needed
    assert uncovered.growth.max() <= needed + 2e-4
    assert distances_outside(centres, radii, uncovered.points).min() > 0.0
    assert not len(find_uncovered(region, centres, radii + uncovered.growth, 1e-4).points)


EXTREME = [
    Cylinder(1.0, 1e-6), Cylinder(1e-6, 1.0), Cylinder(1e6, 1e-7), Cylinder(1e-7, 1e6),
    Cone(1.0, 1e-6), Cone(1e-6, 1.0), Box((1.0, 1.0, 1e-7)), Box((1.0, 1e-7, 1e-7)), Box((1e6, 1e-7, 1.0)),
    Box((1e-7, 1e-7, 1e-7)), Box((1e6, 1e6, 1e6)), Capsule(1e-7, 1.0), Capsule(1e-6, 1e6),
    Ellipsoid((1.0, 1.0, 1e-6)), Ellipsoid((1.0, 1e-6, 1e-6)), Sphere(1e6), Sphere(1e-7),
]  # fmt: skip


@pytest.mark.sampled(2)
@pytest.mark.parametrize("geometry", EXTREME, ids=str)
def test_covers_of_plates_needles_and_extreme_sizes_contain_them(geometry):
    solid = solid_from_geometry(geometry)
    cover, size = cover_solid(solid, most=6), solid.radius
    assert 1 <= len(cover) <= 6
    assert distances_outside(cover.centres, cover.radii, sample(solid, 200)).max() < 1e-7 * size
    # Centres are inside, so that none sticks out by more than its radius.
    assert cover.protrusion <= cover.radii.max() * (1 + 1e-6) + 3e-4 * size
    assert cover.protrusion <= 1.01 * size


def test_cover_of_a_needle_beside_a_plate_contains_both():
    needle, plate = (solid_from_geometry(g) for g in (Cylinder(1e-6, 1.0), Box((1.0, 1.0, 1e-6))))
    pose = np.eye(4)
    pose[2, 3] = 0.5
    cover = cover_solids([(plate, np.eye(4)), (needle, pose)], most=12)
    points = np.concatenate([sample(plate, 200), sample(needle, 200) + pose[:3, 3]])
    assert distances_outside(cover.centres, cover.radii, points).max() < 1e-9


def test_cover_of_nothing_is_refused():
    with pytest.raises(InvalidValueError, match="no solid"):
        cover_solids([])
    with pytest.raises(InvalidValueError, match="no shape"):
        cover_objects([])
