"""Trajectories: paths with times, within limits of speed and acceleration."""

from .blends import BlendedPath, round_corners
from .kinematic_limits import MotionLimits, motion_limits
from .time_parameterization import time_parameterize
from .trajectory import Trajectory, TrajectoryFollower

__all__ = [
    "BlendedPath",
    "MotionLimits",
    "Trajectory",
    "TrajectoryFollower",
    "motion_limits",
    "round_corners",
    "time_parameterize",
]
