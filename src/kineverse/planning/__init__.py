"""Motion planning for any model (layer 5); needs a C compiler."""

from .manifold import FrameHold
from .modes import Mode
from .path import Path
from .planner import Planner
from .trajectories import (
    BlendedPath,
    MotionLimits,
    Trajectory,
    TrajectoryFollower,
    motion_limits,
    round_corners,
    time_parameterize,
)

__all__ = [
    "BlendedPath",
    "FrameHold",
    "Mode",
    "MotionLimits",
    "Path",
    "Planner",
    "Trajectory",
    "TrajectoryFollower",
    "motion_limits",
    "round_corners",
    "time_parameterize",
]
