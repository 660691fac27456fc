"""A world whose true states a test states one by one, and the steps of a session in it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

from kineverse.model.model_view import ModelView
from kineverse.state import State, StateLike
from kineverse.symbols import Symbol
from kineverse.worlds import Observation, PlannedContact, Robot


class Step(NamedTuple):
    commands: Mapping[Symbol, float]
    state: State
    contact: PlannedContact | None = None


class ScriptedWorld:
    """World in which nothing moves by itself; without the name of a robot it has none."""

    name, remarks, timeout = "scripted", (), math.inf

    def __init__(self, model: ModelView, robot: str | None = None, **home: float) -> None:
        self.model = model
        self.robot = Robot.of_mechanism(model) if robot is None else Robot.of(model, robot)
        self.home = model.default_state().updated({n.replace("__", "/"): v for n, v in home.items()})
        self.peak_force = math.nan
        self.reset({})

    def reset(self, state: StateLike) -> None:
        self.show(state, 0.0)

    def show(self, values: StateLike, time: float, held: str | None = None) -> None:
        self.time, self.held = time, held
        self.state = self.home.updated(values, stamp=time)

    def step(self, speeds: Mapping[str, float] | None = None, contact: PlannedContact | None = None) -> Step:
        """Return a step with speeds by name, in which the truth is believed."""
        named = {str(v): v for v in self.model.speeds}
        return Step({named[name]: value for name, value in (speeds or {}).items()}, self.state, contact)

    def apply(self, speeds: StateLike, duration: float, *, stamp: float | None = None) -> None:
        raise NotImplementedError

    def contacts(self) -> tuple[()]:
        return ()

    def observe(self) -> Observation:
        return Observation(self.time, {})
