"""Distance queries between bodies: bounds first, exact distances for the rest."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from kineverse.errors import InvalidValueError

from .bindings import FacingPoints, collision_library
from .broadphase import Indices, PairSelection
from .collision_world import CollisionWorld
from .mesh_files import Floats
from .narrowphase import ACCURACY
from .results import DistanceResult, DistanceResults


def find_distance(world: CollisionWorld, a: str, b: str) -> DistanceResult:
    """Return the distance of two bodies, regardless of the rules."""
    one, other = world.body_index(a), world.body_index(b)
    if one == other:
        raise InvalidValueError(f"'{a}' is asked for its distance to itself.")
    members, others = world.members[one], world.members[other]
    world.prepare((*members, *others))
    pairs = _pair_product(members, others)
    radius, lows = math.inf, np.full(len(pairs), -math.inf)
    if len(pairs) > 1:
        # The distance of the most promising pair bounds the answer from above.
        lows = world.table.lower_bounds(pairs[:, 0], pairs[:, 1])
        radius = _least_distance(world, pairs[[np.argmin(lows)]]) + ACCURACY
        near = lows <= radius
        pairs, lows = pairs[near], lows[near]
    (found,) = _nearest_pairs(world, pairs, lows, radius)
    return found if found.a == a else found.swap()


def find_pairs_within(
    world: CollisionWorld,
    radius: float,
    selection: PairSelection | None = None,
    per_shape: bool = False,
    facing: FacingPoints | None = None,
) -> DistanceResults:
    """Return the pairs of bodies within a radius [m], nearest first.

    All checked pairs are searched, or only the selected ones. If ``per_shape``, the results are all pairs of
    collision objects, else the nearest of each pair of bodies. Selected objects have solids already. With
    ``facing``, near pairs have further facing points.
    """
    check_radius(radius)
    world.prepare(None if selection is None else ())
    table = world.table
    reach = radius + ACCURACY
    measured, nearest = collision_library.search(table, reach, radius, selection, per_shape, facing)
    if measured is None:
        assert nearest is not None
        return DistanceResults(world, *nearest)
    pairs, lows, distances, witnesses = measured
    world.measure_remaining(pairs, lows, radius, distances, witnesses, per_shape)
    order = collision_library.rank(table, pairs, distances, radius, per_shape)
    ranked = collision_library.gather(table, pairs, distances, witnesses, order)
    return DistanceResults(
        world, *(ranked if facing is None else collision_library.extend(table, ranked, facing))
    )


def find_first_contact(world: CollisionWorld, margin: float) -> DistanceResult | None:
    """Return the first pair within a margin [m], in the order of the objects; None if there is none."""
    check_radius(margin)
    world.prepare()
    pairs, _ = collision_library.near(world.table, margin + ACCURACY)
    pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
    distances, witnesses = collision_library.measure(world.table, pairs, margin)
    for k in np.flatnonzero(~(distances > margin)).tolist():
        only = slice(k, k + 1)
        if math.isnan(distances[k]):
            world.measure_remaining(pairs[only], np.zeros(1), margin, distances[only], witnesses[only])
        if distances[k] <= margin:
            return _make_results(
                world, pairs[only], distances[only], witnesses[only], np.zeros(1, dtype=np.int64)
            )[0]
    return None


def find_distances_to(world: CollisionWorld, body: str, radius: float) -> list[DistanceResult]:
    """Return the distances of one body to the others within a radius [m], nearest first."""
    check_radius(radius)
    one = world.body_index(body)
    world.prepare()
    table = world.table
    pairs = _pair_product(world.members[one], np.flatnonzero(table.allowed[one][table.body] == 1).tolist())
    lows = table.lower_bounds(pairs[:, 0], pairs[:, 1])
    near = lows <= radius + ACCURACY
    nearest = _nearest_pairs(world, pairs[near], lows[near], radius)
    return [found if found.a == body else found.swap() for found in nearest]


def _pair_product(members: list[int], others: list[int]) -> Indices:
    """Return all pairs of two lists, (K, 2), the smaller number first."""
    left, right = np.repeat(members, len(others)), np.tile(others, len(members))
    return np.stack([np.minimum(left, right), np.maximum(left, right)], axis=1).astype(np.int32)


def _least_distance(world: CollisionWorld, pairs: Indices) -> float:
    return float(world.measure(pairs, np.zeros(len(pairs)), math.inf)[0].min())


def _nearest_pairs(world: CollisionWorld, pairs: Indices, lows: Floats, radius: float) -> DistanceResults:
    """Measure pairs of objects, and return the nearest of each pair of bodies within a radius [m]."""
    distances, witnesses = world.measure(pairs, lows, radius)
    order = collision_library.rank(world.table, pairs, distances, radius)
    return _make_results(world, pairs, distances, witnesses, order)


def _make_results(
    world: CollisionWorld, pairs: Indices, distances: Floats, witnesses: Floats, order: npt.NDArray[np.int64]
) -> DistanceResults:
    return DistanceResults(world, *collision_library.gather(world.table, pairs, distances, witnesses, order))


def check_radius(radius: float) -> None:
    """Raise InvalidValueError for a radius that is negative or NaN."""
    if not radius >= 0.0:
        raise InvalidValueError(f"A radius is a distance from 0 on [m], not {radius!r}.")
