"""Which earlier observations fit what was identified later: they say how far it goes, too."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import numpy.typing as npt

from kineverse.estimation.identification.fit import Fit
from kineverse.estimation.identification.motion import Linear, Motion, Prior
from kineverse.estimation.identification.observations import Observations
from kineverse.estimation.identification.rigid import Array
from kineverse.estimation.identification.solving import solve

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


def explained(fit: Fit, seen: Observations, first: int) -> tuple[npt.NDArray[np.int_], Fit]:
    """Return which observations a fit to those from one on explains, and the fit with their joint values.

    Parameters
    ----------
    fit
        Of the observations from ``first`` on.
    seen
        All observations.
    first
        Where those of the fit begin.

    Returns
    -------
    rows, fit
        The numbers of earlier observations that are explained, followed by those of the fit.
    """
    late = np.arange(first, len(seen))
    if not first or not fit.motion.joints:
        return late, fit
    relative, poses = seen.relative[:first], fit.poses
    apart = np.sum((relative[:, None] - poses[None])[:, :, :3] ** 2, axis=(2, 3))
    before = Observations(
        seen.parent[:first],
        seen.child[:first],
        None if seen.parent_covariance is None else seen.parent_covariance[:first],
        seen.child_covariance[:first],
    )
    solution = solve(before, Known(fit.motion), fit.joint_values[np.argmin(apart, axis=1)])
    weighted = np.linalg.solve(solution.covariance, solution.residuals[:, :, None])[:, :, 0]
    rows = np.flatnonzero(np.sum(solution.residuals * weighted, axis=1) < _LIKELY)
    values = np.concatenate([solution.values[rows], fit.joint_values])
    return np.concatenate([rows, late]), replace(fit, joint_values=values)
