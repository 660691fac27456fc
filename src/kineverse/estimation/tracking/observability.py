"""Unobservable directions: restarts, averaged measurements, and covariance along a curved ridge.

A filter sums information that was linearised at different estimates. An arm with seven joints can move while
its end effector rests. The direction of this null motion differs a little between estimates, so the sum holds
false information about an unobservable direction. While the state is static, measurements are instead
averaged on SE(3), and the posterior follows from the prior and these means, linearised at one point. This is
needed only while the group has unobservable directions.

One measured point of a body in the plane determines the position of this point but not the angle: the
possible states form a ring. A Gaussian covers the tangent of the ring only and would place the truth within
the noise of that. At the next estimate the tangent differs, and the intersection of two tangents would pass
for information along the ring. :class:`RidgeCovariance` therefore widens the Gaussian by the second moment of
the curvature. Second-order filters add the same to each measurement (Athans, Wishner and Bertolini,
Suboptimal state estimation for continuous-time nonlinear systems, 1968).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from kineverse.errors import KineverseError
from kineverse.estimation.linear_algebra import inverse_spd
from kineverse.lie import Array, pose_difference, retract

from .map_update import MapResult
from .measurements import MeasurementModel, wrap_difference
from .residuals import Measurements, whitening
from .state_space import CoordinateGroup, InformationState, Layout, QuadraticCost

if TYPE_CHECKING:
    from .gaussian_sum_filter import UpdateStep

_UNOBSERVABLE = 0.05  # a direction is unobservable while its deviation exceeds this part of the initial one
_LEAST = 1e-4  # rounding may cancel information; no step is longer than a hundred initial deviations


class UnobservableDirections:
    """Classification of tangent directions by their information."""

    def __init__(self, layout: Layout) -> None:
        self._groups = layout.groups
        self.deviations: Array = np.ones(len(layout.tangent_space.tangent))

    def directions(self, number: int, information: Array) -> Array:
        """Return the unobservable directions of a group as orthogonal steps of one deviation (k, t)."""
        scale = self.deviations[self._groups[number].t]
        values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
        steps = (vectors * np.maximum(values, _LEAST) ** -0.5).T * scale
        return np.asarray(steps[values < _UNOBSERVABLE**-2])

    def is_in(self, number: int, belief: InformationState) -> bool:
        """Return True if a group has unobservable directions in a belief."""
        group = self._groups[number]
        information, scale = belief.information[group.block], self.deviations[group.t]
        return bool(np.linalg.eigvalsh(information * np.outer(scale, scale))[0] < _UNOBSERVABLE**-2)


_EXPLAINED = 3.0  # residuals are explained if their χ² is fewer deviations than this above its mean
_MOST_DIRECTIONS = 2  # restarts are limited to the directions of least information


def find_unexplained(result: MapResult) -> list[int]:
    """Return the groups whose residuals exceed the noise."""
    beyond = result.nis > result.dof + _EXPLAINED * np.sqrt(2 * result.dof)
    return np.flatnonzero(beyond).tolist() if beyond.any() else []


def move_origin(
    belief: InformationState,
    number: int,
    group: CoordinateGroup,
    there: Array,
    step: Array,
    transport: Array | None,
) -> None:
    """Write the same belief of a group about other coordinates, at the end of a tangent step; in place."""
    belief.x[group.x] = there
    belief.set_group_cost(group.t, belief.group_cost(group.t).transported(step, transport))
    record = belief.records[number]
    if record is not None:
        belief.records[number] = replace(record, prior=record.prior.transported(step, transport))


def restart_states(
    step: UpdateStep,
    before: InformationState,
    after: InformationState,
    groups: Sequence[int],
    inputs: Array,
) -> list[InformationState]:
    """Return prior beliefs about points on both sides of the estimate, in unobservable directions.

    The measurement Jacobian may vanish at the estimate, or another point explain the measurements.
    """
    beliefs: list[InformationState] = []
    for number in groups:
        group, record, index = step.layout.groups[number], before.records[number], 0
        x, bounds = before.x[group.x], step.solver.group_bounds[number]
        # Unobservable now, or before the stored measurements.
        directions = step.unobservable.directions(number, after.information[group.block])
        if not len(directions) and record is not None:
            directions = step.unobservable.directions(number, record.prior.matrix)
        directions = directions[:_MOST_DIRECTIONS]
        for direction in (*directions, *-directions):
            try:
                there, _ = step.process_model.retract(number, x, direction, inputs)
                change = bounds.remaining(x, bounds.clip(there), direction)
                there, transport = step.process_model.retract(number, x, change, inputs)
            except KineverseError:  # infeasible
                continue
            if index == len(beliefs):
                beliefs.append(before.copy())
            move_origin(beliefs[index], number, group, there, change, transport)
            index += 1
    return beliefs


def turning_coordinates(step: UpdateStep, number: int) -> list[int]:
    """Return the unlimited coordinates of a group whose turns its measurements may tell, by their index."""
    group, limits, coordinates = (
        step.layout.groups[number],
        step.limits,
        step.layout.tangent_space.coordinates,
    )
    if group.by_speeds:
        return []
    free = group.x[np.isinf(limits.lower[group.x]) & np.isinf(limits.upper[group.x])].tolist()
    return [i for i in free if coordinates[i] not in step.periods]


def turned_states(
    step: UpdateStep,
    before: InformationState,
    after: InformationState,
    reading: Measurements,
    inputs: Array,
    groups: Sequence[int],
) -> list[tuple[InformationState, list[int]]]:
    """Return prior beliefs on other turns of unlimited coordinates, as of a pinion, with their group."""
    result = []
    for number, i in [(n, i) for n in groups for i in turning_coordinates(step, n)]:
        group = step.layout.groups[number]
        place, errors = after.x.copy(), []
        for turn in (0.0, math.tau):
            place[i] = after.x[i] + turn
            out = step.residuals.evaluate(place, inputs)
            measured = step.residuals.errors(out, reading, group.observation_indices)
            errors.append(np.concatenate([error for error, _ in measured.values()]))
        change = errors[1] - errors[0]
        turns = round(-float(errors[0] @ change) / max(float(change @ change), np.finfo(float).tiny))
        if turns:
            place[i] = after.x[i] + turns * math.tau
            start, there = before.copy(), place[group.x]
            move_origin(start, number, group, there, there - before.x[group.x], None)
            result.append((start, [number]))
    return result


_LEAST_WEIGHT = 1e-3  # measurements with a smaller weight are ignored


@dataclass(frozen=True, eq=False)
class MeanMeasurement:
    """Information-weighted mean of measurements of one observation."""

    value: Array  # pose 4×4 row by row, or vector
    information: Array  # inverse covariance of the mean (d, d), in the axes of the observing frame
    peak: float  # log density of all averaged measurements at their mean

    def combine(self, other: MeanMeasurement, one: MeasurementModel) -> MeanMeasurement:
        """Return the mean of both, weighted by information."""
        information = self.information + other.information
        if one.is_pose:
            difference = pose_difference(other.value.reshape(4, 4), self.value.reshape(4, 4))
        else:
            difference = wrap_difference(other.value - self.value, one.period)
        step = np.linalg.solve(information, other.information) @ difference
        peak = self.peak + other.peak - float(difference @ self.information @ step) / 2
        value = retract(self.value.reshape(4, 4), step).reshape(-1) if one.is_pose else self.value + step
        return MeanMeasurement(value, information, peak)


@dataclass(frozen=True, eq=False)
class StaticRecord:
    """Prior and averaged measurements of a group since it last moved."""

    prior: QuadraticCost  # prior before the measurements, in the tangent space at the present estimate
    means: Mapping[int, MeanMeasurement]  # averaged measurements, by number of the observation
    inputs: Array  # values of the inputs during these measurements
    evidence: float  # log evidence of the group before these measurements

    def with_measurements(
        self, new: Mapping[int, MeanMeasurement], observations: Sequence[MeasurementModel]
    ) -> StaticRecord:
        """Return the record with further measurements averaged in."""
        means = dict(self.means)
        for i, one in new.items():
            means[i] = means[i].combine(one, observations[i]) if i in means else one
        return replace(self, means=means)

    def as_measurements(self, step: UpdateStep) -> Measurements:
        """Return the averaged measurements as one reading."""
        layout, empty = step.layout, step.reader.empty()
        white, scale = empty.whitening.copy(), empty.log_scale.copy()
        for i, mean in self.means.items():
            empty.values[layout.measurement_slices[i]] = mean.value
            empty.mask[i], scale[i] = True, -mean.peak
            white[layout.whitening_slices[i]] = whitening(inverse_spd(mean.information)).reshape(-1)
        return empty._replace(whitening=white, log_scale=scale)


class StaticBatch:
    """Batch relinearisation for the groups of a tracker."""

    def __init__(self, step: UpdateStep) -> None:
        self._step, self._layout = step, step.layout
        # In a group with one direction, linearisation at several estimates adds no false information.
        self._groups = {number for number, group in enumerate(step.layout.groups) if len(group.t) > 1}

    def relinearise(
        self,
        before: InformationState,
        result: MapResult,
        reading: Measurements,
        inputs: Array,
        groups: Sequence[int],
    ) -> None:
        """Recompute an update from all stored measurements where a group has unobservable directions."""
        after, unobservable = result.belief, self._step.unobservable
        for number in self._groups.intersection(groups):
            group, old = self._layout.groups[number], before.records[number]
            if old is None and not unobservable.is_in(number, after):
                continue
            new = {
                i: self._mean_measurement(i, reading, float(result.weights[i]))
                for i in group.observation_indices
                if reading.mask[i] and result.weights[i] > _LEAST_WEIGHT
            }
            if old is None or not new:
                if new:
                    prior, evidence = result.prior.group_cost(group.t), float(before.evidence[number])
                    after.records[number] = StaticRecord(prior, new, inputs, evidence)
                continue
            record = old.with_measurements(new, self._layout.observations)
            batch = self._solve_batch(number, before, record)
            after.x[group.x] = batch.belief.x[group.x]
            after.set_group_cost(group.t, batch.belief.group_cost(group.t))
            if self._step.outliers is None:
                after.evidence[number] = batch.belief.evidence[number]
            # Observations still to come may show that the estimate is a mirror image: keep the record.
            is_complete = len(record.means) == len(group.observation_indices)
            record = replace(record, prior=batch.prior.group_cost(group.t))
            is_done = is_complete and not unobservable.is_in(number, after)
            after.records[number] = None if is_done else record

    def add_noise(
        self, number: int, before: InformationState, after: InformationState, added_variance: Array
    ) -> None:
        """Add process noise to the record of a group that moves by noise alone."""
        record, group = before.records[number], self._layout.groups[number]
        assert record is not None
        out = self._step.residuals.evaluate(after.x, record.inputs)
        means = {}
        for i, one in record.means.items():
            size = self._layout.observations[i].size
            slope = out[self._layout.jacobian_slices[i]].reshape(size, len(group.t))
            # Errors from motion are fully correlated; scaled by their number they may count as independent.
            noise = len(record.means) * (slope * added_variance) @ slope.T
            information = inverse_spd(inverse_spd(one.information) + noise)
            lost = np.linalg.slogdet(one.information)[1] - np.linalg.slogdet(information)[1]
            means[i] = replace(one, information=information, peak=one.peak - float(lost) / 2)
        covariance = inverse_spd(record.prior.matrix)
        matrix = inverse_spd(covariance + np.diag(added_variance))
        prior = QuadraticCost.from_density(matrix, matrix @ (covariance @ record.prior.vector))
        step = after.x[group.x] - before.x[group.x]
        reduced = replace(record, prior=prior.transported(step, None), means=means, evidence=0.0)
        # The evidence of past measurements stays; the reduced information applies to future ones only.
        from_record = self._solve_batch(number, after, reduced).belief.evidence[number]
        after.records[number] = replace(reduced, evidence=float(before.evidence[number] - from_record))

    def _mean_measurement(self, i: int, reading: Measurements, weight: float) -> MeanMeasurement:
        size = self._layout.observations[i].size
        white = reading.whitening[self._layout.whitening_slices[i]].reshape(size, size)
        value = reading.values[self._layout.measurement_slices[i]].copy()
        return MeanMeasurement(value, weight * (white.T @ white), -float(reading.log_scale[i]))

    def _solve_batch(self, number: int, before: InformationState, record: StaticRecord) -> MapResult:
        first = before.copy()
        first.set_group_cost(self._layout.groups[number].t, record.prior)
        first.evidence[number] = record.evidence
        return self._step.solve(first, record.as_measurements(self._step), record.inputs, [number])


_STRAIGHT = 0.02  # a ridge that deviates from its tangent by less, in deviations across it, is straight


class RidgeCovariance:
    """Covariance that contains the curved ridge of a posterior with unobservable directions."""

    def __init__(self, step: UpdateStep) -> None:
        self._step, self._layout = step, step.layout

    def compute(self, number: int, belief: InformationState) -> Array:
        """Return the second moment of the posterior of a group about its estimate (t, t)."""
        covariance = inverse_spd(belief.information[self._layout.groups[number].block])
        if belief.records[number] is None:
            return covariance
        bends = self._bends(number, belief, covariance)
        return np.asarray(covariance + bends.T @ bends)

    def inflate(self, number: int, belief: InformationState) -> None:
        """Inflate the Gaussian of a group to this covariance, and drop its static record; in place."""
        t, block = self._layout.groups[number].t, self._layout.groups[number].block
        mean = inverse_spd(belief.information[block]) @ belief.vector[t]
        belief.information[block] = inverse_spd(self.compute(number, belief))
        belief.vector[t] = belief.information[block] @ mean
        belief.records[number] = None

    def is_straight(self, number: int, belief: InformationState) -> bool:
        """Return True if the measurements of a group are linear within its belief."""
        information = belief.information[self._layout.groups[number].block]
        bends = self._bends(number, belief, inverse_spd(information))
        return bool(np.einsum("ij,jk,ik->i", bends, information, bends).max(initial=0.0) < _STRAIGHT**2)

    def _bends(self, number: int, belief: InformationState, covariance: Array) -> Array:
        """Return steps whose outer products add up to the second moment of the curvature of the ridge (m, t).

        A step Σ aₖ uₖ along its tangent, with a ~ N(0, 1), leaves the ridge by Σ aₖ aₗ dₖₗ + Σ aₖ³ oₖ.
        """
        step, group, record, x = self._step, self._layout.groups[number], belief.records[number], belief.x
        assert record is not None
        bounds, inputs, measured = step.solver.group_bounds[number], record.inputs, list(record.means)
        here = step.residuals.evaluate(x, inputs)
        predicted = step.reader.as_reading(here, measured)
        reading = record.as_measurements(step)._replace(values=predicted.values)
        slopes = {i: s for i, (_, s) in step.residuals.errors(here, reading, measured).items()}

        def back(along: Array) -> Array:
            """Return the step back to the ridge from the end of a step along its tangent."""
            there = x.copy()
            try:
                after, _ = step.process_model.retract(number, x[group.x], along, inputs)
                there[group.x] = bounds.clip(after)
                errors = step.residuals.errors(step.residuals.evaluate(there, inputs), reading, measured)
            except KineverseError:  # infeasible
                return np.zeros(len(along))
            left = bounds.remaining(x[group.x], there[group.x], along)
            pull = sum(slopes[i].T @ (error + slopes[i] @ left) for i, (error, _) in errors.items())
            return covariance @ pull if np.isfinite(pull).all() else np.zeros(len(along))

        directions = step.unobservable.directions(number, belief.information[group.block])
        ahead, behind = (np.array([back(one) for one in way]) for way in (directions, -directions))
        even, odd = (ahead + behind) / 2, (ahead - behind) / 2
        rows = [np.sqrt(2.0) * even, np.sqrt(15.0) * odd, even.sum(axis=0, keepdims=True)]
        for k, m in itertools.combinations(range(len(even)), 2):
            both = directions[k] + directions[m]
            rows.append([(back(both) + back(-both)) / 2 - even[k] - even[m]])
        return np.concatenate(rows) if len(even) else np.zeros((0, len(covariance)))
