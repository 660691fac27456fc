"""World of a mechanism without a robot: its coordinates are driven, and move as far as its constraints allow.

A step moves all coordinates together if no constraint of the world's model becomes more violated by it. Else
they move one after the other, each as far as the constraints allow: a locked part stands still, another one
goes at its speed limit, and up to the limit of its position. There are no bodies, forces or contacts.
"""

from __future__ import annotations

import math
from collections.abc import Collection

import numpy as np

from kineverse._checks import as_positive
from kineverse.lie import Array
from kineverse.model.model_view import ModelView, find_symbols
from kineverse.state import State, StateLike, as_state
from kineverse.symbols import Symbol

from .robot import Robot
from .robot_interface import Observation
from .simulated_world import Contact
from .speed_commands import parse_speeds

_ALLOWED = 1e-7  # violation of a constraint that counts as none, in its unit
_NO_VALUE = 1e9
_HALVINGS = 16


class MechanismWorld:
    """World in which the coordinates of a mechanism are driven, such as those of a lockbox.

    Parameters
    ----------
    model
        Model of the mechanism, whose constraints hold here.
    jammed
        Coordinates that do not move, by symbol or name.

    Examples
    --------
    >>> world = kv.worlds.MechanismWorld(kv.load("lockboxes/thesis"))
    >>> world.apply({"lockbox/a:velocity": 0.5, "lockbox/f:velocity": 0.5}, 0.5)  # a is locked
    >>> round(world.state["lockbox/a"], 2), round(world.state["lockbox/f"], 2)
    (0.0, 0.2)
    """

    name = "mechanism"
    held = None
    peak_force = math.nan
    timeout = math.inf
    remarks: tuple[str, ...] = (
        "there are no bodies, forces or contacts: coordinates move as far as constraints allow",
    )

    def __init__(self, model: ModelView, jammed: Collection[Symbol | str] = ()) -> None:
        self.model, self.robot = model, Robot.of_mechanism(model)
        self._symbols, self._columns = model.symbols, model.speeds
        names = find_symbols(model, jammed, "jammed=")
        self.jammed = frozenset(model.degree_of_freedom(s) for s in names)
        self._integrate = model.integrator()
        self._checker = model.constraint_checker((*self._symbols, *self._columns))
        orders = [model.constraints[n].order if n in model.constraints else 0 for n in self._checker.names]
        self._about_speeds = np.array(orders, dtype=int) > 0
        self._place = {
            key: None if v.position in self.jammed else k
            for k, v in enumerate(self._columns)
            for key in (v, str(v))
        }
        self.reset(model.default_state())

    def __repr__(self) -> str:
        return f"<MechanismWorld at {self.time:g} s>"

    @property
    def time(self) -> float:
        """Time since the last reset [s]."""
        return self._time

    @property
    def state(self) -> State:
        """Values of all coordinates; its stamp is the time [s]."""
        values = dict(zip(self._symbols, self._q.tolist(), strict=True))
        return State(values, stamp=self._time, source=self.name)

    def reset(self, state: StateLike) -> None:
        """Start again from a state, at time 0; coordinates without a value have their default one."""
        values = self.model.default_state().updated(as_state(state, self._symbols))
        self._q, self._time = values.vector(self._symbols), 0.0

    def apply(self, speeds: StateLike, duration: float, *, stamp: float | None = None) -> None:
        """Advance by a duration with speeds of the coordinates, as :meth:`.RobotInterface.apply`.

        The stamp is not read.
        """
        length = as_positive(duration, "A duration", "number of seconds")
        v = parse_speeds(speeds, self._place, np.zeros(len(self._columns)))
        after = self._advance(self._q, v, length)
        if after is None:
            after = self._q
            for one in np.flatnonzero(v):
                alone = np.where(np.arange(len(v)) == one, v, 0.0)
                after = self._advance_most(after, alone, length)
        self._q, self._time = after, self._time + length

    def contacts(self) -> tuple[Contact, ...]:
        """Return no contacts."""
        return ()

    def observe(self) -> Observation:
        """Return the positions of all coordinates."""
        state = self.state
        return Observation(self._time, {s: state[s] for s in self.model.degrees_of_freedom})

    def _advance_most(self, q: Array, v: Array, time: float) -> Array:
        """Return the configuration after the largest share of the speeds that the constraints allow."""
        least, most, best = 0.0, 1.0, q
        whole = self._advance(q, v, time)
        if whole is not None:
            return whole
        for _ in range(_HALVINGS):
            share = 0.5 * (least + most)
            after = self._advance(q, share * v, time)
            if after is None:
                most = share
            else:
                least, best = share, after
        return best

    def _advance(self, q: Array, v: Array, time: float) -> Array | None:
        """Return the configuration after a time with speeds; None if a constraint forbids it."""
        after, rest = self._integrate(q, v, time), np.zeros(len(v))
        # Limits of speeds are those at the beginning of a step, before any coordinate has moved.
        moving, before, now = self._excesses(self._q, v), self._excesses(q, rest), self._excesses(after, rest)
        result = np.where(self._about_speeds, moving, now - np.maximum(before, 0.0))
        return after if bool(np.all(result <= _ALLOWED)) else None

    def _excesses(self, q: Array, v: Array) -> Array:
        """Return the excess of each constraint, a large one where it has no value."""
        self._checker(np.concatenate([q, v]))
        return np.nan_to_num(self._checker.excess, nan=_NO_VALUE)
