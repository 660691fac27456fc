"""Recursion of a tracker's state: prediction, update, restart of lost groups, measurements that come late."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from kineverse.errors import InvalidValueError, UnknownNameError, suggest
from kineverse.lie import Array
from kineverse.state import State, StateLike

from .bounds import SpeedLocks
from .estimate import Step, TrackerState, TrackLoss, find_refuted
from .gaussian_sum_filter import StepResult, UpdateStep
from .initialization import InitialBelief
from .process_model import Speeds
from .speed_process import SpeedUpdate
from .state_space import InformationState


class FixedLag:
    """Events of the last ``lag`` seconds, which are repeated after a late measurement."""

    def __init__(self, recursion: Recursion, lag: float) -> None:
        self._recursion, self.lag = recursion, lag
        self.events: tuple[tuple[float, TrackerState, Step], ...] = ()  # with time and state before

    def append(self, time: float | None, before: TrackerState, event: Step) -> None:
        """Add an event, and drop those too old for any late measurement."""
        if self.lag and time is not None:
            kept = (one for one in self.events if one[0] >= time - self.lag)
            self.events = (*kept, (time, before, event))

    def insert(self, stamp: float, late: Step) -> TrackerState:
        """Apply a late measurement at its time, and return the state after all later events."""
        events = [one for one in self.events if one[0] <= stamp]
        later = self.events[len(events) :]
        if later and later[-1][0] - stamp > self.lag:
            raise InvalidValueError(
                f"A measurement at {stamp:g} s is later than the lag of {self.lag:g} s: leave it out, or "
                "give the tracker a longer lag=."
            )
        # A state without a time begins at the first measurement.
        if not later or (later[0][1].stamp is not None and later[0][1].stamp > stamp):
            raise InvalidValueError(
                f"A measurement at {stamp:g} s is from before the start or a reset: leave it out."
            )
        _, state, motion = later[0]
        late = replace(late, commands=motion.commands, noise=motion.noise)
        if motion.reading is None and late.inputs is None:
            late = replace(late, inputs=motion.inputs)
        for time, event in ((stamp, late), *((time, event) for time, _, event in later)):
            events.append((time, state, event))
            state = self._recursion.apply(state, event)
        self.events = tuple(events)
        return state


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

    def predict(self, state: TrackerState, dt: float, event: Step) -> TrackerState:
        """Return the state after a time step [s]."""
        if dt == 0.0:
            return state
        state = replace(state, stamp=None if state.stamp is None else state.stamp + dt, reading=None)
        usual = {**self.noise, **event.noise}
        if not (event.commands or usual):
            return state

        def moved(belief: InformationState) -> InformationState:
            moving, noise = event.commands, usual
            if self.locks:
                free = self.locks.free(belief, state.inputs)
                held = {v: 0.0 for v in usual if v not in free}
                noise = {v: q for v, q in noise.items() if v in free}
                moving = {v: speed for v, speed in moving.items() if v in free} | held
            return self.update_step.predict(belief, state.inputs, dt, moving, noise)

        return replace(state, mixture=state.mixture.map(moved))

    def _advance(self, state: TrackerState, event: Step) -> TrackerState:
        """Return the state predicted to the time of an event; a state without a time begins there."""
        if event.stamp is None or state.stamp is None:
            return replace(state, stamp=event.stamp)
        return replace(self.predict(state, event.stamp - state.stamp, event), stamp=event.stamp)

    def apply(self, state: TrackerState, event: Step) -> TrackerState:
        """Return the state after an event."""
        step, values = self.update_step, self.read_inputs(state.inputs, event.inputs)
        if event.reading is None:
            return self._advance(replace(state, inputs=values), event)
        # The prediction uses the previous values of the inputs, if there are any.
        if not np.isfinite(state.inputs).all():
            state = replace(state, inputs=values)
        reading, latest = event.reading, state.reading
        if event.stamp is not None:
            state, latest = self._advance(state, event), reading
            if state.reading is not None:
                latest = step.reader.combine(state.reading, reading, event.stamp)
        mixture, nis, dof, wrong = self.speed_update.update(state.mixture, reading, event.speeds, values)
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
        residuals = partial(self.speed_update.residuals, predicted, reading, event.speeds, values, outliers)
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
