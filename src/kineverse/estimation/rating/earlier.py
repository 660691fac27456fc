"""Which other observations fit what was identified from some: they say how far it goes, too."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self, TypeAlias

import numpy as np
import numpy.typing as npt

from kineverse.estimation.identification.fit import Fit
from kineverse.estimation.identification.motion import Linear, Motion, Prior
from kineverse.estimation.identification.observations import Observations
from kineverse.estimation.identification.rigid import Array
from kineverse.estimation.identification.solving import Solution, solve

Rows: TypeAlias = "npt.NDArray[np.int_]"

# χ² of six numbers that is exceeded once in a thousand.
_LIKELY = 22.5


@dataclass(frozen=True)
class Known:
    """A member of a family whose parameters are known by now."""

    motion: Motion

    size = 0

    @property
    def joints(self) -> int:
        """The number of joint values."""
        return self.motion.joints

    def at(self, values: Array) -> Linear:
        """Return the poses at joint values (N, k)."""
        linear = self.motion.at(values)
        return linear._replace(by_parameters=np.zeros((*linear.by_joints.shape[:2], 0)))

    def moved(self, step: Array) -> Self:
        """Return itself: there are no parameters."""
        return self

    def bounded(self, values: Array, step: Array) -> Array:
        """Return joint values after a step."""
        return self.motion.bounded(values, step)

    def prior(self) -> Prior:
        """Return that nothing is believed beforehand."""
        return Prior(np.zeros(0), np.zeros((0, 0)))


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
    solution = beside(fit, seen.at(others))
    fits = squared_errors(solution) < _LIKELY
    values = np.concatenate([solution.values[fits], fit.joint_values])
    return np.concatenate([others[fits], used]), replace(fit, joint_values=values)


def beside(fit: Fit, seen: Observations) -> Solution[Known]:
    """Return the most likely joint values of a fit at observations that it need not be made of."""
    apart = np.sum((seen.relative[:, None] - fit.poses[None])[:, :, :3] ** 2, axis=(2, 3))
    return solve(seen, Known(fit.motion), fit.joint_values[np.argmin(apart, axis=1)])


def squared_errors(solution: Solution[Known]) -> Array:
    """Return χ² of each observation, (N,)."""
    weighted = np.linalg.solve(solution.covariance, solution.residuals[:, :, None])[:, :, 0]
    squares: Array = np.sum(solution.residuals * weighted, axis=1)
    return squares
