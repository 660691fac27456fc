"""Grasps of a handle: poses of a hand whose open fingers enclose the bar."""

from __future__ import annotations

from dataclasses import dataclass

from kineverse.lie import Array
from kineverse.model.model_view import ModelView

from .gripper import Gripper
from .handles import Handle


@dataclass(frozen=True, slots=True, eq=False)
class Grasp:
    """Pose of a hand at a handle.

    Attributes
    ----------
    gripper, handle
        What holds what.
    pose
        Pose handle.frame_T_hand (4, 4) of the hand's frame while it holds [m].
    approach
        Pose handle.frame_T_hand (4, 4) before the hand approaches, outside of the handle [m].
    """

    gripper: Gripper
    handle: Handle
    pose: Array
    approach: Array


def sample_grasps(
    model: ModelView, gripper: Gripper, handle: Handle, count: int = 64, seed: int = 0
) -> tuple[Grasp, ...]:
    """Return grasps across a bar, without contact of the open gripper with the object, the best first.

    Grasps differ in the angle about the bar, the place along it, the depth, and by half a turn about the
    approach.

    Raises
    ------
    InvalidValueError
        If the bar is thicker than the gripper opens, or too near to its panel for the fingers.
    """
    raise NotImplementedError
