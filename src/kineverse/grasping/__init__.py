"""Grasping: grippers, handles, and grasps of handles (layer 5)."""

from typing import TYPE_CHECKING

from kineverse._lazy import lazy_face

if TYPE_CHECKING:
    from .grasp_sampling import Grasp as Grasp, sample_grasps as sample_grasps
    from .gripper_detection import (
        Gripper as Gripper,
        find_gripper as find_gripper,
        find_grippers as find_grippers,
    )
    from .handles import Handle as Handle, find_handle as find_handle, find_handles as find_handles

lazy_face(__name__)
