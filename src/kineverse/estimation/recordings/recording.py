"""Recorded tracks, synchronised pairs and effective sample size."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from kineverse.errors import FormatError, InvalidValueError, UnknownNameError, suggest
from kineverse.model.frame import WORLD

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class RecordedTrack:
    """What was seen of one part.

    Attributes
    ----------
    poses
        (N, 4, 4) in the observer's frame [m]; (N, 3) where only positions were seen.
    rows
        (N,) which rows of the table these were: parts of one row were seen at one time.
    lines
        (N,) the lines of the file.
    times
        (N,) [s], None if the table has none.
    """

    poses: Array
    rows: Indices
    lines: Indices
    times: Array | None = None

    @property
    def has_orientation(self) -> bool:
        """Whether whole poses were seen, rather than positions."""
        return self.poses.ndim == 3

    def __len__(self) -> int:
        return len(self.poses)


def spaced_indices(count: int, most: int) -> Indices:
    """Return at most so many of the numbers below a count, the first and the last among them."""
    return np.unique(np.linspace(0, count - 1, most).round().astype(np.intp))


@dataclass(frozen=True, eq=False)
class RecordedPair:
    """Two parts at the times when both were seen.

    Attributes
    ----------
    parent, child
        Their names.
    parent_poses
        (N, 4, 4); None for the world, which is known exactly.
    child_poses
        (N, 4, 4) or (N, 3).
    lines
        (N,) where the child's are in the file.
    alone
        How often one of them was seen without the other.
    timed
        Whether they are in the order of their times.
    """

    parent: str
    child: str
    parent_poses: Array | None
    child_poses: Array
    lines: Indices
    alone: int = 0
    timed: bool = False

    @property
    def is_whole(self) -> bool:
        """Whether orientations were seen, of the child or of a parent."""
        return self.child_poses.ndim == 3 or self.parent_poses is not None

    @property
    def relative(self) -> Array:
        """Poses of the child in the parent (N, 4, 4), or its positions (N, 3), with the errors of both."""
        if self.parent_poses is None:
            return self.child_poses
        if self.child_poses.ndim == 3:
            return np.asarray(np.linalg.solve(self.parent_poses, self.child_poses))
        offsets = self.child_poses - self.parent_poses[:, :3, 3]
        return np.asarray(np.einsum("nji,nj->ni", self.parent_poses[:, :3, :3], offsets))

    def thinned(self, count: int) -> RecordedPair:
        """Return at most so many of the observations, evenly over all.

        Raises
        ------
        InvalidValueError
            If that is less than two.
        """
        if count < 2:
            raise InvalidValueError(f"{count} of the poses: how something moves takes at least two to see.")
        return self.at(spaced_indices(len(self.lines), count))

    def at(self, rows: Indices) -> RecordedPair:
        """Return some of the observations."""
        parents = None if self.parent_poses is None else self.parent_poses[rows]
        return replace(self, parent_poses=parents, child_poses=self.child_poses[rows], lines=self.lines[rows])


@dataclass(frozen=True, eq=False)
class Recording:
    """The tracks of a table.

    Attributes
    ----------
    source
        What the file is called in messages.
    tracks
        By the name of the part; a table that names none has one, called "".
    ignored
        Columns that mean nothing here.
    """

    source: str
    tracks: Mapping[str, RecordedTrack]
    ignored: tuple[str, ...] = ()

    def pair(self, parent: str = WORLD, child: str | None = None) -> RecordedPair:
        """Return two parts at the times when both were seen.

        Parameters
        ----------
        parent
            Its name; ``world``, unless a part is called so, for the frame in which everything was seen.
        child
            Its name; None for the only other part. A table that names no part has one, of any name.

        Raises
        ------
        UnknownNameError
            If there is no such part, or several could be meant.
        FormatError
            If the parent's orientation was not seen, or the two were never seen together.
        """
        others = [name for name in self.tracks if name != parent]
        if child is None:
            if len(others) != 1:
                raise UnknownNameError(
                    f"{self.source}: which part moves? There are {_listed(others)}; name one as the child "
                    "(--child on the command line)."
                )
            child = others[0]
        track = self._track(child)
        if child == parent and parent in self.tracks:
            raise UnknownNameError(f"{self.source}: parent and child are both '{parent}'.")
        if parent != WORLD and "" in self.tracks:
            raise UnknownNameError(
                f"{self.source} names no parts, so it is one part in the world. There is no '{parent}'."
            )
        name = child or "part"
        if parent == WORLD and WORLD not in self.tracks:
            return RecordedPair(parent, name, None, track.poses, track.lines, timed=track.times is not None)
        return self._together(parent, name, self._track(parent), track)

    def _track(self, name: str) -> RecordedTrack:
        if list(self.tracks) == [""] and name != WORLD:
            return self.tracks[""]
        if name not in self.tracks:
            raise UnknownNameError(
                f"{self.source} has no part '{name}'. {suggest(name, self.tracks, 'part')}"
            )
        return self.tracks[name]

    def _together(self, parent: str, child: str, a: RecordedTrack, b: RecordedTrack) -> RecordedPair:
        if not a.has_orientation:
            raise FormatError(
                f"{self.source}: only positions of the parent '{parent}' were seen. How something moves in a "
                "part's frame can only be told if its orientation is known."
            )
        # Times where there are some; else the rows, which in a table of a part per row pair nothing.
        timed = a.times is not None and b.times is not None
        keys = [np.asarray(track.times if timed else track.rows) for track in (a, b)]
        _, of_a, of_b = np.intersect1d(keys[0], keys[1], assume_unique=True, return_indices=True)
        if not len(of_a) and not timed and len(a) == len(b):
            of_a = of_b = np.arange(len(a))
        if not len(of_a):
            raise FormatError(
                f"{self.source}: '{parent}' and '{child}' were never seen at the same time; "
                "a pose of both with the same time is expected."
            )
        alone = len(a) + len(b) - 2 * len(of_a)
        return RecordedPair(parent, child, a.poses[of_a], b.poses[of_b], b.lines[of_b], alone, timed)


def _listed(names: list[str]) -> str:
    return ", ".join(f"'{name}'" for name in names[:12]) or "none"


ResidualArray = npt.NDArray[np.float64]

# Of fewer rows correlations are not known, and fewer than these are never asked for.
_LOOKED_AT, _FEWEST = 20, 8


def effective_sample_size(residuals: ResidualArray) -> int:
    """Return how many of the observations behind residuals (N, m), in order, are worth as much as all.

    What is left of a pose is often left of the next one too: a camera is filtered, a marker is bent. The
    integrated autocorrelation time τ = 1 + 2 Σ ρ_k says of how many rows each tells nothing new, and N / τ
    are left. The sum ends where ρ_k is no larger than by chance, and the slowest component counts.
    """
    count = len(residuals)
    if count <= _LOOKED_AT:
        return count
    slowest = max(_correlation_time(column) for column in residuals.T)
    return min(count, max(_FEWEST, round(count / slowest)))


def _correlation_time(errors: ResidualArray) -> float:
    middle = float(np.median(np.abs(errors)))
    if middle == 0.0:
        return 1.0
    # Three standard deviations: what is wrong altogether says nothing about the others.
    kept = np.clip(errors, -4.5 * middle, 4.5 * middle)
    kept = kept - kept.mean()
    variance = float(kept @ kept)
    if variance == 0.0:
        return 1.0
    time, chance = 1.0, 3.0 / math.sqrt(len(kept))
    for k in range(1, len(kept) // 3):
        alike = float(kept[:-k] @ kept[k:]) / variance
        if alike < chance:
            break
        time += 2.0 * alike
    return time
