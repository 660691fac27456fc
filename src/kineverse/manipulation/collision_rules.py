"""Collision rules of skills: allowed and ignored contact pairs."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from kineverse._names import match_names, matches_pattern
from kineverse.errors import InvalidValueError
from kineverse.geometry import Rule, Scene
from kineverse.state import State

_SAMPLES = 24


def match_bodies(known: Iterable[str], names: str | Iterable[str], argument: str) -> tuple[str, ...]:
    """Return the known bodies that match names or patterns."""
    known = tuple(known)
    matching = match_names(names, known, "body", argument)
    if not matching:
        raise InvalidValueError(f"{argument} lists no body, so nothing may touch the object.")
    return tuple(b for b in known if b in matching)


def find_overlapping_links(scene: Scene, robot_bodies: tuple[str, ...], state: State) -> tuple[Rule, ...]:
    """Return rules for pairs of the robot that overlap at a state, or at all of some random ones."""
    model = scene.model
    watch = scene.watch(robot_bodies, robot_bodies, radius=0.0)
    bounds = [
        (s, *model.limits(s))
        for b in robot_bodies
        for s in model.fk(b).symbols
        if s in model.degrees_of_freedom
    ]
    free = {s: (a, b) for s, a, b in bounds if math.isfinite(a) and math.isfinite(b)}
    generator = np.random.default_rng(0)
    result: list[set[tuple[str, str]]] = []
    for k in range(_SAMPLES):
        values = {s: float(generator.uniform(a, b)) for s, (a, b) in free.items()}
        scene.update(state.updated(values) if k else state)
        result.append({(pair.a, pair.b) for pair in watch()})
    pairs = result[0] | set.intersection(*result[1:])
    return tuple(Rule(a, b, False, "overlapping") for a, b in sorted(pairs))


def furniture_rules(bodies: Iterable[str], robot: Iterable[str]) -> tuple[Rule, ...]:
    """Return rules that except furniture among itself, whose joints keep it apart."""
    robot_bodies = set(robot)
    others = [b for b in bodies if b not in robot_bodies]
    roots = dict.fromkeys(b.split("/")[0] + "/*" if "/" in b else b for b in others)
    if any(matches_pattern(b, tuple(roots)) for b in robot_bodies):
        roots = dict.fromkeys(others)
    names = tuple(roots)
    return tuple(Rule(a, b, False, "furniture") for i, a in enumerate(names) for b in names[i:])
