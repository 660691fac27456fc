"""What an update of a tracker found."""

from __future__ import annotations

from dataclasses import dataclass

from .modes import Modes


@dataclass(slots=True, eq=False)
class Outcome:
    """What an update found.

    Attributes
    ----------
    modes
        After it.
    nis, dof
        The normalised innovation squared, and of how many numbers it is the sum.
    outliers
        The numbers of the observations that were not believed.
    rounds
        How many times the model was evaluated, at most for one explanation.
    """

    modes: Modes
    nis: float
    dof: int
    outliers: tuple[int, ...]
    rounds: int
