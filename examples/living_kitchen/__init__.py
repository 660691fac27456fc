"""Demo scene: a kitchen in motion, tracked from noisy markers, and a joint that is identified.

:class:`.simulation.Simulation` is the scene in numbers: true motion, readings, estimates. It is drawn by
:mod:`.picture` without a browser and by :mod:`.page` in one.
"""

from __future__ import annotations

from .sensor import SensorModel
from .simulation import Simulation

__all__ = ["SensorModel", "Simulation"]
