"""Measured speeds: their models, and updates of states and speeds together."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np

from kineverse.compilation import CompiledFunction, compile
from kineverse.errors import InvalidValueError
from kineverse.estimation.linear_algebra import inverse_spd
from kineverse.expressions.expression import array
from kineverse.expressions.substitution import apply_substitution
from kineverse.lie import Array
from kineverse.model.rates import to_plain

from .gaussian_sum import GaussianSum
from .gaussian_sum_filter import UpdateStep
from .information_state import InformationState
from .measurements import MeasurementModel, wrap_difference
from .residuals import Measurements, log_scale, read_value, whitening
from .speed_process import Rows


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
            mixture = GaussianSum(layout, beliefs, mixture.alive)
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
