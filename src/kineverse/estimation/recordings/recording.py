"""Recorded tracks and synchronised pairs."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from kineverse.errors import FormatError, InvalidValueError, UnknownNameError, suggest
from kineverse.lie import Array
from kineverse.model.frame import WORLD

Indices = npt.NDArray[np.intp]

_ROUNDING = 1e-9  # difference that rounding makes


@dataclass(frozen=True, eq=False)
class RecordedTrack:
    """Recorded poses of one part.

    See Also
    --------
    kineverse.estimation.recordings.read_recording
    """

    poses: Array  # (N, 4, 4) in the observer's frame [m]; (N, 3) for positions only
    rows: Indices  # of the table, (N,); parts in one row were observed at one time
    lines: Indices  # of the file, (N,)
    times: Array | None = None  # (N,) [s]; None if the table has no times
    frame: str = ""  # name of the frame that the poses are in; empty if it is not known

    @property
    def has_orientation(self) -> bool:
        """True for whole poses, False for positions only."""
        return self.poses.ndim == 3

    def __len__(self) -> int:
        return len(self.poses)


def spaced_indices(count: int, size: int) -> Indices:
    """Return at most ``size`` evenly spaced numbers below ``count``, including the first and the last."""
    return np.unique(np.linspace(0, count - 1, size).round().astype(np.intp))


@dataclass(frozen=True, eq=False)
class RecordedPair:
    """Synchronised poses of two parts.

    See Also
    --------
    kineverse.estimation.recordings.read_recording
    """

    parent: str
    child: str
    parent_poses: Array | None  # (N, 4, 4); None for the world, which is known exactly
    child_poses: Array  # (N, 4, 4) or (N, 3)
    lines: Indices  # of the child's poses in the file, (N,)
    unpaired: int = 0  # number of poses of one part without the other
    is_timed: bool = False  # True if the poses are in order of time

    @property
    def has_orientation(self) -> bool:
        """True if the child's or a parent's orientations were observed."""
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

    @property
    def is_in_plane(self) -> bool:
        """True if z, or roll and pitch, are the same in all observations, so that they were not measured."""
        relative = self.relative
        fixed = relative[:, 2, :3] if relative.ndim == 3 else relative[:, 2]
        return len(fixed) > 1 and bool(np.ptp(fixed, axis=0).max() < _ROUNDING)

    @property
    def repeats(self) -> npt.NDArray[np.bool_]:
        """Mask of the observations that equal the one before in all numbers, (N,).

        A table has these if it was written more often than the parts were observed.
        """
        result = np.zeros(len(self.lines), dtype=bool)
        parts = [self.child_poses] if self.parent_poses is None else [self.child_poses, self.parent_poses]
        numbers = np.concatenate([part.reshape(len(self.lines), -1) for part in parts], axis=1)
        result[1:] = (numbers[1:] == numbers[:-1]).all(axis=1)
        return result

    def thin(self, count: int) -> RecordedPair:
        """Return at most ``count`` evenly spaced observations."""
        if count < 2:
            raise InvalidValueError(f"{count} of the poses: a motion takes at least two.")
        return self.select(spaced_indices(len(self.lines), count))

    def select(self, rows: Indices) -> RecordedPair:
        """Return some of the observations."""
        parents = None if self.parent_poses is None else self.parent_poses[rows]
        return replace(self, parent_poses=parents, child_poses=self.child_poses[rows], lines=self.lines[rows])


@dataclass(frozen=True, eq=False)
class Recording:
    """Recorded tracks of a table.

    See Also
    --------
    kineverse.estimation.recordings.read_recording
    """

    source: str  # name of the file in messages
    tracks: Mapping[str, RecordedTrack]  # by name of the part; a table without names has one, called ""
    ignored: tuple[str, ...] = ()  # columns without meaning
    assumptions: tuple[str, ...] = ()  # about what the table leaves open, such as "angles in deg"

    def pair(self, parent: str = WORLD, child: str | None = None) -> RecordedPair:
        """Synchronise the poses of two parts.

        ``world`` stands for the observer's frame, unless a part has this name. None is the only other part.
        A table without names has one part, of any name.
        """
        others = [name for name in self.tracks if name != parent]
        if child is None:
            if len(others) != 1:
                listed = ", ".join(f"'{name}'" for name in others[:12]) or "none"
                raise UnknownNameError(
                    f"{self.source}: which part moves? There are {listed}; name one as the child (--child on "
                    "the command line)."
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
            is_timed = track.times is not None
            return RecordedPair(parent, name, None, track.poses, track.lines, is_timed=is_timed)
        return self._synchronise(parent, name, self._track(parent), track)

    def _track(self, name: str) -> RecordedTrack:
        if list(self.tracks) == [""] and name != WORLD:
            return self.tracks[""]
        ends = [known for known in self.tracks if re.split("[./:]", known)[-1] == name]
        if name not in self.tracks and len(ends) == 1:
            return self.tracks[ends[0]]
        if name not in self.tracks:
            hint = suggest(name, self.tracks, "part")
            raise UnknownNameError(f"{self.source} has no part '{name}'. {hint}")
        return self.tracks[name]

    def _synchronise(self, parent: str, child: str, a: RecordedTrack, b: RecordedTrack) -> RecordedPair:
        if not a.has_orientation:
            raise FormatError(
                f"{self.source}: only positions of the parent '{parent}' were observed. A motion in its "
                "frame takes its orientation."
            )
        if a.frame != b.frame:
            raise FormatError(
                f"{self.source}: '{parent}' was observed in the frame '{a.frame}', and '{child}' in "
                f"'{b.frame}'. One frame for both is expected."
            )
        # Pair by time, else by row. In a table with one part per row, rows pair nothing.
        is_timed = a.times is not None and b.times is not None
        keys = [np.asarray(track.times if is_timed else track.rows) for track in (a, b)]
        _, of_a, of_b = np.intersect1d(keys[0], keys[1], assume_unique=True, return_indices=True)
        if not len(of_a) and not is_timed and len(a) == len(b):
            of_a = of_b = np.arange(len(a))
        if not len(of_a):
            raise FormatError(
                f"{self.source}: '{parent}' and '{child}' were never observed at the same time; a pose of "
                "both with the same time is expected."
            )
        unpaired = len(a) + len(b) - 2 * len(of_a)
        return RecordedPair(parent, child, a.poses[of_a], b.poses[of_b], b.lines[of_b], unpaired, is_timed)
