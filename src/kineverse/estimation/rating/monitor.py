"""Watching the articulations of a model while observations come in."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from kineverse.errors import KineverseError, ShapeError, UnknownNameError, suggest
from kineverse.estimation.identification.observations import Observations
from kineverse.estimation.identification.pairs import Families
from kineverse.estimation.identification.rigid import Array
from kineverse.estimation.identification.tracks import Poses, Track, between, exactly, joined, tracks
from kineverse.estimation.tracking.outliers import Outliers, as_outliers
from kineverse.model.frame import WORLD
from kineverse.model.model import Model

from .judgement import Seen, judged
from .links import Link, Links, find_links
from .misfit import Misfit, misfit
from .plausibility import FALSE_ALARMS, check_false_alarms, untold
from .report import Plausibility, Rating
from .served import Served
from .ties import Ties, Told
from .watch import Watch


@dataclass
class _Watched:
    """A link with all that belongs to it."""

    link: Link
    served: Served | None
    reason: str
    watch: Watch
    # The number of each observation that the watch has taken.
    numbers: list[int] = field(default_factory=list)

    @property
    def stopped(self) -> int | None:
        return None if self.watch.stopped is None else self.numbers[self.watch.stopped]


class PlausibilityMonitor:
    """Says when an articulation of a model stops explaining what is seen, while one watches.

    The probability that it is ever said of an articulation which is as served is at most ``false_alarms``,
    however long one watches. If the model is edited, what the edit changed is judged anew.

    Parameters
    ----------
    model
        The model.
    frames
        Names of the frames that may be seen.
    noise, relative_to, families, false_alarms, outliers
        As in :func:`~kineverse.estimation.plausibility`.
    keep
        How many of the last observations are kept, to say what an articulation is instead.

    Raises
    ------
    UnknownNameError
        For a frame that does not exist.
    """

    def __init__(
        self,
        model: Model,
        frames: Iterable[str],
        *,
        noise: npt.ArrayLike | None = None,
        relative_to: str | None = WORLD,
        families: Families = None,
        false_alarms: float = FALSE_ALARMS,
        outliers: Outliers | bool | None = True,
        keep: int = 500,
    ) -> None:
        check_false_alarms(false_alarms)
        self.model = model
        self.frames = tuple(dict.fromkeys(frames))
        self.false_alarms = false_alarms
        self.count = 0
        self._outliers = as_outliers(outliers)
        self._noise, self._relative_to, self._families = noise, relative_to, families
        self._kept: deque[dict[str, Track]] = deque(maxlen=keep)
        self._watched: list[_Watched] = []
        self._links = Links((), {})
        self._ties = Ties(model, {}, relative_to)
        self._look()

    @property
    def stopped(self) -> dict[str, int]:
        """By tag, the observation from which on an articulation does not explain what is seen."""
        found: dict[str, int] = {}
        for watched in self._watched:
            if (number := watched.stopped) is not None:
                found[watched.link.tag] = min(number, found.get(watched.link.tag, number))
        return found

    def update(self, observations: Mapping[str, Poses]) -> tuple[str, ...]:
        """Take one observation; return the tags of the articulations that it makes implausible.

        Parameters
        ----------
        observations
            From names of frames to a pose, (4, 4), or a pair of a pose and its covariance, (6, 6). What was
            not seen is left out.

        Raises
        ------
        UnknownNameError, ShapeError, ValueRejectedError
            For frames, poses and covariances that are none; nothing has happened then.
        """
        for name in observations:
            if name not in self.frames:
                raise UnknownNameError(
                    f"The frame {name!r} is not watched. {suggest(str(name), self.frames, 'frame')}"
                )
        seen = tracks({name: _one(given, name) for name, given in observations.items()}, self._noise)
        if self.model.version != self._version:
            self._look()
        if self._relative_to is not None:
            seen[self._relative_to] = exactly(1)
        before = set(self.stopped)
        self._add(seen)
        self._kept.append(seen)
        self.count += 1
        return tuple(tag for tag in self.stopped if tag not in before)

    def report(self) -> Plausibility:
        """Return the ratings of all articulations, by the observations that are kept."""
        if self.model.version != self._version:
            self._look()
        first = self.count - len(self._kept)
        told = {watched.link: self._told(watched, first) for watched in self._watched}
        tied = self._ties.tied({link: known for link, known in told.items() if known is not None})
        ratings = [self._rating(watched, tied.get(watched.link), first) for watched in self._watched]
        return Plausibility(tuple(ratings), self._links.left_out, self.false_alarms)

    def _look(self) -> None:
        """Find out what can be judged, and go on with what has not changed."""
        known = {watched.link: watched for watched in self._watched}
        before = self._ties
        self._version = self.model.version
        self._links = find_links(self.model, self.frames, self._relative_to)
        judged_by: dict[Link, Served] = {}
        reasons = dict.fromkeys(self._links.links, "")
        for link in self._links.links:
            try:
                judged_by[link] = Served(self.model, link.child, link.parent)
            except KineverseError as error:
                reasons[link] = f"its pose cannot be computed. {error}"
        self._ties = Ties(self.model, judged_by, self._relative_to)
        self._watched = []
        for link, reason in reasons.items():
            old, served = known.get(link), judged_by.get(link)
            if (
                old is not None
                and old.served is not None
                and served is not None
                and served.same(old.served)
                and self._ties.same(link, before)
            ):
                self._watched.append(old)
            else:
                self._watched.append(_Watched(link, served, reason, self._watch()))

    def _watch(self) -> Watch:
        return Watch(self.false_alarms, self._outliers.fraction if self._outliers else 0.0)

    def _add(self, seen: Mapping[str, Track]) -> None:
        told: dict[Link, Told] = {}
        for watched in self._watched:
            link = watched.link
            if watched.served is None or not {link.parent, link.child} <= seen.keys():
                continue
            parent, child = seen[link.parent], seen[link.child]
            if parent.seen[0] and child.seen[0]:
                now = np.array([0])
                told[link] = Told(now, misfit(watched.served, between(parent, child, now)))
        tied = self._ties.tied(told)
        for watched in self._watched:
            if watched.link in tied:
                left = tied[watched.link]
                watched.numbers.append(self.count)
                watched.watch.add(left.normal[0], left.by_place[0], left.against[0])

    def _told(self, watched: _Watched, first: int) -> Told | None:
        """Return what the observations that are kept tell of an articulation; None if they tell nothing."""
        times = self._times(watched, first)
        if watched.served is None or not times:
            return None
        return Told(np.array(times), misfit(watched.served, self._poses(watched.link, times, first)))

    def _times(self, watched: _Watched, first: int) -> list[int]:
        return [number for number in watched.numbers if number >= first]

    def _poses(self, link: Link, times: Iterable[int], first: int) -> Observations:
        kept = [self._kept[number - first] for number in times]
        parent, child = (joined([one[name] for one in kept]) for name in (link.parent, link.child))
        return between(parent, child, np.arange(len(kept)))

    def _rating(self, watched: _Watched, left: Misfit | None, first: int) -> Rating:
        link = watched.link
        if watched.served is None or left is None:
            never = f"'{link.parent}' and '{link.child}' were not seen together"
            return untold(link, 0, watched.reason or never)
        times = self._times(watched, first)
        seen = Seen(link, watched.served, self._poses(link, times, first), left, np.array(times))
        return judged(self.model, seen, watched.stopped, self._families, self._outliers)


def _one(given: Poses, name: str) -> Poses:
    pose, *covariance = given if isinstance(given, tuple) and len(given) == 2 else (given,)
    try:
        matrix: Array = np.asarray(pose, dtype=np.float64)
    except (TypeError, ValueError):
        raise ShapeError(f"The pose of '{name}' is no array of numbers.") from None
    if matrix.shape != (4, 4):
        raise ShapeError(f"The pose of '{name}' is a 4×4 transform, not of shape {matrix.shape}.")
    return (matrix[None], covariance[0]) if covariance else matrix[None]
