"""Small models for planners, and contacts by the collision scene."""

from __future__ import annotations

import itertools

import numpy as np

import kineverse as kv
from kineverse.geometry import Scene
from kineverse.model.body import (
    Body,
    Box,
    Capsule,
    Cone,
    Cylinder,
    Ellipsoid,
    Geometry,
    Mesh,
    Pose,
    Shape,
    Sphere,
)
from kineverse.planning import Planner
from kineverse.planning.state_validity import densify

SOLIDS = (
    Box((0.2, 0.3, 0.1)),
    Cylinder(0.08, 0.3),
    Capsule(0.06, 0.2),
    Sphere(0.12),
    Ellipsoid((0.15, 0.08, 0.1)),
    Cone(0.12, 0.25),
)


def body(*geometries: Geometry, at: tuple[float, float, float] = (0, 0, 0)) -> Body:
    origin = Pose.from_matrix(np.array(kv.translation(*at)()))
    return Body(collisions=tuple(Shape(geometry, origin) for geometry in geometries))


def arm_among_shapes(hull: Mesh) -> kv.Model:
    """An arm of six shapes with a mimic finger on a base that is placed, and shapes around it, most of them turned."""
    rng = np.random.default_rng(3)
    base, finger = kv.position("base"), kv.position("j1") / 4
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("room", "world", kv.translation(base, -base, 0))
        parent, links = (
            "room",
            (Capsule(0.04, 0.2), Box((0.06, 0.06, 0.2)), Cylinder(0.04, 0.2), Ellipsoid((0.05, 0.05, 0.1))),
        )
        for k, shape in enumerate(links):
            turn = (kv.rotation_y if k % 2 else kv.rotation_z)(kv.position(f"j{k}"))
            edit.add_frame(
                f"link{k}",
                parent,
                kv.translation(0, 0, 0.25 if k else 0) @ turn,
                body(shape, at=(0, 0, 0.125)),
            )
            parent = f"link{k}"
        edit.add_frame("hand", parent, kv.translation(0, 0, 0.27), body(Cone(0.03, 0.05), at=(0, 0, 0.02)))
        edit.add_frame("finger", "hand", kv.translation(0, finger + 0.1, 0.05), body(Sphere(0.02)))
        for k, shape in enumerate((*SOLIDS, hull, SOLIDS[0], SOLIDS[1])):
            way = rng.standard_normal(3)
            place = kv.translation(*(0.65 * way / np.linalg.norm(way)))
            turn = np.eye(4) if k >= 7 else kv.rotation_x(float(rng.uniform(0, 3))) @ kv.rotation_y(k)
            edit.add_frame(f"shape{k}", "room", place @ turn, body(shape))
        edit.add_frame("cart", "room", kv.translation(kv.position("cart"), 0, 0), body(Box((0.1, 0.1, 2.0))))
    return model


def ball_and_plate() -> kv.Model:
    """A small ball that moves in a plane, with a plate of 0.1 mm that has an end, and an arm that turns fully."""
    x, y, turn = kv.position("x"), kv.position("y"), kv.position("turn")
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("ball", "world", kv.translation(x, y, 0), body(Sphere(0.01)))
        edit.add_frame("plate", "world", np.eye(4), body(Box((1e-4, 2.0, 1.0))))
        edit.add_frame(
            "arm",
            "world",
            kv.translation(0, 0, 3) @ kv.rotation_z(turn),
            body(Capsule(0.05, 0.1), at=(0.5, 0, 0)),
        )
        edit.add_frame("post", "world", kv.translation(-0.5, -0.1, 3), body(Sphere(0.02)))
    return model


def contacts(planner: Planner, points: np.ndarray, scene: Scene | None = None) -> np.ndarray:
    """Return the deepest distance of a pair at each configuration, by a scene of its own; infinite beyond 1 m."""
    scene = scene or Scene(planner.model, rules=planner.excluded)
    state, found, query = planner.planning_scene.state, [], None
    for q in points:
        scene.update(state.updated(dict(zip(planner.symbols, q.tolist(), strict=True))))
        query = query or scene.watch(moving=planner.symbols, radius=1.0)
        results = query()
        found.append(results[0].distance if len(results) else np.inf)
    return np.array(found)


def is_free(planner: Planner, points: np.ndarray, samples: float = 640.0) -> bool:
    """Return True if the scene finds no contact on a polyline, 20 times finer than the planner's samples."""
    return bool((contacts(planner, densify(points, 1 / samples)) > 0).all())


def grid(*axes: np.ndarray) -> np.ndarray:
    return np.array(list(itertools.product(*axes)))
