"""Random lockboxes of any shape, their rules, and exhaustive search on their own data, without a model."""

from itertools import pairwise
from types import MappingProxyType

import numpy as np

import kineverse as kv
from kineverse.gallery.lockboxes import Condition, Lockbox, Slider
from kineverse.reasoning import Interval
from kineverse.reasoning.cell_graph import CellGraph, make_graph
from kineverse.reasoning.interlock import Undecided
from kineverse.reasoning.move_rules import MoveRule, relevant_rules


def draw_any_box(parts: int, seed: int, most: int = 3) -> Lockbox:
    """Return a box with conditions on any parts, circles included, in both directions."""
    rng = np.random.default_rng(seed)
    names = [f"p{k}" for k in range(parts)]
    drawn = {}
    for k, name in enumerate(names):
        others = [j for j in rng.permutation(parts).tolist() if j != k]
        groups: list[tuple[Condition, ...]] = []
        for j in others[: int(rng.integers(most + 1))]:
            condition = Condition(names[j], round(float(rng.uniform(0.2, 0.8)), 1), bool(rng.random() < 0.5))
            if groups and rng.random() < 0.3:
                groups[-1] += (condition,)
            else:
                groups.append((condition,))
        blocks = "both" if rng.random() < 0.5 else "forward"
        drawn[name] = Slider(groups=tuple(groups), blocks=blocks)
    return Lockbox(MappingProxyType(drawn), {names[-1]: 1.0})


def box_graph(box: Lockbox) -> CellGraph:
    """Return the graph of a box from its data, a thousand times as fast as from its model."""
    q = {name: kv.position(name) for name in box.parts}
    rules = []
    for name, part in box.parts.items():
        for group in part.groups:
            shut: dict[kv.Symbol, Interval] = {}
            for c in group:
                below = Interval(upper=c.threshold, upper_closed=True)
                side = below if c.beyond else Interval(lower=c.threshold, lower_closed=True)
                shut[q[c.part]] = shut.get(q[c.part], Interval()).intersection(side)
            if not any(side.is_empty for side in shut.values()):
                lock = Undecided(name, "")
                rules.append(MoveRule("up", q[name], shut, lock))
                if part.blocks == "both":
                    rules.append(MoveRule("down", q[name], shut, lock))
    limits = {q[name]: Interval(0.0, part.upper, True, True) for name, part in box.parts.items()}
    goals = {q[name]: value for name, value in box.goal.items()}
    coordinates, about = relevant_rules(rules, goals)
    return make_graph(coordinates, about, limits, dict.fromkeys(coordinates, 0.0), goals)


def can_be_opened(box: Lockbox) -> bool:
    """Return whether a box can be opened, by exhaustive search over positions between the thresholds."""
    places = {}
    for name, part in box.parts.items():
        every = (c for p in box.parts.values() for group in p.groups for c in group)
        cuts = sorted({c.threshold for c in every if c.part == name})
        middles = [(a + b) / 2 for a, b in pairwise(cuts)]
        places[name] = [0.0, *middles, part.upper]
    names = list(places)

    def is_open(state: dict[str, float], part: Slider) -> bool:
        return all(any((state[c.part] > c.threshold) == c.beyond for c in group) for group in part.groups)

    start = (0,) * len(names)
    seen, waiting = {start}, [start]
    while waiting:
        here = waiting.pop()
        state = {name: places[name][k] for name, k in zip(names, here, strict=True)}
        if all(state[name] == value for name, value in box.goal.items()):
            return True
        for n, name in enumerate(names):
            part = box.parts[name]
            free = is_open(state, part)
            for way in (1, -1):
                after = (*here[:n], here[n] + way, *here[n + 1 :])
                inside = 0 <= after[n] < len(places[name])
                if inside and (free or (way < 0 and part.blocks == "forward")) and after not in seen:
                    seen.add(after)
                    waiting.append(after)
    return False
