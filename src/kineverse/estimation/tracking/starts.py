"""Where to begin looking: angles from several values, as one may lead astray."""

from __future__ import annotations

import itertools
import math

import numpy as np

from kineverse.errors import KineverseError
from kineverse.estimation.noise import Array
from kineverse.symbols import Symbol

from .belief import Belief
from .charted import Charted
from .layout import Layout
from .limits import Limits
from .modes import MOST_MODES, Modes
from .residuals import Residuals

# Starts of an angle are no further apart than this [rad].
_APART = math.pi / 2
_SAME = 1e-9


def turning(
    layout: Layout, limits: Limits, residuals: Residuals, x: Array, known: Array
) -> frozenset[Symbol]:
    """Return the coordinates without limits that come back after a turn: nothing looks different then."""
    free = [i for i in range(len(x)) if np.isinf(limits.lower[i]) and np.isinf(limits.upper[i])]
    found = []
    for i in free:
        symbol = layout.chart.coordinates[i]
        if symbol in layout.chart.by_speeds:
            continue
        there = x.copy()
        there[i] += 2 * math.pi
        try:
            change = np.abs(residuals.evaluate(there, known) - residuals.evaluate(x, known)).max()
        except KineverseError:  # a loop that does not close there
            continue
        if change < _SAME * (1 + np.abs(x).max()):
            found.append(symbol)
    return frozenset(found)


def starts(
    layout: Layout, limits: Limits, charted: Charted, first: Belief, known: Array, turns: frozenset[Symbol]
) -> Modes:
    """Return beliefs about several places, all of the same Gaussian."""
    beliefs, alive = [first], [np.ones(len(layout.groups), dtype=bool)]
    for number, group in enumerate(layout.groups):
        steps = [_steps_of(layout, limits, first, i, turns) for i in group.x]
        if group.by_speeds:
            steps = [
                [0.0] if x in layout.chart.by_speeds else s
                for x, s in zip(group.coordinates, steps, strict=True)
            ]
        own = [(x, None) for x in itertools.product(*steps)][:MOST_MODES]
        offsets = [_in_tangent(layout, number, np.array(x)) for x, _ in own]
        offsets += _half_turns(layout, number)
        for mode, offset in enumerate(offsets[1:], 1):
            if mode == len(beliefs):
                beliefs.append(first.copy())
                alive.append(np.zeros(len(layout.groups), dtype=bool))
            alive[mode][number] = True
            x, turn = charted.step(number, first.x[group.x], offset, known)
            moved = first.part(group.t).carried(offset, turn)
            beliefs[mode].x[group.x] = x
            beliefs[mode].put(group.t, moved)
    return Modes(layout, beliefs, np.array(alive))


def _steps_of(layout: Layout, limits: Limits, first: Belief, i: int, turns: frozenset[Symbol]) -> list[float]:
    """Return how far from the first place others are to be tried, itself first."""
    low, high = limits.lower[i], limits.upper[i]
    if layout.chart.coordinates[i] in turns:
        return [0.0, math.pi / 2, math.pi, -math.pi / 2]
    if not math.isfinite(high - low) or high - low <= 2 * _APART + _SAME:
        return [0.0]
    count = math.ceil((high - low) / _APART)
    middles = low + (np.arange(count) + 0.5) * (high - low) / count - first.x[i]
    return [0.0, *middles.tolist()][:MOST_MODES]


def _in_tangent(layout: Layout, number: int, change: Array) -> Array:
    """Return a step that changes coordinates that are their own tangent."""
    group = layout.groups[number]
    step = np.zeros(len(group.tangent))
    for x, by in zip(group.coordinates, change.tolist(), strict=True):
        if x not in layout.chart.by_speeds:
            step[group.tangent.index(x.derivative())] = by
    return step


def _half_turns(layout: Layout, number: int) -> list[Array]:
    """Return steps to the other sides of what moves by others' speeds, such as quaternions."""
    group = layout.groups[number]
    own = {x.derivative() for x in group.coordinates if x not in layout.chart.by_speeds}
    found: list[Array] = []
    for k, speed in enumerate(group.tangent):
        if speed not in own and len(found) < MOST_MODES // 2:
            step = np.zeros(len(group.tangent))
            step[k] = math.pi
            found.append(step)
    return found
