"""Hinges that a part may have by its shape, and how far an arm follows them."""

from __future__ import annotations

import numpy as np

from kineverse.grasping.bars import find_parts
from kineverse.lie import Array, adjoint, exp_se3
from kineverse.manipulation.opening import BasePlacement, PlacementSearch
from kineverse.state import State

from .part import UnknownPart

_LEAST_RADIUS = 0.15
"""Distance of a bar from an edge of its part from which on a hinge may be there [m]."""
_STEP = 0.05
"""Way of the handle between two poses of an arm [m]."""


def guess_hinges(unknown: UnknownPart, search: PlacementSearch, state: State) -> list[Array]:
    """Return the twists (6,) of hinges along the bar at the far edges of a part, in its axes.

    A door has its handle far from its hinge, and along it. A bar in the middle of a narrow front, as of a
    drawer, has none.
    """
    model, handle = unknown.model, unknown.handle
    search.scene.update(state)
    world_T_bar = model.fk(handle.frame)(state) @ handle.pose
    rigid = {b for b in search.others if not model.fk(b, unknown.frame).symbols}
    parts = [part for part in find_parts(search.scene) if part.body in rigid]
    x, y = world_T_bar[:3, 0], world_T_bar[:3, 1]
    extents = np.array([part.extent(np.array([-x, y, -y])) for part in parts]).max(axis=0)
    back, left, right = extents - np.array([-x, y, -y]) @ world_T_bar[:3, 3]
    twists = []
    for side, radius in ((1.0, left), (-1.0, right)):
        if radius > _LEAST_RADIUS:
            axis = np.array([0.0, 0.0, side])
            pivot = np.array([-back, side * radius, 0.0])
            twist = np.concatenate([-np.cross(axis, pivot), axis])
            twists.append(adjoint(unknown.frame_T_handle @ handle.pose) @ twist)
    return twists


def least_share(
    unknown: UnknownPart,
    search: PlacementSearch,
    placement: BasePlacement,
    state: State,
    twists: list[Array],
    way: float,
    turn: float,
) -> float:
    """Return the least share of possible motions along which the arm of a placement holds the handle."""
    assert placement.grasp is not None
    world_T_part = np.asarray(unknown.model.fk(unknown.frame)(state))
    part_T_hand = unknown.frame_T_handle @ placement.grasp.pose
    count = len(search.moving)
    arm, base = placement.way[:1, :count], placement.way[:1, count:]
    shares = [(placement.values[-1] - placement.values[0]) / way]
    for twist in twists:
        radius = float(np.linalg.norm(twist[:3] + np.cross(twist[3:], unknown.point)))
        angles = np.linspace(0.0, turn, max(2, round(radius * turn / _STEP) + 1))
        hands = np.array([world_T_part @ exp_se3(q * twist) @ part_T_hand for q in angles])
        _, reached = search.paths.follow(arm, base, hands[None])
        shares.append(max(0.0, float(reached[0]) - 1.0) / (len(angles) - 1))
    return float(min(shares))
