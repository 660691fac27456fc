"""Motion planning for any model (layer 5); needs a C compiler."""

from typing import TYPE_CHECKING

from kineverse._lazy import lazy_face

if TYPE_CHECKING:
    from .manifold import FrameHold as FrameHold
    from .modes import Mode as Mode
    from .path import Path as Path
    from .planner import Planner as Planner
    from .trajectories import (
        BlendedPath as BlendedPath,
        MotionLimits as MotionLimits,
        Trajectory as Trajectory,
        TrajectoryFollower as TrajectoryFollower,
        motion_limits as motion_limits,
        round_corners as round_corners,
        time_parameterize as time_parameterize,
    )

lazy_face(__name__)
