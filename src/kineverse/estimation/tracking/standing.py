"""What was seen of a state that stands still is kept as it was seen.

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

from kineverse.estimation.noise import Array
from kineverse.estimation.rotations import exponential, logarithm

from .belief import Belief, Quadratic, inverse
from .layout import Layout
from .observed import Observation, nearest
from .openness import Openness
from .reading import Reader, Reading, whitening
from .residuals import Residuals
from .solving import Found, Solver

Update: TypeAlias = Callable[[Belief, Reading, Array, list[int]], Found]

# Who counts less than this has said nothing.
_NOTHING = 1e-3


@dataclass(frozen=True, eq=False)
class Seen:
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

    def joined(self, other: Seen, one: Observation) -> Seen:
        """Return the mean of both."""
        information = self.information + other.information
        apart = self._apart(other, one)
        share = np.linalg.solve(information, other.information)
        step = share @ apart
        peak = self.peak + other.peak - float(apart @ self.information @ step) / 2
        if not one.is_pose:
            return Seen(self.value + step, information, peak)
        pose = self.value.reshape(4, 4).copy()
        pose[:3, :3] = exponential(step[3:]) @ pose[:3, :3]
        pose[:3, 3] += step[:3]
        return Seen(pose.reshape(-1), information, peak)

    def _apart(self, other: Seen, one: Observation) -> Array:
        if not one.is_pose:
            return nearest(other.value - self.value, one.period)
        mine, theirs = self.value.reshape(4, 4), other.value.reshape(4, 4)
        turn = logarithm(theirs[:3, :3] @ mine[:3, :3].T)
        return np.concatenate([theirs[:3, 3] - mine[:3, 3], turn])


@dataclass(frozen=True, eq=False)
class Standing:
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

    prior: Quadratic
    seen: Mapping[int, Seen]
    known: Array
    evidence: float
    looks: int = 0
    branch: object = field(default_factory=object)

    def with_seen(self, new: Mapping[int, Seen], observations: Sequence[Observation]) -> Standing:
        """Return it with more that was seen."""
        seen = dict(self.seen)
        for i, one in new.items():
            seen[i] = seen[i].joined(one, observations[i]) if i in seen else one
        return replace(self, seen=seen, looks=self.looks + 1)

    def reading(self, layout: Layout, reader: Reader) -> Reading:
        """Return all of it as one reading."""
        nothing = reader.nothing()
        white, scale = nothing.whitening.copy(), nothing.log_scale.copy()
        for i, seen in self.seen.items():
            nothing.values[layout.seen_slices[i]] = seen.value
            nothing.seen[i], scale[i] = True, -seen.peak
            white[layout.white_slices[i]] = whitening(inverse(seen.information)).reshape(-1)
        return nothing._replace(whitening=white, log_scale=scale)


class Memory:
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
        reader: Reader,
        solver: Solver,
        openness: Openness,
        update: Update,
    ) -> None:
        self._layout, self._residuals, self._reader = layout, residuals, reader
        self._solver, self._openness, self._update = solver, openness, update
        # A single coordinate has no other that it could move with.
        self._groups = {number for number, group in enumerate(layout.groups) if len(group.t) > 1}

    def remember(
        self,
        before: Belief,
        found: Found,
        reading: Reading,
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
                first = Standing(before.part(group.t), {}, known, evidence)
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

    def loosen(self, number: int, before: Belief, after: Belief, grown: Array) -> None:
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
            information = inverse(inverse(one.information) + noise)
            lost = np.linalg.slogdet(one.information)[1] - np.linalg.slogdet(information)[1]
            seen[i] = replace(one, information=information, peak=one.peak - float(lost) / 2)
        covariance = inverse(standing.prior.matrix)
        matrix = inverse(covariance + np.diag(grown))
        prior = Quadratic.of_density(matrix, matrix @ (covariance @ standing.prior.vector))
        step = after.x[group.x] - before.x[group.x]
        loose = replace(standing, prior=prior.carried(step, None), seen=seen, evidence=0.0)
        # What was seen is as probable as it was; only what comes is judged by what is left.
        as_told = self._from_all(number, after, loose).belief.evidence[number]
        after.standing[number] = replace(loose, evidence=float(before.evidence[number] - as_told))

    def _is_open(self, number: int, belief: Belief) -> bool:
        t = self._layout.groups[number].t
        return self._openness.is_open(number, belief.information[np.ix_(t, t)])

    def _seen(self, i: int, reading: Reading, weight: float) -> Seen:
        size = self._layout.observations[i].size
        white = reading.whitening[self._layout.white_slices[i]].reshape(size, size)
        value = reading.values[self._layout.seen_slices[i]].copy()
        return Seen(value, weight * (white.T @ white), -float(reading.log_scale[i]))

    def _solve(
        self, number: int, before: Belief, after: Belief, standing: Standing, are_all_right: bool
    ) -> None:
        """Find the most probable state from where it was, and what is believed there."""
        group = self._layout.groups[number]
        found = self._from_all(number, before, standing)
        after.x[group.x] = found.belief.x[group.x]
        after.put(group.t, found.belief.part(group.t))
        if are_all_right:
            after.evidence[number] = found.belief.evidence[number]
        after.standing[number] = replace(standing, prior=self._prior(number, before, standing.prior, found))

    def _from_all(self, number: int, before: Belief, standing: Standing) -> Found:
        """Return what follows from all that is remembered, beginning at a place."""
        group = self._layout.groups[number]
        first = before.copy()
        first.put(group.t, standing.prior)
        first.evidence[number] = standing.evidence
        reading = standing.reading(self._layout, self._reader)
        # How a tangent turns on the way, C does not tell.
        update = self._solver.update if group.by_speeds else self._update
        return update(first, reading, standing.known, [number])

    def _prior(self, number: int, before: Belief, prior: Quadratic, found: Found) -> Quadratic:
        """Return what was believed before, in the tangent at the place that was found."""
        if found.priors is not None:
            return found.priors[number]
        group = self._layout.groups[number]
        step = found.belief.x[group.x] - before.x[group.x]
        return prior.carried(step, None)
