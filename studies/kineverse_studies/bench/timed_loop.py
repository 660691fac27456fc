"""Control loops as contenders: the CPU time of each step of a motion."""

from __future__ import annotations

from time import thread_time_ns

import numpy as np

from .control_workloads import ControlLoop
from .controller_loop import ControllerLoop
from .harness import Contender
from .result import Bar, Comparison, Measurement


class TimedLoop:
    """Control loop whose steps are timed, from the state in to the command out."""

    def __init__(self, name: str, loop: ControlLoop, period: float, steps: int) -> None:
        self.name, self.loop = name, loop
        self.period, self.steps = period, steps
        self.times: list[float] = []
        self._solver: list[float] = []

    @property
    def contender(self) -> Contender:
        """The contender; its cost is the median step of a motion."""
        return Contender(self.name, self.run)

    def run(self) -> float:
        """Run the motion; return the median CPU time of a step [s]."""
        loop, own = self.loop, isinstance(self.loop, ControllerLoop)
        times: list[float] = []
        solver: list[float] = []
        loop.reset()
        for k in range(self.steps):
            loop.aim(k * self.period)
            start = thread_time_ns()
            loop.step()
            times.append((thread_time_ns() - start) * 1e-9)
            if own:
                solver.append(loop.command.times.solve)  # type: ignore[attr-defined]
            loop.advance()
        self.times += times
        if own:
            self._solver.append(float(np.median(solver)))
        return float(np.median(times))

    def mean_error(self, steps: int | None = None) -> Measurement:
        """Run the motion, or a number of steps; return the mean error of the task [m], [rad]."""
        self.loop.reset()
        found = []
        for k in range(steps or self.steps):
            self.loop.aim(k * self.period)
            self.loop.step()
            self.loop.advance()
            found.append(self.loop.error())
        return Measurement(f"{self.name}, mean error", "m, rad", (float(np.mean(found)),))

    def slots_in_use(self, count: int) -> Measurement:
        """Run the motion of our controller; return the mean number of contact slots in use."""
        loop = self.loop
        assert isinstance(loop, ControllerLoop)
        loop.reset()
        used = []
        for _ in range(self.steps):
            loop.step()
            loop.advance()
            used.append(min(len(loop.command.contacts), count))
        return Measurement(f"{self.name}, in use", "slots", (float(np.mean(used)),))

    def p99(self) -> Measurement:
        """Return the 99th percentile of all steps."""
        return Measurement(f"{self.name}, p99", "s", (float(np.percentile(self.times, 99)),))

    def solver_alone(self) -> list[Measurement]:
        """Return the median wall times of our solver by round; nothing for other loops."""
        rounds = tuple(self._solver[1:])
        return [Measurement(f"{self.name}, solver alone", "s", rounds)] if rounds else []

    def bounds(self, **limits: float) -> list[Comparison]:
        """Return statistics of all steps with their targets [s]: ``mean``, ``median``, ``p99``, ``worst``."""
        values = {
            "mean": np.mean(self.times),
            "median": np.median(self.times),
            "p99": np.percentile(self.times, 99),
            "worst": np.max(self.times),
        }
        return [
            Comparison(f"{self.name}, {kind}", float(values[kind]), "s", Bar(limit, at_least=False))
            for kind, limit in limits.items()
        ]
