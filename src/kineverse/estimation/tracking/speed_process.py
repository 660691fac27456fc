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
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np

from kineverse.compilation import CompiledFunction, compile
from kineverse.errors import InvalidValueError
from kineverse.estimation.linear_algebra import (
    inverse_spd,
    invert_matrices,
    multiply_vectors,
    symmetric,
    transposed,
)
from kineverse.expressions.expression import array
from kineverse.expressions.substitution import apply_substitution
from kineverse.lie import Array
from kineverse.model.rates import to_plain
from kineverse.symbols import Symbol

from .measurements import MeasurementModel, wrap_difference
from .process_model import ProcessModel, Speeds
from .residuals import Measurements, Residuals, log_scale, read_value, whitening
from .state_space import InformationState, Layout

if TYPE_CHECKING:
    from .gaussian_sum_filter import GaussianSum, UpdateStep

_SETTLED = 1e-12
_LINEAR = 1e-9  # change of a Jacobian that is rounding
_MOST_SUBSTEPS = 10
_KNOWN = 0.5  # largest free motion that a Gaussian describes [m], [rad]

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
    free: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Unmeasured motion in a redundant group: variances of place and speed, their covariance between."""


class SpeedProcess:
    """Prediction of states and speeds of some groups.

    Measurements leave directions of a redundant group free, such as an arm of seven joints seen at its tip.
    These directions turn with the state, so that information about others passes for information about them.
    Once free motion may be long, nothing is therefore stated about the coordinates of the group.
    """

    def __init__(
        self,
        layout: Layout,
        process_model: ProcessModel,
        groups: Iterable[int],
        residuals: Residuals,
        decay: float = math.inf,
    ) -> None:
        self._layout, self._process_model = layout, process_model
        self._residuals, self._decay = residuals, decay
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
        self.redundant = frozenset(self._find_redundant(belief, inputs))
        for number in self.groups:
            group, speeds = self._layout.groups[number], self._process_model.speeds_of(number)
            mean, gain = np.array([means.get(v, 0.0) for v in speeds]), np.zeros((len(speeds), len(group.t)))
            covariance, free = np.diag([variances[v] for v in speeds]), (0.0, 0.0, 0.0)
            if number in self.redundant:
                state = inverse_spd(belief.information[group.block])
                free = float(np.diag(state).max()), 0.0, float(np.diag(covariance).max())
            belief.speeds[number] = ConditionalSpeeds(belief.x[group.x].copy(), mean, gain, covariance, free)

    def _find_redundant(self, belief: InformationState, inputs: Array) -> Iterator[int]:
        apart = belief.x + np.random.default_rng(0).normal(0.0, 0.1, len(belief.x))
        outputs = [self._residuals.evaluate(x, inputs) for x in (belief.x, apart)]
        for number in self.groups:
            indices = self._layout.groups[number].observation_indices
            here, there = (
                np.concatenate([out[self._layout.jacobian_slices[i]] for i in indices]) for out in outputs
            )
            # Rates and linear measurements inform about free directions over time.
            if not self._process_model.is_carried(number) and np.abs(here - there).max() > _LINEAR:
                size = len(self._layout.groups[number].t)
                if np.isfinite(here).all() and np.linalg.matrix_rank(here.reshape(-1, size)) < size:
                    yield number

    def at_state(self, number: int, belief: InformationState, inputs: Array) -> ConditionalSpeeds:
        """Return the speeds of a group given a step in the tangent space at its present state."""
        speeds = belief.speeds[number]
        assert speeds is not None
        x = belief.x[self._layout.groups[number].x]
        if np.array_equal(x, speeds.anchor):
            return speeds
        step, transport = self._step_between(number, speeds.anchor, x, inputs)
        gain = speeds.gain if transport is None else speeds.gain @ np.linalg.inv(transport)
        return replace(speeds, anchor=x.copy(), mean=speeds.mean + speeds.gain @ step, gain=gain)

    def innovate(
        self, number: int, belief: InformationState, inputs: Array, rows: Rows
    ) -> tuple[Array, Array, Array, Array]:
        """Return innovations, their slopes by state and speeds, and mean and covariance of both."""
        group, speeds = self._layout.groups[number], self.at_state(number, belief, inputs)
        errors, by_state, by_speed = rows(belief.x, speeds.mean)
        state = inverse_spd(belief.information[group.block])
        cross, step = speeds.gain @ state, state @ belief.vector[group.t]
        joint = np.block([[state, cross.T], [cross, speeds.covariance + cross @ speeds.gain.T]])
        slope, mean = np.hstack([by_state, by_speed]), np.concatenate([step, speeds.gain @ step])
        return errors - slope @ mean, slope, mean, joint

    def measure(
        self, number: int, belief: InformationState, inputs: Array, rows: Rows
    ) -> tuple[Array, Array]:
        """Update a group by measured speeds, in place; return innovations and their covariance."""
        group, speeds = self._layout.groups[number], self.at_state(number, belief, inputs)
        errors, slope, mean, joint = self.innovate(number, belief, inputs, rows)
        t, spread = len(group.t), np.eye(len(errors)) + slope @ joint @ slope.T
        weights = np.linalg.solve(spread, slope @ joint)
        mean, joint = mean + weights.T @ errors, symmetric(joint - weights.T @ spread @ weights)
        information = inverse_spd(joint[:t, :t])
        gain = joint[t:, :t] @ information
        belief.information[group.block], belief.vector[group.t] = information, information @ mean[:t]
        belief.records[number] = None
        covariance = symmetric(joint[t:, t:] - gain @ joint[:t, t:])
        speed = speeds.mean + mean[t:] - gain @ mean[:t]
        belief.speeds[number] = replace(speeds, mean=speed, gain=gain, covariance=covariance)
        return errors, spread

    def free_variance(self, number: int, belief: InformationState) -> float:
        """Return the variance of each coordinate of a group of which nothing can be stated; else 0."""
        speeds = belief.speeds[number]
        variance = 0.0 if speeds is None else speeds.free[0]
        return variance if variance > _KNOWN**2 and speeds is not None and speeds.gain.any() else 0.0

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
        # [ξ; u] ← [slope, moved; 0, shares] [ξ; u], with the noise of an integrated white acceleration.
        moved = by_speed * reaches[:, None, :]
        added = [integral * density[:, :, None] * np.eye(density.shape[1]) for integral in integrals]
        coupled = moved @ cross @ transposed(slope)
        state = slope @ covariance @ transposed(slope) + coupled + transposed(coupled)
        state += moved @ spread @ transposed(moved) + by_speed @ added[0] @ transposed(by_speed)
        shared = shares[:, :, None] * (cross @ transposed(slope) + spread @ transposed(moved))
        shared += added[1] @ transposed(by_speed)
        information = invert_matrices(symmetric(state))
        regression, mean = shared @ information, multiply_vectors(slope, mean)
        left = shares[:, :, None] * spread * shares[:, None, :] + added[2]
        left = symmetric(left - regression @ transposed(shared))
        belief.information[rows, columns] = information
        belief.vector[t] = multiply_vectors(information, mean)
        speed = shares * speed - multiply_vectors(regression, mean)
        for g, (number, group) in enumerate(zip(numbers, groups, strict=True)):
            after = ends[g][0]
            belief.x[group.x] = after
            a, b, c = speeds[g].free
            if not all(v in commands for v in orders[g]):
                q = float(density[g].max()) if number in self.redundant else 0.0
                a, b = a + 2 * reach * b + reach**2 * c + integrals[0] * q, share * (b + reach * c)
                b, c = b + integrals[1] * q, share**2 * c + integrals[2] * q
            belief.speeds[number] = ConditionalSpeeds(after, speed[g], regression[g], left[g], (a, b, c))

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


class SpeedModel(NamedTuple):
    """Measurement model of an expression with speeds of one group."""

    model: MeasurementModel
    number: int  # of the group
    function: CompiledFunction  # value (d,), Jacobians by coordinates (d, n) and speeds (d, k)


class Residual(NamedTuple):
    """Residual of one measurement: measured minus predicted, before the update."""

    value: Array  # (d,), of a pose as errors of the noise convention
    covariance: Array  # of the residual if the measurement is an inlier (d, d)
    nis: float  # its normalised square, χ² distributed with d degrees of freedom
    is_outlier: bool


class SpeedValue(NamedTuple):
    """Measured value of such an expression."""

    value: Array
    white: Array
    log_scale: float


def build_speed_models(update_step: UpdateStep, models: Iterable[MeasurementModel]) -> dict[str, SpeedModel]:
    """Find the group of each measurement model with speeds."""
    layout, process_model = update_step.layout, update_step.process_model
    tangent_space = layout.tangent_space
    result: dict[str, SpeedModel] = {}
    for model in models:
        plain = tangent_space.resolve(to_plain(model.value))
        carried = {
            v: sum((entry * u for u, entry in tangent_space.rates[v.position].items()), start=array([0.0])[0])
            for v in plain.symbols
            if v.order == 1 and v.position in tangent_space.rates
        }
        value = tangent_space.resolve(apply_substitution(plain, carried)) if carried else plain
        own = [s for s in value.symbols if s not in layout.inputs]
        numbers = [
            n
            for n, group in enumerate(layout.groups)
            if any(s in group.coordinates or s in process_model.speeds_of(n) for s in own)
        ]
        if len(numbers) != 1:
            reason = "speeds of parts that no observation connects" if numbers else "no estimated speed"
            raise InvalidValueError(
                f"'{model.name}' measures {reason}. Observe a frame or an expression that moves with all of "
                "its coordinates."
            )
        group, speeds = layout.groups[numbers[0]], process_model.speeds_of(numbers[0])
        arguments = (*group.coordinates, *speeds, *layout.inputs)
        if unknown := [str(s) for s in own if s not in arguments]:
            raise InvalidValueError(f"'{model.name}' needs {', '.join(unknown)}, which is not estimated.")
        slopes = value.partial(group.coordinates), value.partial(speeds)
        result[model.name] = SpeedModel(model, numbers[0], compile([value, *slopes], arguments))
    return result


class SpeedUpdate:
    """Update by measured speeds, one after the other, and residuals of all measurements."""

    def __init__(self, update_step: UpdateStep, models: Mapping[str, SpeedModel]) -> None:
        self._step, self.models = update_step, models

    def read(self, measurements: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, SpeedValue]]:
        """Return the measurements of the state, and the checked values of speeds."""
        speeds = {}
        for name in [name for name in self.models if name in measurements]:
            value, covariance = read_value(measurements[name], self.models[name].model)
            speeds[name] = SpeedValue(value, whitening(covariance), log_scale(covariance))
        return {name: value for name, value in measurements.items() if name not in speeds}, speeds

    def update(
        self, mixture: GaussianSum, reading: Measurements, speeds: Mapping[str, SpeedValue], inputs: Array
    ) -> tuple[GaussianSum, Array, Array, tuple[str, ...]]:
        """Update all components; return also NIS and degrees of freedom of each group, and outliers."""
        layout, rejected = self._step.layout, []
        nis, dof = np.zeros(len(layout.groups)), np.zeros(len(layout.groups))
        for name, value in speeds.items():
            number, beliefs = self.models[name].number, list(mixture.beliefs)
            for k in np.flatnonzero(mixture.alive[:, number]).tolist():
                beliefs[k], square = self._measure(name, value, beliefs[k], inputs)
                if k == 0 and square is None:
                    rejected.append(name)
                elif k == 0 and square is not None:
                    nis[number] += square
                    dof[number] += len(value.value)
            if not reading.mask[list(layout.groups[number].observation_indices)].any():
                beliefs = [self._step.constrained(belief, inputs) for belief in beliefs]
            mixture = mixture.with_beliefs(beliefs)
        return mixture, nis, dof, tuple(rejected)

    def _measure(
        self, name: str, value: SpeedValue, belief: InformationState, inputs: Array
    ) -> tuple[InformationState, float | None]:
        """Return a belief after one measured speed, with its NIS; None for an outlier."""
        outliers, velocity, one = self._step.outliers, self._step.velocity, self.models[name]
        assert velocity is not None
        after = belief.copy()
        errors, spread = velocity.measure(one.number, after, inputs, self._rows(name, value, inputs))
        square = float(errors @ np.linalg.solve(spread, errors))
        scale = value.log_scale + float(np.linalg.slogdet(spread)[1]) / 2
        if outliers is not None:
            log_density = outliers.log_density(one.model, scale)
            weight, _ = outliers.weigh(square, scale, log_density)
            if weight < 0.5:
                belief = belief.copy()
                belief.evidence[one.number] += log_density
                return belief, None
            scale -= math.log(1 - outliers.fraction)
        after.evidence[one.number] -= square / 2 + scale
        return after, square

    def _rows(self, name: str, measured: SpeedValue, inputs: Array) -> Rows:
        one, group = self.models[name], self._step.layout.groups[self.models[name].number]

        def evaluate(x: Array, u: Array) -> tuple[Array, Array, Array]:
            basis = self._step.process_model.basis(one.number, x[group.x], inputs)
            value, by_state, by_speed = one.function(np.concatenate([x[group.x], u, inputs]))
            error = wrap_difference(measured.value - value, one.model.period)
            return measured.white @ error, measured.white @ by_state @ basis, measured.white @ by_speed

        return evaluate

    def residuals(
        self,
        belief: InformationState,
        reading: Measurements,
        speeds: Mapping[str, SpeedValue],
        inputs: Array,
        outliers: Collection[str],
    ) -> dict[str, Residual]:
        """Return the residual of each measurement by name, for the belief before the update."""
        layout, velocity = self._step.layout, self._step.velocity
        measured = np.flatnonzero(reading.mask).tolist()
        out = self._step.residuals.evaluate(belief.x, inputs)
        whitened = self._step.residuals.errors(out, reading, measured)
        result: dict[str, Residual] = {}

        def add(name: str, error: Array, slope: Array, joint: Array, white: Array) -> None:
            spread, back = np.eye(len(error)) + slope @ joint @ slope.T, np.linalg.inv(white)
            nis = float(error @ np.linalg.solve(spread, error))
            result[name] = Residual(back @ error, back @ spread @ back.T, nis, name in outliers)

        for i in measured:
            group, (error, slope) = layout.groups[layout.group_of[i]], whitened[i]
            state = inverse_spd(belief.information[group.block])
            white = reading.whitening[layout.whitening_slices[i]].reshape(len(error), -1)
            error = error - slope @ state @ belief.vector[group.t]
            add(layout.observations[i].name, error, slope, state, white)
        for name, value in speeds.items():
            assert velocity is not None
            rows = self._rows(name, value, inputs)
            error, slope, _, joint = velocity.innovate(self.models[name].number, belief, inputs, rows)
            add(name, error, slope, joint, value.white)
        return result
