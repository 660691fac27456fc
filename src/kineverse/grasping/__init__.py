"""Grasping: grippers, handles, and grasps of handles (layer 5)."""

from .grasp_sampling import Grasp, sample_grasps
from .gripper_detection import Gripper, find_gripper, find_grippers
from .handles import Handle, find_handle, find_handles

__all__ = [
    "Grasp",
    "Gripper",
    "Handle",
    "find_gripper",
    "find_grippers",
    "find_handle",
    "find_handles",
    "sample_grasps",
]
