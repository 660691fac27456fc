"""Configurations of an arm along a way, as rows: the one at a share of it, and the time that all take."""

from __future__ import annotations

import numpy as np

from kineverse.lie import Array


def find_least_time(rows: Array, speeds: Array) -> float:
    """Return the least time [s] in which a robot passes configurations (L, n) evenly.

    Parameters
    ----------
    rows
        Configurations (L, n).
    speeds
        Largest speeds (n,) of the coordinates [m/s], [rad/s].
    """
    slowest = (np.abs(np.diff(rows, axis=0)) / speeds).max(initial=0.0)
    return float(slowest) * (len(rows) - 1)


def row_at(rows: Array, share: float) -> Array:
    """Return the configuration (n,) at a share of the way along some (K, n)."""
    place = share * (len(rows) - 1)
    k = min(max(int(place), 0), max(len(rows) - 2, 0))
    rest = min(max(place - k, 0.0), 1.0)
    found = (1.0 - rest) * rows[k] + rest * rows[min(k + 1, len(rows) - 1)]
    return np.asarray(found)
