"""Pairs of bodies that a planner does not check, since they touch always."""

from __future__ import annotations

from functools import partial

from kineverse.errors import NoSolutionError
from kineverse.geometry import Rule, Scene
from kineverse.lie import Array
from kineverse.model.sampling import StateSamples
from kineverse.state import State

from .configuration import PlanningSpace

_SAMPLES = 64
_APART = 1e-4
"""Distance beyond the margin at which bodies do not just rest on each other [m]."""


def find_overlapping_pairs(scene: Scene, space: PlanningSpace) -> tuple[Rule, ...]:
    """Return rules for pairs of bodies that touch wherever the coordinates are, those of the others as well.

    So a robot that stands in a wall by default, and is placed elsewhere, does not lose the pairs with the
    wall.
    """
    home = scene.model.default_state()
    samples = StateSamples(scene.model, count=_SAMPLES)
    columns = {s: samples.values_of(s).tolist() for s in home if s.has_derivative and not s.order}
    states = [home.updated({s: values[k] for s, values in columns.items()}) for k in range(samples.size)]
    pairs = {frozenset(pair) for pair in scene.pairs_affected_by(space.symbols)}
    found = scene.find_always_colliding(filter(partial(_has_poses, scene), states))
    return tuple(rule for rule in found if frozenset((rule.a, rule.b)) in pairs)


def find_separate_pairs(
    scene: Scene, space: PlanningSpace, rules: tuple[Rule, ...], state: State, Q: Array, margin: float
) -> frozenset[frozenset[str]]:
    """Return the pairs of bodies of some rules that are apart at some of the configurations (N, n) [m].

    Samples miss a small gap, in which a start may be.
    """
    found = set()
    for q in Q if rules else ():
        if _has_poses(scene, state.updated(dict(zip(space.symbols, q.tolist(), strict=True)))):
            results = scene.distances((rule.a, rule.b) for rule in rules)
            found |= {frozenset((r.a, r.b)) for r in results if r.distance > margin + _APART}
    return frozenset(found)


def _has_poses(scene: Scene, state: State) -> bool:
    """Return True if all loops close at a state."""
    try:
        scene.update(state)
    except NoSolutionError:
        return False
    return True
