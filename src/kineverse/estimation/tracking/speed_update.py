"""Measured speeds, and updates of groups whose states and speeds are measured together."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
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


@dataclass(slots=True, eq=False)
class JointResult:
    """Result of an update by measured speeds, and what is left of the reading."""

    mixture: GaussianSum
    reading: Measurements
    nis: Array  # of accepted measurements of each group
    dof: Array
    outliers: tuple[int, ...] = ()  # numbers of rejected observations
    speed_outliers: tuple[str, ...] = ()  # names of rejected speeds


class SpeedUpdate:
    """Update by measured speeds, and by all measurements of redundant groups."""

    def __init__(self, update_step: UpdateStep, models: Mapping[str, SpeedModel]) -> None:
        self._step, self.models = update_step, models

    def read(self, measurements: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, SpeedValue]]:
        """Return the measurements of the state, and the checked values of speeds."""
        speeds = {}
        for name in self.models.keys() & measurements.keys():
            value, covariance = read_value(measurements[name], self.models[name].model)
            speeds[name] = SpeedValue(value, whitening(covariance), log_scale(covariance))
        return {name: value for name, value in measurements.items() if name not in speeds}, speeds

    def update(
        self, mixture: GaussianSum, reading: Measurements, speeds: Mapping[str, SpeedValue], inputs: Array
    ) -> JointResult:
        """Update all components by the values of speeds, and by all measurements of redundant groups."""
        layout, velocity = self._step.layout, self._step.velocity
        mask, beliefs, count = reading.mask.copy(), list(mixture.beliefs), len(layout.groups)
        result = JointResult(mixture, reading, np.zeros(count), np.zeros(count))
        for number in () if velocity is None else velocity.groups:
            chosen: list[int | str] = [name for name in speeds if self.models[name].number == number]
            start = mixture.best.speeds[number]
            if velocity and number in velocity.redundant and start is not None and start.gain.any():
                poses = [i for i in layout.groups[number].observation_indices if reading.mask[i]]
                mask[poses] = False
                chosen += poses
            for k in range(len(beliefs)) if chosen else ():
                if not mixture.alive[k, number]:
                    continue
                beliefs[k], nis, dof, rejected = self._measure(
                    number, beliefs[k], reading, speeds, chosen, inputs
                )
                if k == 0:
                    result.nis[number], result.dof[number] = nis, dof
                    result.outliers += tuple(i for i in rejected if isinstance(i, int))
                    result.speed_outliers += tuple(i for i in rejected if isinstance(i, str))
            if chosen and not mask[list(layout.groups[number].observation_indices)].any():
                beliefs = [self._step.constrained(belief, inputs) for belief in beliefs]
        result.mixture = GaussianSum(layout, beliefs, mixture.alive)
        result.reading = reading._replace(mask=mask)
        return result

    def residuals(
        self,
        belief: InformationState,
        reading: Measurements,
        speeds: Mapping[str, SpeedValue],
        inputs: Array,
        outliers: Sequence[int | str],
    ) -> dict[str, Residual]:
        """Return the residual of each measurement by name, for the belief before the update."""
        layout, velocity = self._step.layout, self._step.velocity
        result: dict[str, Residual] = {}
        for number, group in enumerate(layout.groups):
            chosen: list[int | str] = [i for i in group.observation_indices if reading.mask[i]]
            chosen += [name for name in speeds if self.models[name].number == number]
            if not chosen:
                continue
            rows = self.rows(number, reading, speeds, chosen, inputs)
            if velocity and number in velocity.groups:
                _, slope, errors, _, joint = velocity.innovate(number, belief, inputs, rows)
            else:
                errors, slope, _ = rows(belief.x, np.empty(0))
                joint = inverse_spd(belief.information[group.block])
                errors = errors - slope @ (joint @ belief.vector[group.t])
            first = 0
            for i in chosen:
                part = slice(first, first + self._model(i).size)
                first = part.stop
                spread = np.eye(part.stop - part.start) + slope[part] @ joint @ slope[part].T
                nis = float(errors[part] @ np.linalg.solve(spread, errors[part]))
                white = (
                    speeds[i].white if isinstance(i, str) else reading.whitening[layout.whitening_slices[i]]
                )
                back = np.linalg.inv(white.reshape(len(spread), -1))
                covariance = back @ spread @ back.T
                result[self._model(i).name] = Residual(back @ errors[part], covariance, nis, i in outliers)
        return result

    def _model(self, i: int | str) -> MeasurementModel:
        return self.models[i].model if isinstance(i, str) else self._step.layout.observations[i]

    def _measure(
        self,
        number: int,
        belief: InformationState,
        reading: Measurements,
        speeds: Mapping[str, SpeedValue],
        chosen: Sequence[int | str],
        inputs: Array,
    ) -> tuple[InformationState, float, int, list[int | str]]:
        """Update a group, without its outliers; return the NIS, its degrees of freedom, and the outliers."""
        outliers, velocity = self._step.outliers, self._step.velocity
        bounds = self._step.solver.group_bounds[number]
        assert velocity is not None
        kept, log_density = list(chosen), 0.0
        rejected: list[int | str] = []
        while kept:
            after, rows = belief.copy(), self.rows(number, reading, speeds, kept, inputs)
            errors, spread = velocity.measure(number, after, inputs, rows, bounds)
            models = [self._model(i) for i in kept]
            ends = np.cumsum([0, *(model.size for model in models)])
            weights = []
            for model, i, first, end in zip(models, kept, ends, ends[1:], strict=False):
                part = spread[first:end, first:end]
                scale = float(reading.log_scale[i]) if isinstance(i, int) else speeds[i].log_scale
                scale += float(np.linalg.slogdet(part)[1]) / 2
                square = float(errors[first:end] @ np.linalg.solve(part, errors[first:end]))
                density = outliers.log_density(model, scale) if outliers else 0.0
                weights.append((outliers.weigh(square, scale, density)[0] if outliers else 1.0, density))
            worst = min(range(len(kept)), key=weights.__getitem__)
            if weights[worst][0] >= 0.5:
                nis = float(errors @ np.linalg.solve(spread, errors))
                log_density -= (nis + float(np.linalg.slogdet(spread)[1])) / 2
                log_density -= sum(
                    float(reading.log_scale[i]) if isinstance(i, int) else speeds[i].log_scale for i in kept
                )
                after.evidence[number] += log_density
                return after, nis, len(errors), rejected
            log_density += weights[worst][1]
            rejected.append(kept.pop(worst))
        after = belief.copy()
        after.evidence[number] += log_density
        return after, 0.0, 0, rejected

    def rows(
        self,
        number: int,
        reading: Measurements,
        speeds: Mapping[str, SpeedValue],
        chosen: Sequence[int | str],
        inputs: Array,
    ) -> Rows:
        """Return the function of whitened errors and Jacobians of some measurements of a group."""
        step, group = self._step, self._step.layout.groups[number]
        poses = [i for i in chosen if isinstance(i, int)]

        def evaluate(x: Array, u: Array) -> tuple[Array, Array, Array]:
            of_poses = (
                step.residuals.errors(step.residuals.evaluate(x, inputs), reading, poses) if poses else {}
            )
            basis = step.process_model.basis(number, x[group.x], inputs)
            parts = []
            for i in chosen:
                if isinstance(i, int):
                    error, slope = of_poses[i]
                    parts.append((error, slope, np.zeros((len(error), len(u)))))
                    continue
                value, by_state, by_speed = self.models[i].function(np.concatenate([x[group.x], u, inputs]))
                error = wrap_difference(speeds[i].value - value, self.models[i].model.period)
                white = speeds[i].white
                parts.append((white @ error, white @ by_state @ basis, white @ by_speed))
            errors, by_states, by_speeds = (np.concatenate(part) for part in zip(*parts, strict=True))
            return errors, by_states, by_speeds

        return evaluate
