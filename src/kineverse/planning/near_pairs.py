"""Pairs of bodies that a planner does not check by spheres: they touch always, or are always near."""

from __future__ import annotations

from functools import partial

import numpy as np

from kineverse.errors import NoSolutionError
from kineverse.geometry import Rule, Scene
from kineverse.model.sampling import StateSamples
from kineverse.state import State

from .checker import CollisionChecker
from .configuration import PlanningSpace
from .judge import SceneJudge

_SAMPLES = 64
_NEARLY_ALWAYS = 0.9
"""Share of configurations from which on pairs of spheres count as always touching."""


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


def leave_near_pairs(checker: CollisionChecker, space: PlanningSpace) -> None:
    """Leave to the scene the pairs whose spheres nearly always touch where the bodies themselves do not.

    Such are the links around a wrist, a few millimetres apart. Of a pair that one coordinate moves, and whose
    bodies touch nowhere on its range, nothing is left to check.
    """
    generator = np.random.default_rng(1)
    home = checker.scene.model.default_state()
    start = home.vector(space.symbols)
    checker.place(home)
    Q = generator.uniform(*space.bounds(start, start[None]), (_SAMPLES, len(start)))
    counts = checker.count_touching(np.ascontiguousarray(Q, dtype=np.float32))
    near = [pair for pair, count in counts.items() if count >= _NEARLY_ALWAYS * _SAMPLES]
    judged = SceneJudge(checker.scene, space.symbols, (), near)
    judged.place(home)
    touching = (
        [{frozenset((c.a, c.b)) for c in judged.uncovered_contacts(q) or ()} for q in Q] if near else []
    )
    apart = [p for p in near if sum(frozenset(p) in t for t in touching) < 0.5 * _SAMPLES]
    checker.leave_to_scene(apart)
    for pair in apart:
        columns = columns_between(space, *pair)
        if len(columns) == 1:
            own = SceneJudge(checker.scene, space.symbols, (), [pair])
            own.place(home)
            low, high = space.bounds(start, start[None])
            ends = own.free_interval(start, columns[0], low[columns[0]], high[columns[0]])
            if ends == (low[columns[0]], high[columns[0]]):
                checker.uncovered.remove(pair)


def columns_between(space: PlanningSpace, a: str, b: str) -> list[int]:
    """Return the columns of the coordinates that move two bodies with respect to each other."""
    moving = {*space.model.fk(a, b).symbols}
    return [k for k, s in enumerate(space.symbols) if s in moving]


def _has_poses(scene: Scene, state: State) -> bool:
    """Return True if all loops close at a state."""
    try:
        scene.update(state)
    except NoSolutionError:
        return False
    return True
