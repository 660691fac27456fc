"""Motion planning for any model (layer 5); needs a C compiler."""

from .path import Path
from .planner import Planner

__all__ = ["Path", "Planner"]
