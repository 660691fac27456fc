"""Rules of the collision filter from observations at many states."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

from kineverse.errors import InvalidValueError, NoSolutionError
from kineverse.model.sampling import StateSamples
from kineverse.state import StateLike

from .collision_filter import Rule
from .collision_world import CollisionWorld
from .distance_queries import find_pairs_within
from .mesh_files import Floats

_SAMPLED = 200


def except_never_within(
    world: CollisionWorld, states: Iterable[StateLike] | None, margin: float
) -> tuple[Rule, ...]:
    """Return rules that except the checked pairs that are within a margin [m] at no state."""
    counts, states_count = _count_within(world, states, margin)
    return _make_rules(world, counts == 0, f"never within {margin:g} m at {states_count} states")


def except_always_within(
    world: CollisionWorld, states: Iterable[StateLike] | None, margin: float
) -> tuple[Rule, ...]:
    """Return rules that except the checked pairs that are within a margin [m] at every state."""
    counts, states_count = _count_within(world, states, margin)
    return _make_rules(world, counts == states_count, f"within {margin:g} m at all of {states_count} states")


def _make_rules(world: CollisionWorld, chosen: npt.NDArray[np.bool_], why: str) -> tuple[Rule, ...]:
    pairs = np.argwhere(np.tril(world.table.allowed * chosen)).tolist()
    return tuple(Rule(world.bodies[b], world.bodies[a], False, why) for a, b in pairs)


def _count_within(
    world: CollisionWorld, states: Iterable[StateLike] | None, margin: float
) -> tuple[npt.NDArray[np.int64], int]:
    """Return the numbers of states at which pairs of bodies are within a margin, and that of all states.

    The numbers of pairs, (B, B), are below the diagonal. If no states are given, they are sampled within
    limits; a state at which a loop does not close is left out.
    """
    world.synchronize()
    counts, number = np.zeros((len(world.bodies),) * 2, dtype=np.int64), 0
    for state in _sample_inputs(world) if states is None else states:
        try:
            world.update(state)
        except NoSolutionError:
            if states is None:
                continue
            raise
        near = find_pairs_within(world, margin).body_indices
        # The first body of each result precedes the second.
        counts[near[:, 1], near[:, 0]] += 1
        number += 1
    if not number:
        raise InvalidValueError(
            "Pairs that touch never or always are found by sampling states; none is given."
        )
    return counts, number


def _sample_inputs(world: CollisionWorld) -> Floats:
    """Return values of the world's inputs, the default ones first and then random ones within limits."""
    samples = StateSamples(world.model, count=_SAMPLED)
    return np.stack([np.zeros(samples.size), *map(samples.values_of, world.inputs)], axis=1)[:, 1:]
