"""Small models for scenes, and brute-force distances."""

from __future__ import annotations

import itertools

import numpy as np

import kineverse as kv
from kineverse.geometry import DistanceResult, Scene
from kineverse.geometry.narrowphase import Narrowphase
from kineverse.geometry.shapes import solid_from_geometry
from kineverse.model.body import Body, Box, Capsule, Cylinder, Geometry, Pose, Shape, Sphere


def body(*geometries: Geometry, at: tuple[float, float, float] = (0, 0, 0)) -> Body:
    origin = Pose.from_matrix(np.array(kv.translation(*at)()))
    return Body(collisions=tuple(Shape(geometry, origin) for geometry in geometries))


def arm_among_boxes(links: int = 5, boxes: int = 8, seed: int = 0) -> kv.Model:
    """A chain of capsules with a hand of two shapes that slides on a rail, among boxes; and a free ball."""
    rng, model = np.random.default_rng(seed), kv.Model()
    with model.edit() as edit:
        rail = kv.position("rail")
        edit.add_frame("base", "world", kv.translation(rail, 0, 0.1), body(Box((0.2, 0.2, 0.2))))
        parent, offset = "base", 0.12
        for k in range(links):
            turn = (kv.rotation_y if k % 2 else kv.rotation_z)(kv.position(f"j{k}"))
            link = body(Capsule(0.04, 0.2), at=(0, 0, 0.1))
            edit.add_frame(f"link{k}", parent, kv.translation(0, 0, offset) @ turn, link)
            parent, offset = f"link{k}", 0.25
        hand = body(Box((0.1, 0.2, 0.02)), Cylinder(0.03, 0.1))
        edit.add_frame("hand", parent, kv.translation(0, 0, 0.22), hand)
        for k in range(boxes):
            place = kv.translation(*rng.uniform(-0.8, 0.8, 3)) @ kv.rotation_x(float(rng.uniform(0, 3)))
            edit.add_frame(f"box{k}", "world", place, body(Box(tuple(rng.uniform(0.05, 0.4, 3).tolist()))))
        edit.apply(kv.Floating(name="ball", parent="world", child="ball"))
        edit.add_frame("ball/body", "ball", np.eye(4), body(Sphere(0.1)))
    return model


def random_state(model: kv.Model, rng: np.random.Generator) -> kv.State:
    state = model.default_state()
    values = {s: float(rng.uniform(-0.8, 0.8)) for s in state}
    return state.updated(values)


def brute_force(scene: Scene, state: kv.State) -> dict[tuple[str, str], float]:
    """Return the distances of all checked pairs of bodies, every pair of shapes measured."""
    model, placed = scene.model, []
    for name in scene.bodies:
        world_T_body = model.fk(name)(state)
        shapes = model.bodies[name].collisions or model.bodies[name].visuals
        placed += [
            (name, solid_from_geometry(s.geometry), (world_T_body @ s.origin.matrix)[:3]) for s in shapes
        ]
    narrow = Narrowphase([s for _, s, _ in placed], np.stack([pose for _, _, pose in placed]))
    found: dict[tuple[str, str], float] = {}
    for (i, one), (j, other) in itertools.combinations(enumerate(placed), 2):
        if scene.checks_pair(one[0], other[0]):
            key = one[0], other[0]
            found[key] = min(found.get(key, np.inf), narrow.distance(i, j))
    return found


def by_names(results: list[DistanceResult]) -> dict[frozenset[str], float]:
    return {frozenset((r.a, r.b)): r.distance for r in results}
