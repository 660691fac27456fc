"""Process models: prediction along q̇ = R(q) u, and default process noise."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from collections.abc import Set as AbstractSet
from contextlib import suppress
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np

from kineverse.compilation import compile
from kineverse.errors import InvalidValueError, KineverseError, UnknownNameError, suggest
from kineverse.estimation.linear_algebra import inverse_spd
from kineverse.expressions.expression import Expression, array, as_expression
from kineverse.expressions.substitution import apply_substitution
from kineverse.lie import Array
from kineverse.symbols import Symbol

from .state_space import InformationState, Layout

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

    def is_carried(self, number: int) -> bool:
        """Return True if rates other than their own speeds move coordinates of a group."""
        return number in self._flows

    def wait(self, timeout: float | None) -> None:
        """Wait until retraction runs in compiled code."""
        for motion in self._steps.values():
            motion.wait(timeout)

    def flow(self, number: int) -> RateFlow | None:
        """Return the flow of a group along its tangent; None if the tangent is its coordinates."""
        return self._steps.get(number)

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

PROCESSES: Mapping[str, tuple[float, float]] = {
    "position": (0.004, 0.01),
    "velocity": (0.1, 0.3),
    "static": (0.0, 0.0),
}
"""Linear and angular noise of frames: of positions [m²/s], [rad²/s], or of speeds [m²/s³], [rad²/s³].

They suit a kitchen door that a hand opens within 3.5 s (``kineverse reproduce stream``)."""

INITIAL_SPEED_TIME = 3.0  # the initial variance of a speed is its process noise during this time [s]
SPEED_DECAY = 2.0 * INITIAL_SPEED_TIME  # time of decay for which this variance is stationary [s]

# Relative positions between limits at which frames are sampled, in addition to the start.
_SAMPLES = (0.2, 0.5, 0.8)
_LEAST = 1e-6
_MOST_OPPOSED = 4.0  # largest ratio of noise for parts that move against each other: at twice the speed


def choose_processes(
    process: Process | None,
    process_model: ProcessModel,
    layout: Layout,
    stated: Speeds,
    measured: AbstractSet[int],
) -> list[Process]:
    """Return the process of each group.

    By default speeds are estimated where rates carry a group, unless process noise is stated, which is that
    of positions there, and where speeds are measured.
    """
    if process is not None and process not in PROCESSES:
        hint = suggest(str(process), PROCESSES, "process")
        raise InvalidValueError(f"There is no process {process!r}. {hint}")
    if measured and process not in (None, "velocity"):
        raise InvalidValueError(
            f"process={process!r} estimates no speeds, but some are measured. Leave it out, or choose "
            'process="velocity".'
        )
    chosen: list[Process] = []
    for number in range(len(layout.groups)):
        is_stated = not stated.keys().isdisjoint(process_model.speeds_of(number))
        is_moving = number in measured or (process_model.is_carried(number) and not is_stated)
        chosen.append(process or ("velocity" if is_moving else "position"))
    return chosen


def default_process_noise(
    update_step: UpdateStep, processes: Sequence[Process], start: Array, inputs: Array
) -> dict[Symbol, float]:
    """Return the process noise of each speed: a variance per second, or a density of accelerations."""
    limits, process_model = update_step.limits, update_step.process_model
    bounded = np.isfinite(limits.upper - limits.lower)
    lower, upper = limits.lower[bounded], limits.upper[bounded]
    states = [start]
    for share in _SAMPLES:
        states.append(start.copy())
        states[-1][bounded] = lower + share * (upper - lower)
    outputs = []
    for x in states:
        with suppress(KineverseError):  # infeasible
            outputs.append((x, update_step.residuals.evaluate(x, inputs)))
    result: dict[Symbol, float] = {}
    for number, process in enumerate(processes):
        if process == "static":
            continue
        linear, angular = PROCESSES[process]
        squares = [_frame_motion(update_step, number, x, out, inputs, linear, angular) for x, out in outputs]
        largest = np.max(squares, axis=0, initial=0.0)
        noise = np.where(largest > _LEAST, 1.0 / np.maximum(largest, _LEAST), angular)
        result |= zip(process_model.speeds_of(number), noise.tolist(), strict=True)
    return result


def _frame_motion(
    update_step: UpdateStep, number: int, x: Array, out: Array, inputs: Array, linear: float, angular: float
) -> Array:
    """Return the square of the motion of the group's frames by each speed, in units of their noise (k,).

    It is less for speeds that move frames against each other, since each frame moves by itself.
    """
    layout, process_model = update_step.layout, update_step.process_model
    group, speeds = layout.groups[number], process_model.speeds_of(number)
    _, _, gain = process_model.transition(number, x[group.x], np.zeros(len(speeds)), inputs)
    largest, together = np.zeros(len(speeds)), np.zeros((len(speeds), len(speeds)))
    for i in group.observation_indices:
        one = layout.observations[i]
        slope = out[layout.jacobian_slices[i]].reshape(one.size, len(group.t)) @ gain
        if not one.frame or not np.isfinite(slope).all():
            continue
        slope = slope / np.sqrt([linear] * 3 + [angular] * (one.size - 3))[:, None]
        for part in (slope[:3], slope[3:]):
            largest = np.maximum(largest, np.square(part).sum(axis=0))
        together += slope.T @ slope
    scale = np.sqrt(np.diag(together))
    scale[scale == 0.0] = 1.0
    correlation = together / np.outer(scale, scale) + np.eye(len(scale)) * 1e-12
    opposed = np.diag(np.linalg.inv(correlation)) * np.diag(correlation)
    return np.asarray(largest / np.clip(opposed, 1.0, _MOST_OPPOSED))
