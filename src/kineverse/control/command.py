"""Command of a controller: speeds, and the reasons for them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from kineverse._names import answer_foreign_names
from kineverse._synonyms import COMMAND_SYNONYMS
from kineverse.lie import Array
from kineverse.symbols import Symbol

if TYPE_CHECKING:
    from kineverse.geometry.results import DistanceResult

SATURATED = 1e-9  # multiplier from which a bound counts as active


class StepTimes(NamedTuple):
    """Durations of the parts of a step [s]: distance queries, evaluation of the program, solution, all."""

    query: float
    evaluate: float
    solve: float
    total: float


class TaskErrors(NamedTuple):
    """Errors of tasks at a state."""

    names: tuple[str, ...]
    values: Array  # (k,) norms of the errors at the state
    speed_goals: npt.NDArray[np.intp]  # places of goals about speeds among these
    first_rows: npt.NDArray[np.intp]  # of these in the Jacobian
    jacobian: Array | None  # (m, n), of all goals about speeds; None without any
    rate: Array | None  # (m,), wanted

    def norms(self, speeds: Array) -> dict[str, float]:
        """Return the norm of the error of each task at speeds (n,), by name."""
        values = self.values
        if self.jacobian is not None and self.rate is not None:
            squares = (self.jacobian @ speeds - self.rate) ** 2
            values = values.copy()
            values[self.speed_goals] = np.sqrt(np.add.reduceat(squares, self.first_rows))
        return dict(zip(self.names, values.tolist(), strict=True))


@answer_foreign_names("A command", COMMAND_SYNONYMS)
@dataclass(frozen=True, slots=True, eq=False)
class Command:
    """Speeds for one time step, with the state of each task.

    Attributes
    ----------
    speeds
        Speed by symbol, for ``model.integrate`` and for drives [m/s], [rad/s].
    vector
        The speeds (n,) in the order of the controller's.
    progress
        Share of the wanted correction of holds that is possible, in [0, 1]: the least of all holds, 1 if
        nothing is held.
    times
        Durations of the parts of the step.
    contacts
        Near pairs of bodies, nearest first; the first of them have rows.

    See Also
    --------
    kineverse.control.Controller.step
    """

    speeds: Mapping[Symbol, float]
    vector: Array = field(repr=False)
    progress: float
    times: StepTimes
    iterations: int
    multipliers: Array = field(repr=False)
    row_names: tuple[tuple[str, ...], ...] = field(repr=False)
    contacts: Sequence[DistanceResult] = field(repr=False)
    errors: TaskErrors = field(repr=False)

    @property
    def residuals(self) -> dict[str, float]:
        """Norm of the error of each task at the state, by name, in the unit of its expression.

        For a goal about speeds it is the norm of the rate error, for a keep its violation.
        """
        return self.errors.norms(self.vector)

    @property
    def active(self) -> tuple[str, ...]:
        """Names of the constraints that restrict the command, the strongest first."""
        sizes = abs(self.multipliers)
        order = sorted((k for k in range(len(sizes)) if sizes[k] > SATURATED), key=lambda k: -sizes[k])
        return tuple(dict.fromkeys(name for k in order for name in self.names_of_row(k)))

    def names_of_row(self, index: int) -> tuple[str, ...]:
        """Return the names of the constraints of a bound or row, or of both bodies of a contact."""
        static = len(self.row_names)
        if index < static:
            return self.row_names[index]
        pair = self.contacts[index - static]
        return (name_contact(pair),)


def name_contact(pair: DistanceResult) -> str:
    """Return the name of the row of a near pair."""
    return f"contact of {pair.a} and {pair.b}"
