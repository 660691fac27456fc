"""Estimated state with covariance and confidence, track loss, and recently measured poses."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType

import numpy as np
import numpy.typing as npt

from kineverse._names import answer_foreign_names
from kineverse._rich_display import html_table
from kineverse._synonyms import ESTIMATE_SYNONYMS
from kineverse.compilation import compile
from kineverse.estimation.linear_algebra import inverse_spd
from kineverse.lie import Array
from kineverse.model.frame import WORLD
from kineverse.model.model_view import ModelView
from kineverse.state import State, StateLike
from kineverse.symbols import Symbol

from .gaussian_sum_filter import GaussianSum, StepResult, UpdateStep
from .process_model import Speeds
from .residuals import Measurements
from .speed_process import Residual, SpeedValue
from .state_space import Layout

Groups = npt.NDArray[np.bool_]
_AGREEING = 2  # updates in a row that end a loss; a single one may agree by chance
_QUANTILE = 4.753  # quantile of the standard normal distribution that is exceeded once in a million


@dataclass(frozen=True, eq=False)
class Step:
    """Prediction to a time, or update by measurements at it."""

    stamp: float | None  # [s]; None for the present time
    reading: Measurements | None = None  # None for a prediction
    speeds: Mapping[str, SpeedValue] = field(default_factory=dict)  # measured speeds
    inputs: StateLike | None = None  # the last ones if None
    commands: Speeds = field(default_factory=dict)
    noise: Speeds = field(default_factory=dict)  # process noise of this step alone


@dataclass(frozen=True, eq=False)
class TrackLoss:
    """Rejected measurements and refuted updates in a row."""

    rejected: npt.NDArray[np.int64]  # number of times in a row that each observation was rejected (m,)
    refuted: npt.NDArray[np.int64]  # updates in a row that refute a group, less those that agree (groups,)
    is_lost: Groups  # True for each lost group (groups,)

    @cached_property
    def is_clear(self) -> bool:
        """True if nothing was rejected, refuted or lost: then an update that agrees changes nothing."""
        return not (self.rejected.any() or (self.refuted > 0).any() or self.is_lost.any())

    def after(
        self, layout: Layout, reading: Measurements, outliers: Sequence[int], refuted: Groups, lost_after: int
    ) -> TrackLoss:
        """Return the state after an update; a lost group stays lost until two in a row agree with it."""
        if self.is_clear and not outliers and not refuted.any():
            return self
        rejected, measured = self.rejected, find_measured(layout, reading)
        if outliers or rejected.any():
            rejected = np.where(reading.mask, 0, rejected)
            rejected[list(outliers)] = self.rejected[list(outliers)] + 1
        count = np.where(refuted, np.maximum(self.refuted, 0) + 1, np.minimum(self.refuted, 0) - 1)
        count = np.where(measured, count, self.refuted)
        is_lost = (self.is_lost & (count > -_AGREEING)) | (count >= lost_after)
        return TrackLoss(rejected, count, is_lost)

    def find_due(self, layout: Layout, outliers: Sequence[int], lost_after: int) -> Groups:
        """Return True for each group that may have moved, since it contradicts the latest looks (groups,).

        A second rejection in a row is hardly an error again. Later ones are tried less often.
        """
        result = np.zeros(len(layout.groups), dtype=bool)
        for i in outliers:
            count = int(self.rejected[i])
            result[layout.group_of[i]] |= count % (2 if count < lost_after else lost_after) == 0
        return result


def find_measured(layout: Layout, reading: Measurements) -> Groups:
    """Return True for each group that was measured (groups,)."""
    result = np.zeros(len(layout.groups), dtype=bool)
    result[np.array(layout.group_of)[reading.mask]] = True
    return result


def find_refuted(layout: Layout, reading: Measurements, result: StepResult, has_outliers: bool) -> Groups:
    """Return True for each group without an accepted measurement, or with an extreme NIS (groups,)."""
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
    """Return the quantiles of χ² exceeded once in a million (n,) (Wilson and Hilferty 1931)."""
    variance = 2.0 / (9.0 * np.maximum(dof, 1.0))
    return np.asarray(dof * (1.0 - variance + _QUANTILE * np.sqrt(variance)) ** 3)


@dataclass(frozen=True, eq=False)
class TrackerState:
    """State of a tracker between two steps."""

    mixture: GaussianSum
    result: StepResult  # of the last update
    loss: TrackLoss
    inputs: Array
    stamp: float | None = None  # time [s]; None if unknown
    reading: Measurements | None = None  # latest measurements of this time, of each observation
    outliers: tuple[str, ...] = ()  # names of measurements that the last update rejected
    residuals: Callable[[], dict[str, Residual]] = dict  # of the last update


@answer_foreign_names("An estimate", ESTIMATE_SYNONYMS)
class Estimate:
    """MAP estimate of the state inside the limits, with its uncertainty.

    Parameters
    ----------
    now, update_step
        State and components of the tracker.

    Attributes
    ----------
    nis, dof
        Normalised innovation squared of the inliers of the last update, and its degrees of freedom. It is χ²
        distributed if the noise is as the covariances say.
    rounds
        Number of model evaluations; at 50 the iteration stopped without convergence.
    stamp
        Time [s]; None if unknown.

    See Also
    --------
    kineverse.estimation.Tracker
    """

    def __init__(self, now: TrackerState, update_step: UpdateStep) -> None:
        self._mixture, self._belief, self._loss = now.mixture, now.mixture.best, now.loss
        self._inputs, self._outliers = now.inputs, now.outliers
        self._residuals = now.residuals
        self._update_step, self._layout = update_step, update_step.layout
        self.nis, self.dof = float(now.result.nis.sum()), int(now.result.dof.sum())
        self.rounds, self.stamp = now.result.rounds, now.stamp

    @cached_property
    def state(self) -> State:
        """Most probable state inside the limits, with its speeds if they are estimated."""
        values = dict(zip(self._layout.tangent_space.coordinates, self._belief.x.tolist(), strict=True))
        return State({**values, **self.speeds}, stamp=self.stamp, source="tracker")

    @cached_property
    def speeds(self) -> Mapping[Symbol, float]:
        """Speeds by symbol [m/s], [rad/s]; empty if none are estimated."""
        result: dict[Symbol, float] = {}
        if (velocity := self._update_step.velocity) is not None:
            for number in velocity.groups:
                means = velocity.at_state(number, self._belief, self._inputs).mean.tolist()
                result |= zip(self._update_step.process_model.speeds_of(number), means, strict=True)
        return MappingProxyType(result)

    @cached_property
    def speed_covariance(self) -> Array:
        """Covariance of :attr:`speeds`, in their order (k, k) [m²/s²], [rad²/s²]."""
        blocks = [np.zeros((0, 0))]
        if (velocity := self._update_step.velocity) is not None:
            for number in velocity.groups:
                state = self.covariance[self._layout.groups[number].block]
                blocks.append(velocity.covariance(number, self._belief, self._inputs, state))
        size = sum(map(len, blocks))
        result, at = np.zeros((size, size)), 0
        for block in blocks:
            result[at : at + len(block), at : at + len(block)] = block
            at += len(block)
        return result

    @property
    def lost(self) -> bool:
        """True if measurements refute the estimate of some coordinates, in many updates in a row."""
        return bool(self._loss.is_lost.any())

    @property
    def lost_groups(self) -> tuple[tuple[Symbol, ...], ...]:
        """Groups of coordinates that are lost."""
        return self._groups_where(self._loss.is_lost.tolist())

    @property
    def refuted_groups(self) -> tuple[tuple[Symbol, ...], ...]:
        """Groups of coordinates whose prediction the last update refuted, be it a move or an error.

        After ``lost_after`` such updates in a row, the group is lost.
        """
        return self._groups_where((self._loss.refuted > 0).tolist())

    def _groups_where(self, mask: list[bool]) -> tuple[tuple[Symbol, ...], ...]:
        pairs = zip(self._layout.groups, mask, strict=True)
        return tuple(group.coordinates for group, holds in pairs if holds)

    @property
    def outliers(self) -> tuple[str, ...]:
        """Names of the measurements classified as outliers in the last update."""
        return self._outliers

    @cached_property
    def residuals(self) -> Mapping[str, Residual]:
        """Residual of each measurement of the last update, by name: measured minus predicted.

        ``residuals[name]`` has its ``value``, its ``covariance``, its normalised square ``nis``, and
        ``is_outlier``.
        """
        return MappingProxyType(self._residuals())

    @property
    def tangent(self) -> tuple[Symbol, ...]:
        """Directions of the rows and columns of the covariance, as speeds."""
        return self._layout.tangent_space.tangent

    @cached_property
    def information(self) -> Array:
        """Inverse of the covariance."""
        return inverse_spd(self.covariance)

    @cached_property
    def covariance(self) -> Array:
        """Covariance of the Gaussian, not truncated at limits, in the tangent space (t, t) [m²], [rad²]."""
        result = np.zeros_like(self._belief.information)
        for number, group in enumerate(self._layout.groups):
            block = self._update_step.ridge_covariance.compute(number, self._belief)
            if (velocity := self._update_step.velocity) is not None:
                block = block + velocity.free_variance(number, self._belief) * np.eye(len(block))
            result[group.block] = block
        return result

    @cached_property
    def mean(self) -> Array:
        """Mean of the Gaussian, not truncated at limits, as a tangent step from the state (t,)."""
        result = np.zeros_like(self._belief.vector)
        for group in self._layout.groups:
            information = self._belief.information[group.block]
            result[group.t] = inverse_spd(information) @ self._belief.vector[group.t]
        return result

    @cached_property
    def deviation(self) -> Mapping[Symbol | str, float]:
        """Standard deviation of each coordinate and estimated speed, by symbol and by name.

        It belongs to the Gaussian that is not truncated at limits. At a limit the state varies by less.
        """
        result: dict[Symbol | str, float] = {}
        for number, group in enumerate(self._layout.groups):
            basis = self._update_step.process_model.basis(number, self._belief.x[group.x], self._inputs)
            variances = np.einsum("ij,jk,ik->i", basis, self.covariance[group.block], basis)
            for x, variance in zip(group.coordinates, variances.tolist(), strict=True):
                result[x] = result[str(x)] = float(np.sqrt(variance))
        for v, variance in zip(self.speeds, np.diag(self.speed_covariance).tolist(), strict=True):
            result[v] = result[str(v)] = float(np.sqrt(variance))
        return MappingProxyType(result)

    @cached_property
    def confidence(self) -> Mapping[tuple[Symbol, ...], float]:
        """Probability of each group's best component among those of the Gaussian sum; 0 if it is lost."""
        result = {}
        for number, group in enumerate(self._layout.groups):
            evidence = self._mixture.evidence(number)
            best = float(np.exp(evidence[0] - np.logaddexp.reduce(evidence)))
            result[group.coordinates] = 0.0 if self._loss.is_lost[number] else best
        return MappingProxyType(result)

    @cached_property
    def log_evidence(self) -> float:
        """Log density of all measurements so far."""
        return self._mixture.log_evidence

    def __repr__(self) -> str:
        at = "" if self.stamp is None else f" at {self.stamp:g} s"
        values = ", ".join(f"{s}={value:.4g}±{self.deviation[s]:.2g}" for s, value in self.state.items())
        return f"<Estimate{at}: {values}{', lost' if self.lost else ''}>"

    def _repr_html_(self) -> str:
        rows = [(str(s), f"{value:.4g}", f"{self.deviation[s]:.2g}") for s, value in self.state.items()]
        at = "" if self.stamp is None else f" at {self.stamp:g} s"
        caption = f"estimate{at}{', lost' if self.lost else ''}"
        return html_table(caption, ("coordinate", "value", "standard deviation"), rows)


@dataclass(frozen=True, eq=False)
class RecentPoses:
    """Poses of frames that one observer measured."""

    relative_to: str  # name of the observing frame
    poses: Mapping[str, Array]  # poses by name of the frame (N, 4, 4), in order; NaN where missing
    covariances: Mapping[str, Array]  # (6, 6), (N, 6, 6)
    times: Array | None  # (N,) [s]; None if they have none


def collect_recent_poses(model: ModelView, layout: Layout, updates: Sequence[Step]) -> RecentPoses:
    """Return the poses of updates with their times, of the first observer among the observations."""
    poses = {i: one for i, one in enumerate(layout.observations) if one.is_pose}
    observer = next((one.relative_to for one in poses.values()), "")
    has_times = all(one.stamp is not None for one in updates)
    stamps = [one.stamp if has_times else k for k, one in enumerate(updates)]
    # Updates at one time are one row.
    times, rows = np.unique(np.array(stamps, dtype=float), return_inverse=True)
    measured, covariances = {}, {}
    inputs = np.zeros((len(times), len(layout.inputs)))
    for row, update in zip(rows.tolist(), updates, strict=True):
        known = State(update.inputs or {})
        inputs[row] = [known[s] for s in layout.inputs]
    for i, one in poses.items():
        if one.relative_to == observer:
            measured[one.frame] = np.full((len(times), 4, 4), np.nan)
            weights = []
            for row, update in zip(rows.tolist(), updates, strict=True):
                if (reading := update.reading) is not None and reading.mask[i]:
                    measured[one.frame][row] = reading.values[layout.measurement_slices[i]].reshape(4, 4)
                    weights.append(reading.whitening[layout.whitening_slices[i]].reshape(6, 6))
            white: Array = np.array(weights).reshape(-1, 6, 6)
            each = np.linalg.inv(white.transpose(0, 2, 1) @ white)
            mean = each.mean(axis=0) if weights else one.covariance
            if one.is_stated or not np.allclose(mean, one.covariance, rtol=1e-9):
                covariances[one.frame] = mean
    if observer in model.frames and len(times):
        place = model.fk(observer)
        if place.symbols and {*place.symbols} <= {*layout.inputs}:
            # No joint between an observer that moves and a part could be tested.
            places = compile(place, layout.inputs).batch(inputs)
            turns = np.zeros((len(times), 6, 6))
            turns[:, :3, :3] = turns[:, 3:, 3:] = places[:, :3, :3]
            measured = {name: places @ track for name, track in measured.items()}
            covariances = {name: turns @ one @ turns.mT for name, one in covariances.items()}
            observer = WORLD
    return RecentPoses(observer, measured, covariances, times if has_times else None)
