"""Recursion of a tracker's state: prediction, update, restart of lost groups, measurements that come late."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType

import numpy as np

from kineverse.errors import InvalidValueError, UnknownNameError, suggest
from kineverse.lie import Array
from kineverse.state import State, StateLike

from .bounds import SpeedLocks
from .estimate import TrackerState, TrackLoss, find_refuted
from .gaussian_sum_filter import StepResult, UpdateStep
from .information_state import InformationState
from .initialization import InitialBelief
from .process_model import Speeds
from .residuals import Measurements
from .speed_update import SpeedUpdate, SpeedValue


@dataclass(frozen=True, eq=False)
class Step:
    """Step of a tracker."""

    stamp: float  # time at its end [s]
    before: TrackerState
    apply: Callable[[TrackerState], TrackerState]
    predict: Callable[[TrackerState, float], TrackerState]


@dataclass(eq=False)
class FixedLag:
    """Steps of the last ``lag`` seconds, which are repeated after a late measurement."""

    lag: float
    steps: tuple[Step, ...] = ()

    def append(self, step: Step) -> None:
        """Add a step, and drop those too old for any late measurement."""
        oldest = step.stamp - self.lag
        self.steps = (*(one for one in self.steps if one.stamp >= oldest), step)

    def insert(self, stamp: float, apply: Callable[[TrackerState], TrackerState]) -> TrackerState:
        """Apply a late measurement at its time, repeat all later steps, and return the state at their end."""
        later = [one for one in self.steps if one.stamp > stamp]
        if later and later[-1].stamp - stamp > self.lag:
            raise InvalidValueError(
                f"A measurement at {stamp:g} s is later than the lag of {self.lag:g} s: leave it out, or "
                "give the tracker a longer lag=."
            )
        # A state without a time begins at the first measurement.
        began = later[0].before.stamp if later else math.inf
        if began is not None and began > stamp:
            raise InvalidValueError(
                f"A measurement at {stamp:g} s is from before the start or a reset: leave it out."
            )
        predict, state = later[0].predict, later[0].before
        steps = [one for one in self.steps if one.stamp <= stamp]
        for one in (Step(stamp, state, partial(_apply_late, predict, stamp, apply), predict), *later):
            steps.append(replace(one, before=state))
            state = one.apply(state)
        self.steps = tuple(steps)
        return state


def _apply_late(
    predict: Callable[[TrackerState, float], TrackerState],
    stamp: float,
    apply: Callable[[TrackerState], TrackerState],
    before: TrackerState,
) -> TrackerState:
    return apply(predict(before, stamp))


NO_NOISE: Speeds = MappingProxyType({})  # process noise of no speed
NO_SPEEDS: Mapping[str, SpeedValue] = {}  # no measured speeds; a proxy could not be pickled


@dataclass(frozen=True, eq=False)
class Recursion:
    """Prediction and update of states, which it never changes in place."""

    update_step: UpdateStep
    speed_update: SpeedUpdate
    first: InitialBelief
    noise: Speeds  # process noise by speed
    locks: SpeedLocks | None  # None if locks are ignored
    lost_after: int  # number of refuted updates in a row after which a group is lost
    restarts: bool  # True if lost groups restart

    def start(self, inputs: Array, stamp: float | None) -> TrackerState:
        """Return the initial state."""
        mixture = self.first.spread(self.update_step, np.nan_to_num(inputs))
        count = len(self.update_step.layout.groups)
        result = StepResult(mixture, np.zeros(count), np.zeros(count), (), 0)
        none = np.zeros(len(self.update_step.layout.observations), dtype=np.int64)
        loss = TrackLoss(none, np.zeros(count, dtype=np.int64), np.zeros(count, dtype=bool))
        return TrackerState(mixture, result, loss, inputs, stamp)

    def predict(
        self, state: TrackerState, dt: float, speeds: Speeds, noise_now: Speeds = NO_NOISE
    ) -> TrackerState:
        """Return the state after a time step [s]; ``noise_now`` overrides the process noise."""
        if dt == 0.0:
            return state
        state = replace(state, stamp=None if state.stamp is None else state.stamp + dt, reading=None)
        usual = {**self.noise, **noise_now}
        if not (speeds or usual):
            return state

        def moved(belief: InformationState) -> InformationState:
            moving, noise = speeds, usual
            if self.locks:
                free = self.locks.free(belief, state.inputs)
                held = {v: 0.0 for v in usual if v not in free}
                noise = {v: q for v, q in noise.items() if v in free}
                moving = {v: speed for v, speed in speeds.items() if v in free} | held
            return self.update_step.predict(belief, state.inputs, dt, moving, noise)

        return replace(state, mixture=state.mixture.map(moved))

    def advance(
        self,
        state: TrackerState,
        stamp: float,
        speeds: Speeds,
        inputs: StateLike | None = None,
        noise_now: Speeds = NO_NOISE,
    ) -> TrackerState:
        """Return the state predicted to a time; a state without a time begins there."""
        if inputs is not None:
            state = replace(state, inputs=self.read_inputs(state.inputs, inputs))
        if state.stamp is None:
            return replace(state, stamp=stamp)
        return replace(self.predict(state, stamp - state.stamp, speeds, noise_now), stamp=stamp)

    def update(
        self,
        state: TrackerState,
        reading: Measurements,
        stamp: float | None,
        speeds: Speeds,
        inputs: StateLike | None,
        noise_now: Speeds = NO_NOISE,
        measured_speeds: Mapping[str, SpeedValue] = NO_SPEEDS,
    ) -> TrackerState:
        """Return the state after a reading at a time, or at the present one."""
        step, values = self.update_step, self.read_inputs(state.inputs, inputs)
        # The prediction uses the previous values of the inputs, if there are any.
        if not np.isfinite(state.inputs).all():
            state = replace(state, inputs=values)
        latest = state.reading
        if stamp is not None:
            state, latest = self.advance(state, stamp, speeds, noise_now=noise_now), reading
            if state.reading is not None:
                latest = step.reader.combine(state.reading, reading, stamp)
        mixture, nis, dof, wrong = self.speed_update.update(state.mixture, reading, measured_speeds, values)
        result = step.update(mixture, reading, values)
        result.nis, result.dof = result.nis + nis, result.dof + dof
        has_outliers = step.outliers is not None
        refuted = find_refuted(step.layout, reading, result, has_outliers)
        loss, mixture = state.loss, result.mixture
        loss = loss.after(step.layout, reading, result.outliers, refuted, self.lost_after)
        if result.outliers or refuted.any():
            due = loss.is_lost & (loss.refuted % self.lost_after == 0) & refuted
            if has_outliers:
                due = loss.find_due(step.layout, result.outliers, self.lost_after)
            if self.restarts and due.any():
                groups = np.flatnonzero(due).tolist()
                initial = self.first.moved(step, state.mixture.best.x, self.noise).spread(step, values)
                restarted = step.restart(state.mixture, initial, groups, reading, values)
                if has_outliers:
                    mask = np.isin(np.arange(len(reading.mask)), result.outliers)
                    rejected = reading._replace(mask=mask)
                    explained = due & step.find_accepted(restarted.mixture, rejected, values)
                    mixture = mixture.join(restarted.mixture, explained)
                    is_found = due & step.find_accepted(mixture, rejected, values)[0]
                else:
                    is_found = due & ~find_refuted(step.layout, reading, restarted, has_outliers)
                    mixture = mixture.replace_groups(restarted.mixture, np.flatnonzero(is_found).tolist())
                # They stay lost until measurements agree with them.
                loss = replace(loss, refuted=np.where(is_found, 0, loss.refuted))
        outliers = (*(step.layout.observations[i].name for i in result.outliers), *wrong)
        predicted = state.mixture.best
        residuals = partial(
            self.speed_update.residuals, predicted, reading, measured_speeds, values, outliers
        )
        return TrackerState(mixture, result, loss, values, state.stamp, latest, outliers, residuals)

    def read_inputs(self, last: Array, inputs: StateLike | None) -> Array:
        """Return the values of the inputs, with the last ones for those that are absent."""
        symbols, values = self.update_step.layout.inputs, last.copy()
        if inputs is not None:
            state = inputs if isinstance(inputs, State) else State(inputs)
            names = {str(s): i for i, s in enumerate(symbols)}
            for key in state:
                if str(key) in names:
                    values[names[str(key)]] = state[key]
                elif not isinstance(inputs, State):
                    raise UnknownNameError(f"'{key}' is not in inputs=. {suggest(str(key), names, 'symbol')}")
        for symbol, value in zip(symbols, values.tolist(), strict=True):
            if not math.isfinite(value):
                raise InvalidValueError(f"There is no finite value of '{symbol}'; give it in inputs=.")
        return values
