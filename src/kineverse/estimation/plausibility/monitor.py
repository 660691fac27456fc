"""Online plausibility monitor."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from kineverse.errors import KineverseError, ShapeError, UnknownNameError, suggest
from kineverse.estimation.identification.kinematic_graph.pairwise import FamilyChoice
from kineverse.estimation.identification.observations import (
    Observations,
    PosesLike,
    PoseTrack,
    check_tracks,
    concatenate_tracks,
    exact_track,
    pair_tracks,
)
from kineverse.estimation.robust import Outliers, as_outliers
from kineverse.lie import Stack
from kineverse.model.frame import WORLD
from kineverse.model.model import Model

from .alternatives import JointObservations, judge_joint
from .consistency import ConsistencyTests, TimedResiduals
from .known_motion import KnownJoint
from .known_residuals import KnownResiduals, compute_residuals
from .plausibility import FALSE_ALARMS, check_false_alarms, undetermined
from .report import JointVerdict, Plausibility
from .sequential_test import SequentialTest
from .testability import TestableJoint, TestableJoints, find_testable_joints


@dataclass
class _MonitoredJoint:
    """A link with all that belongs to it."""

    link: TestableJoint
    served: KnownJoint | None
    reason: str
    watch: SequentialTest
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
        As in :func:`~kineverse.estimation.check_plausibility`.
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
        families: FamilyChoice = None,
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
        self._kept: deque[dict[str, PoseTrack]] = deque(maxlen=keep)
        self._watched: list[_MonitoredJoint] = []
        self._links = TestableJoints((), {})
        self._ties = ConsistencyTests(model, {}, relative_to)
        self._look()

    @property
    def stopped(self) -> dict[str, int]:
        """By tag, the observation from which on an articulation does not explain what is seen."""
        found: dict[str, int] = {}
        for watched in self._watched:
            if (number := watched.stopped) is not None:
                found[watched.link.tag] = min(number, found.get(watched.link.tag, number))
        return found

    def update(self, observations: Mapping[str, PosesLike]) -> tuple[str, ...]:
        """Take one observation; return the tags of the articulations that it makes implausible.

        Parameters
        ----------
        observations
            From names of frames to a pose, (4, 4), or a pair of a pose and its covariance, (6, 6). What was
            not seen is left out.

        Raises
        ------
        UnknownNameError, ShapeError, InvalidValueError
            For frames, poses and covariances that are none; nothing has happened then.
        """
        for name in observations:
            if name not in self.frames:
                raise UnknownNameError(
                    f"The frame {name!r} is not watched. {suggest(str(name), self.frames, 'frame')}"
                )
        seen = check_tracks({name: _one(given, name) for name, given in observations.items()}, self._noise)
        if self.model.version != self._version:
            self._look()
        if self._relative_to is not None:
            seen[self._relative_to] = exact_track(1)
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
        self._links = find_testable_joints(self.model, self.frames, self._relative_to)
        judged_by: dict[TestableJoint, KnownJoint] = {}
        reasons = dict.fromkeys(self._links.links, "")
        for link in self._links.links:
            try:
                judged_by[link] = KnownJoint(self.model, link.child, link.parent)
            except KineverseError as error:
                reasons[link] = f"its pose cannot be computed. {error}"
        self._ties = ConsistencyTests(self.model, judged_by, self._relative_to)
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
                self._watched.append(_MonitoredJoint(link, served, reason, self._watch()))

    def _watch(self) -> SequentialTest:
        return SequentialTest(self.false_alarms, self._outliers.fraction if self._outliers else 0.0)

    def _add(self, seen: Mapping[str, PoseTrack]) -> None:
        told: dict[TestableJoint, TimedResiduals] = {}
        for watched in self._watched:
            link = watched.link
            if watched.served is None or not {link.parent, link.child} <= seen.keys():
                continue
            parent, child = seen[link.parent], seen[link.child]
            if parent.seen[0] and child.seen[0]:
                now = np.array([0])
                told[link] = TimedResiduals(
                    now, compute_residuals(watched.served, pair_tracks(parent, child, now))
                )
        tied = self._ties.tied(told)
        for watched in self._watched:
            if watched.link in tied:
                left = tied[watched.link]
                watched.numbers.append(self.count)
                watched.watch.add(left.normal[0], left.by_place[0], left.against[0])

    def _told(self, watched: _MonitoredJoint, first: int) -> TimedResiduals | None:
        """Return what the observations that are kept tell of an articulation; None if they tell nothing."""
        times = self._times(watched, first)
        if watched.served is None or not times:
            return None
        return TimedResiduals(
            np.array(times), compute_residuals(watched.served, self._poses(watched.link, times, first))
        )

    def _times(self, watched: _MonitoredJoint, first: int) -> list[int]:
        return [number for number in watched.numbers if number >= first]

    def _poses(self, link: TestableJoint, times: Iterable[int], first: int) -> Observations:
        kept = [self._kept[number - first] for number in times]
        parent, child = (
            concatenate_tracks([one[name] for one in kept]) for name in (link.parent, link.child)
        )
        return pair_tracks(parent, child, np.arange(len(kept)))

    def _rating(self, watched: _MonitoredJoint, left: KnownResiduals | None, first: int) -> JointVerdict:
        link = watched.link
        if watched.served is None or left is None:
            never = f"'{link.parent}' and '{link.child}' were not seen together"
            return undetermined(link, 0, watched.reason or never)
        times = self._times(watched, first)
        seen = JointObservations(link, watched.served, self._poses(link, times, first), left, np.array(times))
        return judge_joint(self.model, seen, watched.stopped, self._families, self._outliers)


def _one(given: PosesLike, name: str) -> PosesLike:
    pose, *covariance = given if isinstance(given, tuple) and len(given) == 2 else (given,)
    try:
        matrix: Stack = np.asarray(pose, dtype=np.float64)
    except (TypeError, ValueError):
        raise ShapeError(f"The pose of '{name}' is no array of numbers.") from None
    if matrix.shape != (4, 4):
        raise ShapeError(f"The pose of '{name}' is a 4×4 transform, not of shape {matrix.shape}.")
    return (matrix[None], covariance[0]) if covariance else matrix[None]
