"""How many of the observations of a recording say something of their own."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

# Of fewer rows correlations are not known, and fewer than these are never asked for.
_LOOKED_AT, _FEWEST = 20, 8


def independent_count(residuals: Array) -> int:
    """Return how many of the observations behind residuals (N, m), in order, are worth as much as all.

    What is left of a pose is often left of the next one too: a camera is filtered, a marker is bent. The
    integrated autocorrelation time τ = 1 + 2 Σ ρ_k says of how many rows each tells nothing new, and N / τ
    are left. The sum ends where ρ_k is no larger than by chance, and the slowest component counts.
    """
    count = len(residuals)
    if count <= _LOOKED_AT:
        return count
    slowest = max(_correlation_time(column) for column in residuals.T)
    return min(count, max(_FEWEST, round(count / slowest)))


def _correlation_time(errors: Array) -> float:
    middle = float(np.median(np.abs(errors)))
    if middle == 0.0:
        return 1.0
    # Three standard deviations: what is wrong altogether says nothing about the others.
    kept = np.clip(errors, -4.5 * middle, 4.5 * middle)
    kept = kept - kept.mean()
    variance = float(kept @ kept)
    if variance == 0.0:
        return 1.0
    time, chance = 1.0, 3.0 / math.sqrt(len(kept))
    for k in range(1, len(kept) // 3):
        alike = float(kept[:-k] @ kept[k:]) / variance
        if alike < chance:
            break
        time += 2.0 * alike
    return time
