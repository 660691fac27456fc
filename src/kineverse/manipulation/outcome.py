"""Results of skills."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from kineverse.errors import KineverseError


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of a skill, true if it was done.

    Attributes
    ----------
    done
        Whether the object is where it was wanted, in the world's truth, and nothing went through anything on
        the way: no two bodies overlapped by more than 0.5 mm that did not at the start.
    value
        Value of the coordinate at the end, in the world's truth [m], [rad].
    reason
        Why it is done, or what prevented it.
    seconds
        Time in the world [s].
    steps
        Number of control steps.
    measures
        Further figures by name: see the tables of ``kineverse reproduce``.
    claimed
        Whether the skill itself says that it is done, by what it knows; ``done`` if not given.
    """

    done: bool
    value: float
    reason: str
    world: str
    seconds: float
    steps: int
    measures: Mapping[str, Any] = field(default_factory=dict)
    claimed: bool | None = None

    def __post_init__(self) -> None:
        if self.claimed is None:
            object.__setattr__(self, "claimed", self.done)

    def __bool__(self) -> bool:
        return self.done


class SkillError(KineverseError):
    """End of a skill that is not done.

    Attributes
    ----------
    kind
        ``"collision"``, ``"reach"``, ``"time"`` or ``"other"``.
    """

    def __init__(self, kind: str, reason: str) -> None:
        super().__init__(reason)
        self.kind = kind
