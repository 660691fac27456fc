"""Detection of lost groups: those whose measurements refute the estimate in many updates in a row."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from kineverse.lie import Array

from .layout import Layout
from .residuals import Measurements
from .step import StepResult

Groups = npt.NDArray[np.bool_]

# Quantile of the standard normal distribution that is exceeded once in a million.
_QUANTILE = 4.753


@dataclass(frozen=True, eq=False)
class TrackLoss:
    """Refuted updates of each group."""

    refuted: npt.NDArray[np.int64]  # number of updates in a row that refute the estimate (groups,)
    is_lost: Groups  # True for each lost group (groups,)

    @staticmethod
    def none(count: int) -> TrackLoss:
        """Return the state of groups of which none is lost."""
        return TrackLoss(np.zeros(count, dtype=np.int64), np.zeros(count, dtype=bool))

    @cached_property
    def is_clear(self) -> bool:
        """True if no group is lost or refuted."""
        return not (self.refuted.any() or self.is_lost.any())

    def after(self, measured: Groups, refuted: Groups, lost_after: int) -> TrackLoss:
        """Return the state after an update with masks of measured and of refuted groups (groups,).

        A group that is lost stays lost until measurements agree with it.
        """
        count = np.where(measured, np.where(refuted, self.refuted + 1, 0), self.refuted)
        return TrackLoss(count, (self.is_lost | (count >= lost_after)) & (refuted | ~measured))

    def with_restarted(self, groups: Groups) -> TrackLoss:
        """Return the state after a restart of some groups; they stay lost."""
        return TrackLoss(np.where(groups, 0, self.refuted), self.is_lost)


def find_measured(layout: Layout, reading: Measurements) -> Groups:
    """Return True for each group that was measured (groups,)."""
    result = np.zeros(len(layout.groups), dtype=bool)
    result[np.array(layout.group_of)[reading.mask]] = True
    return result


def find_refuted(layout: Layout, reading: Measurements, result: StepResult, has_outliers: bool) -> Groups:
    """Return True for each group whose estimate an update refutes (groups,).

    With an outlier model, all measurements of the group are rejected. Without one, the normalised innovation
    squared exceeds its quantile of one in a million.
    """
    if has_outliers and not result.outliers:
        return np.zeros(len(layout.groups), dtype=bool)
    if not has_outliers:
        # The quantile of any number of degrees of freedom is beyond this.
        if not (result.nis > result.dof + 20.0).any():
            return np.zeros(len(layout.groups), dtype=bool)
        return np.asarray(result.nis > chi_squared_quantile(result.dof))
    kept = reading.mask.copy()
    kept[list(result.outliers)] = False
    measured = find_measured(layout, reading)
    measured[np.array(layout.group_of)[kept]] = False
    return measured


def chi_squared_quantile(dof: Array) -> Array:
    """Return the quantiles of χ² that are exceeded once in a million, for degrees of freedom (n,).

    Wilson and Hilferty, The distribution of chi-square, 1931.
    """
    variance = 2.0 / (9.0 * np.maximum(dof, 1.0))
    return np.asarray(dof * (1.0 - variance + _QUANTILE * np.sqrt(variance)) ** 3)
