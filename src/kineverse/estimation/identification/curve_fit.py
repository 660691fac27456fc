"""Fit of a curve to observations: order along the path, spline by least squares, number of knots by evidence.

The observations come in any order. Candidates for their order along the path are that of the recording, of
the first principal component, of the length of the shortest path through near neighbours, and of the joint
values of other families. Each gives a coarse curve, and the nearest one continues: all observations are
projected onto it, it is fitted again, and its knots are spread evenly. The most probable number of knots is
chosen.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np

from kineverse.lie import Array, log_so3, mean_rotation, quaternion

from .curve import KNOTS, LEVER, CurveMotion, NaturalSpline, PathWidths, aligned_quaternions
from .least_squares import Solution, levenberg_marquardt
from .marginal_likelihood import Scored, laplace_evidence
from .motion_model import FamilyMember
from .observations import Observations

FEWEST_POSES = 5
"""Least number of observations of a curve."""

# Largest number of knots of the first curve, steps of the solver in a round, and rounds of projection.
_COARSE, _STEPS, _ROUNDS = 7, 6, 2
# Points of a curve among which the nearest is searched, for each knot.
_SAMPLES = 24
# Largest number of knots relative to the number of observations.
_DENSEST = 0.75
# Log evidence that a curve may lack, and the part of it that twice as many knots must leave at most.
_HOPELESS, _LEFT = 30.0, 0.6
# Largest number of observations among which the shortest paths are searched, and by which the shape is found.
_MOST, _MOST_FITTED = 120, 240
# Largest difference of poses that are equal.
_EQUAL = 1e-9


def may_be_curve(observations: Observations) -> bool:
    """Return True if there are enough observations for a curve, and not all of them are equal."""
    poses = observations.relative if observations.rows == 6 else observations.relative[:, :3, 3]
    return len(poses) >= FEWEST_POSES and float(np.ptp(poses, axis=0).max()) > _EQUAL


def fit_curve(
    observations: Observations,
    covariance: Array,
    orders: Iterable[Array] = (),
    log_evidence: Callable[[Solution[FamilyMember]], float] | None = None,
    competitor: float = -math.inf,
) -> Scored | None:
    """Return the most probable curve through observations; None if they are too few for one, or equal."""
    if not may_be_curve(observations):
        return None
    if len(observations) > _MOST_FITTED:
        some = np.linspace(0, len(observations) - 1, _MOST_FITTED).round().astype(int)
        thinned = observations.select(some), covariance[some], [order[some] for order in orders]
        known = fit_curve(*thinned, log_evidence)
        assert known is not None  # there are enough observations
        motion, covariance = _as_curve(known.solution), known.solution.covariance
        deviations = np.sqrt(np.einsum("nii->ni", covariance).mean(axis=0))
        values = _nearest(observations, deviations, motion)
        solution = levenberg_marquardt(observations, motion, values, steps=_STEPS)
        return Scored(solution, stated_log_evidence(solution))
    score = log_evidence or stated_log_evidence
    deviations = np.sqrt(np.einsum("nii->ni", covariance).mean(axis=0))
    possible = [count for count in KNOTS if count <= _DENSEST * len(observations)]
    middle = max(k for k, count in enumerate(possible) if count <= _COARSE)
    points = _whitened(observations.relative, observations.relative, deviations)
    *_, directions = np.linalg.svd(points, full_matrices=False)
    in_time = np.arange(len(points), dtype=np.float64)
    candidates = [in_time, points @ directions[0], _length_along_path(points), *orders]
    starts = [(_regressed(observations, along, possible[middle]), True) for along in candidates]
    # In the order of time, even knots would be poor where the motion pauses.
    starts.append((_regressed(observations, in_time, possible[middle], even=False), False))
    begun = [(_refine(observations, deviations, motion, 1, even), even) for motion, even in starts]
    start, even = min(begun, key=lambda pair: pair[0].cost)

    def fit(motion: CurveMotion, count: int) -> _FittedCurve:
        solution = _refine(observations, deviations, _with_knots(motion, count, even), _ROUNDS, even)
        return _FittedCurve(solution, score(solution))

    best = latest = fit(start.motion, possible[middle])
    worse = 0
    for count in possible[middle + 1 :]:
        missing = competitor - latest.log_evidence
        latest = fit(latest.solution.motion, count)
        worse = 0 if latest.log_evidence > best.log_evidence else worse + 1
        best = max(best, latest, key=lambda fitted: fitted.log_evidence)
        if worse == 2 or competitor - latest.log_evidence > max(_HOPELESS, _LEFT * missing):
            break
    if best.log_evidence > competitor - _HOPELESS:
        for count in reversed(possible[:middle]):
            fewer = fit(start.motion, count)
            if fewer.log_evidence < best.log_evidence:
                break
            best = fewer
    return continue_curve(observations, best.solution)


class _FittedCurve(NamedTuple):
    """Solution of a curve with some number of knots, and its log evidence."""

    solution: Solution[CurveMotion]
    log_evidence: float


def continue_curve(observations: Observations, before: Solution[FamilyMember]) -> Scored:
    """Return the curve with the knots of an earlier one, for the same observations or more."""
    motion, known, values = _as_curve(before), len(before.values), before.values
    if known < len(observations):
        new = observations.select(slice(known, None))
        deviations = np.sqrt(np.einsum("nii->ni", before.covariance).mean(axis=0))
        values = np.concatenate([values, _nearest(new, deviations, motion)])
    solution = levenberg_marquardt(observations, motion, values, steps=2 * _STEPS)
    return Scored(solution, stated_log_evidence(solution))


def _as_curve(solution: Solution[FamilyMember]) -> CurveMotion:
    motion = solution.motion
    assert isinstance(motion, CurveMotion)
    return motion


def stated_log_evidence(solution: Solution[FamilyMember]) -> float:
    """Return the log evidence of a curve for noise of the size of its covariances."""
    return laplace_evidence(solution).log_evidence


def _whitened(poses: Array, around: Array, deviations: Array) -> Array:
    """Return poses as points, (N, m): positions and rotations in standard deviations of their errors."""
    points = poses[:, :3, 3] - around[:, :3, 3].mean(axis=0)
    if len(deviations) == 6:
        mean = mean_rotation(around[:, :3, :3])
        points = np.concatenate([points, log_so3(poses[:, :3, :3] @ mean.T)], axis=1)
    return np.asarray(points / deviations)


def _length_along_path(points: Array) -> Array:
    """Return the length of the shortest path through near neighbours from one end to each point."""
    count = len(points)
    some = np.unique(np.linspace(0, count - 1, min(count, _MOST)).round().astype(int))
    distances = np.linalg.norm(points[:, None] - points[None, some], axis=2)
    among = distances[some]
    # Long steps cost more, so the path passes through near neighbours. Steps within the noise are free.
    costs = np.maximum(among - 1.0, 1e-3) ** 2
    for k in range(len(some)):
        np.minimum(costs, costs[:, k, None] + costs[None, k], out=costs)
    first = int(np.argmax(costs[int(np.argmax(costs[0]))]))
    reached = np.argsort(costs[first], kind="stable")
    along = np.empty(len(some))
    along[reached] = np.arange(len(some))
    nearest = np.argsort(distances, axis=1)[:, :2]
    result = np.asarray(along[nearest].mean(axis=1))
    result[some] = along
    return result


def _regressed(observations: Observations, along: Array, count: int, even: bool = True) -> CurveMotion:
    """Return the curve of least squares through observations with positions along it."""
    along = np.argsort(np.argsort(along, kind="stable"), kind="stable").astype(np.float64)
    order = np.argsort(along, kind="stable")
    spline = NaturalSpline(0.0, (len(along) - 1) / (count - 1), count)
    weights = spline.weights(along[order]).values
    relative = observations.relative[order]
    places = relative[:, :3, 3]
    turns = aligned_quaternions(relative[:, :3, :3])
    # The ridge keeps knots finite that no observation determines.
    ridge = 1e-3 * np.diff(np.eye(count), n=2, axis=0)
    system = np.concatenate([weights, ridge])
    right = np.concatenate([np.concatenate([places, turns], axis=1), np.zeros((count - 2, 7))])
    values = np.linalg.lstsq(system, right, rcond=None)[0]
    widths = PathWidths.of_poses(relative, observations.rows)
    return _resampled(observations.rows, spline, values[:, :3], values[:, 3:], count, even, widths)


def _resampled(
    rows: int,
    spline: NaturalSpline,
    positions: Array,
    quaternions: Array,
    count: int,
    even: bool,
    widths: PathWidths,
    lever: float = LEVER,
) -> CurveMotion:
    """Return a curve with other knots; the joint value becomes the length along it if ``even``."""
    at = np.linspace(spline.first, spline.last, _SAMPLES * count)
    weights = spline.weights(at).values
    places, turns = weights @ positions, weights @ quaternions
    steps = np.sum(np.diff(places, axis=0) ** 2, axis=1)
    if rows == 6:
        turn = quaternion(turns)
        steps += lever**2 * np.sum(log_so3(turn[1:] @ np.swapaxes(turn[:-1], 1, 2)) ** 2, axis=1)
    lengths = np.concatenate([[0.0], np.cumsum(np.sqrt(steps))])
    whole = max(float(lengths[-1]), 1e-6)
    knots = NaturalSpline(-0.5 * whole, whole / (count - 1), count)
    chosen = np.interp(knots.knots + 0.5 * whole, lengths, at) if even else np.linspace(at[0], at[-1], count)
    new = spline.weights(chosen).values
    return CurveMotion.through(rows, knots, new @ positions, new @ quaternions, widths, lever)


def _with_knots(
    motion: CurveMotion, count: int, even: bool, ends: tuple[float, float] | None = None
) -> CurveMotion:
    """Return a curve with equidistant knots over a range of its joint value."""
    first, last = ends or (motion.spline.first, motion.spline.last)
    part = NaturalSpline(first, (last - first) / (4 * count), 4 * count + 1)
    weights = motion.spline.weights(part.knots).values
    positions, quaternions = weights @ motion.positions, weights @ motion.quaternions
    return _resampled(motion.rows, part, positions, quaternions, count, even, motion.widths, motion.lever)


def _refine(
    observations: Observations, deviations: Array, motion: CurveMotion, rounds: int, even: bool = True
) -> Solution[CurveMotion]:
    """Return the solution after rounds of projection onto the curve, steps of the solver and even knots."""
    for k in range(rounds):
        values = _nearest(observations, deviations, motion)
        solution = levenberg_marquardt(observations, motion, values, steps=_STEPS)
        if k == rounds - 1:
            break
        used = solution.values[:, 0]
        ends = float(used.min()), float(used.max())
        if ends[1] - ends[0] < 1e-3 * motion.length:
            break
        motion = _with_knots(solution.motion, motion.spline.count, even, ends)
    return solution


def _nearest(observations: Observations, deviations: Array, motion: CurveMotion) -> Array:
    """Return the joint value of the nearest point of a curve for each observation, (N, 1)."""
    at = np.linspace(motion.spline.first, motion.spline.last, _SAMPLES * motion.spline.count)
    relative = observations.relative
    observed = _whitened(relative, relative, deviations)
    points = _whitened(motion.linearise(at[:, None]).pose, relative, deviations)
    squares = np.sum(points**2, axis=1) - 2.0 * observed @ points.T
    return np.asarray(at[np.argmin(squares, axis=1)][:, None])
