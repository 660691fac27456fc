"""Hierarchies over spheres."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from kineverse.errors import InvalidValueError, ShapeError
from kineverse.planning.spheres import enclosing_ball, make_sphere_tree


def spheres(seed: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    return random.normal(size=(count, 3)) * (0.3, 0.1, 0.05), random.uniform(0.01, 0.1, size=count)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 1000), st.integers(1, 60))
def test_parents_contain_their_children_and_the_ball_contains_all(seed, count):
    centres, radii = spheres(seed, count)
    tree = make_sphere_tree(centres, radii)
    assert np.array_equal(tree.centres, centres[tree.order])
    assert np.array_equal(tree.radii, radii[tree.order])
    assert sorted(tree.order.tolist()) == list(range(count))
    assert tree.first[0] == 0
    assert tree.first[-1] == count
    assert (np.diff(tree.first) > 0).all()
    parent = np.repeat(np.arange(len(tree.coarse_radii)), np.diff(tree.first))
    reach = np.linalg.norm(tree.centres - tree.coarse_centres[parent], axis=1) + tree.radii
    assert (reach <= tree.coarse_radii[parent]).all()
    assert (np.linalg.norm(centres - tree.ball_centre, axis=1) + radii <= tree.ball_radius).all()
    assert len(tree.coarse_radii) == count if count <= 4 else len(tree.coarse_radii) <= round(np.sqrt(count))


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 1000), st.integers(2, 20))
def test_enclosing_ball_is_close_to_the_smallest(seed, count):
    centres, radii = spheres(seed, count)
    found = enclosing_ball(centres, radii)[1]

    def reach(x):
        return (np.linalg.norm(centres - x, axis=1) + radii).max()

    tried = (minimize(reach, x, method="Nelder-Mead", options={"xatol": 1e-7}) for x in centres[:3])
    assert found <= 1.01 * min(result.fun for result in tried)


def test_one_sphere_is_its_own_hierarchy():
    tree = make_sphere_tree([[1.0, 2.0, 3.0]], [0.5])
    assert tree.ball_radius == 0.5
    assert tree.ball_centre.tolist() == [1.0, 2.0, 3.0]


def test_concentric_spheres_have_the_largest_as_their_ball():
    assert make_sphere_tree(np.zeros((6, 3)), np.arange(1.0, 7.0)).ball_radius == pytest.approx(6.0)


def test_make_sphere_tree_refuses_what_is_no_sphere():
    with pytest.raises(ShapeError):
        make_sphere_tree(np.zeros((0, 3)), np.zeros(0))
    with pytest.raises(InvalidValueError):
        make_sphere_tree([[0, 0, np.inf]], [1.0])
