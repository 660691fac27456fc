"""Volume of a union of spheres."""

from __future__ import annotations

import numpy as np

from kineverse.geometry.mesh_files import Floats

_COLUMNS = 96


def union_volume(centres: Floats, radii: Floats) -> float:
    """Return the volume of the union of spheres, (N, 3) and (N,) [m], to a few parts in a thousand [m³].

    The union of the spheres' sections with each of many vertical lines is exact.
    """
    low, high = (centres - radii[:, None]).min(axis=0), (centres + radii[:, None]).max(axis=0)
    steps = (high - low)[:2] / _COLUMNS
    ticks = [low[k] + steps[k] * (np.arange(_COLUMNS) + 0.5) for k in (0, 1)]
    x, y = (grid.reshape(-1, 1) for grid in np.meshgrid(*ticks, indexing="ij"))
    square = radii**2 - (x - centres[:, 0]) ** 2 - (y - centres[:, 1]) ** 2
    half = np.sqrt(np.maximum(square, 0.0))
    # Spheres that a line misses have sections of no length.
    order = (centres[:, 2] - half).argsort(axis=1)
    begin = np.take_along_axis(centres[:, 2] - half, order, axis=1)
    end = np.take_along_axis(centres[:, 2] + half, order, axis=1)
    reached = np.maximum.accumulate(end, axis=1)
    begin[:, 1:] = np.maximum(begin[:, 1:], reached[:, :-1])
    return float(np.maximum(end - begin, 0.0).sum() * steps.prod())
