import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kineverse.errors import InvalidValueError
from kineverse.model.body import Box, Sphere
from kineverse.view.meshes import mesh_geometry
from kineverse.view.rendering.camera import Camera, fit_camera
from kineverse.view.rendering.rasterizer import Projection, rasterize

SEEDS = st.integers(0, 10_000)


def traced(projection, corners, one_sided):
    """The same question by brute force: each ray against each triangle."""
    rays = projection.pixel_rays(np.arange(projection.width * projection.height)).astype(float)
    found, nearest = np.full(len(rays), -1), np.full(len(rays), np.inf)
    for k, (a, b, c) in enumerate(corners - projection.origin):
        normal = np.cross(b - a, c - a)
        slope = rays @ normal
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (a @ normal) / slope
            points = distance[:, None] * rays
        inside = distance > 0.01
        if one_sided[k]:
            inside &= slope < 0
        for p, q in ((a, b), (b, c), (c, a)):
            inside &= np.cross(q - p, points - p) @ normal >= 0
        inside &= distance < nearest
        found[inside], nearest[inside] = k, distance[inside]
    return found, nearest


@given(SEEDS, st.booleans())
def test_visible_triangles_are_those_that_rays_hit(seed, one_sided):
    rng = np.random.default_rng(seed)
    corners = rng.uniform(-1, 1, (12, 3, 3))
    # Every other example stands amidst the triangles: some are cut by the picture's plane.
    eye = rng.uniform(-1, 1, 3) * (0.7 if seed % 2 else 4.0)
    camera = Camera(tuple(eye), tuple(rng.uniform(-0.5, 0.5, 3)), field_of_view=1.0)
    projection = Projection.from_camera(camera, 40, 30)
    sides = np.full(len(corners), one_sided)
    seen, near = rasterize(projection, corners, sides)
    expected, distance = traced(projection, corners, sides)
    # Rays that meet an edge may fall to either side of it.
    assert (seen != expected).mean() < 0.01
    same = (seen == expected) & (seen >= 0)
    np.testing.assert_allclose(1.0 / near[same], distance[same], rtol=1e-3)


def test_single_precision_gives_the_same_triangles():
    ball = mesh_geometry(Sphere(1.0))
    projection = Projection.from_camera(fit_camera(ball.vertices, 0.3, 0.4, 1.0), 64, 64)
    corners = ball.vertices[ball.faces]
    double, _ = rasterize(projection, corners)
    single, _ = rasterize(projection, corners.astype(np.float32))
    assert (double != single).mean() < 0.02


def test_a_half_opaque_triangle_covers_half_of_its_pixels():
    box = mesh_geometry(Box((1.0, 1.0, 1.0)))
    corners = box.vertices[box.faces]
    projection = Projection.from_camera(fit_camera(box.vertices, 0.0, 0.0, 1.0), 64, 64)
    solid, _ = rasterize(projection, corners, np.ones(12, dtype=bool))
    half, _ = rasterize(projection, corners, np.ones(12, dtype=bool), np.full(12, 0.5))
    assert (half >= 0).sum() == pytest.approx(0.5 * (solid >= 0).sum(), rel=0.05)


def test_an_empty_scene_is_rasterized():
    projection = Projection.from_camera(Camera((1, 0, 0), (0, 0, 0)), 8, 8)
    for corners in (np.zeros((0, 3, 3)), np.full((1, 3, 3), 5.0), np.zeros((2, 3, 3))):
        seen, near = rasterize(projection, corners)
        assert (seen == -1).all()
        assert (near == -np.inf).all()


@given(SEEDS, st.floats(0, 6.28), st.floats(-1.2, 1.2), st.floats(0.4, 3.0))
def test_fit_camera_frames_all_points_tightly(seed, azimuth, elevation, aspect):
    points = np.random.default_rng(seed).uniform(-2, 2, (20, 3))
    camera = fit_camera(points, azimuth, elevation, aspect, margin=0.08)
    projection = Projection.from_camera(camera, round(1000 * aspect), 1000)
    xy, _ = projection.to_pixels(projection.to_camera(points))
    share = xy / [projection.width, projection.height]
    assert (share > 0.079).all()
    assert (share < 0.921).all()
    spans = share.max(axis=0) - share.min(axis=0)
    assert spans.max() == pytest.approx(0.84, abs=0.01)


def test_fit_camera_accepts_one_point_or_none():
    for points in ([[1.0, 2.0, 3.0]], np.zeros((0, 3))):
        assert np.isfinite(fit_camera(points, 0.0, 0.0, 1.5).position).all()


@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (0.0, 1.0, 0.0)])
def test_a_camera_along_its_up_direction_has_axes(up):
    axes = Camera((0, 0, 5), (0, 0, 0), up=up).axes
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(-1.0)  # right, up, ahead: ahead is minus the z of OpenGL


@pytest.mark.parametrize(
    "wrong",
    [
        {"position": (0, 0, 0), "target": (0, 0, 0)},
        {"position": (np.nan, 0, 0), "target": (0, 0, 0)},
        {"position": (1, 0, 0), "target": (0, 0, 0), "field_of_view": 3.2},
    ],
)
def test_invalid_cameras_are_refused(wrong):
    with pytest.raises(InvalidValueError):
        Camera(**wrong)
