"""Handles of an articulated object: slim bodies that a joint moves, far from its axis."""

from __future__ import annotations

from dataclasses import dataclass

from kineverse.lie import Array
from kineverse.model.model_view import ModelView
from kineverse.symbols import Symbol


@dataclass(frozen=True, slots=True, eq=False)
class Handle:
    """Bar that a gripper can hold.

    Attributes
    ----------
    frame
        Frame of the body with the collision shapes of the bar.
    coordinate
        Coordinate of the object that moves it.
    pose
        Pose frame_T_bar (4, 4) [m]: its origin is the middle of the bar, z is along the bar, x points away
        from what the bar is fixed to: a hand approaches along -x.
    length, thickness, clearance
        Size of the bar along z and across y, and the free space between bar and panel along x [m].
    """

    frame: str
    coordinate: Symbol
    pose: Array
    length: float
    thickness: float
    clearance: float


def find_handles(model: ModelView, coordinate: Symbol | str) -> tuple[Handle, ...]:
    """Return the handles that a coordinate moves, the best first; empty if there is none.

    Parameters
    ----------
    model
        Model of the object.
    coordinate
        Coordinate of a door, a drawer or any other mechanism.
    """
    raise NotImplementedError


def find_handle(model: ModelView, coordinate: Symbol | str, frame: str | None = None) -> Handle:
    """Return the best handle that a coordinate moves, or the one at a frame.

    Raises
    ------
    UnknownNameError
        If there is none; the message says which bodies the coordinate moves and why none is a handle.
    """
    raise NotImplementedError
