"""Which observations are wrong altogether: looked for before an articulation is compared with others."""

from __future__ import annotations

import math

import numpy as np

from kineverse.estimation.identification.outlying import Rows, is_right
from kineverse.estimation.tracking.outliers import Outliers

from .misfit import Misfit


def credible(left: Misfit, outliers: Outliers | None) -> Rows:
    """Return the numbers of the observations that are right if the articulation is as served."""
    everything = np.arange(len(left))
    if outliers is None or not len(left):
        return everything
    squares = np.sum(left.normal**2, axis=1)
    if left.against.size:
        squares = squares + np.fmax(left.against, 0.0).max(axis=1) ** 2
    log_scale = left.log_scale + 0.5 * np.linalg.slogdet(2.0 * np.pi * left.covariances)[1]
    right = everything[is_right(squares, log_scale, outliers)]
    # More than chance makes of their fraction are no outliers, but something that is not understood.
    expected = outliers.fraction * len(left)
    usual = len(left) - len(right) <= expected + 2.0 * math.sqrt(expected)
    return right if usual else everything
