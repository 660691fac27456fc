"""Process models: prediction along q̇ = R(q) u, constant velocity, default process noise.

With constant velocity, the acceleration is white noise with the spectral density q (Bar-Shalom, Li and
Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, 6.2.2):

    ẋ = R(x) u,    u̇ = w,    Cov ∫ w dt = q dt

No measurement depends on speeds. So an update of the state alone is exact, and for a step ξ in the tangent
space the speeds stay Gaussian, u | ξ ~ N(m + K ξ, C).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np

from kineverse.compilation import compile
from kineverse.errors import InvalidValueError, KineverseError, UnknownNameError, suggest
from kineverse.estimation.linear_algebra import (
    inverse_spd,
    invert_matrices,
    multiply_vectors,
    symmetric,
    transposed,
)
from kineverse.expressions.expression import Expression, array, as_expression
from kineverse.expressions.substitution import apply_substitution
from kineverse.lie import Array
from kineverse.symbols import Symbol

from .information_state import InformationState
from .state_space import Layout

if TYPE_CHECKING:
    from .gaussian_sum_filter import UpdateStep

Speeds: TypeAlias = Mapping[Symbol, float]

# Largest displacement in one Runge-Kutta step; the error is below 1e-8.
_LONGEST = 0.1
_MOST_STEPS = 100_000


class RateFlow:
    """Flow of coordinates at constant speeds, with its partial derivatives."""

    def __init__(
        self,
        coordinates: Sequence[Symbol],
        rows: Sequence[Mapping[Symbol, Expression]],
        speeds: Sequence[Symbol],
        inputs: Sequence[Symbol],
    ) -> None:
        self.coordinates, self.speeds = tuple(coordinates), tuple(speeds)
        zero = as_expression(0.0)
        matrix = array([[row.get(v, zero) for v in speeds] for row in rows])
        u, q = array(list(speeds)), array(list(coordinates))

        def rate(at: Expression) -> Expression:
            return apply_substitution(matrix, dict(zip(self.coordinates, at, strict=True))) @ u

        k1 = matrix @ u
        k2 = rate(q + k1 / 2)
        k3 = rate(q + k2 / 2)
        after = q + (k1 + 2 * k2 + 2 * k3 + rate(q + k3)) / 6
        arguments = (*self.coordinates, *self.speeds, *inputs)
        # Constant rates are integrated exactly by one step of any length.
        self.is_varying = np.array([[v in row and bool(row[v].symbols) for v in speeds] for row in rows])
        self._rates = compile(matrix, (*self.coordinates, *inputs))
        self._step = compile([after, after.partial(self.coordinates), after.partial(self.speeds)], arguments)

    def wait(self, timeout: float | None) -> None:
        """Wait until the compiled code is ready."""
        self._rates.wait(timeout)
        self._step.wait(timeout)

    @property
    def addresses(self) -> tuple[int, int] | None:
        """Addresses of the C functions of rates and steps; None before compilation ends."""
        rates, step = self._rates.address, self._step.address
        return None if rates is None or step is None else (rates, step)

    def rates(self, q: Array, inputs: Array) -> Array:
        """Return R(q) (n, m)."""
        return np.asarray(self._rates(np.concatenate([q, inputs])))

    def integrate(self, q: Array, speeds: Array, inputs: Array) -> tuple[Array, Array, Array]:
        """Return q after one unit of time by Runge-Kutta steps, and its derivatives (n, n), (n, m)."""
        largest = float((self.is_varying * np.abs(self.rates(q, inputs))).sum(axis=0) @ np.abs(speeds))
        if not math.isfinite(largest) or largest > _MOST_STEPS * _LONGEST:
            names = ", ".join(map(str, self.coordinates))
            raise InvalidValueError(
                f"The step of {names} is too long to be integrated: after a long time without measurements, "
                "reset the tracker."
            )
        by_start, by_speeds = np.eye(len(q)), np.zeros((len(q), len(speeds)))
        count = max(1, math.ceil(largest / _LONGEST))
        for _ in range(count):
            q, slope, gain = self._step(np.concatenate([q, speeds / count, inputs]))
            by_start, by_speeds = slope @ by_start, slope @ by_speeds + gain / count
        return q, by_start, by_speeds


class ProcessModel:
    """Process model of a layout: retraction and prediction."""

    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        tangent_space, rates = layout.tangent_space, layout.tangent_space.rates
        one = as_expression(1.0)
        self._steps: dict[int, RateFlow] = {}
        self._flows: dict[int, RateFlow] = {}
        by_name: dict[str, Symbol] = {}
        for number, group in enumerate(layout.groups):
            rows = [rates[x] if x in rates else {x.derivative(): one} for x in group.coordinates]
            speeds = sorted({v for row in rows for v in row}, key=lambda s: s.sort_key)
            by_name.update({str(v): v for v in speeds})
            if any(x in rates for x in group.coordinates):
                self._flows[number] = RateFlow(group.coordinates, rows, speeds, layout.inputs)
            if group.by_speeds:
                process_model = [tangent_space.rate_row(x) for x in group.coordinates]
                self._steps[number] = RateFlow(group.coordinates, process_model, group.tangent, layout.inputs)
        self._identities = [np.eye(len(group.t)) for group in layout.groups]
        self.speeds: Mapping[str, Symbol] = by_name

    def speed(self, key: Symbol | str) -> Symbol:
        """Return the speed of a name, or that of the coordinate of this name."""
        result = self.speeds.get(str(key), self.speeds.get(f"{key}:velocity"))
        if result is None:
            hint = suggest(str(key), self.speeds, "speed")
            raise UnknownNameError(f"No estimated coordinate moves with '{key}'. {hint}")
        return result

    def speeds_of(self, number: int) -> tuple[Symbol, ...]:
        """Return the speeds with which a group moves, in order."""
        flow = self._flows.get(number)
        return self._layout.groups[number].tangent if flow is None else flow.speeds

    def is_noise_only(self, number: int, speeds: Speeds) -> bool:
        """Return True if a group moves by noise alone, in directions that are its coordinates."""
        group = self._layout.groups[number]
        return number not in self._flows and not any(speeds.get(v, 0.0) for v in group.tangent)

    def wait(self, timeout: float | None) -> None:
        """Wait until retraction runs in compiled code."""
        for motion in self._steps.values():
            motion.wait(timeout)

    def flow(self, number: int) -> RateFlow | None:
        """Return the flow of a group along its tangent; None if the tangent is its coordinates."""
        return self._steps.get(number)

    @property
    def has_rates(self) -> bool:
        """True if some coordinates move by rates other than their own speeds."""
        return bool(self._flows)

    def find_moving_groups(self, speeds: Speeds, noise: Speeds) -> list[int]:
        """Return the numbers of the groups that move at these speeds or with noise."""
        active = {v for by in (speeds, noise) for v, value in by.items() if value}
        numbers = range(len(self._layout.groups))
        return [number for number in numbers if not active.isdisjoint(self.speeds_of(number))]

    def retract(self, number: int, x: Array, step: Array, inputs: Array) -> tuple[Array, Array | None]:
        """Return coordinates after a tangent step, and its transport Jacobian; None for the identity."""
        motion = self._steps.get(number)
        if motion is None:
            return x + step, None
        after, _, gain = motion.integrate(x, step, inputs)
        return after, np.linalg.pinv(motion.rates(after, inputs)) @ gain

    def basis(self, number: int, x: Array, inputs: Array) -> Array:
        """Return the Jacobian of a group's coordinates by its tangent (n, t)."""
        motion = self._steps.get(number)
        return np.eye(len(x)) if motion is None else motion.rates(x, inputs)

    def predict(
        self, belief: InformationState, inputs: Array, dt: float, speeds: Speeds, noise: Speeds
    ) -> None:
        """Predict a belief by ``dt`` seconds, with speeds and variances per second; in place."""
        for number, group in enumerate(self._layout.groups):
            order = self.speeds_of(number)
            displacement = np.array([speeds.get(v, 0.0) for v in order]) * dt
            added_variance = np.array([noise.get(v, 0.0) for v in order]) * dt
            if not (displacement.any() or added_variance.any()):
                continue
            covariance = inverse_spd(belief.information[group.block])
            after, slope, gain = self.transition(number, belief.x[group.x], displacement, inputs)
            mean = slope @ (covariance @ belief.vector[group.t])
            covariance = slope @ covariance @ slope.T + (gain * added_variance) @ gain.T
            information = inverse_spd(covariance)
            belief.x[group.x] = after
            belief.information[group.block] = information
            belief.vector[group.t] = information @ mean

    def transition(
        self, number: int, x: Array, displacement: Array, inputs: Array
    ) -> tuple[Array, Array, Array]:
        """Return coordinates after a displacement, and its tangent Jacobians (t, t), (t, k)."""
        flow = self._flows.get(number)
        if flow is None:
            identity = self._identities[number]
            return x + displacement, identity, identity
        after, slope, gain = flow.integrate(x, displacement, inputs)
        back = np.linalg.pinv(self.basis(number, after, inputs))
        return after, back @ slope @ self.basis(number, x, inputs), back @ gain


Process: TypeAlias = Literal["position", "velocity", "static"]

PROCESSES: Mapping[str, tuple[float, float]] = {"position": (0.004, 0.01), "velocity": (0.1, 0.3)}
"""Linear and angular noise of frames: of positions [m²/s], [rad²/s], or of speeds [m²/s³], [rad²/s³].

They suit a kitchen door that a hand opens within 3.5 s (``kineverse reproduce stream``)."""

INITIAL_SPEED_TIME = 3.0  # the initial variance of a speed is its process noise during this time [s]

# Relative positions between limits at which frames are sampled, in addition to the start.
_SAMPLES = (0.2, 0.5, 0.8)
_LEAST = 1e-6


def check_process(process: str) -> None:
    """Check the name of a process model."""
    known = (*PROCESSES, "static")
    if process not in known:
        raise InvalidValueError(f"There is no process {process!r}. {suggest(str(process), known, 'process')}")


def default_process_noise(
    update_step: UpdateStep, process: Process, start: Array, inputs: Array
) -> dict[Symbol, float]:
    """Return the process noise of each speed: a variance per second, or a density of accelerations."""
    if process == "static":
        return {}
    angular = PROCESSES[process][1]
    largest = dict.fromkeys(update_step.process_model.speeds.values(), 0.0)
    limits = update_step.limits
    bounded = np.isfinite(limits.upper - limits.lower)
    lower, upper = limits.lower[bounded], limits.upper[bounded]
    states = [start]
    for share in _SAMPLES:
        states.append(start.copy())
        states[-1][bounded] = lower + share * (upper - lower)
    for x in states:
        with suppress(KineverseError):  # infeasible
            for v, square in _frame_motions(update_step, x, inputs, *PROCESSES[process]):
                largest[v] = max(largest[v], square)
    return {v: 1.0 / square if square > _LEAST else angular for v, square in largest.items()}


def _frame_motions(
    update_step: UpdateStep, x: Array, inputs: Array, linear: float, angular: float
) -> Iterator[tuple[Symbol, float]]:
    """Yield the square of the motion of each frame by each speed, in units of the noise of frames."""
    layout, process_model = update_step.layout, update_step.process_model
    out = update_step.residuals.evaluate(x, inputs)
    for number, group in enumerate(layout.groups):
        speeds = process_model.speeds_of(number)
        _, _, gain = process_model.transition(number, x[group.x], np.zeros(len(speeds)), inputs)
        for i in group.observation_indices:
            one = layout.observations[i]
            if one.frame:
                slope = out[layout.jacobian_slices[i]].reshape(one.size, len(group.t)) @ gain
                squares = np.square(slope[:3]).sum(axis=0) / linear
                if one.is_pose:
                    squares = np.maximum(squares, np.square(slope[3:]).sum(axis=0) / angular)
                yield from ((v, s) for v, s in zip(speeds, squares.tolist(), strict=True) if math.isfinite(s))


_SETTLED = 1e-12
_MOST_SUBSTEPS = 10


@dataclass(frozen=True, eq=False)
class ConditionalSpeeds:
    """Gaussian of the speeds of a group given its state: u | ξ ~ N(m + K ξ, C)."""

    anchor: Array  # coordinates (n,) in whose tangent space ξ is
    mean: Array  # m (k,), K (k, t) and C (k, k)
    gain: Array
    covariance: Array


class ConstantVelocity:
    """Prediction of states and speeds."""

    def __init__(self, layout: Layout, process_model: ProcessModel) -> None:
        self._layout, self._process_model = layout, process_model
        self.periods: Mapping[Symbol, float] = {}
        by_size: dict[tuple[int, int], list[int]] = {}
        for number, group in enumerate(layout.groups):
            by_size.setdefault((len(group.t), len(process_model.speeds_of(number))), []).append(number)
        self._batches = list(by_size.values())

    def initialise(self, belief: InformationState, means: Speeds, variances: Speeds) -> None:
        """Set the speeds of all groups, those without a mean to 0, independent of the state; in place."""
        for number, group in enumerate(self._layout.groups):
            speeds = self._process_model.speeds_of(number)
            mean, gain = np.array([means.get(v, 0.0) for v in speeds]), np.zeros((len(speeds), len(group.t)))
            covariance = np.diag([variances[v] for v in speeds])
            belief.speeds[number] = ConditionalSpeeds(belief.x[group.x].copy(), mean, gain, covariance)

    def at_state(self, number: int, belief: InformationState, inputs: Array) -> ConditionalSpeeds:
        """Return the speeds of a group given a step in the tangent space at its present state."""
        speeds = belief.speeds[number]
        assert speeds is not None
        x = belief.x[self._layout.groups[number].x]
        if np.array_equal(x, speeds.anchor):
            return speeds
        step, transport = self._step_between(number, speeds.anchor, x, inputs)
        gain = speeds.gain if transport is None else speeds.gain @ np.linalg.inv(transport)
        return ConditionalSpeeds(x, speeds.mean + speeds.gain @ step, gain, speeds.covariance)

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
        speeds = [self.at_state(n, belief, inputs) for n in numbers]
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
        for g, order in enumerate(orders):
            for k, v in enumerate(order):
                if v in commands:
                    speed[g, k], density[g, k] = commands[v], 0.0
                    cross[g, k] = spread[g, k] = spread[g, :, k] = 0.0
        ends = [
            self._process_model.transition(n, belief.x[group.x], by, inputs)
            for n, group, by in zip(numbers, groups, speed * dt, strict=True)
        ]
        slope, by_speed = (np.array([end[i] for end in ends]) for i in (1, 2))
        # [ξ; u] ← [slope, by_speed dt; 0, 1] [ξ; u], with the noise of an integrated white acceleration.
        moved = cross @ transposed(slope) + dt * spread @ transposed(by_speed)
        moved += dt**2 / 2 * density[:, :, None] * transposed(by_speed)
        state = slope @ covariance @ transposed(slope)
        coupled = dt * by_speed @ cross @ transposed(slope)
        state += coupled + transposed(coupled)
        spread_and_noise = dt**2 * spread + dt**3 / 3 * density[:, :, None] * np.eye(density.shape[1])
        state += by_speed @ spread_and_noise @ transposed(by_speed)
        information = invert_matrices(symmetric(state))
        regression, mean = moved @ information, multiply_vectors(slope, mean)
        left = spread + dt * density[:, :, None] * np.eye(density.shape[1]) - regression @ transposed(moved)
        left = symmetric(left)
        belief.information[rows, columns] = information
        belief.vector[t] = multiply_vectors(information, mean)
        speed -= multiply_vectors(regression, mean)
        for g, (number, group) in enumerate(zip(numbers, groups, strict=True)):
            after = ends[g][0]
            belief.x[group.x] = after
            belief.speeds[number] = ConditionalSpeeds(after, speed[g], regression[g], left[g])

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
