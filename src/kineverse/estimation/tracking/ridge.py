"""How far a state may be off where little is known in some directions.

A point that is seen of a body on a plane says where this point is and nothing of the angle: states are
possible on a ring. A Gaussian is about the ring's tangent, and would have the truth within its noise of that.
So the covariance that is told is another one: the mean of the squares of what the state may be off by, summed
up along its ridge, which is walked in open directions, with Laplace's approximation across.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from kineverse.errors import KineverseError
from kineverse.estimation.noise import Array

from .belief import Belief, inverse, symmetric
from .box import Box
from .charted import Charted
from .layout import Layout
from .openness import Openness
from .reading import Reader, Reading
from .residuals import Residuals
from .standing import Standing

# In deviations.
_STRIDE, _FARTHEST = 0.5, 5.0
_MOST_CORRECTIONS = 6
# A correction of so many deviations across the ridge is the last.
_SETTLED = 0.03
# Who is so much less probable than the top is not there, and nobody counts so much more.
_LEAST, _MOST = 1e-4, 10.0
# A ridge that is nowhere farther off from straight, and the density from a Gaussian's by no more, is that.
_STRAIGHT = 0.05


class Ridge:
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
        charted: Charted,
        reader: Reader,
        boxes: Sequence[Box],
        openness: Openness,
    ) -> None:
        self._layout, self._residuals, self._charted = layout, residuals, charted
        self._reader, self._boxes, self._openness = reader, boxes, openness

    def covariance(self, number: int, belief: Belief) -> Array:
        """Return how far the state of a group may be off: the mean of the squares (t, t).

        Raises
        ------
        ValueRejectedError
            If rounding has left nothing of the information in some direction.
        """
        t = self._layout.groups[number].t
        information = belief.information[np.ix_(t, t)]
        straight = inverse(information)
        standing = belief.standing[number]
        if standing is None:
            return straight
        ways, across = self._openness.directions(number, information)
        reading = standing.reading(self._layout, self._reader)
        hill = _Hill(number, belief, standing, across, reading)
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
            is_straight &= float(np.linalg.norm(bend @ back)) < _STRAIGHT
            found = found + np.outer(bend, bend)
        return straight if is_straight else _no_narrower(found, np.concatenate([ways, across]))

    def _beyond(self, hill: _Hill, way: Array) -> tuple[Array, bool]:
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
                is_straight &= float(np.linalg.norm(aside)) < _STRAIGHT and abs(log) < _STRAIGHT
        found /= total
        return found - np.outer(way, way), is_straight

    def _bend(self, hill: _Hill, one: Array, other: Array) -> Array:
        """Return by how much the ridge is bent where both ways are gone, beyond what each alone says."""
        bend = np.zeros_like(one)
        for sign in (1, -1):
            for way in (one + sign * other, -one - sign * other):
                place = self._above(hill, way)
                if place is None:
                    return np.zeros_like(one)
                bend += sign * (place.step - way) / 4
        return bend

    def _along(self, hill: _Hill, top: _Place, ray: Array) -> Iterator[tuple[_Place, float]]:
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

    def _above(self, hill: _Hill, step: Array) -> _Place | None:
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

    def _place(self, hill: _Hill, step: Array) -> _Place | None:
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
        return _Place(step, cost, hill.across @ gradient, hill.across @ information @ hill.across.T)


def _no_narrower(covariance: Array, steps: Array) -> Array:
    """Return a covariance that is as wide as half of each step: what is narrower would not have been seen."""
    back = np.linalg.inv(steps)
    values, vectors = np.linalg.eigh(symmetric(back.T @ covariance @ back))
    wide = steps.T @ vectors * np.sqrt(np.maximum(values, 0.25))
    return symmetric(wide @ wide.T)


@dataclass(frozen=True, eq=False)
class _Hill:
    """The probability of a group about its state, and steps of one deviation across the ridge (c, t)."""

    number: int
    belief: Belief
    standing: Standing
    across: Array
    reading: Reading

    def spread(self, place: _Place) -> Array:
        """Return the mean of the squares of steps to near a place."""
        found: Array = (
            np.outer(place.step, place.step) + self.across.T @ np.linalg.inv(place.across) @ self.across
        )
        return found


@dataclass(frozen=True, eq=False)
class _Place:
    """A step from the state, the cost there, and across the ridge its gradient (c,) and curvature (c, c)."""

    step: Array
    cost: float
    gradient: Array
    across: Array

    @cached_property
    def narrowness(self) -> float:
        return float(np.linalg.slogdet(self.across)[1])

    def density(self, top: _Place) -> float:
        """Return how probable it is to be across from here, compared with the top."""
        log = top.cost - self.cost + (top.narrowness - self.narrowness) / 2
        return math.exp(min(log, math.log(_MOST)))
