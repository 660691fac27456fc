"""Posterior covariance along unobservable manifolds, and its inflation for curvature.

A point that is seen of a body on a plane says where this point is and nothing of the angle: states are
possible on a ring. A Gaussian is about the ring's tangent, and would have the truth within its noise of that.
So the covariance that is told is another one: the mean of the squares of what the state may be off by, summed
up along its ridge, which is walked in open directions, with Laplace's approximation across.

A Gaussian is about the tangent of a ridge. At the next estimate the tangent is a bit different, and two of
them cross: as if something were known along them. So before it is carried on it is made so wide that the
curve fits in, as far as it reaches. Second-order filters add the same to each observation (Athans, Wishner
and Bertolini, Suboptimal state estimation for continuous-time nonlinear systems, 1968).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from kineverse.errors import KineverseError
from kineverse.lie import Array

from .bounds import GroupBounds
from .gaussian import InformationState, inverse_spd, symmetric
from .layout import Layout
from .observability import UnobservableDirections
from .process_model import ProcessModel
from .residuals import MeasurementReader, Measurements, Residuals
from .static_batch import StaticRecord

# In deviations.
_STRIDE, _FARTHEST = 0.5, 5.0
_MOST_CORRECTIONS = 6
# A correction of so many deviations across the ridge is the last.
_SETTLED = 0.03
# Who is so much less probable than the top is not there, and nobody counts so much more.
_LEAST, _MOST = 1e-4, 10.0
# A ridge that is nowhere farther off from straight, and the density from a Gaussian's by no more, is that.
_RIDGE_CURVATURE = 0.05


class RidgeCovariance:
    """Finds the covariance of groups.

    Parameters
    ----------
    layout, residuals, charted, reader, boxes, openness
        The parts of a tracker.
    """

    def __init__(
        self,
        layout: Layout,
        residuals: Residuals,
        charted: ProcessModel,
        reader: MeasurementReader,
        boxes: Sequence[GroupBounds],
        openness: UnobservableDirections,
    ) -> None:
        self._layout, self._residuals, self._charted = layout, residuals, charted
        self._reader, self._boxes, self._openness = reader, boxes, openness

    def covariance(self, number: int, belief: InformationState) -> Array:
        """Return how far the state of a group may be off: the mean of the squares (t, t).

        Raises
        ------
        InvalidValueError
            If rounding has left nothing of the information in some direction.
        """
        t = self._layout.groups[number].t
        information = belief.information[np.ix_(t, t)]
        straight = inverse_spd(information)
        standing = belief.standing[number]
        if standing is None:
            return straight
        ways, across = self._openness.directions(number, information)
        reading = standing.reading(self._layout, self._reader)
        hill = _LocalPosterior(number, belief, standing, across, reading)
        if not len(ways) or self._place(hill, np.zeros(len(t))) is None:
            return straight
        found, is_straight = straight, True
        for k in range(len(ways)):
            others = np.concatenate([np.delete(ways, k, axis=0), across])
            more, is_so = self._beyond(replace(hill, across=others), ways[k])
            found, is_straight = found + more, is_straight and is_so
        back = np.linalg.inv(np.concatenate([ways, across]))
        for one, other in itertools.combinations(ways, 2):
            bend = self._bend(hill, one, other)
            is_straight &= float(np.linalg.norm(bend @ back)) < _RIDGE_CURVATURE
            found = found + np.outer(bend, bend)
        return straight if is_straight else _no_narrower(found, np.concatenate([ways, across]))

    def _beyond(self, hill: _LocalPosterior, way: Array) -> tuple[Array, bool]:
        """Return what a walk along a way adds to the covariance, and whether that is straight."""
        top = self._place(hill, np.zeros(len(way)))
        assert top is not None
        back = np.linalg.inv(np.concatenate([way[None], hill.across]))
        total, found, is_straight = 1.0, np.zeros_like(back), True
        for ray in (way, -way):
            for place, density in self._along(hill, top, ray):
                total += density
                found += density * (hill.spread(place) - hill.spread(top))
                along, *aside = place.step @ back
                log = math.log(density) + along**2 / 2
                is_straight &= float(np.linalg.norm(aside)) < _RIDGE_CURVATURE and abs(log) < _RIDGE_CURVATURE
        found /= total
        return found - np.outer(way, way), is_straight

    def _bend(self, hill: _LocalPosterior, one: Array, other: Array) -> Array:
        """Return by how much the ridge is bent where both ways are gone, beyond what each alone says."""
        bend = np.zeros_like(one)
        for sign in (1, -1):
            for way in (one + sign * other, -one - sign * other):
                place = self._above(hill, way)
                if place is None:
                    return np.zeros_like(one)
                bend += sign * (place.step - way) / 4
        return bend

    def _along(
        self, hill: _LocalPosterior, top: _ManifoldPoint, ray: Array
    ) -> Iterator[tuple[_ManifoldPoint, float]]:
        """Yield places on the ridge in one direction, with the density across from them."""
        stride, place, density = _STRIDE * ray, top, 1.0
        aside = before = np.zeros_like(ray)
        for count in range(1, math.ceil(_FARTHEST / _STRIDE)):
            there = self._above(hill, count * stride + 2 * aside - before)
            if there is None:
                # Beyond what can be, as limits are not in a Gaussian: it goes on as straight and as one.
                density *= math.exp(-(count - 0.5) * _STRIDE**2)
                place = replace(place, step=place.step + stride)
            else:
                place, density = there, there.density(top)
                before, aside = aside, there.step - count * stride
            if density < _LEAST:
                return
            yield place, density

    def _above(self, hill: _LocalPosterior, step: Array) -> _ManifoldPoint | None:
        """Return the most probable place across from the end of a step; None if nobody can be there."""
        best, share = self._place(hill, step), 1.0
        for _ in range(_MOST_CORRECTIONS):
            if best is None:
                return None
            aside = np.linalg.solve(best.across, -best.gradient)
            if float(np.linalg.norm(aside)) < _SETTLED:
                break
            tried = self._place(hill, best.step + share * aside @ hill.across)
            if tried is None or tried.cost > best.cost:
                share /= 4
            else:
                best, share = tried, 1.0
        return best

    def _place(self, hill: _LocalPosterior, step: Array) -> _ManifoldPoint | None:
        group, known = self._layout.groups[hill.number], hill.standing.known
        here, there = hill.belief.x[group.x], hill.belief.x.copy()
        try:
            x, turn = self._charted.step(hill.number, here, step, known)
            there[group.x] = self._boxes[hill.number].clipped(x.copy())
            if not np.array_equal(there[group.x], x):
                return None
            said = self._residuals.evaluate(there, known)
        except KineverseError:
            return None
        prior = hill.standing.prior
        cost = float(step @ prior.matrix @ step) / 2 - float(prior.vector @ step)
        gradient, information = prior.matrix @ step - prior.vector, prior.matrix.copy()
        for error, slope in self._residuals.errors(said, hill.reading, group.seen).values():
            along = slope if turn is None else slope @ turn
            cost += float(error @ error) / 2
            gradient -= along.T @ error
            information += along.T @ along
        if not (math.isfinite(cost) and np.isfinite(information).all()):
            return None
        return _ManifoldPoint(step, cost, hill.across @ gradient, hill.across @ information @ hill.across.T)


def _no_narrower(covariance: Array, steps: Array) -> Array:
    """Return a covariance that is as wide as half of each step: what is narrower would not have been seen."""
    back = np.linalg.inv(steps)
    values, vectors = np.linalg.eigh(symmetric(back.T @ covariance @ back))
    wide = steps.T @ vectors * np.sqrt(np.maximum(values, 0.25))
    return symmetric(wide @ wide.T)


@dataclass(frozen=True, eq=False)
class _LocalPosterior:
    """The probability of a group about its state, and steps of one deviation across the ridge (c, t)."""

    number: int
    belief: InformationState
    standing: StaticRecord
    across: Array
    reading: Measurements

    def spread(self, place: _ManifoldPoint) -> Array:
        """Return the mean of the squares of steps to near a place."""
        found: Array = (
            np.outer(place.step, place.step) + self.across.T @ np.linalg.inv(place.across) @ self.across
        )
        return found


@dataclass(frozen=True, eq=False)
class _ManifoldPoint:
    """A step from the state, the cost there, and across the ridge its gradient (c,) and curvature (c, c)."""

    step: Array
    cost: float
    gradient: Array
    across: Array

    @cached_property
    def narrowness(self) -> float:
        return float(np.linalg.slogdet(self.across)[1])

    def density(self, top: _ManifoldPoint) -> float:
        """Return how probable it is to be across from here, compared with the top."""
        log = top.cost - self.cost + (top.narrowness - self.narrowness) / 2
        return math.exp(min(log, math.log(_MOST)))


_RANK = 1e-6
# What is off by fewer deviations of all that was seen is straight.
_STRAIGHT = 0.02


class CovarianceInflation:
    """Makes beliefs so wide that what was seen before still fits in.

    Parameters
    ----------
    layout, residuals, charted, reader, boxes, openness
        The parts of a tracker.
    """

    def __init__(
        self,
        layout: Layout,
        residuals: Residuals,
        charted: ProcessModel,
        reader: MeasurementReader,
        boxes: Sequence[GroupBounds],
        openness: UnobservableDirections,
    ) -> None:
        self._layout, self._residuals, self._charted = layout, residuals, charted
        self._reader, self._boxes, self._openness = reader, boxes, openness

    def widen(self, number: int, belief: InformationState) -> None:
        """Believe in a Gaussian that is wide enough, and forget what was seen."""
        standing = belief.standing[number]
        if standing is None:
            return
        t = self._layout.groups[number].t
        block = np.ix_(t, t)
        information = belief.information[block].copy()
        ways, _ = self._openness.directions(number, information)
        if len(ways):
            covariance = inverse_spd(information)
            most, slopes = self._bends(number, belief, ways, standing, self._reader.nothing())
            missing = self._missing(number, covariance, most, slopes)
            belief.information[block] = inverse_spd(covariance + missing)
            belief.vector[t] = belief.information[block] @ (covariance @ belief.vector[t])
        belief.standing[number] = None

    def is_straight(self, number: int, belief: InformationState) -> bool:
        """Whether all that was seen of a group is straight as far as the belief reaches."""
        standing = belief.standing[number]
        assert standing is not None
        t = self._layout.groups[number].t
        ways, _ = self._openness.directions(number, belief.information[np.ix_(t, t)])
        reading = standing.reading(self._layout, self._reader)
        most, _ = self._bends(number, belief, ways, standing, reading)
        return max(most.values()) < _STRAIGHT**2

    def _bends(
        self, number: int, belief: InformationState, ways: Array, standing: StaticRecord, noise: Measurements
    ) -> tuple[dict[int, float], dict[int, Array]]:
        """Return how far what was seen is off from straight, squared and by number, and slopes.

        Both are in deviations of the noise of a reading.
        """
        group, known = self._layout.groups[number], standing.known
        seen = list(standing.seen)
        here = self._residuals.evaluate(belief.x, known)
        as_said = noise._replace(values=self._reader.values_of(here))
        as_said.seen[seen] = True
        slopes = {i: s for i, (_, s) in self._residuals.errors(here, as_said, seen).items()}
        most = dict.fromkeys(seen, 0.0)
        for step in (*ways, *-ways):
            try:
                x, _ = self._charted.step(number, belief.x[group.x], step, known)
                there = belief.x.copy()
                there[group.x] = self._boxes[number].clipped(x)
                said = self._residuals.evaluate(there, known)
            except KineverseError:  # nobody can be there
                continue
            taken = self._boxes[number].taken(belief.x[group.x], there[group.x], step)
            for i, (error, _) in self._residuals.errors(said, as_said, seen).items():
                bend = error + slopes[i] @ taken
                if np.isfinite(bend).all():
                    most[i] = max(most[i], float(bend @ bend) / len(bend))
        return most, slopes

    def _missing(
        self, number: int, covariance: Array, most: Mapping[int, float], slopes: Mapping[int, Array]
    ) -> Array:
        """Return what the covariance lacks (t, t), so that what was seen is as uncertain as it is bent."""
        lacking = []
        for i, slope in slopes.items():
            variance = float(np.einsum("ij,jk,ik->", slope, covariance, slope)) / len(slope)
            lacking.append(np.full(len(slope), max(most[i] - variance, 0.0)))
        scale = self._openness.deviations[self._layout.groups[number].t]
        back = np.linalg.pinv(np.concatenate(list(slopes.values())) * scale, rcond=_RANK)
        back *= scale[:, None]
        missing: Array = (back * np.concatenate(lacking)) @ back.T
        return missing
