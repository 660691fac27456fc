"""Result of inverse kinematics."""

from __future__ import annotations

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
    best
        The solution that is nearest to the given state. Without a solution, the best point: of least
        weighted squared errors of goals, while holds, keeps and constraints are satisfied if that is
        possible. It has values for everything in the model; what no task moves has the given ones.
    solved
        True if all tasks are done, within the limits and without collisions.
    solutions
        Different solutions, the nearest first; empty if not solved.
    residuals
        Norm of the error of each task and equality at the best point, by name, in the unit of its expression;
        for a keep its violation.
    active
        Names of the limits and constraints that stop goals at the best point, the strongest first; empty if
        solved.
    contacts
        Pairs of bodies nearer than the margin at the best point, nearest first.
    starts, iterations
        Numbers of starts and of Gauss-Newton steps.
    seconds
        Duration [s].
    """

    best: State
    solved: bool
    solutions: tuple[State, ...]
    residuals: Mapping[str, float]
    active: tuple[str, ...]
    contacts: Sequence[DistanceResult]
    starts: int
    iterations: int
    seconds: float
    explain: Callable[[], str] = field(repr=False)

    @cached_property
    def why(self) -> str:
        """Text that names what prevents a solution; computed on first use, by further searches."""
        return self.explain()

    def __repr__(self) -> str:
        state = "solved" if self.solved else "not solved"
        worst = ", ".join(f"{name}: {value:.3g}" for name, value in self.residuals.items())
        return f"<IkResult: {state} after {self.starts} starts, {self.iterations} steps; {worst}>"
