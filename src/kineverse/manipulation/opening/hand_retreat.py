"""Retreat of an open hand from a handle that was moved to an unchecked place."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from kineverse.grasping import Grasp
from kineverse.lie import Array

if TYPE_CHECKING:
    from .hand_motion import HandMotion

_ASIDE = tuple(math.radians(a) for a in (0.0, 25.0, -25.0, 50.0, -50.0))
"""Angles along the bar by which a retreat deviates from the reversed approach [rad]."""
_STEPS = 12
"""Number of arms along a retreat."""


@dataclass(frozen=True, slots=True, eq=False)
class HandRetreat:
    """Straight way of a hand from a handle."""

    end: Array  # last pose world_T_hand (4, 4)
    arms: Array | None  # configurations (L, n) of the arm along it; None if the arm does not reach the end


def find_retreat(motion: HandMotion, grasp: Grasp, world_T_handle: Array, world_T_hand: Array) -> HandRetreat:
    """Return the retreat that touches nothing, or the one that goes the farthest before it does.

    It is the reversed approach of the grasp, or deviates from it along the bar.
    """
    search, state = motion.search, motion.state
    out = grasp.approach[:3, 3] - grasp.pose[:3, 3]
    bar, length = grasp.handle.pose[:3, 2], float(np.linalg.norm(out))
    ends = np.repeat(world_T_hand[None], len(_ASIDE), axis=0)
    for k, angle in enumerate(_ASIDE):
        away = math.cos(angle) * out + math.sin(angle) * length * bar
        ends[k, :3, 3] += world_T_handle[:3, :3] @ away
    share = np.linspace(0.0, 1.0, _STEPS)[:, None]
    lines = np.repeat(ends[:, None], _STEPS, axis=1)
    lines[:, :, :3, 3] = world_T_hand[:3, 3] + share * (ends[:, None, :3, 3] - world_T_hand[:3, 3])
    arm, base = state.vector(search.moving), state.vector(search.standing)
    count = len(_ASIDE)
    ways, reached = search.paths.follow(np.tile(arm, (count, 1)), np.tile(base, (count, 1)), lines)
    best, farthest = HandRetreat(ends[0], None), 0
    for end, way, number in zip(ends, ways, reached.tolist(), strict=True):
        if number < 2:
            continue
        rows = way[:number]
        hit = search.contacts.first(state, search.moving, rows, motion.handle.frame, opened=False)
        free = number if hit is None else hit
        if free > farthest:
            best, farthest = HandRetreat(end, way if number == _STEPS else None), free
    return best
