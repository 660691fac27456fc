"""Initial angles of a multi-start, and periodic coordinates."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable

import numpy as np

from kineverse.errors import KineverseError
from kineverse.lie import Array
from kineverse.symbols import Symbol

from .gaussian import InformationState
from .gaussian_sum import GaussianSum
from .layout import CoordinateGroup, Layout
from .measurements import wrap_difference
from .step import UpdateStep

# Starts are no further apart than this [rad], of an angle that may be anywhere.
_APART = math.pi / 2
_MOST_STARTS = 32
# Nobody is so many deviations from where one was told to begin.
_FARTHEST = 5.5
_SAME = 1e-9
# Where between limits that is looked at.
_SHARES = (0.125, 0.375, 0.625, 0.875)


def find_periodic_coordinates(filter_: UpdateStep, x: Array, known: Array) -> frozenset[Symbol]:
    """Return the coordinates without limits that come back after a turn: nothing looks different then."""
    chart, limits = filter_.layout.chart, filter_.limits
    free = np.flatnonzero(np.isinf(limits.lower) & np.isinf(limits.upper))
    found = []
    for i in free.tolist():
        there = x.copy()
        there[i] += 2 * math.pi
        try:
            before, after = (filter_.residuals.evaluate(at, known) for at in (x, there))
        except KineverseError:  # a loop that does not close there
            continue
        with np.errstate(invalid="ignore"):  # where the model says nothing finite
            change = np.abs(_difference(filter_.layout, before, after)).max()
        is_same = change < _SAME * (1 + np.abs(x).max())
        if is_same and chart.coordinates[i] not in chart.by_speeds:
            found.append(chart.coordinates[i])
    return frozenset(found)


def _difference(layout: Layout, before: Array, after: Array) -> Array:
    """Return by how much a model says something else than before."""
    found = after - before
    for one, where in zip(layout.observations, layout.value_slices, strict=True):
        found[where] = wrap_difference(found[where], one.period)
    return found


def spread_starts(filter_: UpdateStep, first: InformationState, known: Array) -> GaussianSum:
    """Return beliefs about several places, all of the same Gaussian, the given one first."""
    layout = filter_.layout
    beliefs, alive = [first], [np.ones(len(layout.groups), dtype=bool)]
    ambiguous = _find_ambiguous(filter_, first, known)
    for number, group in enumerate(layout.groups):
        steps = [_steps_of(filter_, first, i, i in ambiguous) for i in group.x]
        offsets = [_in_tangent(layout, number, np.array(x)) for x in _some(itertools.product(*steps))]
        mode = 0
        for offset in offsets[1:] + _half_turns(layout, number):
            if np.abs(offset / filter_.openness.deviations[group.t]).max() > _FARTHEST:
                continue
            x, turn = filter_.charted.step(number, first.x[group.x], offset, known)
            there = first.copy()
            there.x[group.x] = x
            if not filter_.is_possible(number, there, known):
                continue
            mode += 1
            if mode == len(beliefs):
                beliefs.append(first.copy())
                alive.append(np.zeros(len(layout.groups), dtype=bool))
            alive[mode][number] = True
            beliefs[mode].x[group.x] = x
            beliefs[mode].put(group.t, first.part(group.t).carried(offset, turn))
    return GaussianSum(layout, beliefs, np.array(alive))


def _some(places: Iterable[tuple[float, ...]]) -> list[tuple[float, ...]]:
    """Return as many places as there may be, from all over, the first one first."""
    every = list(itertools.islice(places, 4096))
    step = math.ceil(len(every) / _MOST_STARTS)
    return every[::step]


def _find_ambiguous(filter_: UpdateStep, first: InformationState, known: Array) -> set[int]:
    """Return the coordinates of which something that is seen goes back while they go on between their limits.

    So the distance from a place says the same on both sides of it. Groups are looked at all at once.
    """
    layout, limits = filter_.layout, filter_.limits
    width = limits.upper - limits.lower
    found: set[int] = set()
    for k in range(max(len(group.x) for group in layout.groups)):
        groups = [
            g for g in layout.groups if k < len(g.x) and g.own_place(k) >= 0 and np.isfinite(width[g.x[k]])
        ]
        said: list[Array] = []
        for share in _SHARES if groups else ():
            x = first.x.copy()
            for group in groups:
                x[group.x[k]] = limits.lower[group.x[k]] + share * width[group.x[k]]
            try:
                said.append(filter_.residuals.evaluate(x, known))
            except KineverseError:  # nobody can be there
                continue
        if said:
            found.update(int(g.x[k]) for g in groups if _goes_back(layout, g, g.own_place(k), np.array(said)))
    return found


def _goes_back(layout: Layout, group: CoordinateGroup, column: int, said: Array) -> bool:
    """Whether something that is seen has opposite slopes at two places, or jumps against them in between."""
    for i in group.seen:
        one = layout.observations[i]
        slopes = said[:, layout.slope_slices[i]].reshape(len(said), one.size, -1)[:, :, column]
        white = np.linalg.inv(np.linalg.cholesky(one.covariance))
        with np.errstate(invalid="ignore"):  # where the model says nothing finite
            slopes = slopes @ white.T
            if (slopes @ slopes.T < 0.0).any():
                return True
            if not one.is_pose:
                changes = (
                    wrap_difference(np.diff(said[:, layout.value_slices[i]], axis=0), one.period) @ white.T
                )
                if (np.einsum("ij,ij->i", changes, slopes[1:] + slopes[:-1]) < 0.0).any():
                    return True
    return False


def _steps_of(filter_: UpdateStep, first: InformationState, i: int, is_ambiguous: bool) -> list[float]:
    """Return how far from the first place of a coordinate others are to be tried, itself first."""
    coordinate = filter_.layout.chart.coordinates[i]
    if coordinate in filter_.layout.chart.by_speeds:
        return [0.0]
    if coordinate in filter_.turns:
        return [0.0, math.pi / 2, math.pi, -math.pi / 2]
    low, high = filter_.limits.lower[i], filter_.limits.upper[i]
    if not math.isfinite(high - low):
        return [0.0]
    if high - low <= 2 * _APART + _SAME:
        return [0.0, *(low + share * (high - low) - first.x[i] for share in _SHARES if is_ambiguous)]
    count = min(math.ceil((high - low) / _APART), _MOST_STARTS - 1)
    middles = low + (np.arange(count) + 0.5) * (high - low) / count - first.x[i]
    return [0.0, *middles.tolist()]


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
    found = []
    for k in group.driven:
        step = np.zeros(len(group.tangent))
        step[k] = math.pi
        found.append(step)
    return found
