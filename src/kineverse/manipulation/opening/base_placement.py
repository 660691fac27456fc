"""Results of searches of base placements."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass

from kineverse.grasping import Grasp
from kineverse.lie import Array
from kineverse.symbols import Symbol

NO_WAY, NO_PLACE = "no way to the handle", "no free place of the base"
"""Reasons of placements that are refused, and of bases that touch something."""
_DIFFERENCE = 0.025
"""Difference of the values at the ends of a way to those of the way back [m], [rad]."""


@dataclass(frozen=True, slots=True, eq=False)
class BasePlacement:
    """Base, grasp and way of the arm, true if they were found.

    Attributes
    ----------
    grasp
        The grasp; None if nothing was found.
    coordinates
        Coordinates (n,) of the robot: base and arm.
    approach, line
        Configuration (n,) before the hand is at the handle, and those (L, n) from there to the grasp.
    values, way
        Values (K,) of the object's coordinate [m], [rad], and configurations (K, n) of the robot there. They
        end at the target, or where the arm or something in the way ends them.
    retreat
        Configurations (L, n) with which the hand goes away from the handle at the end.
    samples
        Number of sampled bases.
    reasons
        Number of samples by the reason of their failure.
    seconds
        Duration of the search [s].
    stands
        Whether the robot has no mobile base, so that each sample is an arm instead of a base.
    """

    grasp: Grasp | None
    coordinates: tuple[Symbol, ...]
    approach: Array
    line: Array
    values: Array
    way: Array
    retreat: Array
    samples: int
    reasons: Counter[str]
    seconds: float
    stands: bool = False

    def __bool__(self) -> bool:
        return self.grasp is not None

    def find_end_backwards(self, value: float, target: float) -> float | None:
        """Return the value to which the way leads back from a value, towards a target; None if it does not.

        It begins where the way ends, and small differences [m], [rad] at both ends are made up for.
        """
        ahead = math.copysign(1.0, target - value)
        begin, end = float(self.values[-1]), float(self.values[0])
        if abs(value - begin) >= _DIFFERENCE or ahead * (end - value) <= 0.0:
            return None
        return target if ahead * (target - end) < _DIFFERENCE else end

    @property
    def failure(self) -> str:
        """Class of the failure: ``"collision"`` if an arm reaches along the way, otherwise ``"reach"``."""
        return "collision" if any(" at " in r or r in (NO_WAY, NO_PLACE) for r in self.reasons) else "reach"

    @property
    def why(self) -> str:
        """Text with the number of samples and the reasons of failures."""
        failed = ", ".join(f"{n} {reason}" for reason, n in self.reasons.most_common(6) if n)
        what = "arms of a robot without a mobile base" if self.stands else "bases"
        found = (
            f"Found after {self.samples} {what}" if self else f"None of {self.samples} {what} goes through"
        )
        return f"{found}; failed: {failed}." if failed else f"{found}."
