"""Consistency tests between coupled coordinates.

A limit g(q) <= 0 may depend on several coordinates, as that of a drawer which a door lets out. At the
estimated values it is passed by z = g / σ standard deviations, with σ² = ∇gᵀ C ∇g. And one coordinate may
move several parts, as the fingers of a gripper or the bars of a linkage: each is seen by itself, and what
they say of the coordinate differs by z standard deviations. If the model is right, z is at most standard
normal, to first order. Where it is not known how well g is told, as where a bound jumps within what is known
of a coordinate, z is NaN and says nothing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from kineverse.compile import compile  # noqa: A004
from kineverse.errors import KineverseError
from kineverse.estimation.linear_algebra import multiply_vectors
from kineverse.expressions.expression import Expression, array, as_expression
from kineverse.lie import Stack, pose_difference
from kineverse.model.model import Model
from kineverse.model.operation import ARTICULATIONS
from kineverse.model.rate_nodes import to_plain
from kineverse.symbols import Symbol

from .known_motion import KnownJoint, is_own_limit
from .known_residuals import KnownResiduals
from .testability import TestableJoint

# How far coordinates may be off, in standard deviations, and by which part of its own a limit may differ
# there from what its slope says.
_FAR, _BENT = 2.0, 0.5


@dataclass(frozen=True)
class TimedResiduals:
    """What observations tell of an articulation, and when.

    Attributes
    ----------
    times
        The numbers of the observations, (N,).
    left
        Beside the articulation as served.
    """

    times: npt.NDArray[np.int_]
    left: KnownResiduals


class ConsistencyTests:
    """The ties of all articulations that are judged.

    Parameters
    ----------
    model
        The model as it is served.
    judged
        The articulations by link.
    exact
        The frame whose place is exactly known, if any.
    """

    def __init__(self, model: Model, judged: Mapping[TestableJoint, KnownJoint], exact: str | None) -> None:
        self._judged = judged
        self._frames = {link: {link.parent, link.child} - {exact} for link in judged}
        self._source = _sources(model, judged)
        self._limits = {link: _Limits(model, link, served, self._source) for link, served in judged.items()}

    def same(self, link: TestableJoint, other: ConsistencyTests) -> bool:
        """Whether an articulation has the same ties among others."""
        mine, yours = self._limits[link], other._limits.get(link)
        return yours is not None and mine.slacks == yours.slacks and self._twins(link) == other._twins(link)

    def tied(self, told: Mapping[TestableJoint, TimedResiduals]) -> dict[TestableJoint, KnownResiduals]:
        """Return what is told of each articulation, with what is told of others."""
        return {link: self._tied(link, told) for link in told}

    def _twins(self, link: TestableJoint) -> tuple[Symbol, ...]:
        """Return the coordinates that another articulation tells as well, and before this one."""
        served = self._judged[link]
        return tuple(x for x in served.coordinates if served.is_plain and self._source[x] != link)

    def _tied(self, link: TestableJoint, told: Mapping[TestableJoint, TimedResiduals]) -> KnownResiduals:
        served, limits, mine = self._judged[link], self._limits[link], told[link]
        twins = self._twins(link)
        if not limits.slacks and not twins:
            return mine.left
        others = list(dict.fromkeys([*limits.others, *twins]))
        values, covariances, shared = self._known(link, others, mine.times, told)
        beyond = limits.beyond(served, mine.left, values, covariances, shared)
        apart = np.zeros((len(mine.times), len(twins)))
        for j, x in enumerate(twins):
            k, other = served.coordinates.index(x), others.index(x)
            told_there = values[:, other], covariances[:, other, other]
            apart[:, j] = _apart(served, mine.left, k, *told_there, shared[other])
        at = [others.index(x) for x in twins]
        return replace(mine.left, tied=beyond, apart=apart, others=values[:, at])

    def _known(
        self,
        link: TestableJoint,
        others: Sequence[Symbol],
        when: npt.NDArray[np.int_],
        told: Mapping[TestableJoint, TimedResiduals],
    ) -> tuple[Stack, Stack, npt.NDArray[np.bool_]]:
        """Return values (N, m) and covariances (N, m, m) of coordinates; NaN where they are not told.

        And which of them come from a frame that this articulation is seen by, too.
        """
        values = np.full((len(when), len(others)), np.nan)
        covariances = np.zeros((len(when), len(others), len(others)))
        shared = np.zeros(len(others), dtype=bool)
        for source in {self._source[x] for x in others}:
            at = np.array([j for j, x in enumerate(others) if self._source[x] == source])
            shared[at] = bool(self._frames[source] & self._frames[link])
            if source not in told:
                continue
            columns = np.array([self._judged[source].coordinates.index(others[j]) for j in at])
            known = told[source]
            _, mine, theirs = np.intersect1d(when, known.times, return_indices=True)
            values[np.ix_(mine, at)] = known.left.values[np.ix_(theirs, columns)]
            covariances[np.ix_(mine, at, at)] = known.left.covariances[np.ix_(theirs, columns, columns)]
        return values, covariances, shared


class _Limits:
    """The limits of an articulation that are more than bounds of a coordinate of its own."""

    def __init__(
        self, model: Model, link: TestableJoint, served: KnownJoint, sources: Mapping[Symbol, TestableJoint]
    ) -> None:
        slacks = {}
        for constraint in model.constraints_for(served.coordinates).values():
            if served.is_plain and any(is_own_limit(constraint, x) for x in served.coordinates):
                continue
            limited = model.rates.resolve(to_plain(constraint.expression))
            if not set(served.coordinates) & set(limited.symbols):
                continue  # it is the limit of something else, which is to blame
            for bound, sign in ((constraint.lower, -1.0), (constraint.upper, 1.0)):
                if not bound.symbols and not np.isfinite(float(bound)):
                    continue
                slack = sign * (limited - model.rates.resolve(to_plain(bound)))
                moving = {s for s in slack.symbols if s.has_derivative}
                if all(s.order == 0 and (s in served.coordinates or s in sources) for s in moving):
                    slacks[slack] = sorted(moving - {*served.coordinates}, key=lambda s: s.sort_key)
        self.slacks: tuple[Expression, ...] = tuple(slacks)
        self.others = tuple(dict.fromkeys(s for others in slacks.values() for s in others))
        if not slacks:
            return
        inputs = (*served.coordinates, *self.others)
        # Parameters have values of their own.
        given = {s: s.value or 0.0 for slack in slacks for s in slack.symbols if s not in inputs}
        stacked = array([slack.substitute(given) if given else slack for slack in slacks])
        gradient, none = stacked.gradient(heuristic=False), as_expression(np.zeros(len(slacks)))
        self._function = compile([stacked, *(gradient.get(x.derivative(), none) for x in inputs)], inputs)

    def beyond(
        self,
        served: KnownJoint,
        left: KnownResiduals,
        values: Stack,
        covariances: Stack,
        shared: npt.NDArray[np.bool_],
    ) -> Stack:
        """Return by how many standard deviations limits are passed, (N, c).

        Parameters
        ----------
        served, left
            The articulation and what is told of it.
        values, covariances, shared
            Of other coordinates, those of the limits first.
        """
        count, m = len(left), len(self.others)
        if not self.slacks:
            return np.zeros((count, 0))
        own = left.values if served.is_plain else left.coordinates
        points = np.concatenate([own, values[:, :m]], axis=1)
        slack, *slopes = self._at(points)
        n = own.shape[1]
        by_joints = served.per_joint(own, np.stack(slopes[:n], axis=2))
        by_others = np.stack(slopes[n:], axis=2) if m else np.zeros((count, len(self.slacks), 0))
        spread = _variances(by_joints, left.covariances)
        others = _variances(by_others, covariances[:, :m, :m])
        z = _deviations(slack, spread, others, bool(shared[:m].any()))
        # The slope says how well a limit is told only where it is nearly that within what is known.
        within = np.sqrt(np.einsum("nii->ni", covariances[:, :m, :m]))
        if served.is_plain:
            within = np.concatenate([np.sqrt(np.einsum("nii->ni", left.covariances)), within], axis=1)
        else:
            within = np.concatenate([np.zeros((count, n)), within], axis=1)
        total = np.sqrt(spread + others)
        for k in range(points.shape[1]):
            for step in (-_FAR, _FAR):
                moved = points.copy()
                moved[:, k] += step * within[:, k]
                bent = self._at(moved)[0] - slack - step * within[:, k, None] * slopes[k]
                z[~(np.abs(bent) <= _BENT * _FAR * total)] = np.nan
        return z

    def _at(self, points: Stack) -> Sequence[Stack]:
        """Return slacks and their slopes; NaN where they mean nothing."""
        found = [np.full((len(points), len(self.slacks)), np.nan) for _ in range(1 + points.shape[1])]
        waiting = [np.flatnonzero(np.isfinite(points).all(axis=1))]
        while waiting:
            rows = waiting.pop()
            if not len(rows):
                continue
            try:
                parts = self._function.batch(points[rows])
            except KineverseError:
                if len(rows) > 1:
                    waiting += np.array_split(rows, 2)
                continue
            for result, part in zip(found, parts, strict=True):
                result[rows] = part
        return found


def _sources(model: Model, judged: Mapping[TestableJoint, KnownJoint]) -> dict[Symbol, TestableJoint]:
    """Return what tells each coordinate: what it belongs to, if that was seen, or else what moves with it."""
    sources: dict[Symbol, TestableJoint] = {}
    for only_own in (True, False):
        for link, served in judged.items():
            writes = model.history.entry(link.tag).writes
            own = {
                x for (kind, _), value in writes.items() if kind == ARTICULATIONS for x in value.coordinates
            }
            for x in served.coordinates if served.is_plain else ():
                if x in own or not only_own:
                    sources.setdefault(x, link)
    return sources


def _apart(
    served: KnownJoint, left: KnownResiduals, k: int, other: Stack, variance: Stack, shared: bool
) -> Stack:
    """Return by how much coordinate k differs from what others say it is, in standard deviations, (N,).

    Poses are compared, and from where the others say it is: what follows a crank is at the same
    place twice in a turn, and does not say in which of both.
    """
    there = left.values.copy()
    there[:, k] = other
    try:
        here, expected = served.at(left.values), served.at(there)
        back = np.asarray(np.linalg.pinv(np.nan_to_num(expected.by_joints)), dtype=np.float64)
        own = back @ here.by_joints
        spread = (own @ left.covariances @ np.swapaxes(own, 1, 2))[:, k, k]
        z = _deviations(
            multiply_vectors(back, pose_difference(here.pose, expected.pose))[:, k], spread, variance, shared
        )
        # Where a linkage is stretched its slope does not say how well anything is known, here or there.
        enough = _BENT * _FAR * np.sqrt(spread + variance)
        sides = (left.values, here, left.covariances[:, k, k]), (there, expected, variance)
        for values, linear, own_variance in sides:
            for step in (-_FAR * np.sqrt(own_variance), _FAR * np.sqrt(own_variance)):
                moved = values.copy()
                moved[:, k] += step
                off = (
                    pose_difference(served.at(moved).pose, linear.pose)
                    - step[:, None] * linear.by_joints[:, :, k]
                )
                z[~(np.abs(multiply_vectors(back, off)[:, k]) <= enough)] = np.nan
    except KineverseError:
        return np.full(len(left), np.nan)
    return z


def _variances(slopes: Stack, covariances: Stack) -> Stack:
    """Return the variances (N, c) of what has slopes (N, c, n); NaN slopes stay."""
    variances: Stack = np.einsum("ncj,njk,nck->nc", slopes, covariances, slopes)
    return variances


def _deviations(off: Stack, own: Stack, other: Stack, shared: bool) -> Stack:
    """Return what is off in standard deviations; NaN where that is not known.

    Errors of a frame that both were seen by may add up.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        deviation = np.sqrt(own) + np.sqrt(other) if shared else np.sqrt(own + other)
        z: Stack = off / deviation
    z[~np.isfinite(z)] = np.nan
    return z
