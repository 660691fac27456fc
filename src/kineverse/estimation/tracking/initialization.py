"""Initial belief of a tracker and of restarted groups, with several starts for ambiguous angles."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from kineverse.errors import InvalidValueError, KineverseError, UnknownNameError, suggest
from kineverse.lie import Array
from kineverse.state import State, StateLike
from kineverse.symbols import Symbol

from .bounds import initial_deviations, initial_point
from .gaussian_sum_filter import GaussianSum, UpdateStep
from .measurements import require_mapping, require_positive, wrap_difference
from .state_space import CoordinateGroup, InformationState, Layout

if TYPE_CHECKING:
    from kineverse.model.model_view import ModelView

# Largest distance between initial values of an angle [rad].
_SPACING = math.pi / 2
_MOST_STARTS = 32
# Initial points are at most this many deviations from the first.
_FARTHEST = 5.5
_SAME = 1e-9
_MOST_TURNS = 12  # turns after which gears may stand as before: a gear of ratio p/q does so after q turns
_SAMPLES = (0.125, 0.375, 0.625, 0.875)  # relative positions between limits at which predictions are sampled


def find_periods(update_step: UpdateStep, x: Array, inputs: Array) -> dict[Symbol, float]:
    """Return coordinates with a period of all predictions [rad], in whole turns."""
    layout, limits = update_step.layout, update_step.limits
    periods: dict[Symbol, float] = {}
    for i in np.flatnonzero(np.isinf(limits.lower) & np.isinf(limits.upper)).tolist():

        def turned(turns: int, i: int = i) -> Array:
            there = x.copy()
            there[i] += turns * math.tau
            return update_step.residuals.evaluate(there, inputs)

        with suppress(
            KineverseError, StopIteration
        ):  # the loop does not close there, or it is no number of turns
            before = turned(0)
            # Most coordinates are no angles: one look is enough for all numbers of turns.
            for numbers in ((math.lcm(*range(1, _MOST_TURNS + 1)),), range(1, _MOST_TURNS + 1)):
                turns = next(k for k in numbers if _is_same(layout, before, turned(k), x))
            periods[layout.tangent_space.coordinates[i]] = turns * math.tau
    return periods


def _is_same(layout: Layout, before: Array, after: Array, x: Array) -> bool:
    """Return True if predicted values, of which some are periodic, and Jacobians are equal."""
    with np.errstate(invalid="ignore"):  # where the model is not finite
        change = after - before
    for one, where in zip(layout.observations, layout.value_slices, strict=True):
        change[where] = wrap_difference(change[where], one.period)
    return bool((np.abs(change) < _SAME * (1 + np.abs(x).max())).all())


def spread_starts(update_step: UpdateStep, first: InformationState, inputs: Array) -> GaussianSum:
    """Return beliefs about several initial points with the same Gaussian, the initial state first."""
    layout = update_step.layout
    beliefs, alive = [first], [np.ones(len(layout.groups), dtype=bool)]
    ambiguous = _find_ambiguous(update_step, first, inputs)
    for number, group in enumerate(layout.groups):
        steps = [_offsets(update_step, first, i, i in ambiguous) for i in group.x]
        changes = list(itertools.islice(itertools.product(*steps), 4096))
        changes = changes[:: math.ceil(len(changes) / _MOST_STARTS)]
        offsets = []
        for change in changes[1:]:
            step = np.zeros(len(group.tangent))
            for symbol, by in zip(group.coordinates, change, strict=True):
                if symbol not in layout.tangent_space.by_speeds:
                    step[group.tangent.index(symbol.derivative())] = by
            offsets.append(step)
        # Half turns about rate directions, such as those of quaternions.
        offsets += [math.pi * np.eye(len(group.tangent))[k] for k in group.rate_directions]
        component = 0
        for offset in offsets:
            if float(offset**2 @ np.diag(first.information)[group.t]) > _FARTHEST**2:
                continue
            x, transport = update_step.process_model.retract(number, first.x[group.x], offset, inputs)
            there = first.copy()
            there.x[group.x] = x
            if not update_step.is_possible(number, there, inputs):
                continue
            component += 1
            if component == len(beliefs):
                beliefs.append(first.copy())
                alive.append(np.zeros(len(layout.groups), dtype=bool))
            alive[component][number] = True
            beliefs[component].x[group.x] = x
            cost = first.group_cost(group.t).transported(offset, transport)
            beliefs[component].set_group_cost(group.t, cost)
    return GaussianSum(layout, beliefs, np.array(alive))


def _find_ambiguous(update_step: UpdateStep, first: InformationState, inputs: Array) -> set[int]:
    """Return coordinates on which a prediction, such as a distance, is not monotonic between their limits."""
    layout, limits = update_step.layout, update_step.limits
    width = limits.upper - limits.lower
    result: set[int] = set()
    for k in range(max(len(group.x) for group in layout.groups)):
        groups = [g for g in layout.groups if k < len(g.x) and g.tangent_index(k) >= 0]
        groups = [g for g in groups if np.isfinite(width[g.x[k]])]
        predicted: list[Array] = []
        for share in _SAMPLES if groups else ():
            x = first.x.copy()
            for group in groups:
                x[group.x[k]] = limits.lower[group.x[k]] + share * width[group.x[k]]
            try:
                predicted.append(update_step.residuals.evaluate(x, inputs))
            except KineverseError:  # infeasible
                continue
        for group in groups if predicted else ():
            if _is_ambiguous(layout, group, group.tangent_index(k), np.array(predicted)):
                result.add(int(group.x[k]))
    return result


def _is_ambiguous(layout: Layout, group: CoordinateGroup, column: int, predicted: Array) -> bool:
    """Return True if a prediction has opposite slopes at two points, or jumps against its slope."""
    for i in group.observation_indices:
        one = layout.observations[i]
        slopes = predicted[:, layout.jacobian_slices[i]].reshape(len(predicted), one.size, -1)[:, :, column]
        white = np.linalg.inv(np.linalg.cholesky(one.covariance))
        with np.errstate(invalid="ignore"):  # where the model is not finite
            slopes = slopes @ white.T
            if (slopes @ slopes.T < 0.0).any():
                return True
            if not one.is_pose:
                steps = np.diff(predicted[:, layout.value_slices[i]], axis=0)
                changes = wrap_difference(steps, one.period) @ white.T
                if (np.einsum("ij,ij->i", changes, slopes[1:] + slopes[:-1]) < 0.0).any():
                    return True
    return False


def _offsets(update_step: UpdateStep, first: InformationState, i: int, is_ambiguous: bool) -> list[float]:
    """Return the offsets of further initial values of a coordinate, 0 first."""
    coordinate = update_step.layout.tangent_space.coordinates[i]
    if coordinate in update_step.layout.tangent_space.by_speeds:
        return [0.0]
    if (period := update_step.periods.get(coordinate)) is not None:
        count = min(round(period / _SPACING), _MOST_STARTS)
        return [math.remainder(k / count, 1.0) * period for k in range(count)]
    low, high = update_step.limits.lower[i], update_step.limits.upper[i]
    if not math.isfinite(high - low):
        return [0.0]
    if high - low <= 2 * _SPACING + _SAME:
        return [0.0, *(low + share * (high - low) - first.x[i] for share in _SAMPLES if is_ambiguous)]
    count = min(math.ceil((high - low) / _SPACING), _MOST_STARTS - 1)
    return [0.0, *(low + (np.arange(count) + 0.5) * (high - low) / count - first.x[i]).tolist()]


_BEYOND = 1e-3  # distance beyond limits that may be rounding


@dataclass(frozen=True, eq=False)
class InitialBelief:
    """Initial state and its standard deviations."""

    x: Array  # coordinates (n,)
    deviations: Array  # standard deviation of each tangent direction (t,)
    widest: Array  # deviations of what is known of the model alone, the limits or the room (t,)
    speeds: Mapping[Symbol, float] = field(default_factory=dict)
    speed_variances: Mapping[Symbol, float] = field(default_factory=dict)

    def moved(self, update_step: UpdateStep, x: Array, noise: Mapping[Symbol, float]) -> InitialBelief:
        """Return the belief about what was at x (n,) and may have moved by any distance since."""
        after, deviations, limits = self.x.copy(), self.deviations.copy(), update_step.limits
        for number, group in enumerate(update_step.layout.groups):
            speeds = update_step.process_model.speeds_of(number)
            is_carried = update_step.process_model.is_carried(number) and any(noise.get(v) for v in speeds)
            for k, v in zip(group.t.tolist(), group.tangent, strict=True):
                if is_carried or noise.get(v):
                    deviations[k] = max(deviations[k], self.widest[k])
            is_moving = [is_carried or bool(noise.get(s.derivative())) for s in group.coordinates]
            after[group.x[is_moving]] = x[group.x[is_moving]]
        middle = np.isfinite(limits.upper - limits.lower) & (after != self.x)
        after[middle] = (limits.lower[middle] + limits.upper[middle]) / 2
        return replace(self, x=after, deviations=deviations)

    def spread(self, update_step: UpdateStep, inputs: Array) -> GaussianSum:
        """Return the belief about several initial points."""
        belief = InformationState((len(self.x), len(self.deviations), len(update_step.layout.groups)))
        belief.x[:] = self.x
        with np.errstate(over="ignore"):
            variances = np.array([*self.deviations**2, *self.deviations**-2.0])
        if not (np.isfinite(variances).all() and variances.all()):
            raise InvalidValueError("An initial uncertainty is too large or too small for floating point.")
        belief.information[:] = np.diag(self.deviations**-2.0)
        if update_step.velocity is not None:
            update_step.velocity.initialise(belief, self.speeds, self.speed_variances, inputs)
        return spread_starts(update_step, belief, inputs)

    def with_values(self, update_step: UpdateStep, values: InitialValues) -> InitialBelief:
        """Return the belief with other values of some coordinates and speeds, and other deviations."""
        x, deviations = self.x.copy(), self.deviations.copy()
        for symbol, value in values.coordinates.items():
            k = update_step.layout.tangent_space.coordinates.index(symbol)
            x[k] = np.clip(value, update_step.limits.lower[k], update_step.limits.upper[k])
        for k, value in values.deviations.items():
            deviations[k] = value
        variances = {v: deviation**2 for v, deviation in values.speed_deviations.items()}
        speeds, speed_variances = {**self.speeds, **values.speeds}, {**self.speed_variances, **variances}
        return InitialBelief(x, deviations, self.widest, speeds, speed_variances)


@dataclass(frozen=True, eq=False)
class InitialValues:
    """Checked initial values and standard deviations."""

    coordinates: Mapping[Symbol, float]
    speeds: Mapping[Symbol, float]
    deviations: Mapping[int, float]  # standard deviations by number of the tangent direction
    speed_deviations: Mapping[Symbol, float]

    @staticmethod
    def read(
        update_step: UpdateStep, start: StateLike | None, uncertainty: StateLike | None
    ) -> InitialValues:
        """Check initial values and standard deviations."""
        tangent_space, limits = update_step.layout.tangent_space, update_step.limits
        velocity, speeds_of = update_step.velocity, update_step.process_model.speeds_of
        speeds = [v for number in velocity.groups for v in speeds_of(number)] if velocity else []
        state = start if isinstance(start, State) else State({} if start is None else start)
        values = {s: state[s] for s in (*tangent_space.coordinates, *speeds) if s in state}
        for name in () if isinstance(start, State) else state:
            if name not in values:
                raise _unknown_name(name, (*tangent_space.coordinates, *speeds))
        for symbol, value in values.items():
            if not math.isfinite(value):
                raise InvalidValueError(f"start= of '{symbol}' is {value!r}; it must be finite.")
            if not isinstance(start, State) and symbol in tangent_space.coordinates:
                k = tangent_space.coordinates.index(symbol)
                low, high = float(limits.lower[k]), float(limits.upper[k])
                if not low - _BEYOND <= value <= high + _BEYOND:
                    raise InvalidValueError(
                        f"start= of '{symbol}' is {value:g}, beyond its limits {low:g} to {high:g}."
                    )
        names: dict[str, int] = {}
        for k, v in enumerate(tangent_space.tangent):
            names[str(v.position) if v.position in tangent_space.coordinates else str(v)] = k
        speed_names = {str(v): v for v in speeds if str(v) not in names}
        deviations, speed_deviations = {}, {}
        uncertainty = {} if uncertainty is None else uncertainty
        for key, value in require_mapping(uncertainty, "uncertainty=").items():
            if str(key) in speed_names:
                speed_deviations[speed_names[str(key)]] = require_positive(key, value)
            elif str(key) in names:
                deviations[names[str(key)]] = require_positive(key, value)
            else:
                raise _unknown_name(key, (*names, *speed_names))
        coordinates = {s: value for s, value in values.items() if s not in speeds}
        values_of_speeds = {s: value for s, value in values.items() if s in speeds}
        return InitialValues(coordinates, values_of_speeds, deviations, speed_deviations)


def _unknown_name(key: object, names: Iterable[object]) -> UnknownNameError:
    hint = suggest(str(key), map(str, names), "coordinate")
    return UnknownNameError(f"'{key}' is not estimated. {hint}")


def make_initial_belief(
    model: ModelView, update_step: UpdateStep, values: InitialValues, inputs: Array
) -> InitialBelief:
    """Return the initial belief, and set the periodic coordinates and initial deviations of a tracker."""
    tangent_space, limits = update_step.layout.tangent_space, update_step.limits
    x = initial_point(model, tangent_space, limits, values.coordinates)
    update_step.periods = find_periods(update_step, x, inputs)
    usual = initial_deviations(tangent_space, limits, update_step.periodic)
    belief = InitialBelief(x, usual, usual).with_values(update_step, values)
    update_step.unobservable.deviations = belief.deviations
    return belief
