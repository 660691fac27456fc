"""Motion planning (layer 5)."""

from .blends import BlendedPath, round_corners
from .time_parameterization import time_parameterize
from .trajectory import Trajectory

__all__ = ["BlendedPath", "Trajectory", "round_corners", "time_parameterize"]
