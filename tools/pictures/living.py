"""The picture of the scene that lives: both kitchens after a while, and the axis that was learned."""

from __future__ import annotations

import numpy as np
from living_kitchen.picture import picture
from living_kitchen.simulation import Life


def drawn() -> np.ndarray:
    """Return the picture, (height, width, 3) bytes."""
    life = Life()
    for _ in range(156):
        life.step(1.0 / 12.0)
    return picture(life, (480, 240))
