from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kineverse.model.body import Box, Capsule, Cone, Cylinder, Ellipsoid, Sphere
from kineverse.view.meshes import mesh_geometry
from kineverse.view.rendering.triangle_mesh import build_creased_mesh, concatenate_meshes, mesh_placeholder

LENGTH = st.floats(0.01, 3.0)
PRIMITIVES = st.one_of(
    st.builds(Box, st.tuples(LENGTH, LENGTH, LENGTH)),
    st.builds(Cylinder, LENGTH, LENGTH),
    st.builds(Capsule, LENGTH, LENGTH),
    st.builds(Sphere, LENGTH),
    st.builds(Ellipsoid, st.tuples(LENGTH, LENGTH, LENGTH)),
    st.builds(Cone, LENGTH, LENGTH),
)


def volume(surface):
    """The divergence theorem: positive exactly if the faces run counter-clockwise seen from outside."""
    a, b, c = np.moveaxis(surface.vertices[surface.faces], 1, 0)
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0)


def exact_volume(shape):
    match shape:
        case Box(size):
            return np.prod(size)
        case Cylinder(radius, length):
            return np.pi * radius**2 * length
        case Capsule(radius, length):
            return np.pi * radius**2 * length + 4 / 3 * np.pi * radius**3
        case Sphere(radius):
            return 4 / 3 * np.pi * radius**3
        case Ellipsoid(radii):
            return 4 / 3 * np.pi * np.prod(radii)
        case Cone(radius, length):
            return np.pi * radius**2 * length / 3


def extent(shape):
    match shape:
        case Box(size):
            return np.array(size)
        case Cylinder(radius, length):
            return np.array([2 * radius, 2 * radius, length])
        case Capsule(radius, length):
            return np.array([2 * radius, 2 * radius, length + 2 * radius])
        case Sphere(radius):
            return np.full(3, 2 * radius)
        case Ellipsoid(radii):
            return 2 * np.array(radii)
        case Cone(radius, length):
            return np.array([2 * radius, 2 * radius, length])


@given(PRIMITIVES)
def test_primitive_meshes_have_the_size_and_volume_of_the_primitive(shape):
    surface = mesh_geometry(shape)
    low, high = surface.bounds
    np.testing.assert_allclose(high - low, extent(shape), rtol=0.01)
    np.testing.assert_allclose(high + low, 0.0, atol=1e-9)
    assert volume(surface) == pytest.approx(exact_volume(shape), rel=0.02)
    assert surface.closed


@given(PRIMITIVES)
def test_normals_have_unit_length_and_point_outwards(shape):
    surface = mesh_geometry(shape)
    np.testing.assert_allclose(np.linalg.norm(surface.normals, axis=1), 1.0)
    assert (np.einsum("ij,ij->i", surface.normals, surface.vertices) > 0).all()


@given(PRIMITIVES, st.tuples(*[st.sampled_from([-1.5, -1.0, 0.5, 2.0])] * 3))
def test_a_mirrored_mesh_keeps_its_outside_outside(shape, scale):
    surface = mesh_geometry(shape)
    assert volume(surface.scale(scale)) == pytest.approx(abs(np.prod(scale)) * volume(surface))


def test_equal_primitives_share_one_mesh():
    assert mesh_geometry(Sphere(0.25)) is mesh_geometry(Sphere(0.25))


def test_transform_rotates_vertices_and_normals():
    turn = np.array([[0.0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])
    surface = mesh_geometry(Box((2.0, 4.0, 6.0)))
    moved = surface.transform(turn)
    np.testing.assert_allclose(moved.bounds, [[-1, 1, 0], [3, 3, 6]])
    np.testing.assert_allclose(moved.normals, surface.normals @ turn[:3, :3].T)


def test_build_creased_mesh_of_a_cube_has_sharp_edges():
    box = mesh_geometry(Box((1.0, 1.0, 1.0)))
    corners, index = np.unique(box.vertices, axis=0, return_inverse=True)
    assert len(corners) == 8
    surface, kept = build_creased_mesh(corners, index[box.faces])
    assert len(surface.vertices) == 24
    assert kept.tolist() == list(range(12))
    assert (np.abs(surface.normals).max(axis=1) == 1.0).all()


def test_build_creased_mesh_of_a_fine_sphere_is_smooth():
    ball = mesh_geometry(Sphere(1.0))
    surface, _ = build_creased_mesh(ball.vertices, ball.faces)
    np.testing.assert_allclose(surface.normals, surface.vertices, atol=0.03)


def test_faces_without_area_are_dropped_and_the_others_indexed():
    surface, kept = build_creased_mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0]], [[0, 1, 3], [0, 1, 2]])
    assert (len(surface.faces), kept.tolist()) == (1, [1])
    nothing, _ = build_creased_mesh(np.zeros((0, 3)), np.zeros((0, 3)))
    assert len(nothing.faces) == 0
    np.testing.assert_array_equal(nothing.bounds, np.zeros((2, 3)))


def test_concatenate_meshes_shifts_indices_and_keeps_colours_only_if_all_have_some():
    box, mark = mesh_geometry(Box((1.0, 1.0, 1.0))), mesh_placeholder()
    both = concatenate_meshes([box, mark])
    assert volume(both) == pytest.approx(volume(box) + volume(mark))
    assert both.colors is None
    painted = [replace(s, colors=np.ones((len(s.faces), 4))) for s in (box, mark)]
    assert concatenate_meshes(painted).colors.shape == (len(both.faces), 4)
