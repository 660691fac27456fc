"""Coordinates that follow others in loops, to first order, where they were seen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from .rigid import Array

Times = npt.NDArray[np.int_]


class Twists(NamedTuple):
    """Twists of a frame per unit of each of n coordinates, (N, 6, n), at the times of N observations."""

    names: tuple[str, ...]
    times: Times
    twists: Array


class _Slopes(NamedTuple):
    """By how much a coordinate changes with each of those it follows, (N,), at N times."""

    times: Times
    slopes: Mapping[str, Array]


class Followers:
    """Which coordinates follow which others."""

    def __init__(self) -> None:
        self._known: dict[str, _Slopes] = {}

    @property
    def leading(self) -> set[str]:
        """The coordinates that are followed."""
        return {u for known in self._known.values() for u in known.slopes}

    def resolved(self, motion: Twists) -> Twists:
        """Return twists per unit of coordinates that follow no others."""
        times = motion.times
        for x in motion.names:
            if x in self._known:
                times = np.intersect1d(times, self._known[x].times)
        rows = np.searchsorted(motion.times, times)
        columns: dict[str, Array] = {}
        for k, x in enumerate(motion.names):
            for u, slope in self._slopes(x, times).items():
                columns[u] = columns.get(u, 0.0) + motion.twists[rows, :, k] * slope[:, None]
        return Twists(tuple(columns), times, np.stack([*columns.values()], axis=2))

    def add(self, motion: Twists, columns: Sequence[int], slopes: Array) -> None:
        """Have some columns follow the others, by slopes (N, followers, leaders)."""
        leads = [x for k, x in enumerate(motion.names) if k not in columns]
        new = {
            motion.names[k]: _Slopes(motion.times, {x: slopes[:, i, j] for j, x in enumerate(leads)})
            for i, k in enumerate(columns)
        }
        before, self._known = self._known, new
        for x, (times, by_others) in before.items():
            common = times
            for u in by_others:
                if u in new:
                    common = np.intersect1d(common, new[u].times)
            rows = np.searchsorted(times, common)
            total: dict[str, Array] = {}
            for u, own in by_others.items():
                for v, slope in self._slopes(u, common).items():
                    total[v] = total.get(v, 0.0) + own[rows] * slope
            self._known[x] = _Slopes(common, total)

    def _slopes(self, name: str, times: Times) -> Mapping[str, Array]:
        """Return what a coordinate follows: itself, if no other."""
        if name not in self._known:
            return {name: np.ones(len(times))}
        known = self._known[name]
        rows = np.searchsorted(known.times, times)
        return {u: slope[rows] for u, slope in known.slopes.items()}
