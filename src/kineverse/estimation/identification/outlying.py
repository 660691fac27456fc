"""Which observations a fit does not explain: they are wrong altogether, or it is."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from kineverse.estimation.tracking.outliers import Outliers

from .fit import Fit
from .observations import Observations
from .pairs import covariance_of
from .rigid import Array


def outlying(fit: Fit, seen: Observations, outliers: Outliers | None = None) -> npt.NDArray[np.int_]:
    """Return the numbers of the observations that are wrong, more probably than not, if a fit is right.

    Parameters
    ----------
    fit
        Of these observations.
    seen
        Poses or positions, with the covariances that they have.
    outliers
        How often observations are wrong, and where they are then; the usual ones if None.
    """
    covariance = covariance_of(seen, fit)
    weighted = np.linalg.solve(covariance, fit.residuals[:, :, None])[:, :, 0]
    squares = np.sum(fit.residuals * weighted, axis=1)
    log_scale = 0.5 * np.linalg.slogdet(2.0 * np.pi * covariance)[1]
    wrong: npt.NDArray[np.int_] = np.flatnonzero(
        ~is_right(squares, log_scale, outliers or Outliers(), seen.rows)
    )
    return wrong


def is_right(squares: Array, log_scale: Array, outliers: Outliers, rows: int = 6) -> npt.NDArray[np.bool_]:
    """Return which observations are more probable to be right than wrong.

    Parameters
    ----------
    squares, log_scale
        Of whitened errors, and ½ log |2πS| of their covariances, (N,).
    outliers
        How often they are wrong, and where they are then.
    rows
        6 for poses, 3 for positions.
    """
    anywhere = outliers.log_anywhere if rows == 6 else -3.0 * math.log(outliers.reach)
    right: npt.NDArray[np.bool_] = (
        math.log(1.0 - outliers.fraction) - 0.5 * squares - log_scale > math.log(outliers.fraction) + anywhere
    )
    return right
