"""Recursion of a tracker's state: prediction, update, restart of lost groups, measurements that come late."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType
from typing import Generic, Protocol, TypeVar

import numpy as np

from kineverse.errors import InvalidValueError, UnknownNameError, suggest
from kineverse.lie import Array
from kineverse.state import State, StateLike
from kineverse.symbols import Symbol

from .bounds import SpeedLocks
from .estimate import TrackerState, TrackLoss, find_measured, find_refuted
from .gaussian_sum_filter import StepResult, UpdateStep
from .information_state import InformationState
from .initialization import InitialBelief
from .residuals import Measurements


class Stamped(Protocol):
    """State with the time [s] it belongs to; None if it has none."""

    @property
    def stamp(self) -> float | None:
        """Time [s]."""


StampedState = TypeVar("StampedState", bound=Stamped)


@dataclass(frozen=True, eq=False)
class Step(Generic[StampedState]):
    """Step of a filter."""

    stamp: float  # time at its end [s]
    before: StampedState  # state before it
    apply: Callable[
        [StampedState], StampedState
    ]  # function of the state before it that returns the state at its end
    predict: Callable[[StampedState, float], StampedState]


class FixedLag(Generic[StampedState]):
    """Steps of the last seconds, which are repeated after a late measurement."""

    def __init__(self, lag: float) -> None:
        self.lag = lag
        self._steps: tuple[Step[StampedState], ...] = ()

    def copy(self) -> FixedLag[StampedState]:
        """Return an independent buffer with the same steps."""
        other = FixedLag[StampedState](self.lag)
        other._steps = self._steps
        return other

    def clear(self) -> None:
        """Forget all steps."""
        self._steps = ()

    def append(self, step: Step[StampedState]) -> None:
        """Add a step, and drop those too old for any late measurement."""
        oldest = step.stamp - self.lag
        self._steps = (*(one for one in self._steps if one.stamp >= oldest), step)

    def insert(self, stamp: float, apply: Callable[[StampedState], StampedState]) -> StampedState:
        """Apply a late measurement at its time, repeat all later steps, and return the state at their end."""
        later = [one for one in self._steps if one.stamp > stamp]
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
        steps = [one for one in self._steps if one.stamp <= stamp]
        late = Step(stamp, state, partial(_apply_late, predict, stamp, apply), predict)
        for one in (late, *later):
            steps.append(Step(one.stamp, state, one.apply, one.predict))
            state = one.apply(state)
        self._steps = tuple(steps)
        return state


def _apply_late(
    predict: Callable[[StampedState, float], StampedState],
    stamp: float,
    apply: Callable[[StampedState], StampedState],
    before: StampedState,
) -> StampedState:
    return apply(predict(before, stamp))


NO_NOISE: Mapping[Symbol, float] = MappingProxyType({})
"""Process noise of no speed."""


@dataclass(frozen=True, eq=False)
class Recursion:
    """Prediction and update of states, which it never changes in place."""

    update_step: UpdateStep  # prediction and update of beliefs
    first: InitialBelief  # initial belief
    noise: Mapping[Symbol, float]  # process noise by speed
    locks: SpeedLocks | None  # locks that hold speeds; None if they are ignored
    lost_after: int  # number of refuted updates in a row after which a group is lost
    restarts: bool  # True if lost groups start anew

    def start(self, inputs: Array, stamp: float | None) -> TrackerState:
        """Return the initial state."""
        mixture = self.first.spread(self.update_step, np.nan_to_num(inputs))
        count = len(self.update_step.layout.groups)
        result = StepResult(mixture, np.zeros(count), np.zeros(count), (), 0)
        return TrackerState(mixture, result, TrackLoss.none(count), inputs, stamp)

    def predict(
        self,
        state: TrackerState,
        dt: float,
        speeds: Mapping[Symbol, float],
        noise_now: Mapping[Symbol, float] = NO_NOISE,
    ) -> TrackerState:
        """Return the state after a time step [s] with commanded speeds.

        Speeds that ``noise_now`` has get its process noise, and others the usual one.
        """
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
        speeds: Mapping[Symbol, float],
        inputs: StateLike | None = None,
        noise_now: Mapping[Symbol, float] = NO_NOISE,
    ) -> TrackerState:
        """Return the state predicted to a time, with other values of inputs if these are given.

        A state without a time begins there.
        """
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
        speeds: Mapping[Symbol, float],
        inputs: StateLike | None,
        noise_now: Mapping[Symbol, float] = NO_NOISE,
    ) -> TrackerState:
        """Return the state after a reading at a time, or at the present one."""
        values = self.read_inputs(state.inputs, inputs)
        # The prediction uses the previous values of the inputs, if there are any.
        if not np.isfinite(state.inputs).all():
            state = replace(state, inputs=values)
        seen = None
        if stamp is not None:
            state, seen = self.advance(state, stamp, speeds, noise_now=noise_now), reading
            if state.reading is not None:
                seen = self.update_step.reader.combine(state.reading, reading, stamp)
        step = self.update_step
        result = step.update(state.mixture, reading, values)
        has_outliers = step.outliers is not None
        refuted = find_refuted(self.update_step.layout, reading, result, has_outliers)
        loss, mixture = state.loss, result.mixture
        if not loss.is_clear or refuted.any():
            loss = loss.after(find_measured(step.layout, reading), refuted, self.lost_after)
            due = loss.is_lost & (loss.refuted % self.lost_after == 0) & refuted
            if self.restarts and due.any():
                groups = np.flatnonzero(due).tolist()
                anew = step.restart(state.mixture, self.first.spread(step, values), groups, reading, values)
                explained = due & (
                    step.find_accepted(anew.mixture, reading, values)
                    if has_outliers
                    else ~find_refuted(step.layout, reading, anew, has_outliers)
                )
                mixture = mixture.replace_groups(anew.mixture, np.flatnonzero(explained).tolist())
                loss = loss.with_restarted(explained)
        return TrackerState(mixture, result, loss, values, state.stamp, seen or state.reading)

    def read_inputs(self, last: Array, given: StateLike | None) -> Array:
        """Return the values of the inputs, those not given as they were last."""
        symbols = self.update_step.layout.inputs
        values = last.copy()
        if given is not None:
            state = given if isinstance(given, State) else State(given)
            names = {str(s): i for i, s in enumerate(symbols)}
            for key in state:
                if str(key) in names:
                    values[names[str(key)]] = state[key]
                elif not isinstance(given, State):
                    raise UnknownNameError(f"'{key}' is not in inputs=. {suggest(str(key), names, 'symbol')}")
        missing = [str(s) for s, v in zip(symbols, values.tolist(), strict=True) if not math.isfinite(v)]
        if missing and (given is not None or symbols):
            raise InvalidValueError(f"There is no finite value of '{missing[0]}'; give it in inputs=.")
        return values
