"""Result of inverse kinematics."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

from kineverse.geometry.results import DistanceResult
from kineverse.state import State


@dataclass(frozen=True, eq=False)
class IkResult:
    """Configuration found by inverse kinematics, with the state of each task.

    Attributes
    ----------
    solved
        True if all tasks are done, within the limits and without collisions.
    residuals
        Norm of the error of each task and equality at the best point, by name, in the unit of its expression;
        for a keep its violation.
    active
        Names of the limits and constraints that stop goals at the best point, the strongest first; empty if
        solved.
    contacts
        Pairs of bodies nearer than the margin at the best point, nearest first.
    obstacles
        Pairs of bodies that stopped solutions, with the number of starts.
    starts, iterations
        Numbers of starts and of Gauss-Newton steps.
    seconds
        Duration [s].
    """

    solved: bool
    residuals: Mapping[str, float]
    active: tuple[str, ...]
    contacts: Sequence[DistanceResult]
    starts: int
    iterations: int
    seconds: float
    make_states: Callable[[], tuple[State, ...]] = field(repr=False)
    explain: Callable[[IkResult], str] = field(repr=False)
    obstacles: Counter[str] = field(repr=False)

    @cached_property
    def best(self) -> State:
        """State of the solution that is nearest to the given state, else of the best point.

        That is the point of least weighted squared errors of goals found, where holds, keeps and constraints
        are satisfied if that is possible. A state has values for everything in the model; what no task moves
        has the given ones.
        """
        return self._states[0]

    @cached_property
    def solutions(self) -> tuple[State, ...]:
        """Different solutions, the nearest to the given state first; empty if not solved."""
        return self._states if self.solved else ()

    @cached_property
    def why(self) -> str:
        """Text that names what prevents a solution; computed on first use, by further searches."""
        return self.explain(self)

    @cached_property
    def _states(self) -> tuple[State, ...]:
        return self.make_states()

    def __repr__(self) -> str:
        state = "solved" if self.solved else "not solved"
        worst = ", ".join(f"{name}: {value:.3g}" for name, value in self.residuals.items())
        return f"<IkResult: {state} after {self.starts} starts, {self.iterations} steps; {worst}>"
