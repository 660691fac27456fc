"""The picture of the scene that lives: both kitchens after a while, and the axis that was learned."""

from __future__ import annotations

import numpy as np
from living_kitchen.picture import picture
from living_kitchen.simulation import Simulation


def drawn() -> np.ndarray:
    """Return the picture, (height, width, 3) bytes."""
    simulation = Simulation()
    for _ in range(156):
        simulation.step(1.0 / 12.0)
    return picture(simulation, (480, 240))
