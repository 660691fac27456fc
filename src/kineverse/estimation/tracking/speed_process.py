"""Estimated speeds: prediction with white accelerations, and updates of states and speeds together.

Speeds change by white accelerations of the spectral density q and decay with the time τ (Singer, Estimating
optimal tracking filter performance for manned maneuvering targets, 1970). Without decay they are the constant
velocities of Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001,
6.2.2:

    ẋ = R(x) u,    u̇ = -u/τ + w,    Cov ∫ w dt = q dt

For a step ξ in the tangent space the speeds stay Gaussian, u | ξ ~ N(m + K ξ, C). So an update by
measurements of the state alone is exact.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from kineverse.estimation.linear_algebra import (
    inverse_spd,
    invert_matrices,
    multiply_vectors,
    symmetric,
    transposed,
)
from kineverse.lie import Array
from kineverse.symbols import Symbol

from .information_state import InformationState
from .process_model import ProcessModel, Speeds
from .state_space import Layout

if TYPE_CHECKING:
    from .bounds import GroupBounds

_SETTLED = 1e-12
_MOST_SUBSTEPS = 10
_RANK = 1e-9
_LONGEST = 0.5  # [m], [rad]
_FARTHEST, _WALK = 0.5, 4

Jacobian: TypeAlias = Callable[[int, Array, Array], Array]
"""Function of the number of a group, the whole state and inputs: its whitened measurement Jacobian (d, t)."""
Rows: TypeAlias = Callable[[Array, Array], tuple[Array, Array, Array]]
"""Function of the whole state and a group's speeds (k,): whitened errors (d,), and the Jacobians of predicted
measurements by the state (d, t) and by the speeds (d, k)."""


@dataclass(frozen=True, eq=False)
class ConditionalSpeeds:
    """Gaussian of the speeds of a group given its state: u | ξ ~ N(m + K ξ, C)."""

    anchor: Array  # coordinates (n,) in whose tangent space ξ is
    mean: Array  # m (k,), K (k, t) and C (k, k)
    gain: Array
    covariance: Array
    information: Array  # of the state when it was predicted (t, t)
    free: float = 0.0  # largest deviation of the state so far in directions that measurements leave free


class SpeedProcess:
    """Prediction of states and speeds of some groups.

    If measurements leave directions of a group free, these directions turn with the state, and information
    about others would pass for information about them. So errors are carried along such that their measured
    part and their free part stay what they are (Huang, Mourikis and Roumeliotis, Observability-based rules
    for designing consistent EKF SLAM estimators, 2010).
    """

    def __init__(
        self,
        layout: Layout,
        process_model: ProcessModel,
        groups: Iterable[int],
        jacobian: Jacobian,
        decay: float = math.inf,
    ) -> None:
        self._layout, self._process_model = layout, process_model
        self._jacobian, self._decay = jacobian, decay
        self.groups = tuple(groups)
        self.periods: Mapping[Symbol, float] = {}
        self.redundant: frozenset[int] = frozenset()
        by_size: dict[tuple[int, int], list[int]] = {}
        for number in self.groups:
            size = len(layout.groups[number].t), len(process_model.speeds_of(number))
            by_size.setdefault(size, []).append(number)
        self._batches = list(by_size.values())

    def initialise(self, belief: InformationState, means: Speeds, variances: Speeds, inputs: Array) -> None:
        """Set the speeds of all groups, those without a mean to 0, independent of the state; in place."""
        redundant = set()
        for number in self.groups:
            group, speeds = self._layout.groups[number], self._process_model.speeds_of(number)
            mean, gain = np.array([means.get(v, 0.0) for v in speeds]), np.zeros((len(speeds), len(group.t)))
            covariance, x = np.diag([variances[v] for v in speeds]), belief.x[group.x].copy()
            belief.speeds[number] = ConditionalSpeeds(
                x, mean, gain, covariance, belief.information[group.block]
            )
            # Rates and linear measurements inform about free directions over time.
            if self._process_model.is_carried(number) or self._layout.is_affine(number):
                continue
            if len(self._split(number, belief, x, inputs)[1]):
                redundant.add(number)
        self.redundant = frozenset(redundant)

    def _split(self, number: int, belief: InformationState, x: Array, inputs: Array) -> tuple[Array, Array]:
        """Return the measurement Jacobian of a group at a state (d, t), and its free directions (k, t)."""
        there = belief.x.copy()
        there[self._layout.groups[number].x] = x
        jacobian = self._jacobian(number, there, inputs)
        _, values, rows = np.linalg.svd(jacobian)
        return jacobian, rows[int((values > _RANK * values.max(initial=0.0)).sum()) :]

    def _carry(self, number: int, belief: InformationState, start: Array, end: Array, inputs: Array) -> Array:
        """Return the map of errors at one state to errors at another with the same parts (t, t)."""
        measured, free = self._split(number, belief, start, inputs)
        measured_there, free_there = self._split(number, belief, end, inputs)
        left, _, right = np.linalg.svd(free_there @ free.T, full_matrices=False)
        here = np.concatenate([measured, left @ right @ free])
        change = np.linalg.pinv(np.concatenate([measured_there, free_there])) @ here - np.eye(len(start))
        # Near a singular state the map is unbounded.
        return np.asarray(np.eye(len(start)) + change / max(1.0, float(np.linalg.norm(change, 2)) / _LONGEST))

    def at_state(self, number: int, belief: InformationState, inputs: Array) -> ConditionalSpeeds:
        """Return the speeds of a group given a step in the tangent space at its present state."""
        speeds = belief.speeds[number]
        assert speeds is not None
        x = belief.x[self._layout.groups[number].x]
        if np.array_equal(x, speeds.anchor):
            return speeds
        step, transport = self._step_between(number, speeds.anchor, x, inputs)
        gain, information = speeds.gain, speeds.information
        if transport is not None:
            back = np.linalg.inv(transport)
            gain, information = gain @ back, symmetric(back.T @ information @ back)
        mean = speeds.mean + speeds.gain @ step
        return replace(speeds, anchor=x.copy(), mean=mean, gain=gain, information=information)

    def _realigned(self, number: int, belief: InformationState, inputs: Array) -> ConditionalSpeeds:
        """Return the speeds at the state of a redundant group, and carry its prior there, in place."""
        group, before = self._layout.groups[number], belief.speeds[number]
        speeds = self.at_state(number, belief, inputs)
        if before is None or speeds is before:
            return speeds
        back = np.linalg.inv(self._carry(number, belief, before.anchor, speeds.anchor, inputs))
        mean = inverse_spd(belief.information[group.block]) @ belief.vector[group.t]
        carried = back.T @ before.information @ back - speeds.information
        belief.information[group.block] = symmetric(belief.information[group.block] + carried)
        belief.vector[group.t] = belief.information[group.block] @ mean
        forth = np.linalg.inv(back) if len(back) == len(speeds.mean) else np.eye(len(speeds.mean))
        covariance = symmetric(forth @ speeds.covariance @ forth.T)
        return replace(speeds, gain=forth @ before.gain @ back, covariance=covariance)

    def innovate(
        self, number: int, belief: InformationState, inputs: Array, rows: Rows
    ) -> tuple[Array, Array, Array, Array, Array]:
        """Return slopes, by speeds and by both; innovations; mean and covariance of state and speeds."""
        group, speeds = self._layout.groups[number], self.at_state(number, belief, inputs)
        errors, by_state, by_speed = rows(belief.x, speeds.mean)
        state = inverse_spd(belief.information[group.block])
        cross, step = speeds.gain @ state, state @ belief.vector[group.t]
        joint = np.block([[state, cross.T], [cross, speeds.covariance + cross @ speeds.gain.T]])
        slope, off = np.hstack([by_state, by_speed]), np.concatenate([step, speeds.gain @ step])
        return by_speed, slope, errors - slope @ off, off, joint

    def measure(
        self, number: int, belief: InformationState, inputs: Array, rows: Rows, bounds: GroupBounds
    ) -> tuple[Array, Array]:
        """Update a group by measurements of states and speeds, in place; return innovations and covariance.

        The update is that of a Kalman filter. A redundant group then moves along its measured directions to
        the state with the predictions that the update demands.
        """
        group, speeds = self._layout.groups[number], self.at_state(number, belief, inputs)
        by_speed, slope, errors, off, joint = self.innovate(number, belief, inputs, rows)
        t, spread = len(group.t), np.eye(len(errors)) + slope @ joint @ slope.T
        weights, prior = np.linalg.solve(spread, slope @ joint), joint
        off = off + weights.T @ errors
        joint = symmetric(joint - weights.T @ spread @ weights)
        step, speed = off[:t], speeds.mean + off[t:]
        anchor = speeds.anchor
        if number in self.redundant:
            of_state = ~by_speed.any(axis=1)
            goal = np.linalg.solve(spread, errors)[of_state]
            x = belief.x.copy()
            more: Array = step
            for _ in range(_MOST_SUBSTEPS):
                by = more / max(1.0, float(np.abs(more).max()) / _LONGEST)
                x[group.x] = bounds.clip(self._process_model.retract(number, x[group.x], by, inputs)[0])
                left, jacobian, _ = rows(x, speed)
                jacobian = jacobian[of_state]
                gradient = jacobian.T @ (left[of_state] - goal)
                more = np.asarray(np.linalg.solve(jacobian.T @ jacobian + np.eye(t), gradient))
                if float(more @ more) < _SETTLED:
                    break
            carried, step = self._carry(number, belief, anchor, x[group.x], inputs), np.zeros(t)
            anchor = x[group.x].copy()
            belief.x[group.x] = anchor
            free = self._split(number, belief, anchor, inputs)[1]
            both, unseen = np.eye(len(joint)), np.zeros_like(joint)
            for part in (slice(t), slice(t, None))[: 1 + (len(speed) == t)]:
                both[part, part], unseen[part, part] = carried, free.T @ free
            seen = np.eye(len(joint)) - unseen
            joint = seen @ both @ joint @ both.T @ seen + unseen @ both @ prior @ both.T @ unseen
        belief.records[number] = None
        information = inverse_spd(joint[:t, :t])
        gain = joint[t:, :t] @ information
        covariance = symmetric(joint[t:, t:] - gain @ joint[:t, t:])
        belief.information[group.block], belief.vector[group.t] = information, information @ step
        mean = speed - gain @ step
        belief.speeds[number] = ConditionalSpeeds(anchor, mean, gain, covariance, information, speeds.free)
        return errors, spread

    def spread(self, number: int, belief: InformationState, inputs: Array) -> Array:
        """Return the covariance of the state of a redundant group along its curved free directions (t, t).

        No Gaussian describes free motion of more than ``_FARTHEST``. From then on nothing is stated about any
        coordinate: each has the deviation of the free motion.
        """
        group, speeds = self._layout.groups[number], belief.speeds[number]
        start, result = belief.x[group.x], inverse_spd(belief.information[group.block])
        assert speeds is not None
        if speeds.free > _FARTHEST:
            return result + speeds.free**2 * np.eye(len(result))
        for direction in self._split(number, belief, start, inputs)[1]:
            length = math.sqrt(float(direction @ result @ direction))
            for sign in (1.0, -1.0):
                x, along, away = start, sign * direction, np.zeros(len(direction))
                for _ in range(_WALK):
                    step = length / _WALK * along
                    x, away = self._process_model.retract(number, x, step, inputs)[0], away + step
                    free = self._split(number, belief, x, inputs)[1]
                    along = free.T @ (free @ along)
                    along /= np.linalg.norm(along)
                result = result + np.outer(away, away) / 2
        return result

    def covariance(self, number: int, belief: InformationState, inputs: Array, state: Array) -> Array:
        """Return the covariance of the speeds of a group (k, k), for a covariance of its state (t, t)."""
        speeds = self.at_state(number, belief, inputs)
        return symmetric(speeds.covariance + speeds.gain @ state @ speeds.gain.T)

    def predict(
        self, belief: InformationState, inputs: Array, dt: float, commands: Speeds, noise: Speeds
    ) -> None:
        """Predict states and speeds by ``dt`` seconds; in place."""
        # Too long a step leads to numbers that are not finite, which the caller refuses.
        with np.errstate(over="ignore", invalid="ignore"):
            for numbers in self._batches:
                self._predict(numbers, belief, inputs, np.float64(dt), commands, noise)

    def _predict(
        self,
        numbers: Sequence[int],
        belief: InformationState,
        inputs: Array,
        dt: float,
        commands: Speeds,
        noise: Speeds,
    ) -> None:
        groups = [self._layout.groups[n] for n in numbers]
        at_state = [self._realigned if n in self.redundant else self.at_state for n in numbers]
        speeds = [at(n, belief, inputs) for n, at in zip(numbers, at_state, strict=True)]
        t = np.array([group.t for group in groups])
        rows, columns = t[:, :, None], t[:, None, :]
        covariance = invert_matrices(belief.information[rows, columns])
        mean = multiply_vectors(covariance, belief.vector[t])
        gain = np.array([one.gain for one in speeds])
        speed = np.array([one.mean for one in speeds]) + multiply_vectors(gain, mean)
        cross = gain @ covariance
        spread = np.array([one.covariance for one in speeds]) + cross @ transposed(gain)
        orders = [self._process_model.speeds_of(n) for n in numbers]
        density = np.array([[noise.get(v, 0.0) for v in order] for order in orders])
        reach, share, integrals = self._integrate(dt)
        reaches, shares = np.full(speed.shape, reach), np.full(speed.shape, share)
        for g, order in enumerate(orders):
            for k, v in enumerate(order):
                if v in commands:
                    speed[g, k], density[g, k] = commands[v], 0.0
                    reaches[g, k], shares[g, k] = dt, 1.0
                    cross[g, k] = spread[g, k] = spread[g, :, k] = 0.0
        ends = [
            self._process_model.transition(n, belief.x[group.x], by, inputs)
            for n, group, by in zip(numbers, groups, speed * reaches, strict=True)
        ]
        slope, by_speed = (np.array([end[i] for end in ends]) for i in (1, 2))
        kept = shares[:, :, None] * np.eye(density.shape[1])
        for g, number in enumerate(numbers):
            if number in self.redundant:
                slope[g] = self._carry(number, belief, belief.x[groups[g].x], ends[g][0], inputs)
                if slope.shape == by_speed.shape:
                    by_speed[g], kept[g] = slope[g] @ by_speed[g], slope[g] @ kept[g]
        # [ξ; u] ← [slope, moved; 0, kept] [ξ; u], with the noise of an integrated white acceleration.
        moved = by_speed * reaches[:, None, :]
        added = [integral * density[:, :, None] * np.eye(density.shape[1]) for integral in integrals]
        coupled = moved @ cross @ transposed(slope)
        state = slope @ covariance @ transposed(slope) + coupled + transposed(coupled)
        state += moved @ spread @ transposed(moved) + by_speed @ added[0] @ transposed(by_speed)
        shared = kept @ (cross @ transposed(slope) + spread @ transposed(moved))
        shared += added[1] @ transposed(by_speed)
        information = invert_matrices(symmetric(state))
        regression, mean = shared @ information, multiply_vectors(slope, mean)
        left = kept @ spread @ transposed(kept) + added[2]
        left = symmetric(left - regression @ transposed(shared))
        belief.information[rows, columns] = information
        belief.vector[t] = multiply_vectors(information, mean)
        speed = multiply_vectors(kept, speed) - multiply_vectors(regression, mean)
        for g, (number, group) in enumerate(zip(numbers, groups, strict=True)):
            after = ends[g][0]
            belief.x[group.x] = after
            free = speeds[g].free
            if number in self.redundant:
                if free > _FARTHEST:
                    free += dt * math.sqrt(np.linalg.eigvalsh(spread[g])[-1])
                free = max(free, math.sqrt(np.linalg.eigvalsh(state[g])[-1]))
            belief.speeds[number] = ConditionalSpeeds(
                after, speed[g], regression[g], left[g], information[g], free
            )

    def _integrate(self, dt: float) -> tuple[float, float, tuple[float, float, float]]:
        """Return the way of a unit of speed, what is left of it, and the noise of (x, x), (x, u), (u, u)."""
        tau = self._decay
        if math.isinf(tau):
            return dt, 1.0, (dt**3 / 3, dt**2 / 2, dt)
        share, way = math.exp(-dt / tau), -tau * math.expm1(-dt / tau)
        speeds = way * (1 + share) / 2
        return way, share, (tau**2 * max(dt - 2 * way + speeds, 0.0), way**2 / 2, speeds)

    def _step_between(
        self, number: int, start: Array, end: Array, inputs: Array
    ) -> tuple[Array, Array | None]:
        """Return the tangent step between two states of a group, and its transport."""
        change = end - start
        for k, x in enumerate(self._layout.groups[number].coordinates):
            if x in self.periods:
                change[k] = math.remainder(change[k], self.periods[x])
        if self._process_model.flow(number) is None:
            return change, None
        target = start + change
        step = np.linalg.pinv(self._process_model.basis(number, start, inputs)) @ change
        for _ in range(_MOST_SUBSTEPS):
            there, transport = self._process_model.retract(number, start, step, inputs)
            left = np.linalg.pinv(self._process_model.basis(number, there, inputs)) @ (target - there)
            step = step + left
            if float(left @ left) < _SETTLED:
                break
        return step, transport
