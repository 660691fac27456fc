"""Which other observations fit what was identified from some: they say how far it goes, too."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from kineverse.estimation.identification.beside import beside, squared_errors
from kineverse.estimation.identification.fit import Fit
from kineverse.estimation.identification.observations import Observations
from kineverse.estimation.identification.outlying import Rows

# χ² of six numbers that is exceeded once in a thousand.
_LIKELY = 22.5


def explained(fit: Fit, seen: Observations, used: Rows) -> tuple[Rows, Fit]:
    """Return which observations a fit to some of them explains, and the fit with their joint values.

    Parameters
    ----------
    fit
        Of the observations ``used``.
    seen
        All observations.
    used
        The numbers of those of the fit.

    Returns
    -------
    rows, fit
        The numbers of other observations that are explained, followed by those of the fit.
    """
    others = np.setdiff1d(np.arange(len(seen)), used)
    if not len(others) or not fit.motion.joints:
        return used, fit
    solution = beside(fit.motion, fit.joint_values, seen.at(others))
    fits = squared_errors(solution) < _LIKELY
    values = np.concatenate([solution.values[fits], fit.joint_values])
    return np.concatenate([others[fits], used]), replace(fit, joint_values=values)
