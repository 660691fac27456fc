"""Grasping: grippers, handles, and grasps of handles (layer 5)."""

from .gripper import Gripper, find_gripper, find_grippers

__all__ = ["Gripper", "find_gripper", "find_grippers"]
