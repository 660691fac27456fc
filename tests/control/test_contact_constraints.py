"""Constraints of near pairs: equal in C and in numpy, as distances change, and at parallel faces."""

from types import SimpleNamespace

import numpy as np
import pytest

import kineverse as kv
from kineverse.articulations import OmniBase
from kineverse.control import Controller, Goal, contact_constraints
from kineverse.control.contact_constraints import ContactRows
from kineverse.geometry import Scene
from kineverse.model.body import Body, Box, Pose, Shape

GAIN, RECOVERY, WEIGHT = 10.0, 5.0, 3.0


@pytest.fixture(params=["numpy", pytest.param("c", marks=pytest.mark.compiler)])
def either_library(request, monkeypatch):
    if request.param == "c":
        assert contact_constraints.row_library.prepare(wait=True)
    else:
        monkeypatch.setattr(
            contact_constraints, "row_library", SimpleNamespace(code=None, prepare=lambda wait: False)
        )


def test_rows_are_the_rates_of_distances(either_library):
    rng, n, pairs, bodies = np.random.default_rng(0), 7, 5, 6
    group, twists = rng.integers(4, size=bodies), rng.normal(size=(4, 6, n))
    margins, witnesses = rng.uniform(-0.1, 0.1, (bodies, bodies)), rng.normal(size=(pairs, 9))
    witnesses[:, 6:] /= np.linalg.norm(witnesses[:, 6:], axis=1)[:, None]
    owners = np.array([rng.choice(bodies, 2, replace=False) for _ in range(pairs)], dtype=np.int32)
    distances = np.array([-0.2, 0.0, 0.02, 0.3, 0.4])
    found = SimpleNamespace(
        distances=distances,
        body_indices=owners,
        witnesses=witnesses,
        points_a=witnesses[:, :3],
        points_b=witnesses[:, 3:6],
        normals=witnesses[:, 6:],
    )
    H, f, A, lower = np.eye(n + 1), np.ones(n + 1), np.zeros((6, n + 1)), np.full(6, -np.inf)
    used = pairs - 1
    rows = ContactRows(group, twists, margins, H, f, A, lower)
    rows.write(found, used, gain=GAIN, recovery=RECOVERY, weight=WEIGHT)
    costs, linear = np.eye(n + 1), np.ones(n + 1)
    for k, (a, b) in enumerate(owners[:used]):
        p, q, normal = witnesses[k].reshape(3, 3)
        for speeds in rng.normal(size=(3, n)):
            (v, w), (u, z) = ((twists[group[body]] @ speeds).reshape(2, 3) for body in (a, b))
            rate = normal @ (u + np.cross(z, q) - v - np.cross(w, p))
            assert A[k, :n] @ speeds == pytest.approx(rate)
        gap = distances[k] - margins[a, b]
        assert lower[k] == pytest.approx(-GAIN * max(gap, 0.0))
        if gap < 0.0:  # half the weight times the squared difference to the wanted rate
            costs += WEIGHT * np.outer(A[k], A[k])
            linear -= WEIGHT * RECOVERY * (contact_constraints.INWARDS - gap) * A[k]
    assert {bool(d < margins[a, b]) for d, (a, b) in zip(distances, owners[:used], strict=False)} == {
        True,
        False,
    }
    np.testing.assert_allclose(H, costs, atol=1e-12)
    np.testing.assert_allclose(f, linear, atol=1e-12)
    assert not A[used:].any()
    assert not A[:, n].any()
    assert np.isinf(lower[used:]).all()


def slab(*size):
    return Body(collisions=(Shape(Box(size), Pose.from_matrix(np.eye(4))),))


@pytest.fixture(scope="module")
def model():
    """A base, 1 m wide, that drives on a floor without a shape, and a wall at x = 1."""
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(OmniBase(name="robot/base", parent="world", child="robot/base", speed=0.5, turn=0.6))
        edit.add_frame("robot/box", "robot/base", np.eye(4), body=slab(0.4, 1.0, 0.2))
        edit.add_frame("wall", "world", kv.translation(1.05, 0, 0), body=slab(0.1, 4, 2))
    return model


def least_distance(model):
    """Return the least distance to the wall of a base that is drawn to it and turned to and fro."""
    x, y, angle = (model.symbol(f"robot/base/{name}") for name in ("x", "y", "angle"))
    swing = kv.control.Target("swing", 0.0)
    tasks = [
        Goal(x, 2.0, name="x"),
        Goal(y, 1.5, name="y", speed=0.1),
        Goal(angle, swing.expression, name="turn", weight=10.0),
    ]
    controller = Controller(model, tasks, dt=0.02, scene=Scene(model), contacts=8)
    state = model.default_state().updated({x: 0.793})
    scene, least = Scene(model), np.inf
    for k in range(200):
        controller.set(swing, 0.3 * (-1.0) ** (k // 3))
        state = model.integrate(state, controller.step(state).speeds, 0.02)
        scene.update(state)
        least = min(least, scene.distance("robot/box", "wall").distance)
    assert state[y] > 0.2
    return least


def test_a_base_that_turns_to_and_fro_beside_a_wall_does_not_touch_it(model, monkeypatch):
    assert least_distance(model) > 2e-3
    monkeypatch.setattr(contact_constraints, "FacingPoints", lambda *_: None)
    assert least_distance(model) < -0.005
