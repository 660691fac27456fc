"""All pairs of parts, and how probable it is that one hangs on the other."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import numpy.typing as npt

from .fit import Found
from .identify import family_weights, identify
from .observations import Observations
from .rigid import Array
from .tracks import Track, between

Families = Iterable[str] | Mapping[str, float] | None

LOG_ANYWHERE = -math.log(8.0 * math.pi**2) - 3.0 * math.log(2.0)
"""Logarithm of the density of a pose of which nothing is known, within 2 m [1/m³]; all turns have 8π²."""

# That of a pose by itself, somewhere in a room of 10 m.
_LOG_ROOM = -math.log(8.0 * math.pi**2) - 3.0 * math.log(10.0)


@dataclass(frozen=True)
class Pair:
    """Two parts that were seen together.

    Attributes
    ----------
    parent, child
        Their names.
    found
        What was identified between them.
    times
        The numbers of the observations in which both were seen.
    gain
        By how much the logarithm of the density of what was seen is larger than if each pose of the child
        were anywhere in a room, all families taken together.
    """

    parent: str
    child: str
    found: Found
    times: npt.NDArray[np.int_]
    gain: float

    @property
    def rigid(self) -> float:
        """The logarithm of the odds that both are one rigid body."""
        rigid = sum(fit.probability for fit in self.found if fit.family == "rigid")
        other = sum(fit.probability for fit in self.found if fit.family != "rigid")
        tiny = 1e-300
        return math.log(max(rigid, tiny)) - math.log(max(other, tiny))


def pair(tracks: Mapping[str, Track], parent: str, child: str, families: Families) -> Pair | None:
    """Return what is between two parts; None if they were not seen together at least twice."""
    a, b = tracks[parent], tracks[child]
    times = np.flatnonzero(a.seen & b.seen)
    if len(times) < 2:
        return None
    found = identified(between(a, b, times), families)
    weights = family_weights(families)
    best = found.best
    log = best.log_evidence + math.log(weights[best.family] / best.probability / sum(weights.values()))
    return Pair(parent, child, found, times, log + LOG_ANYWHERE - len(times) * _LOG_ROOM)


def identified(seen: Observations, families: Families) -> Found:
    """Return what is between two parts that were seen."""
    exact = seen.parent_covariance is None
    return identify(
        None if exact else seen.parent,
        seen.relative if exact else seen.child,
        covariance_a=seen.parent_covariance,
        covariance_b=seen.child_covariance,
        families=families,
    )


def all_pairs(
    tracks: Mapping[str, Track],
    families: Families,
    progress: Callable[[int, int], object] | None,
) -> dict[frozenset[str], Pair]:
    """Return what is between all parts, those that were seen together."""
    names = list(combinations(tracks, 2))
    found: dict[frozenset[str], Pair] = {}
    for done, (a, b) in enumerate(names):
        if progress is not None:
            progress(done, len(names))
        if (known := pair(tracks, a, b, families)) is not None:
            found[frozenset((a, b))] = known
    if progress is not None:
        progress(len(names), len(names))
    return found


def ways_to_move(pairs: Iterable[Pair], tracks: Mapping[str, Track]) -> int | None:
    """Return in how many ways the ends of a chain of parts can move against each other at once.

    None if there was no time at which all of them were seen.
    """
    chain = list(pairs)
    common = chain[0].times
    for one in chain[1:]:
        common = np.intersect1d(common, one.times)
    if not len(common):
        return None
    chosen = common[np.unique(np.linspace(0, len(common) - 1, 15).astype(int))]
    places = np.concatenate(
        [tracks[name].poses[chosen, :3, 3] for p in chain for name in (p.parent, p.child)]
    )
    middle = places.mean(axis=0)
    size = math.sqrt(float(np.mean(np.sum((places - middle) ** 2, axis=1)))) or 1.0
    columns = np.concatenate([_twists(p, tracks, chosen, middle, size) for p in chain], axis=2)
    if not columns.shape[2]:
        return 0
    values = np.linalg.svd(columns, compute_uv=False)
    ranks = np.sum(values > 0.05 * values[:, :1], axis=1)
    return int(np.median(ranks))


def _twists(
    one: Pair, tracks: Mapping[str, Track], chosen: npt.NDArray[np.int_], middle: Array, size: float
) -> Array:
    """Return twists about a point per unit of each joint value, lengths in units of a size."""
    fit = one.found.best
    linear = fit.motion.at(fit.joint_values[np.searchsorted(one.times, chosen)])
    parent = tracks[one.parent].poses[chosen]
    turned = parent[:, :3, :3]
    v, w = turned @ linear.by_joints[:, :3], turned @ linear.by_joints[:, 3:]
    child = (parent @ linear.pose)[:, :3, 3]
    v = v - np.cross(w, (child - middle)[:, :, None], axis=1)
    return np.concatenate([v / size, w], axis=1)
