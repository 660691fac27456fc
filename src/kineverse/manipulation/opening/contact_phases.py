"""Contact phases: what a hand holds or presses on the way of an object to a target, and ways of handles.

A plan of :func:`kineverse.reasoning.plan_unlocking` is a sequence of moves. Consecutive ones that move the
same handle are one phase: a grasp, with a way over several coordinates, such as those of a lever and of the
door that it unlatches. A part without a handle, such as a button, is pressed. A phase is planned from the
state before it, so that nothing has to be remembered: what a spring has moved back is moved again.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise, takewhile
from typing import TYPE_CHECKING

import numpy as np

from kineverse.errors import UnknownNameError
from kineverse.grasping import Handle, find_handle
from kineverse.lie import Array
from kineverse.manipulation.outcome import SkillError
from kineverse.model.model_view import ModelView
from kineverse.model.symbolic_view import cached_for_version
from kineverse.state import State
from kineverse.symbols import Symbol
from kineverse.worlds import Robot

if TYPE_CHECKING:
    from kineverse.reasoning import UnlockingPlan, UnlockingStep

_STEP = 0.05  # distance of neighbouring values along a way [m], [rad]
_CLEAR = 0.1  # way beyond the place from which on a key is not needed after which it is let back [m], [rad]
_BEYOND = 0.12  # largest distance by which a held key goes beyond its threshold [m], [rad]
_HALVINGS = 5  # steps in which that place is found between two rows of a way
_SIGMAS = 3.0  # standard deviations from where it rests up to which a part may rest
_SHARE = 0.4  # largest distance from a target, as a share of its distance beyond a threshold


@dataclass(frozen=True, slots=True, eq=False)
class Way:
    """Way of a handle: values of all coordinates that move it, one row after another."""

    coordinates: tuple[Symbol, ...]  # coordinates (m,), that of the object last
    values: Array  # their values (K, m) [m], [rad]

    @classmethod
    def straight(
        cls, coordinate: Symbol, start: float, target: float, held: Mapping[Symbol, float] | None = None
    ) -> Way:
        """Return the way of one coordinate; others are held at values if they are given."""
        others = {} if held is None else {s: v for s, v in held.items() if s != coordinate}
        return cls.through((*others, coordinate), [[*others.values(), v] for v in (start, target)])

    @classmethod
    def through(cls, coordinates: Sequence[Symbol], corners: Sequence[Sequence[float]]) -> Way:
        """Return the way through corners, each row m values, with rows between them."""
        points = np.array(corners, dtype=float)
        rows = [points[:1]]
        for a, b in pairwise(points):
            count = math.ceil(np.abs(b - a).max() / _STEP)
            rows.append(np.linspace(a, b, count + 1)[1:])
        values = np.vstack(rows)
        return cls(tuple(coordinates), values if len(values) > 1 else values[[0, 0]])

    def __len__(self) -> int:
        return len(self.values)

    @property
    def target(self) -> float:
        """Value of the object's coordinate at the end [m], [rad]."""
        return float(self.values[-1, -1])

    @property
    def corners(self) -> tuple[int, ...]:
        """Indices of the rows at which one coordinate has arrived before another one moves."""
        moving = np.diff(self.values, axis=0) != 0.0
        return tuple((np.flatnonzero((moving[1:] != moving[:-1]).any(axis=1)) + 1).tolist())

    @property
    def last_run(self) -> int:
        """Index of the row from which on the object's coordinate moves alone."""
        others = self.values[:, :-1]
        moved = np.flatnonzero((others != others[-1]).any(axis=1))
        return int(moved[-1]) + 1 if len(moved) else 0

    @property
    def keys(self) -> tuple[Symbol, ...]:
        """Coordinates that move besides that of the object."""
        moved = np.ptp(self.values[:, :-1], axis=0) > 0.0
        return tuple(s for s, moves in zip(self.coordinates[:-1], moved.tolist(), strict=True) if moves)

    def at(self, index: int) -> dict[Symbol, float]:
        """Return the values of a row by coordinate."""
        return dict(zip(self.coordinates, self.values[index].tolist(), strict=True))

    def cut(self, first: int, end: int) -> Way:
        """Return the rows from one to before another one."""
        return Way(self.coordinates, self.values[first:end])


@dataclass(frozen=True, slots=True, eq=False)
class ContactPhase:
    """Moves that one contact makes."""

    coordinate: Symbol  # coordinate that moves last
    target: float  # its value at the end [m], [rad]
    tolerance: (
        float | None
    )  # largest distance from there that passes the threshold of a lock; None without one
    handle: Handle | None  # what is held; None if the part is pressed
    way: Way  # way of what is held or pressed


def find_keys(model: ModelView, robot: Robot, coordinate: Symbol) -> tuple[Symbol, ...]:
    """Return the coordinates of other objects on which the limits of one and of its speed depend."""
    both = coordinate, coordinate.derivative()
    limits = (c for s in both for c in model.constraints_for(s, exact=True).values())
    found = {s.position if s.order else s for c in limits for s in c.symbols} - {coordinate}
    return tuple(s for s in model.degrees_of_freedom if s in found and not robot.moves(s))


class PhasePlanner:
    """Planner of the next contact phase for an object that is held by a handle.

    ``carriers`` are coordinates that move the handle besides that of the object, such as that of a lever on a
    door. With ``has_keys``, where other parts are decides if the object can move.
    """

    def __init__(self, model: ModelView, robot: Robot, handle: Handle) -> None:
        self._model, self._handle = model, handle
        self._objects = [s for s in model.degrees_of_freedom if not robot.moves(s)]
        self.coordinate = handle.coordinate
        self.carriers = tuple(s for s in self._movers(handle.frame) if s != self.coordinate)
        self.has_keys = bool(find_keys(model, robot, self.coordinate))

    def find_next(
        self,
        state: State,
        target: float,
        still: Collection[Symbol] = (),
        deviation: Callable[[Symbol], float] = lambda s: 0.0,
    ) -> ContactPhase:
        """Return the first contact phase on the way from a state to a target, or raise SkillError if none is.

        ``still`` are coordinates that did not move when they should have. What may be at rest by the standard
        deviation of its value is taken to be, so that no latch is open by noise. Where the locks cannot be
        read, the object is taken to be free.
        """
        if not self.has_keys:
            return self._hold(state, state, [], target)
        default = self._model.default_state()
        resting = {
            s: default[s] for s in self._objects if abs(state[s] - default[s]) <= _SIGMAS * deviation(s)
        }
        surely = state.updated(resting)
        plan = self._plan(surely, target, still)
        if plan.verdict == "refuted" and resting:
            plan, surely = self._plan(state, target, still), state
        if plan.verdict == "refuted":
            raise SkillError("other", str(plan))
        if plan.verdict == "undecided" or not plan.steps:
            return self._hold(state, surely, [], target)
        first = plan.steps[0]
        if first.coordinate in (self.coordinate, *self.carriers):
            return self._hold(state, surely, plan.steps, target)
        try:
            handle = find_handle(self._model, first.coordinate)
        except UnknownNameError:
            handle = None
        tolerance = _find_tolerance(first)
        way = Way.straight(first.coordinate, state[first.coordinate], first.target)
        return ContactPhase(first.coordinate, first.target, tolerance, handle, way)

    def latches(self, state: State, target: float) -> bool:
        """Return True if the object does not move back from a target unless something unlatches it."""
        if not self.has_keys:
            return False
        default = self._model.default_state()
        there = state.updated({s: default[s] for s in self._objects} | {self.coordinate: target})
        plan = self._plan(there, float(state[self.coordinate]), ())
        return plan.verdict == "found" and any(step.coordinate != self.coordinate for step in plan.steps)

    def find_straight(self, state: State, target: float) -> Way:
        """Return the way on which the object alone moves."""
        here = state[self.coordinate]
        return Way.straight(self.coordinate, here, target, {s: state[s] for s in self.carriers})

    def _hold(
        self, state: State, surely: State, steps: Sequence[UnlockingStep], target: float
    ) -> ContactPhase:
        """Return the phase of the first steps, all those that move the handle, one after another."""
        own = self.coordinate, *self.carriers
        group = list(takewhile(lambda step: step.coordinate in own, steps))
        last = group[-1].coordinate if group else self.coordinate
        end = group[-1].target if group else target
        order = (*(s for s in own if s != last), last)
        if {step.coordinate for step in group} <= {last}:
            way = Way.straight(last, state[last], end, {s: state[s] for s in order})
            return ContactPhase(last, end, None, self._handle, way)
        at = {s: float(state[s]) for s in order}
        corners = [[*at.values()]]
        for step in group:
            before = at[step.coordinate]
            at[step.coordinate] = (
                step.target if step is group[-1] else self._go_beyond(step, surely, at, target)
            )
            if step is group[-1]:
                corners += self._let_back(surely, at, before, target)
            corners.append([*at.values()])
        return ContactPhase(last, end, None, self._handle, Way.through(order, corners))

    def _go_beyond(
        self, step: UnlockingStep, state: State, at: Mapping[Symbol, float], target: float
    ) -> float:
        """Return a value clear of the threshold of a key: a hand gives way to its spring."""
        key, threshold = step.coordinate, step.threshold
        if threshold is None or step.target == threshold:
            return step.target
        side = math.copysign(1.0, step.target - threshold)
        room = side * (self._model.limits(key)[side > 0.0] - threshold)
        far = threshold + side * min(_BEYOND, room / 2)
        plan = self._plan(state.updated({**at, key: far}), target, ())
        free = plan.verdict == "found" and all(later.coordinate != key for later in plan.steps)
        return far if free and side * (far - step.target) > 0.0 else step.target

    def _let_back(
        self, state: State, end: dict[Symbol, float], before: float, target: float
    ) -> list[list[float]]:
        """Return corners at which the keys are let back on the last run of a way; ``end`` gets their values.

        They are where they were as soon as no move that is left needs them. Thus a lever is never let go
        while it is turned, and what is reached when an arm ends on the way is not latched again by that.
        """
        *keys, last = end
        resting = {s: float(state[s]) for s in keys}

        def is_free(value: float) -> bool:
            plan = self._plan(state.updated({**resting, last: value}), target, ())
            return plan.verdict == "found" and not any(step.coordinate in keys for step in plan.steps)

        run = Way.straight(last, before, end[last]).values[:, 0].tolist()
        k = next((k for k in range(1, len(run)) if is_free(run[k])), None)
        if k is None:
            return []
        latched, free = run[k - 1], run[k]
        for _ in range(_HALVINGS):
            middle = (latched + free) / 2
            latched, free = (latched, middle) if is_free(middle) else (middle, free)
        rest = end[last] - free
        free = free + math.copysign(_CLEAR, rest) if abs(rest) > _CLEAR else end[last]
        pulled = [*(end[s] for s in keys), free]
        end |= resting
        return [pulled, [*resting.values(), free]]

    def _plan(self, state: State, target: float, still: Collection[Symbol]) -> UnlockingPlan:
        from kineverse.reasoning import interlocks, plan_unlocking  # for start-up time

        model = self._model
        found = cached_for_version(model, ("interlocks",), lambda: interlocks(model))
        goal, places = {self.coordinate: target}, {s: state[s] for s in self._objects}
        return plan_unlocking(model, goal, places, found=found, fixed=still)

    def _movers(self, frame: str) -> list[Symbol]:
        moving = self._model.fk(frame).symbols
        return [s for s in self._objects if s in moving]


def _find_tolerance(step: UnlockingStep) -> float | None:
    passed = 0.0 if step.threshold is None else abs(step.target - step.threshold)
    return _SHARE * passed if passed else None
