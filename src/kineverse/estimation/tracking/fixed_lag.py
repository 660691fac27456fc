"""Fixed-lag buffer: measurements that come late are applied in the order of their times."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Generic, Protocol, TypeVar

from kineverse.errors import InvalidValueError


class Stamped(Protocol):
    """State with the time [s] it belongs to; None if it has none."""

    @property
    def stamp(self) -> float | None:
        """Time [s]."""


State = TypeVar("State", bound=Stamped)


@dataclass(frozen=True, eq=False)
class Step(Generic[State]):
    """Step of a filter."""

    stamp: float  # time at its end [s]
    before: State  # state before it
    apply: Callable[[State], State]  # function of the state before it that returns the state at its end
    predict: Callable[[State, float], State]


class FixedLag(Generic[State]):
    """Steps of the last seconds, which are repeated after a late measurement."""

    def __init__(self, lag: float) -> None:
        self.lag = lag
        self._steps: tuple[Step[State], ...] = ()

    def copy(self) -> FixedLag[State]:
        """Return an independent buffer with the same steps."""
        other = FixedLag[State](self.lag)
        other._steps = self._steps
        return other

    def clear(self) -> None:
        """Forget all steps."""
        self._steps = ()

    def append(self, step: Step[State]) -> None:
        """Add a step, and drop those too old for any late measurement."""
        oldest = step.stamp - self.lag
        self._steps = (*(one for one in self._steps if one.stamp >= oldest), step)

    def insert(self, stamp: float, apply: Callable[[State], State]) -> State:
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
    predict: Callable[[State, float], State], stamp: float, apply: Callable[[State], State], before: State
) -> State:
    return apply(predict(before, stamp))
