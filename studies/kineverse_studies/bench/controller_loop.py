"""Control loop of this library, as of the peers: a controller, and the integration of its commands."""

from __future__ import annotations

import numpy as np

from kineverse.compile import compile  # noqa: A004
from kineverse.control import Command, Controller, Goal, Hold
from kineverse.errors import InvalidValueError
from kineverse.expressions.functions import norm
from kineverse.state import State
from kineverse.symbols import Symbol


class ControllerLoop:
    """Control loop of a controller, with vectors for states."""

    command: Command

    def __init__(
        self, controller: Controller, start: State, clock: Symbol | None = None, task: str | None = None
    ) -> None:
        self.controller = controller
        model = controller.model
        self._symbols = model.symbols
        self._integrate = model.integrator(controller.speeds)
        self._start = start.vector(self._symbols)
        place = {s: k for k, s in enumerate(self._symbols)}
        inputs = controller.inputs
        self._input = np.array([0.0 if s.value is None else s.value for s in inputs])
        self._own = np.array([k for k, s in enumerate(inputs) if s in place], dtype=np.intp)
        self._places = np.array([place[s] for s in inputs if s in place], dtype=np.intp)
        self._clock = [k for k, s in enumerate(inputs) if s == clock]
        self._error = compile(norm(_find_task(controller, task).error[:3]), inputs)
        self.reset()

    def reset(self) -> None:
        """Return to the start."""
        self.controller.reset()
        self._q = self._start.copy()

    def aim(self, time: float) -> None:
        """Move the targets to a time [s]."""
        self._input[self._clock] = time

    def step(self) -> None:
        """Compute the command at the present state."""
        self._input[self._own] = self._q[self._places]
        self.command = self.controller.step(self._input)

    def advance(self) -> None:
        """Integrate the command."""
        self._q = self._integrate(
            self._q, np.fromiter(self.command.speeds.values(), float), self.controller.dt
        )

    def error(self) -> float:
        """Return the error of the task [m], [rad]."""
        self._input[self._own] = self._q[self._places]
        return float(self._error(self._input))

    @property
    def state(self) -> State:
        """The present state."""
        return State(dict(zip(self._symbols, self._q.tolist(), strict=True)))


def _find_task(controller: Controller, name: str | None) -> Goal | Hold:
    """Return a goal or hold by its name, or the first one."""
    tasks = [task for task in controller.tasks if isinstance(task, Goal | Hold) and name in (None, task.name)]
    if not tasks:
        raise InvalidValueError(f"The controller has no goal or hold {name!r}.")
    return tasks[0]
