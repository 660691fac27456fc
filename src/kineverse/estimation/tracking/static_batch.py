"""Batch relinearisation of measurements while the state is static.

A filter adds up what observations say where they are linear, each at another estimate. An arm with seven
joints moves in itself while its tip stays; the direction of this differs a bit from estimate to estimate, so
the sum knows of a motion of which nobody has seen anything. As long as nothing moves, all can be linearised
anew at one place: what was seen is summed up on SE(3) instead, and the belief follows from what was believed
before and from that. This needs to be done only as long as there are open directions.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeAlias

import numpy as np

from kineverse.lie import Array, pose_difference, retract

from .gaussian import InformationState, QuadraticCost, inverse_spd
from .layout import Layout
from .map_update import MapResult, MapSolver
from .measurements import MeasurementModel, wrap_difference
from .observability import UnobservableDirections
from .residuals import MeasurementReader, Measurements, Residuals, whitening

UpdateFunction: TypeAlias = Callable[[InformationState, Measurements, Array, list[int]], MapResult]

# Who counts less than this has said nothing.
_NOTHING = 1e-3


@dataclass(frozen=True, eq=False)
class MeanMeasurement:
    """The mean of observations, weighted with their information.

    Attributes
    ----------
    value
        Pose 4×4 row by row, or vector.
    information
        Of it (d, d), in the axes of the observer.
    peak
        The log density of all of them if the mean is the truth.
    """

    value: Array
    information: Array
    peak: float

    def joined(self, other: MeanMeasurement, one: MeasurementModel) -> MeanMeasurement:
        """Return the mean of both."""
        information = self.information + other.information
        apart = self._apart(other, one)
        share = np.linalg.solve(information, other.information)
        step = share @ apart
        peak = self.peak + other.peak - float(apart @ self.information @ step) / 2
        if not one.is_pose:
            return MeanMeasurement(self.value + step, information, peak)
        pose = retract(self.value.reshape(4, 4), step)
        return MeanMeasurement(pose.reshape(-1), information, peak)

    def _apart(self, other: MeanMeasurement, one: MeasurementModel) -> Array:
        if not one.is_pose:
            return wrap_difference(other.value - self.value, one.period)
        return pose_difference(other.value.reshape(4, 4), self.value.reshape(4, 4))


@dataclass(frozen=True, eq=False)
class StaticRecord:
    """What is known of a group since it moved last.

    Attributes
    ----------
    prior
        What was believed before anything was seen, in the tangent at the present place.
    seen
        What was seen since, by the number of the observation.
    known
        The values of what is known, at which it was seen.
    evidence
        The log evidence of the group before.
    looks
        How often something was seen.
    branch
        The same for all that follows from the same first look.
    """

    prior: QuadraticCost
    seen: Mapping[int, MeanMeasurement]
    known: Array
    evidence: float
    looks: int = 0
    branch: object = field(default_factory=object)

    def with_seen(
        self, new: Mapping[int, MeanMeasurement], observations: Sequence[MeasurementModel]
    ) -> StaticRecord:
        """Return it with more that was seen."""
        seen = dict(self.seen)
        for i, one in new.items():
            seen[i] = seen[i].joined(one, observations[i]) if i in seen else one
        return replace(self, seen=seen, looks=self.looks + 1)

    def reading(self, layout: Layout, reader: MeasurementReader) -> Measurements:
        """Return all of it as one reading."""
        nothing = reader.nothing()
        white, scale = nothing.whitening.copy(), nothing.log_scale.copy()
        for i, seen in self.seen.items():
            nothing.values[layout.seen_slices[i]] = seen.value
            nothing.seen[i], scale[i] = True, -seen.peak
            white[layout.white_slices[i]] = whitening(inverse_spd(seen.information)).reshape(-1)
        return nothing._replace(whitening=white, log_scale=scale)


class StaticBatch:
    """Keeps what was seen of what stands still.

    Parameters
    ----------
    layout, residuals, reader, solver, openness
        The parts of a tracker.
    update
        What does the same as the solver, and faster where it can.
    """

    def __init__(
        self,
        layout: Layout,
        residuals: Residuals,
        reader: MeasurementReader,
        solver: MapSolver,
        openness: UnobservableDirections,
        update: UpdateFunction,
    ) -> None:
        self._layout, self._residuals, self._reader = layout, residuals, reader
        self._solver, self._openness, self._update = solver, openness, update
        # A single coordinate has no other that it could move with.
        self._groups = {number for number, group in enumerate(layout.groups) if len(group.t) > 1}

    def remember(
        self,
        before: InformationState,
        found: MapResult,
        reading: Measurements,
        known: Array,
        groups: Sequence[int] | None = None,
    ) -> None:
        """Have what was found follow from all that was seen, where it has open directions.

        Parameters
        ----------
        before
            What was believed before a reading.
        found
            What is believed after it, which is changed.
        reading
            What was seen.
        known
            Values of what is known.
        groups
            The numbers of those that are changed; all if None.
        """
        after, weights = found.belief, found.weights
        for number in self._groups if groups is None else self._groups.intersection(groups):
            group, old = self._layout.groups[number], before.standing[number]
            new = {
                i: self._seen(i, reading, 1.0 if weights is None else float(weights[i]))
                for i in group.seen
                if reading.seen[i] and (weights is None or weights[i] > _NOTHING)
            }
            if not new or (old is None and not self._is_open(number, after)):
                continue
            if old is None:
                evidence = float(before.evidence[number])
                first = StaticRecord(before.part(group.t), {}, known, evidence)
                standing = first.with_seen(new, self._layout.observations)
                if found.priors is not None or not group.by_speeds:
                    after.standing[number] = replace(
                        standing, prior=self._prior(number, before, first.prior, found)
                    )
                    continue
                old = first
            standing = old.with_seen(new, self._layout.observations)
            self._solve(number, before, after, standing, are_all_right=weights is None)
            # What was never seen yet may still say that all was taken for its mirror image.
            if len(standing.seen) == len(group.seen) and not self._is_open(number, after):
                after.standing[number] = None

    def add_noise(self, number: int, before: InformationState, after: InformationState, grown: Array) -> None:
        """Let go of what noise takes away: of a group that moves by that alone, the rest is remembered.

        Parameters
        ----------
        number
            Of the group.
        before, after
            What was believed before and after, of which the latter is changed.
        grown
            The variances that have come to its tangent (t,).
        """
        standing, group = before.standing[number], self._layout.groups[number]
        assert standing is not None
        out = self._residuals.evaluate(after.x, standing.known)
        seen = {}
        for i, one in standing.seen.items():
            size = self._layout.observations[i].size
            slope = out[self._layout.slope_slices[i]].reshape(size, len(group.t))
            # All that was seen moves alike. Taken to be independent, each is told of the motion of all.
            noise = len(standing.seen) * (slope * grown) @ slope.T
            information = inverse_spd(inverse_spd(one.information) + noise)
            lost = np.linalg.slogdet(one.information)[1] - np.linalg.slogdet(information)[1]
            seen[i] = replace(one, information=information, peak=one.peak - float(lost) / 2)
        covariance = inverse_spd(standing.prior.matrix)
        matrix = inverse_spd(covariance + np.diag(grown))
        prior = QuadraticCost.of_density(matrix, matrix @ (covariance @ standing.prior.vector))
        step = after.x[group.x] - before.x[group.x]
        loose = replace(standing, prior=prior.carried(step, None), seen=seen, evidence=0.0)
        # What was seen is as probable as it was; only what comes is judged by what is left.
        as_told = self._from_all(number, after, loose).belief.evidence[number]
        after.standing[number] = replace(loose, evidence=float(before.evidence[number] - as_told))

    def _is_open(self, number: int, belief: InformationState) -> bool:
        t = self._layout.groups[number].t
        return self._openness.is_open(number, belief.information[np.ix_(t, t)])

    def _seen(self, i: int, reading: Measurements, weight: float) -> MeanMeasurement:
        size = self._layout.observations[i].size
        white = reading.whitening[self._layout.white_slices[i]].reshape(size, size)
        value = reading.values[self._layout.seen_slices[i]].copy()
        return MeanMeasurement(value, weight * (white.T @ white), -float(reading.log_scale[i]))

    def _solve(
        self,
        number: int,
        before: InformationState,
        after: InformationState,
        standing: StaticRecord,
        are_all_right: bool,
    ) -> None:
        """Find the most probable state from where it was, and what is believed there."""
        group = self._layout.groups[number]
        found = self._from_all(number, before, standing)
        after.x[group.x] = found.belief.x[group.x]
        after.put(group.t, found.belief.part(group.t))
        if are_all_right:
            after.evidence[number] = found.belief.evidence[number]
        after.standing[number] = replace(standing, prior=self._prior(number, before, standing.prior, found))

    def _from_all(self, number: int, before: InformationState, standing: StaticRecord) -> MapResult:
        """Return what follows from all that is remembered, beginning at a place."""
        group = self._layout.groups[number]
        first = before.copy()
        first.put(group.t, standing.prior)
        first.evidence[number] = standing.evidence
        reading = standing.reading(self._layout, self._reader)
        # How a tangent turns on the way, C does not tell.
        update = self._solver.update if group.by_speeds else self._update
        return update(first, reading, standing.known, [number])

    def _prior(
        self, number: int, before: InformationState, prior: QuadraticCost, found: MapResult
    ) -> QuadraticCost:
        """Return what was believed before, in the tangent at the place that was found."""
        if found.priors is not None:
            return found.priors[number]
        group = self._layout.groups[number]
        step = found.belief.x[group.x] - before.x[group.x]
        return prior.carried(step, None)
