"""Picture of the living kitchen: truth and estimate after a while, and the identified axis."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).resolve().parents[2] / "examples"))

from living_kitchen.picture import picture
from living_kitchen.simulation import Simulation


def draw_living_kitchen() -> np.ndarray:
    """Return the picture, (height, width, 3) bytes."""
    simulation = Simulation()
    for _ in range(156):
        simulation.step(1.0 / 12.0)
    return picture(simulation, (480, 240))
