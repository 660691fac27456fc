"""Trajectories: paths with times, within limits of speed and acceleration."""

from typing import TYPE_CHECKING

from kineverse._lazy import lazy_face

if TYPE_CHECKING:
    from .blends import BlendedPath as BlendedPath, round_corners as round_corners
    from .kinematic_limits import MotionLimits as MotionLimits, motion_limits as motion_limits
    from .time_parameterization import time_parameterize as time_parameterize
    from .trajectory import Trajectory as Trajectory, TrajectoryFollower as TrajectoryFollower

lazy_face(__name__)
