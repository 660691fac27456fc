"""Posterior covariance along unobservable manifolds, and its inflation for curvature.

One measured point of a body in the plane determines the position of this point but not the angle: the
possible states form a ring. A Gaussian covers the tangent of the ring only and would place the truth within
the noise of that. :class:`RidgeCovariance` therefore computes the second moment of the posterior along its
ridge: it steps along the unobservable directions and applies Laplace's approximation across them.

At the next estimate the tangent of the ridge differs, and the intersection of two tangents would pass for
information along the ridge. :class:`CovarianceInflation` therefore widens the Gaussian before prediction, so
that it contains the curved ridge. Second-order filters add the same to each measurement (Athans, Wishner and
Bertolini, Suboptimal state estimation for continuous-time nonlinear systems, 1968).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from kineverse.errors import KineverseError
from kineverse.estimation.linear_algebra import inverse_spd, symmetric
from kineverse.lie import Array

from .information_state import InformationState
from .observability import Components, StaticRecord
from .residuals import Measurements

# Step length and largest distance along the ridge, in deviations.
_STRIDE, _FARTHEST = 0.5, 5.0
_MOST_CORRECTIONS = 6
_SETTLED = 0.03  # corrections across the ridge stop below this length, in deviations
# Relative densities below the first end the walk; those above the second are cut off.
_LEAST_DENSITY, _MOST_DENSITY = 1e-4, 10.0
# A ridge whose deviation from a line and log density ratio to a Gaussian stay below this is straight.
_RIDGE_CURVATURE = 0.05
_RANK = 1e-6
_LINEAR = 0.02  # measurements that deviate from linearity by less, in deviations of the noise, are linear


class _CovarianceComputation:
    def __init__(self, components: Components) -> None:
        self._layout, self._residuals, self._process_model = components[:3]
        self._reader, self._group_bounds, self._unobservable = components[3:]


class RidgeCovariance(_CovarianceComputation):
    """Posterior covariance of groups with unobservable directions."""

    def compute(self, number: int, belief: InformationState) -> Array:
        """Return the second moment of the posterior of a group about its estimate (t, t)."""
        information = belief.information[self._layout.groups[number].block]
        gaussian = inverse_spd(information)
        record = belief.records[number]
        if record is None:
            return gaussian
        directions, across = self._unobservable.directions(number, information)
        reading = record.as_measurements(self._layout, self._reader)
        posterior = _LocalPosterior(number, belief, record, across, reading)
        if not len(directions) or self._evaluate(posterior, np.zeros(len(information))) is None:
            return gaussian
        result, is_straight = gaussian, True
        for k in range(len(directions)):
            others = np.concatenate([np.delete(directions, k, axis=0), across])
            more, is_so = self._integrate_direction(replace(posterior, across=others), directions[k])
            result, is_straight = result + more, is_straight and is_so
        inverse = np.linalg.inv(np.concatenate([directions, across]))
        for one, other in itertools.combinations(directions, 2):
            curvature = self._mixed_curvature(posterior, one, other)
            is_straight &= float(np.linalg.norm(curvature @ inverse)) < _RIDGE_CURVATURE
            result = result + np.outer(curvature, curvature)
        if is_straight:
            return gaussian
        # The standard deviation is at least half of each step.
        values, vectors = np.linalg.eigh(symmetric(inverse.T @ result @ inverse))
        wide = np.concatenate([directions, across]).T @ vectors * np.sqrt(np.maximum(values, 0.25))
        return symmetric(wide @ wide.T)

    def _integrate_direction(self, posterior: _LocalPosterior, direction: Array) -> tuple[Array, bool]:
        """Return the covariance gained along one direction, and whether the ridge is straight there."""
        top = self._evaluate(posterior, np.zeros(len(direction)))
        assert top is not None
        inverse = np.linalg.inv(np.concatenate([direction[None], posterior.across]))
        total, result, is_straight = 1.0, np.zeros_like(inverse), True
        for ray in (direction, -direction):
            for point, density in self._walk_ridge(posterior, top, ray):
                total += density
                result += density * (posterior.spread(point) - posterior.spread(top))
                along, *deviation = point.step @ inverse
                off = abs(math.log(density) + along**2 / 2), float(np.linalg.norm(deviation))
                is_straight &= max(off) < _RIDGE_CURVATURE
        result /= total
        return result - np.outer(direction, direction), is_straight

    def _mixed_curvature(self, posterior: _LocalPosterior, one: Array, other: Array) -> Array:
        """Return the curvature of the ridge for two directions together, beyond that of each alone."""
        curvature = np.zeros_like(one)
        for sign in (1, -1):
            for direction in (one + sign * other, -one - sign * other):
                point = self._ridge_point(posterior, direction)
                if point is None:
                    return np.zeros_like(one)
                curvature += sign * (point.step - direction) / 4
        return curvature

    def _walk_ridge(
        self, posterior: _LocalPosterior, top: _ManifoldPoint, ray: Array
    ) -> Iterator[tuple[_ManifoldPoint, float]]:
        stride, point, density = _STRIDE * ray, top, 1.0
        deviation = before = np.zeros_like(ray)
        for count in range(1, math.ceil(_FARTHEST / _STRIDE)):
            there = self._ridge_point(posterior, count * stride + 2 * deviation - before)
            if there is None:
                # Beyond the limits, which the Gaussian ignores: continue straight, with its density.
                density *= math.exp(-(count - 0.5) * _STRIDE**2)
                point = replace(point, step=point.step + stride)
            else:
                point, density = there, there.density(top)
                before, deviation = deviation, there.step - count * stride
            if density < _LEAST_DENSITY:
                return
            yield point, density

    def _ridge_point(self, posterior: _LocalPosterior, step: Array) -> _ManifoldPoint | None:
        """Return the most probable point across the ridge at the end of a step; None if it is infeasible."""
        best, share = self._evaluate(posterior, step), 1.0
        for _ in range(_MOST_CORRECTIONS):
            if best is None:
                return None
            deviation = np.linalg.solve(best.across, -best.gradient)
            if float(np.linalg.norm(deviation)) < _SETTLED:
                break
            trial = self._evaluate(posterior, best.step + share * deviation @ posterior.across)
            if trial is None or trial.cost > best.cost:
                share /= 4
            else:
                best, share = trial, 1.0
        return best

    def _evaluate(self, posterior: _LocalPosterior, step: Array) -> _ManifoldPoint | None:
        group, inputs = self._layout.groups[posterior.number], posterior.record.inputs
        here, there = posterior.belief.x[group.x], posterior.belief.x.copy()
        try:
            x, transport = self._process_model.retract(posterior.number, here, step, inputs)
            there[group.x] = self._group_bounds[posterior.number].clip(x.copy())
            if not np.array_equal(there[group.x], x):
                return None
            predicted = self._residuals.evaluate(there, inputs)
        except KineverseError:
            return None
        prior = posterior.record.prior
        cost = float(step @ prior.matrix @ step) / 2 - float(prior.vector @ step)
        gradient, information = prior.matrix @ step - prior.vector, prior.matrix.copy()
        errors = self._residuals.errors(predicted, posterior.reading, group.observation_indices)
        for error, slope in errors.values():
            along = slope if transport is None else slope @ transport
            cost += float(error @ error) / 2
            gradient -= along.T @ error
            information += along.T @ along
        if not (math.isfinite(cost) and np.isfinite(information).all()):
            return None
        across = posterior.across
        return _ManifoldPoint(step, cost, across @ gradient, across @ information @ across.T)


@dataclass(frozen=True, eq=False)
class _LocalPosterior:
    """Posterior of a group about its estimate, with steps of one deviation across the ridge (c, t)."""

    number: int
    belief: InformationState
    record: StaticRecord
    across: Array
    reading: Measurements

    def spread(self, point: _ManifoldPoint) -> Array:
        """Return the second moment of steps to the neighbourhood of a point."""
        across: Array = self.across.T @ np.linalg.inv(point.across) @ self.across
        return np.outer(point.step, point.step) + across


@dataclass(frozen=True, eq=False)
class _ManifoldPoint:
    """Step from the estimate, with its cost, and gradient (c,) and curvature (c, c) across the ridge."""

    step: Array
    cost: float
    gradient: Array
    across: Array

    @cached_property
    def log_curvature(self) -> float:
        """Log determinant of the curvature across the ridge."""
        return float(np.linalg.slogdet(self.across)[1])

    def density(self, top: _ManifoldPoint) -> float:
        """Return the density marginalised across the ridge, relative to the top."""
        log = top.cost - self.cost + (top.log_curvature - self.log_curvature) / 2
        return math.exp(min(log, math.log(_MOST_DENSITY)))


class CovarianceInflation(_CovarianceComputation):
    """Inflation of beliefs by the curvature of the posterior."""

    def inflate(self, number: int, belief: InformationState) -> None:
        """Inflate the covariance of a group by the curvature of its posterior, and drop its static record."""
        record = belief.records[number]
        if record is None:
            return
        t, block = self._layout.groups[number].t, self._layout.groups[number].block
        information = belief.information[block].copy()
        directions, _ = self._unobservable.directions(number, information)
        if len(directions):
            covariance = inverse_spd(information)
            largest, slopes = self._curvature(number, belief, directions, self._reader.empty())
            # Predictions become as uncertain as they are curved.
            lacking = []
            for i, slope in slopes.items():
                variance = float(np.einsum("ij,jk,ik->", slope, covariance, slope)) / len(slope)
                lacking.append(np.full(len(slope), max(largest[i] - variance, 0.0)))
            scale = self._unobservable.deviations[t]
            inverse = np.linalg.pinv(np.concatenate(list(slopes.values())) * scale, rcond=_RANK)
            inverse *= scale[:, None]
            missing = (inverse * np.concatenate(lacking)) @ inverse.T
            belief.information[block] = inverse_spd(covariance + missing)
            belief.vector[t] = belief.information[block] @ (covariance @ belief.vector[t])
        belief.records[number] = None

    def is_straight(self, number: int, belief: InformationState) -> bool:
        """Return True if the measurements of a group are linear within its belief."""
        record = belief.records[number]
        assert record is not None
        block = self._layout.groups[number].block
        directions, _ = self._unobservable.directions(number, belief.information[block])
        reading = record.as_measurements(self._layout, self._reader)
        largest, _ = self._curvature(number, belief, directions, reading)
        return max(largest.values()) < _LINEAR**2

    def _curvature(
        self, number: int, belief: InformationState, directions: Array, noise: Measurements
    ) -> tuple[dict[int, float], dict[int, Array]]:
        """Return the squared nonlinearity of each measurement, and its Jacobian, in deviations of noise."""
        group, record = self._layout.groups[number], belief.records[number]
        assert record is not None
        inputs = record.inputs
        measured = list(record.means)
        here = self._residuals.evaluate(belief.x, inputs)
        as_predicted = noise._replace(values=self._reader.as_values(here))
        as_predicted.mask[measured] = True
        slopes = {i: s for i, (_, s) in self._residuals.errors(here, as_predicted, measured).items()}
        largest = dict.fromkeys(measured, 0.0)
        for step in (*directions, *-directions):
            try:
                x, _ = self._process_model.retract(number, belief.x[group.x], step, inputs)
                there = belief.x.copy()
                there[group.x] = self._group_bounds[number].clip(x)
                predicted = self._residuals.evaluate(there, inputs)
            except KineverseError:  # infeasible
                continue
            remaining = self._group_bounds[number].remaining(belief.x[group.x], there[group.x], step)
            for i, (error, _) in self._residuals.errors(predicted, as_predicted, measured).items():
                curvature = error + slopes[i] @ remaining
                if np.isfinite(curvature).all():
                    largest[i] = max(largest[i], float(curvature @ curvature) / len(curvature))
        return largest, slopes
