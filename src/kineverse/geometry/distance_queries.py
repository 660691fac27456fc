"""Distance queries between bodies: bounds first, exact distances for the rest."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from kineverse.errors import InvalidValueError

from .bindings import collision_library
from .broadphase import Flags, Indices
from .collision_world import CollisionWorld
from .mesh_files import Floats
from .narrowphase import ACCURACY
from .results import DistanceResult, DistanceResults


def find_distance(mirror: CollisionWorld, a: str, b: str) -> DistanceResult:
    """Return how near two bodies are, whatever the rules say."""
    one, other = mirror.number(a), mirror.number(b)
    if one == other:
        raise InvalidValueError(f"'{a}' is asked for its distance to itself.")
    members, others = mirror.members[one], mirror.members[other]
    mirror.ready((*members, *others))
    pairs = _pair_product(members, others)
    radius, lows = math.inf, np.full(len(pairs), -math.inf)
    if len(pairs) > 1:
        # The two that may be nearest say how near the others would have to be.
        lows = mirror.table.lower_bounds(pairs[:, 0], pairs[:, 1])
        radius = _least_distance(mirror, pairs[[np.argmin(lows)]]) + ACCURACY
        near = lows <= radius
        pairs, lows = pairs[near], lows[near]
    (found,) = _nearest_pairs(mirror, pairs, lows, radius)
    return found if found.a == a else found.swapped()


def find_pairs_within(mirror: CollisionWorld, radius: float, wanted: Flags | None = None) -> DistanceResults:
    """Return the pairs of bodies within a radius [m], nearest first.

    Those that are looked at; or of these only some, (B, B) flags.
    """
    _check_radius(radius)
    mirror.ready()
    table = mirror.table
    reach = radius + ACCURACY
    pairs, lows, distances, witnesses, nearest = collision_library.search(table, reach, radius, wanted)
    if nearest is not None:
        return DistanceResults(mirror, *nearest)
    mirror.measure_rest(pairs, lows, radius, distances, witnesses)
    order = collision_library.rank(table, pairs, distances, radius)
    return _make_results(mirror, pairs, distances, witnesses, order)


def find_first_contact(mirror: CollisionWorld, margin: float) -> DistanceResult | None:
    """Return the first pair found within a margin [m], in the order of the pieces; None if there is none."""
    _check_radius(margin)
    mirror.ready()
    pairs, _ = collision_library.near(mirror.table, margin + ACCURACY)
    pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
    distances, witnesses = collision_library.measure(mirror.table, pairs, margin)
    for k in np.flatnonzero(~(distances > margin)).tolist():
        only = slice(k, k + 1)
        if math.isnan(distances[k]):
            mirror.measure_rest(pairs[only], np.zeros(1), margin, distances[only], witnesses[only])
        if distances[k] <= margin:
            return _make_results(
                mirror, pairs[only], distances[only], witnesses[only], np.zeros(1, dtype=np.int64)
            )[0]
    return None


def find_distances_to(mirror: CollisionWorld, body: str, radius: float) -> list[DistanceResult]:
    """Return how near the others are to one body, nearest first."""
    _check_radius(radius)
    one = mirror.number(body)
    mirror.ready()
    table = mirror.table
    pairs = _pair_product(mirror.members[one], np.flatnonzero(table.allowed[one][table.body] == 1).tolist())
    lows = table.lower_bounds(pairs[:, 0], pairs[:, 1])
    near = lows <= radius + ACCURACY
    nearest = _nearest_pairs(mirror, pairs[near], lows[near], radius)
    return [found if found.a == body else found.swapped() for found in nearest]


def _pair_product(members: list[int], others: list[int]) -> Indices:
    """Return all pairs of two lists, (K, 2), the smaller number first."""
    left, right = np.repeat(members, len(others)), np.tile(others, len(members))
    return np.stack([np.minimum(left, right), np.maximum(left, right)], axis=1).astype(np.int32)


def _least_distance(mirror: CollisionWorld, pairs: Indices) -> float:
    return float(mirror.measure(pairs, np.zeros(len(pairs)), math.inf)[0].min())


def _nearest_pairs(mirror: CollisionWorld, pairs: Indices, lows: Floats, radius: float) -> DistanceResults:
    """Measure pairs of pieces, and return the nearest ones of each pair of bodies within a radius [m]."""
    distances, witnesses = mirror.measure(pairs, lows, radius)
    order = collision_library.rank(mirror.table, pairs, distances, radius)
    return _make_results(mirror, pairs, distances, witnesses, order)


def _make_results(
    mirror: CollisionWorld, pairs: Indices, distances: Floats, witnesses: Floats, order: npt.NDArray[np.int64]
) -> DistanceResults:
    return DistanceResults(
        mirror, *collision_library.gather(mirror.table, pairs, distances, witnesses, order)
    )


def _check_radius(radius: float) -> None:
    if not radius >= 0.0:
        raise InvalidValueError(f"A radius is a distance from 0 on [m], not {radius!r}.")
