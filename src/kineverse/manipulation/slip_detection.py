"""Detection of a handle that slips in the hand, by encoders and estimates, without the world's truth."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from kineverse.compilation import compile
from kineverse.expressions import Expression
from kineverse.grasping import Gripper
from kineverse.lie import inverse
from kineverse.state import State
from kineverse.symbols import Symbol

from .outcome import SkillError
from .session import Session

SLIPPED, PULLED_OUT = 0.008, 0.012
"""Distances from its place in the hand from which on a handle has slipped [m]: of a modelled object, and of a
part whose joint is unknown."""
_SIGMAS = 4.0  # standard deviations of the estimate that are added
_EMPTY = 0.002  # motion of closed fingers from which on nothing is between them any more [m]


class SlipError(SkillError):
    """Loss of a held handle."""

    def __init__(self, reason: str) -> None:
        super().__init__("other", reason)


class SlipDetector:
    """Watch over a bar in closed fingers, compared with its place in the hand at the start."""

    def __init__(
        self,
        session: Session,
        gripper: Gripper,
        bar: Expression,
        hand: Expression,
        fingers: Mapping[Symbol, float],
    ) -> None:
        self._session, self._gripper, self._fingers = session, gripper, fingers
        self.bar_T_hand = inverse(bar(session.state)) @ hand(session.state)
        self._middle = gripper.grasp_pose[:, 3]
        error = ((bar @ self.bar_T_hand - hand) @ self._middle)[:3]
        self._limit = SLIPPED + _SIGMAS * float(np.linalg.norm([session.deviation(x) for x in error]))
        self._poses = compile([bar, hand], tier="interpreter")  # a call a step

    def measure(self, state: State) -> float:
        """Return the distance of the bar from its place in the hand at a state [m]."""
        world_T_bar, world_T_hand = self._poses(state.vector(self._poses.inputs))
        return float(np.linalg.norm(((world_T_bar @ self.bar_T_hand - world_T_hand) @ self._middle)[:3]))

    def check(self, distance: float, coordinate: Symbol) -> None:
        """Raise SlipError if the distance is too large, or if the fingers have closed further."""
        empty = self._are_fingers_empty()
        if empty or distance > self._limit:
            how = "It is out of the hand." if empty else f"It moved {1e3 * distance:.0f} mm in the hand."
            value = self._session.state[coordinate]
            raise SlipError(f"The handle slipped at {value:.3f} of '{coordinate}'. {how}")

    def _are_fingers_empty(self) -> bool:
        gripper, state = self._gripper, self._session.state
        closed = 0.0
        for s, held in self._fingers.items():
            range_ = gripper.closed[s] - gripper.opened[s]
            noise = math.copysign(4.0 * self._session.deviation(s), range_)
            further = (state[s] - held - noise) / range_ if range_ else 0.0
            closed = max(closed, gripper.width * further)
        return closed > _EMPTY
