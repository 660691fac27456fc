"""Results of skills: what a skill believes, and how it fails."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from kineverse.errors import KineverseError


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of a skill as the skill believes it, true if it was done.

    Attributes
    ----------
    done
        Whether the object is where it was wanted, by the robot's own readings.
    value
        Believed value of the coordinate at the end [m], [rad].
    reason
        Why it is done, or what prevented it.
    world
        Name of the robot's interface, such as ``"kinematic"``.
    seconds
        Time that it took, by the robot's clock [s].
    steps
        Number of control steps.
    measures
        Further figures by name; ``failure`` is the kind of what prevented it: ``"collision"``, ``"reach"``,
        ``"time"`` or ``"other"``.

    See Also
    --------
    kineverse.manipulation.open_object
    """

    done: bool
    value: float
    reason: str
    world: str
    seconds: float
    steps: int
    measures: Mapping[str, Any] = field(default_factory=dict)

    def __bool__(self) -> bool:
        return self.done


class SkillError(KineverseError):
    """End of a skill that is not done.

    Attributes
    ----------
    kind
        ``"collision"``, ``"reach"``, ``"time"`` or ``"other"``.
    measures
        Figures of the failure, which the outcome gets.

    See Also
    --------
    kineverse.manipulation.SkillRun
    """

    def __init__(self, kind: str, reason: str, measures: Mapping[str, Any] | None = None) -> None:
        super().__init__(reason)
        self.kind, self.measures = kind, dict(measures or {})
