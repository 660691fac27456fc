"""Heights of a hand and of an object: whether a robot is too low for what it has to touch."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import product

import numpy as np

from kineverse.geometry import Scene
from kineverse.grasping import Gripper
from kineverse.lie import Array, inverse
from kineverse.state import State
from kineverse.symbols import Symbol

from .hand_paths import HandPaths

_ARMS = 200
"""Number of random arms from which the highest one is sought."""
_STEPS = np.geomspace(0.5, 2e-3, 60)
"""Largest changes of a coordinate in the steps of the ascent [m], [rad]."""


def find_highest_reach(scene: Scene, paths: HandPaths, gripper: Gripper, state: State) -> float:
    """Return the greatest height of a point of a gripper over all arms [m].

    It is sought by steepest ascent from random arms. Boxes stand for the shapes, so the height is rather too
    great than too small. Contacts are left out.
    """
    hand_T_world = inverse(np.asarray(scene.model.fk(gripper.hand)(state)))
    corners = [
        _find_corners(scene, gripper.bodies, state.updated(gripper.values_at(gap)))
        for gap in (0.0, gripper.width)
    ]
    points = np.vstack(corners) @ hand_T_world[:3, :3].T + hand_T_world[:3, 3]
    random = np.random.default_rng(0)
    bounded = np.isfinite(paths.lower) & np.isfinite(paths.upper)
    lower, upper = np.where(bounded, paths.lower, -np.pi), np.where(bounded, paths.upper, np.pi)
    Q = random.uniform(lower, upper, (_ARMS, len(lower)))
    highest = -np.inf
    for most in _STEPS.tolist():
        heights, slopes = paths.find_heights(Q, state.vector(paths.still), points)
        highest = max(highest, float(heights.max()))
        outward = ((paths.lower >= Q) & (slopes < 0.0)) | ((paths.upper <= Q) & (slopes > 0.0))
        slopes = np.where(outward, 0.0, slopes)
        steepest = np.abs(slopes).max(axis=1, initial=1e-9)
        Q = np.clip(Q + most * slopes / steepest[:, None], paths.lower, paths.upper)
    return highest


def find_highest_passage(
    scene: Scene, bodies: Iterable[str], state: State, coordinate: Symbol, values: Array
) -> tuple[float, float]:
    """Return the value (of some) at which an object is the highest, and the height of its lowest point [m]."""
    names = tuple(bodies)
    lowest = [
        _find_corners(scene, names, state.updated({coordinate: v}))[:, 2].min() for v in values.tolist()
    ]
    highest = int(np.argmax(lowest))
    return float(values[highest]), float(lowest[highest])


def _find_corners(scene: Scene, bodies: Iterable[str], state: State) -> Array:
    """Return the corners (N, 3) of the boxes around the shapes of bodies at a state, in the world."""
    scene.update(state)
    world = scene.collision_world
    world.prepare()
    signs = np.array(list(product((-1.0, 1.0), repeat=3)))
    found = []
    for body in bodies:
        for item in world.members[world.body_index(body)] if body in world.bodies else ():
            solid, pose = world.solid(item), world.table.poses[item]
            found.append((solid.centre + signs * solid.half) @ pose[:, :3].T + pose[:, 3])
    return np.vstack(found)
