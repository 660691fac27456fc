"""Command of a controller: speeds, and the reasons for them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from kineverse.geometry.results import DistanceResult
from kineverse.lie import Array
from kineverse.symbols import Symbol

SATURATED = 1e-9
"""Multiplier from which a bound counts as active."""


@dataclass(frozen=True, slots=True)
class StepTimes:
    """Durations of the parts of a step [s]: distance queries, evaluation of the program, solution, all."""

    query: float
    evaluate: float
    solve: float
    total: float


@dataclass(frozen=True, slots=True, eq=False)
class Command:
    """Speeds for one time step, with the state of each task.

    Attributes
    ----------
    speeds
        Speed by symbol, for ``model.integrate`` and for drives [m/s], [rad/s].
    residuals
        Norm of the error of each task at the state, by name, in the unit of its expression; for a goal about
        speeds the norm of what is missing, for a keep its violation.
    progress
        Share of the wanted correction of holds that is possible, in [0, 1]: the least of all holds, 1 if
        nothing is held.
    times
        Durations of the parts of the step.
    iterations
        Iterations of the solver.
    contacts
        Near pairs of bodies, nearest first; the first of them have rows.
    """

    speeds: Mapping[Symbol, float]
    residuals: Mapping[str, float]
    progress: float
    times: StepTimes
    iterations: int
    multipliers: Array = field(repr=False)
    row_names: tuple[tuple[str, ...], ...] = field(repr=False)
    contacts: Sequence[DistanceResult] = field(repr=False)

    @property
    def active(self) -> tuple[str, ...]:
        """Names of the constraints that restrict the command, the strongest first."""
        sizes = abs(self.multipliers)
        order = sorted((k for k in range(len(sizes)) if sizes[k] > SATURATED), key=lambda k: -sizes[k])
        return tuple(dict.fromkeys(name for k in order for name in self.names_of_row(k)))

    def names_of_row(self, index: int) -> tuple[str, ...]:
        """Return the names of the constraints of a bound or row; of a contact, the names of both bodies."""
        static = len(self.row_names)
        if index < static:
            return self.row_names[index]
        pair = self.contacts[index - static]
        return (name_contact(pair),)


def name_contact(pair: DistanceResult) -> str:
    """Return the name of the row of a near pair."""
    return f"contact of {pair.a} and {pair.b}"
