"""Grippers of a robot: two opposed fingers on a hand, found from the SRDF or from the joints."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from kineverse.formats.srdf.description import Srdf
from kineverse.lie import Array
from kineverse.model.model_view import ModelView
from kineverse.symbols import Symbol


@dataclass(frozen=True, slots=True, eq=False)
class Gripper:
    """Two opposed fingers on a hand.

    Attributes
    ----------
    hand
        Frame that carries the fingers.
    grasp_pose
        Pose hand_T_grasp (4, 4) [m]: its origin lies between the finger pads, x points out of the hand, y
        along the closing motion.
    fingers
        Frames of the one finger, and of the other.
    bodies
        Frames of the hand and all fingers: the group that may touch what is grasped.
    joints
        Free coordinates that open and close the fingers.
    opened, closed
        Values of these coordinates for open and for closed fingers [m], [rad].
    width
        Gap between the open fingers [m].
    """

    hand: str
    grasp_pose: Array
    fingers: tuple[tuple[str, ...], tuple[str, ...]]
    bodies: tuple[str, ...]
    joints: tuple[Symbol, ...]
    opened: Mapping[Symbol, float]
    closed: Mapping[Symbol, float]
    width: float


def find_grippers(model: ModelView, robot: str, srdf: Srdf | None = None) -> tuple[Gripper, ...]:
    """Return the grippers of a robot, the likeliest for manipulation first; empty if it has none.

    Parameters
    ----------
    model
        Model that contains the robot.
    robot
        Prefix of the robot in the model; empty for a model without prefix.
    srdf
        Semantic description, whose end effectors come first.
    """
    raise NotImplementedError


def find_gripper(model: ModelView, robot: str, hand: str | None = None, srdf: Srdf | None = None) -> Gripper:
    """Return the gripper of a robot, the one of a hand if there is a name.

    Parameters
    ----------
    model, robot, srdf
        As for :func:`find_grippers`.
    hand
        Frame of the hand, or one of its fingers.

    Raises
    ------
    UnknownNameError
        If the robot has no gripper, or none at this frame; the message lists the grippers.
    """
    raise NotImplementedError
