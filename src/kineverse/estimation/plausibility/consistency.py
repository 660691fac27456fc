"""Consistency tests between coupled coordinates.

A limit g(q) <= 0 may depend on several coordinates: a drawer opens only as far as the door next to it. At the
estimated values it is violated by z = g / σ standard deviations, with σ² = ∇gᵀ C ∇g. One coordinate may also
move several parts, as the fingers of a gripper or the bars of a linkage. Each part is observed by itself,
and the estimates of the coordinate differ by z standard deviations. If the model is right, z is at most
standard normal, to first order. Where the uncertainty of g is unknown, as at a jump of a bound, z is NaN and
is ignored.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import combinations

import numpy as np
import numpy.typing as npt

from kineverse.compilation import compile
from kineverse.errors import KineverseError
from kineverse.estimation.identification.observations import PoseTrack, pair_tracks
from kineverse.estimation.linear_algebra import multiply_vectors
from kineverse.estimation.noise import CHI_SQUARED_6
from kineverse.expressions.expression import Expression, array, as_expression
from kineverse.lie import Array, pose_difference
from kineverse.model.model import Model
from kineverse.model.operation import ARTICULATIONS
from kineverse.model.rates import to_plain
from kineverse.symbols import Symbol

from .report import TestableJoint
from .residuals import JointObservations, KnownJoint, KnownResiduals, compute_residuals, is_own_limit

# Range of the linearity test in standard deviations, and the accepted relative nonlinearity.
_RANGE, _NONLINEAR = 2.0, 0.5


def find_exchanged_frames(
    rejected: Mapping[TestableJoint, int],
    served_joints: Mapping[TestableJoint, KnownJoint],
    tracks: Mapping[str, PoseTrack],
    exact: str | None,
) -> dict[TestableJoint, str]:
    """Return the joints rejected since some row that fit once two frames are exchanged, with the reason."""
    since = min(rejected.values(), default=0)

    def fits(joint: TestableJoint, tracks: Mapping[str, PoseTrack]) -> bool:
        parent, child = tracks[joint.parent], tracks[joint.child]
        rows = np.flatnonzero(parent.observed & child.observed)
        if not len(rows := rows[rows >= since]):
            return False
        residuals = compute_residuals(served_joints[joint], pair_tracks(parent, child, rows))
        return float(np.median(np.sum(residuals.orthogonal**2, axis=1))) < CHI_SQUARED_6

    known = [joint for joint in served_joints if {joint.parent, joint.child} <= tracks.keys()]
    frames = dict.fromkeys(f for joint in rejected for f in (joint.parent, joint.child) if f != exact)
    for a, b in combinations(frames, 2):
        exchanged = {**tracks, a: tracks[b], b: tracks[a]}
        involved = [joint for joint in known if {joint.parent, joint.child} & {a, b}]
        if not any(fits(joint, tracks) for joint in involved):
            if all(fits(joint, exchanged) for joint in involved):
                reason = (
                    f"the poses of '{a}' and '{b}' seem to be exchanged: with each other's the joint fits"
                )
                return dict.fromkeys([joint for joint in involved if joint in rejected], reason)
    return {}


class ConsistencyTests:
    """Consistency tests of all tested joints."""

    def __init__(
        self, model: Model, served_joints: Mapping[TestableJoint, KnownJoint], exact: str | None
    ) -> None:
        self._served_joints = served_joints
        self._frames = {joint: {joint.parent, joint.child} - {exact} for joint in served_joints}
        self._sources = _sources(model, served_joints)
        self._limits = {
            joint: _Limits(model, joint, served, self._sources) for joint, served in served_joints.items()
        }

    def is_equal(self, joint: TestableJoint, other: ConsistencyTests) -> bool:
        """Return True if a joint has the same consistency tests as in another set."""
        mine, theirs = self._limits[joint], other._limits.get(joint)
        if theirs is None or mine.slacks != theirs.slacks:
            return False
        return self._shared_coordinates(joint) == other._shared_coordinates(joint)

    def apply(
        self, data: Mapping[TestableJoint, JointObservations]
    ) -> dict[TestableJoint, JointObservations]:
        """Return the observations of each joint with the results of the tests added to their residuals."""
        return {joint: replace(each, residuals=self._apply_to(joint, data)) for joint, each in data.items()}

    def _shared_coordinates(self, joint: TestableJoint) -> tuple[Symbol, ...]:
        served = self._served_joints[joint]
        return tuple(x for x in served.coordinates if served.is_plain and self._sources[x] != joint)

    def _apply_to(
        self, joint: TestableJoint, data: Mapping[TestableJoint, JointObservations]
    ) -> KnownResiduals:
        served, limits, mine = self._served_joints[joint], self._limits[joint], data[joint]
        shared_coordinates = self._shared_coordinates(joint)
        if not limits.slacks and not shared_coordinates:
            return mine.residuals
        others = list(dict.fromkeys([*limits.others, *shared_coordinates]))
        # Values and covariances of other coordinates, NaN where unknown, and those that share a frame.
        count, m = len(mine.numbers), len(others)
        values, covariances = np.full((count, m), np.nan), np.zeros((count, m, m))
        shared = np.zeros(m, dtype=bool)
        for source in {self._sources[x] for x in others}:
            at = np.array([j for j, x in enumerate(others) if self._sources[x] == source])
            shared[at] = bool(self._frames[source] & self._frames[joint])
            if source in data:
                columns = np.array([self._served_joints[source].coordinates.index(others[j]) for j in at])
                known = data[source].residuals
                _, here, there = np.intersect1d(mine.numbers, data[source].numbers, return_indices=True)
                values[np.ix_(here, at)] = known.values[np.ix_(there, columns)]
                covariances[np.ix_(here, at, at)] = known.covariances[np.ix_(there, columns, columns)]
        excess = limits.excess(served, mine.residuals, values, covariances, shared)
        columns = np.array([others.index(x) for x in shared_coordinates], dtype=int)
        disagreement = np.zeros((count, len(columns)))
        for j, other in enumerate(columns):
            k, elsewhere = (
                served.coordinates.index(others[other]),
                (values[:, other], covariances[:, other, other]),
            )
            disagreement[:, j] = _disagreement(served, mine.residuals, k, *elsewhere, bool(shared[other]))
        return replace(
            mine.residuals, limit_excess=excess, disagreement=disagreement, other_values=values[:, columns]
        )


class _Limits:
    """Limits of a joint that are more than bounds on one of its coordinates."""

    def __init__(
        self, model: Model, joint: TestableJoint, served: KnownJoint, sources: Mapping[Symbol, TestableJoint]
    ) -> None:
        slacks = {}
        for constraint in model.constraints_for(served.coordinates).values():
            if served.is_plain and any(is_own_limit(constraint, x) for x in served.coordinates):
                continue
            limited = model.rates.resolve(to_plain(constraint.expression))
            if not set(served.coordinates) & set(limited.symbols):
                continue  # the constraint limits another joint
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
        # Parameters have their values.
        parameters = {s: s.value or 0.0 for slack in slacks for s in slack.symbols if s not in inputs}
        stacked = array([slack.substitute(parameters) if parameters else slack for slack in slacks])
        gradient, none = stacked.gradient(heuristic=False), as_expression(np.zeros(len(slacks)))
        self._function = compile([stacked, *(gradient.get(x.derivative(), none) for x in inputs)], inputs)

    def excess(
        self,
        served: KnownJoint,
        residuals: KnownResiduals,
        values: Array,
        covariances: Array,
        shared: npt.NDArray[np.bool_],
    ) -> Array:
        """Return the violation of each limit in standard deviations, (N, c)."""
        count, m = len(residuals), len(self.others)
        if not self.slacks:
            return np.zeros((count, 0))
        q = residuals.values if served.is_plain else residuals.coordinates
        points = np.concatenate([q, values[:, :m]], axis=1)
        slack, *slopes = self._evaluate(points)
        n = q.shape[1]
        by_joints = served.per_joint(q, np.stack(slopes[:n], axis=2))
        by_others = np.stack(slopes[n:], axis=2) if m else np.zeros((count, len(self.slacks), 0))
        spread, others = (
            np.einsum("ncj,njk,nck->nc", by, covariance, by)
            for by, covariance in ((by_joints, residuals.covariances), (by_others, covariances[:, :m, :m]))
        )
        z = _deviations(slack, spread, others, bool(shared[:m].any()))
        of_joint = np.einsum("nii->ni", residuals.covariances) if served.is_plain else np.zeros((count, n))
        within = np.sqrt(np.concatenate([of_joint, np.einsum("nii->ni", covariances[:, :m, :m])], axis=1))
        enough = _NONLINEAR * _RANGE * np.sqrt(spread + others)
        for k, slope in enumerate(slopes):
            z[~_is_linear(lambda p: self._evaluate(p)[0], points, k, within[:, k], slope, enough)] = np.nan
        return z

    def _evaluate(self, points: Array) -> Array:
        """Return the slacks and their slopes, (1 + n, N, c); NaN where a loop does not close."""
        result = np.full((1 + points.shape[1], len(points), len(self.slacks)), np.nan)
        rows = np.isfinite(points).all(axis=1)
        try:
            if rows.any():
                result[:, rows] = self._function.batch(points[rows])
        except KineverseError:
            for k in range(len(points) if len(points) > 1 else 0):
                result[:, k : k + 1] = self._evaluate(points[k : k + 1])
        return result


def _is_linear(
    function: Callable[[Array], Array], points: Array, k: int, deviations: Array, slope: Array, enough: Array
) -> npt.NDArray[np.bool_]:
    """Return True where first-order propagation holds within the uncertainty of coordinate k."""
    here, result = function(points), np.ones(enough.shape, dtype=bool)
    for step in (-_RANGE * deviations, _RANGE * deviations):
        moved = points.copy()
        moved[:, k] += step
        result &= enough >= np.abs((function(moved) - here).T - step * slope.T).T
    return result


def _sources(model: Model, served_joints: Mapping[TestableJoint, KnownJoint]) -> dict[Symbol, TestableJoint]:
    """Return the joint that estimates each coordinate: its joint if observed, else one that moves with it."""
    sources: dict[Symbol, TestableJoint] = {}
    for only_written in (True, False):
        for joint, served in served_joints.items():
            cells = model.history.entry(joint.tag).writes.items()
            written = {x for (kind, _), value in cells if kind == ARTICULATIONS for x in value.coordinates}
            for x in served.coordinates if served.is_plain else ():
                if x in written or not only_written:
                    sources.setdefault(x, joint)
    return sources


def _disagreement(
    served: KnownJoint, residuals: KnownResiduals, k: int, other: Array, variance: Array, shared: bool
) -> Array:
    """Return the difference of coordinate k from its estimate by others, in standard deviations, (N,).

    Poses are compared, starting from the estimate by others: a bar that follows a crank has the same pose
    twice per turn, which leaves its estimate from its pose ambiguous.
    """
    there = residuals.values.copy()
    there[:, k] = other
    try:
        here, expected = served.linearise(residuals.values), served.linearise(there)
        back = np.asarray(np.linalg.pinv(np.nan_to_num(expected.by_joints)), dtype=np.float64)

        def change(values: Array) -> Array:
            return multiply_vectors(back, pose_difference(served.linearise(values).pose, expected.pose))[:, k]

        by_joints = back @ here.by_joints
        spread = (by_joints @ residuals.covariances @ np.swapaxes(by_joints, 1, 2))[:, k, k]
        z = _deviations(change(residuals.values), spread, variance, shared)
        # In a singular linkage first-order propagation fails, for either value.
        enough = _NONLINEAR * _RANGE * np.sqrt(spread + variance)
        sides = (
            (residuals.values, by_joints, residuals.covariances[:, k, k]),
            (there, back @ expected.by_joints, variance),
        )
        for values, slopes, of_side in sides:
            z[~_is_linear(change, values, k, np.sqrt(of_side), slopes[:, k, k], enough)] = np.nan
    except KineverseError:
        return np.full(len(residuals), np.nan)
    return z


def _deviations(off: Array, one: Array, other: Array, shared: bool) -> Array:
    """Return values in standard deviations, added up if a frame is shared; NaN where undefined."""
    with np.errstate(invalid="ignore", divide="ignore"):
        deviation = np.sqrt(one) + np.sqrt(other) if shared else np.sqrt(one + other)
        z: Array = off / deviation
    z[~np.isfinite(z)] = np.nan
    return z
