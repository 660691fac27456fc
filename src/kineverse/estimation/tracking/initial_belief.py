"""Initial belief of a tracker, and that of groups that start anew."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from kineverse.errors import InvalidValueError, UnknownNameError, suggest
from kineverse.lie import Array
from kineverse.state import State, StateLike
from kineverse.symbols import Symbol

from .bounds import initial_deviations, initial_point
from .gaussian import InformationState
from .gaussian_sum import GaussianSum
from .measurements import require_mapping, require_positive
from .multi_start import find_turning_coordinates, spread_starts
from .step import UpdateStep

if TYPE_CHECKING:
    from kineverse.model.model_view import ModelView


# Distance beyond limits that may be rounding.
_BEYOND = 1e-3


@dataclass(frozen=True, eq=False)
class InitialBelief:
    """Initial state and its standard deviations."""

    x: Array  # coordinates (n,)
    deviations: Array  # standard deviation of each tangent direction (t,)
    speeds: Mapping[Symbol, float] = field(default_factory=dict)
    speed_variances: Mapping[Symbol, float] = field(default_factory=dict)

    def spread(self, update_step: UpdateStep, inputs: Array) -> GaussianSum:
        """Return the belief about several initial points, see :mod:`.multi_start`."""
        groups = len(update_step.layout.groups)
        belief = InformationState((len(self.x), len(self.deviations), groups))
        belief.x[:] = self.x
        with np.errstate(over="ignore"):
            variances = np.array([*self.deviations**2, *self.deviations**-2.0])
        if not (np.isfinite(variances).all() and variances.all()):
            raise InvalidValueError("An initial uncertainty is too large or too small for floating point.")
        belief.information[:] = np.diag(self.deviations**-2.0)
        if update_step.velocity is not None:
            update_step.velocity.initialise(belief, self.speeds, self.speed_variances)
        return spread_starts(update_step, belief, inputs)

    def with_values(self, update_step: UpdateStep, values: GivenValues) -> InitialBelief:
        """Return the belief with other values of some coordinates and speeds, and other deviations."""
        x, deviations = self.x.copy(), self.deviations.copy()
        for symbol, value in values.coordinates.items():
            k = update_step.layout.tangent_space.coordinates.index(symbol)
            x[k] = np.clip(value, update_step.limits.lower[k], update_step.limits.upper[k])
        for k, value in values.deviations.items():
            deviations[k] = value
        variances = {v: deviation**2 for v, deviation in values.speed_deviations.items()}
        speeds, speed_variances = {**self.speeds, **values.speeds}, {**self.speed_variances, **variances}
        return InitialBelief(x, deviations, speeds, speed_variances)


@dataclass(frozen=True, eq=False)
class GivenValues:
    """Checked initial values and standard deviations."""

    coordinates: Mapping[Symbol, float]  # values by symbol
    speeds: Mapping[Symbol, float]
    deviations: Mapping[int, float]  # standard deviations by number of the tangent direction
    speed_deviations: Mapping[Symbol, float]  # standard deviations of speeds

    @staticmethod
    def read(update_step: UpdateStep, start: StateLike, uncertainty: StateLike) -> GivenValues:
        """Check initial values and standard deviations."""
        tangent_space = update_step.layout.tangent_space
        speeds = () if update_step.velocity is None else tuple(update_step.process_model.speeds.values())
        state = start if isinstance(start, State) else State(start)
        given = {s: state[s] for s in (*tangent_space.coordinates, *speeds) if s in state}
        for name in () if isinstance(start, State) else state:
            if name not in given:
                raise _unknown_name(name, (*tangent_space.coordinates, *speeds))
        for symbol, value in given.items():
            if not math.isfinite(value):
                raise InvalidValueError(f"start= of '{symbol}' is {value!r}; it must be finite.")
            if not isinstance(start, State) and symbol in tangent_space.coordinates:
                _check_limits(update_step, symbol, value)
        names: dict[str, int] = {}
        for k, v in enumerate(tangent_space.tangent):
            names[str(v.position) if v.position in tangent_space.coordinates else str(v)] = k
        speed_names = {str(v): v for v in speeds if str(v) not in names}
        deviations, speed_deviations = {}, {}
        for key, value in require_mapping(uncertainty, "uncertainty=").items():
            if str(key) in speed_names:
                speed_deviations[speed_names[str(key)]] = require_positive(key, value)
            elif str(key) in names:
                deviations[names[str(key)]] = require_positive(key, value)
            else:
                raise _unknown_name(key, (*names, *speed_names))
        return GivenValues(
            {s: value for s, value in given.items() if s not in speeds},
            {s: value for s, value in given.items() if s in speeds},
            deviations,
            speed_deviations,
        )


def _check_limits(update_step: UpdateStep, symbol: Symbol, value: float) -> None:
    """Check that a given value is within the limits of its coordinate."""
    k = update_step.layout.tangent_space.coordinates.index(symbol)
    low, high = float(update_step.limits.lower[k]), float(update_step.limits.upper[k])
    if not low - _BEYOND <= value <= high + _BEYOND:
        raise InvalidValueError(
            f"start= of '{symbol}' is {value:g}, beyond its limits {low:g} to {high:g} [m], [rad]."
        )


def _unknown_name(key: object, names: Iterable[object]) -> UnknownNameError:
    hint = suggest(str(key), map(str, names), "coordinate")
    return UnknownNameError(f"'{key}' is not estimated. {hint}")


def make_initial_belief(
    model: ModelView, update_step: UpdateStep, values: GivenValues, inputs: Array
) -> InitialBelief:
    """Return the initial belief, and set the periodic coordinates and initial deviations of a tracker."""
    tangent_space, limits = update_step.layout.tangent_space, update_step.limits
    x = initial_point(model, tangent_space, limits, values.coordinates)
    update_step.periods, update_step.counted = find_turning_coordinates(update_step, x, inputs)
    usual = initial_deviations(tangent_space, limits, update_step.periodic)
    belief = InitialBelief(x, usual).with_values(update_step, values)
    update_step.unobservable.deviations = belief.deviations
    return belief
