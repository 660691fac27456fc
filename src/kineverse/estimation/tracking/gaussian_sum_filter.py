"""Gaussian sums of beliefs: components, their pruning and merging, and one update of all of them.

Each group has its own components. They are kept until the evidence of one exceeds that of the others by far
(Alspach and Sorenson, Nonlinear Bayesian estimation using Gaussian sum approximations, 1972). Mirror images
predict the same measurements from different states and stay apart.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from kineverse.errors import InvalidValueError, KineverseError
from kineverse.estimation.noise import Outliers
from kineverse.lie import Array
from kineverse.symbols import Symbol

from .bounds import StateBounds
from .map_update import Loss, MapResult, MapSolver
from .native import NativeMapSolver, native_library
from .observability import (
    RidgeCovariance,
    StaticBatch,
    UnobservableDirections,
    find_unexplained,
    restart_states,
    turned_states,
    turning_coordinates,
)
from .process_model import ProcessModel, Speeds
from .residuals import MeasurementReader, Measurements, Residuals
from .speed_process import SpeedProcess
from .state_space import InformationState, Layout

MOST_COMPONENTS = 8  # largest number of components of a group

PRUNING_LOG_RATIO = 15.0
"""Components whose log evidence is lower than the best by more are pruned: one in three million."""


@dataclass(slots=True, eq=False)
class Candidate:
    """Candidate component for some groups."""

    belief: InformationState  # belief after the update
    weights: Array  # inlier weight of each observation
    nis: Array  # normalised innovation squared of each group
    dof: Array  # its degrees of freedom
    groups: Sequence[int]  # numbers of the groups


class GaussianSum:
    """Gaussian sum with independent components for each group, the best first."""

    def __init__(
        self, layout: Layout, beliefs: Sequence[InformationState], alive: npt.NDArray[np.bool_]
    ) -> None:
        self._layout = layout
        self.beliefs, self.alive = tuple(beliefs), alive

    @property
    def best(self) -> InformationState:
        """Best component of every group."""
        return self.beliefs[0]

    def groups(self, component: int, among: Iterable[int]) -> list[int]:
        """Return those of some groups that have a component."""
        return [number for number in among if self.alive[component, number]]

    def map(self, change: Callable[[InformationState], InformationState]) -> GaussianSum:
        """Apply a function to each component."""
        return self.with_beliefs([change(b) for b in self.beliefs])

    def with_beliefs(self, beliefs: Sequence[InformationState]) -> GaussianSum:
        """Return the same components with other beliefs."""
        return GaussianSum(self._layout, beliefs, self.alive)

    def evidence(self, number: int) -> Array:
        """Return the log evidence of the components of a group, the best first."""
        return np.array([belief.evidence[number] for belief in self.components(number)])

    @property
    def log_evidence(self) -> float:
        """Log evidence of all groups, summed over components."""
        count = len(self._layout.groups)
        return float(sum(np.logaddexp.reduce(self.evidence(number)) for number in range(count)))

    def select(
        self, candidates: Sequence[Candidate], step: UpdateStep, inputs: Array
    ) -> tuple[GaussianSum, list[Candidate | None]]:
        """Prune and merge candidates to new components; also return the best candidate of each group."""
        kept: list[list[InformationState]] = []
        best: list[Candidate | None] = []
        for number in range(len(self._layout.groups)):
            ranked = [c for c in candidates if number in c.groups]
            ranked.sort(key=lambda c: -float(c.belief.evidence[number]))
            chosen: list[Candidate] = []
            for one in ranked:
                deficit = ranked[0].belief.evidence[number] - one.belief.evidence[number]
                if deficit > PRUNING_LOG_RATIO or len(chosen) == MOST_COMPONENTS:
                    break
                if not any(_are_one(one.belief, other.belief, number, step, inputs) for other in chosen):
                    chosen.append(one)
            kept.append([c.belief for c in chosen] or self.components(number))
            best.append(chosen[0] if chosen else None)
        return self._assemble(kept), best

    def components(self, number: int) -> list[InformationState]:
        """Return the components of a group, the best first."""
        return [b for b, alive in zip(self.beliefs, self.alive, strict=True) if alive[number]]

    def replace_groups(self, other: GaussianSum, groups: Iterable[int]) -> GaussianSum:
        """Return this sum with the components of another one for some groups."""
        sources = [self] * len(self._layout.groups)
        for number in groups:
            sources[number] = other
        return self._assemble([source.components(number) for number, source in enumerate(sources)])

    def join(self, other: GaussianSum, chosen: npt.NDArray[np.bool_]) -> GaussianSum:
        """Return this sum with chosen components of another one (components, groups), if probable."""
        components = [self.components(number) for number in range(len(self._layout.groups))]
        for n in np.flatnonzero(chosen.any(axis=0)).tolist():
            more = [other.beliefs[k] for k in np.flatnonzero(chosen[:, n] & other.alive[:, n]).tolist()]
            ranked = sorted(components[n] + more, key=lambda b: -float(b.evidence[n]))
            least = ranked[0].evidence[n] - PRUNING_LOG_RATIO
            components[n] = [b for b in ranked if b.evidence[n] >= least][:MOST_COMPONENTS]
        return self._assemble(components)

    def _assemble(self, components: Sequence[Sequence[InformationState]]) -> GaussianSum:
        beliefs, alive = [], []
        for k in range(max(map(len, components))):
            belief = self.best.copy()
            for n, (group, of_group) in enumerate(zip(self._layout.groups, components, strict=True)):
                source = of_group[min(k, len(of_group) - 1)]
                belief.x[group.x], belief.vector[group.t] = source.x[group.x], source.vector[group.t]
                belief.information[group.block] = source.information[group.block]
                belief.evidence[n] = source.evidence[n]
                belief.records[n], belief.speeds[n] = source.records[n], source.speeds[n]
            beliefs.append(belief)
            alive.append([k < len(of_group) for of_group in components])
        return GaussianSum(self._layout, beliefs, np.array(alive))


# Candidates merge if their predictions differ by fewer deviations of the noise, and each coordinate of the
# state by fewer of its own.
_SAME_PREDICTION, _NEAR = 0.3, 3.0
_EQUAL = 1e-3  # states that differ by fewer deviations predict the same


def _are_one(
    one: InformationState, other: InformationState, number: int, step: UpdateStep, inputs: Array
) -> bool:
    """Return True if two beliefs predict the same measurements of a group from nearby states."""
    group, here = step.layout.groups[number], other.x[step.layout.groups[number].x]
    change = one.x[group.x] - here
    for k, x in enumerate(group.coordinates):
        if x in step.periods:
            change[k] = math.remainder(change[k], step.periods[x])
    # Between both states, to first order.
    between = (
        np.linalg.pinv(step.process_model.basis(number, here, inputs)) @ change if group.by_speeds else change
    )
    squared = float(between @ other.information[group.block] @ between)
    if squared < _EQUAL**2 or squared >= _NEAR**2 * len(between):
        return squared < _EQUAL**2
    here, there = (step.residuals.evaluate(belief.x, inputs) for belief in (other, one))
    reading = step.reader.as_reading(here, group.observation_indices)
    errors = step.residuals.errors(there, reading, group.observation_indices)
    return all(float(e @ e) < _SAME_PREDICTION**2 for e, _ in errors.values())


@dataclass(slots=True, eq=False)
class StepResult:
    """Result of an update of all components."""

    mixture: GaussianSum  # gaussian sum after the update
    nis: Array  # normalised innovation squared of each group
    dof: Array  # its degrees of freedom, without rejected measurements
    outliers: tuple[int, ...]  # numbers of the observations with an inlier probability below one half
    rounds: int  # number of model evaluations, the largest of all candidates


_OUTSIDE = 1e-9
# With these odds a measurement is certainly an inlier, and a group has no other explanation.
_LOG_CERTAIN = math.log(1000.0)
_SETTLED = 1e-5  # a belief closer to its mean, in deviations, is about its mean, as after an update


class UpdateStep:
    """Prediction and update of all components of a tracker."""

    def __init__(self, layout: Layout, limits: StateBounds, outliers: Outliers | None) -> None:
        self.layout, self.limits, self.outliers = layout, limits, outliers
        self._group_of, self._all_groups = np.array(layout.group_of), list(range(len(layout.groups)))
        self.function = layout.compile_function()
        self.process_model = ProcessModel(layout)
        self.velocity: SpeedProcess | None = None
        self.residuals = Residuals(layout, self.function)
        self.reader = MeasurementReader(layout)
        self.solver = MapSolver(layout, self.residuals, self.process_model, limits, outliers)
        suits = NativeMapSolver.suits(layout)
        self.native = NativeMapSolver(self.solver, self.function) if suits else None
        self.unobservable = UnobservableDirections(layout)
        self.static_batch, self.ridge_covariance = StaticBatch(self), RidgeCovariance(self)
        self.periods: Mapping[Symbol, float] = {}
        if self.native:
            native_library.prepare()

    @property
    def is_native(self) -> bool:
        """True if updates run in compiled C."""
        return self.native is not None and self.native.is_ready

    @property
    def periodic(self) -> frozenset[Symbol]:
        """Coordinates of which a single turn changes no observation."""
        return frozenset(x for x, period in self.periods.items() if period == math.tau)

    def update(self, mixture: GaussianSum, reading: Measurements, inputs: Array) -> StepResult:
        """Update all components with a reading; see :meth:`.map_update.MapSolver.update`."""
        result = self._update(mixture, reading, inputs)
        self._keep_turns(result.mixture, mixture.best.x)
        return result

    def _update(self, mixture: GaussianSum, reading: Measurements, inputs: Array) -> StepResult:
        mixture = self._forget_other_inputs(mixture, inputs)
        measured = self._measured_groups(reading)
        candidates, rounds = self._solve_unambiguous(mixture, reading, inputs, measured)
        settled = candidates[0].groups if candidates else ()
        if len(mixture.beliefs) == 1 and len(settled) == len(measured) and candidates:
            one, alive = candidates[0], mixture.alive
            return StepResult(GaussianSum(self.layout, [one.belief], alive), one.nis, one.dof, (), rounds)
        remaining = [number for number in measured if number not in settled]
        for component, belief in enumerate(mixture.beliefs):
            groups = mixture.groups(component, remaining)
            if not groups:
                continue
            try:
                new, count = self._explain(belief, reading, inputs, groups, component == 0)
            except KineverseError:
                # The best component must succeed; others that fail are dropped.
                if component == 0:
                    raise
                continue
            candidates += new
            rounds = max(rounds, count)
        after, best = mixture.select(candidates, self, inputs)
        nis = np.array([c.nis[n] if c else 0.0 for n, c in enumerate(best)])
        dof = np.array([c.dof[n] if c else 0.0 for n, c in enumerate(best)])
        of_group = [(i, best[n]) for i, n in enumerate(self.layout.group_of) if reading.mask[i]]
        rejected = [i for i, candidate in of_group if candidate is not None and candidate.weights[i] < 0.5]
        return StepResult(after, nis, dof, tuple(rejected), rounds)

    def solve(
        self,
        belief: InformationState,
        reading: Measurements,
        inputs: Array,
        groups: list[int],
        loss: Loss = "gaussian",
    ) -> MapResult:
        """Update some groups of one component."""
        if self.native is not None and self.native.is_ready:
            if (result := self.native.update(belief, reading, inputs, groups, loss)) is not None:
                return result
        return self.solver.update(belief, reading, inputs, groups, loss)

    def _solve_unambiguous(
        self, mixture: GaussianSum, reading: Measurements, inputs: Array, groups: list[int]
    ) -> tuple[list[Candidate], int]:
        """Return the candidate of all groups for which there is only one, and the number of evaluations."""
        belief, single = mixture.best, groups
        if len(mixture.beliefs) > 1:
            count = mixture.alive.sum(axis=0)
            single = [number for number in groups if count[number] == 1]
        try:
            result = self.solve(belief, reading, inputs, single)
        except KineverseError:
            if self.outliers is None:
                raise
            return [], 0  # a gross error is too far away for least squares
        if self.outliers is None:
            # Other points of a group may explain what its residuals leave.
            beyond = find_unexplained(result)
            unobserved = self._find_unobserved(belief, result, beyond)
            ambiguous = {*unobserved, *(n for n in beyond if turning_coordinates(self, n))}
            settled = [n for n in single if n not in ambiguous] if ambiguous else single
        else:
            are_certain = self._are_inliers(belief, result, reading, self.outliers)
            settled = [number for number in single if are_certain[number]]
        return [self._relinearised(belief, result, reading, inputs, settled)], result.rounds

    def _are_inliers(
        self, before: InformationState, result: MapResult, reading: Measurements, outliers: Outliers
    ) -> npt.NDArray[np.bool_]:
        """Return True for each group whose measurements are certain inliers, and add this to its evidence."""
        log_inlier, log_outlier = math.log(1 - outliers.fraction), self.solver.outlier_densities(reading)
        is_doubtful = log_inlier - result.squares / 2 - log_outlier < _LOG_CERTAIN
        as_inliers, as_outliers, doubts = (
            np.bincount(self._group_of, np.where(reading.mask, each, 0.0), len(self.layout.groups))
            for each in (log_inlier, log_outlier - reading.log_scale, is_doubtful)
        )
        result.belief.evidence += as_inliers
        gained = result.belief.evidence - before.evidence
        return np.asarray((gained - as_outliers > _LOG_CERTAIN) & (doubts == 0))

    def _restart_from(
        self, start: InformationState, reading: Measurements, inputs: Array, groups: list[int]
    ) -> list[Candidate]:
        try:
            if self.outliers is None:
                result = self.solve(start, reading, inputs, groups)
            else:
                robust = self.solve(start, reading, inputs, groups, "cauchy").prior
                result = self.solve(robust, reading, inputs, groups, "mixture")
            candidate = self._relinearised(start, result, reading, inputs, groups)
        except KineverseError:
            return []
        kept = [n for n in groups if self.outliers is None and start.records[n] is not None]
        if kept:
            # The stored measurements belong to another branch: the present residuals decide.
            candidate.nis[kept] = 0.0
            measured = [i for i, n in enumerate(self.layout.group_of) if n in kept and reading.mask[i]]
            out = self.residuals.evaluate(candidate.belief.x, inputs)
            for i, (e, _) in self.residuals.errors(out, reading, measured).items():
                candidate.nis[self.layout.group_of[i]] += e @ e
        return [candidate]

    def _relinearised(
        self,
        old: InformationState,
        result: MapResult,
        reading: Measurements,
        inputs: Array,
        groups: list[int],
    ) -> Candidate:
        self.static_batch.relinearise(old, result, reading, inputs, groups)
        _require_finite(result.belief.numbers)
        return Candidate(result.belief, result.weights, result.nis, result.dof, groups)

    def _forget_other_inputs(self, mixture: GaussianSum, inputs: Array) -> GaussianSum:
        def changed(belief: InformationState) -> InformationState:
            records = [(n, record) for n, record in enumerate(belief.records) if record]
            return self._inflated(belief, [n for n, r in records if not np.array_equal(r.inputs, inputs)])

        return mixture.map(changed) if len(inputs) else mixture

    def _inflated(self, belief: InformationState, groups: Iterable[int]) -> InformationState:
        wide = belief
        for number in groups:
            if belief.records[number] is not None:
                wide = belief.copy() if wide is belief else wide
                self.ridge_covariance.inflate(number, wide)
        return wide

    def predict(
        self, belief: InformationState, inputs: Array, dt: float, speeds: Speeds, noise: Speeds
    ) -> InformationState:
        """Predict a belief by ``dt`` seconds; it stays about the most probable point inside the limits."""
        if self.velocity is not None:
            belief = self._predict_speeds(self.velocity, belief, inputs, dt, speeds, noise)
            if len(self.velocity.groups) == len(self.layout.groups):
                return belief
            estimated = {v for n in self.velocity.groups for v in self.process_model.speeds_of(n)}
            speeds = {v: speed for v, speed in speeds.items() if v not in estimated}
            noise = {v: q for v, q in noise.items() if v not in estimated}
        moving = self.process_model.find_moving_groups(speeds, noise)
        still = {*moving}.difference(self.process_model.find_moving_groups(speeds, {}))
        recorded = [n for n in still if belief.records[n] is not None]
        noise_only = [n for n in recorded if not self.process_model.is_carried(n)]
        belief = self._inflated(belief, set(moving).difference(noise_only))
        moved = None
        if self.native is not None and self.native.is_ready:
            tangent = self.layout.tangent_space.tangent
            motion = (np.array([by.get(v, 0.0) for v in tangent]) * dt for by in (speeds, noise))
            moved = self.native.predict(belief, *motion)
        if moved is None:
            moved = belief.copy()
            self.process_model.predict(moved, inputs, dt, speeds, noise)
            moved = self.constrained(moved, inputs)
        for number in noise_only:
            # A straight posterior is Gaussian; its prediction is exact.
            if self.ridge_covariance.is_straight(number, belief):
                moved.records[number] = None
                continue
            group = self.layout.groups[number]
            added_variance = np.array([noise.get(v, 0.0) for v in group.tangent]) * dt
            self.static_batch.add_noise(number, belief, moved, added_variance)
        _require_finite(moved.numbers)
        return moved

    def _predict_speeds(
        self,
        velocity: SpeedProcess,
        belief: InformationState,
        inputs: Array,
        dt: float,
        speeds: Speeds,
        noise: Speeds,
    ) -> InformationState:
        result = self._inflated(belief, velocity.groups).copy()
        velocity.periods = self.periods
        velocity.predict(result, inputs, dt, speeds, noise)
        moments = [m for one in result.speeds if one for m in (one.mean, one.gain, one.covariance)]
        _require_finite(result.numbers, *moments)
        result = self.constrained(result, inputs)
        _require_finite(result.numbers)
        return result

    def constrained(self, belief: InformationState, inputs: Array) -> InformationState:
        """Return the same belief about the most probable point inside the limits."""
        inside = np.clip(belief.x, self.limits.lower, self.limits.upper)
        if (beyond := np.flatnonzero(inside != belief.x)).size:
            # The model need not be finite beyond the bounds of coordinates.
            step, tangent_space = np.zeros(len(belief.vector)), self.layout.tangent_space
            for i in beyond.tolist():
                direction = tangent_space.tangent.index(tangent_space.coordinates[i].derivative())
                step[direction] = inside[i] - belief.x[i]
            belief = belief.copy()
            belief.vector -= belief.information @ step
            belief.x[:] = inside
        elif not self.layout.limits:
            if float(belief.vector @ np.linalg.solve(belief.information, belief.vector)) < _SETTLED**2:
                return belief
        return self.solve(belief, self.reader.empty(), inputs, self._all_groups).belief

    def is_possible(self, number: int, belief: InformationState, inputs: Array) -> bool:
        """Return True if a group is inside its limits at a state and its model is finite there."""
        try:
            out = self.residuals.evaluate(belief.x, inputs)
        except KineverseError:
            return False
        group = self.layout.groups[number]
        if not self.residuals.is_finite(out, group.observation_indices):
            return False
        return self.solver.group_bounds[number].rows(belief.x[group.x], out).violation < _OUTSIDE

    def _measured_groups(self, reading: Measurements) -> list[int]:
        if reading.mask.all():
            return self._all_groups
        counts = np.bincount(self._group_of[reading.mask], minlength=len(self.layout.groups))
        return list(np.flatnonzero(counts).tolist())

    def _keep_turns(self, mixture: GaussianSum, predicted: Array) -> None:
        """Take periodic coordinates to the turn nearest to their prediction (n,), in place."""
        for x, period in self.periods.items():
            i = self.layout.tangent_space.coordinates.index(x)
            for belief in mixture.beliefs:
                belief.x[i] -= period * round((belief.x[i] - predicted[i]) / period)

    def restart(
        self, old: GaussianSum, initial: GaussianSum, groups: list[int], reading: Measurements, inputs: Array
    ) -> StepResult:
        """Return the result of a reading of some groups that restart; they keep their evidence.

        With outliers, an unexpected motion is taken to be as probable as a gross error.
        """
        mask = reading.mask & np.isin(self.layout.group_of, groups)
        log_prior = math.log(self.outliers.fraction) if self.outliers else 0.0
        evidence = {n: log_prior + float(np.logaddexp.reduce(old.evidence(n))) for n in groups}

        def with_evidence(belief: InformationState) -> InformationState:
            result = belief.copy()
            for number, log in evidence.items():
                result.evidence[number] = log
            return result

        start = old.replace_groups(initial.map(with_evidence), groups)
        result = self.update(start, reading._replace(mask=mask), inputs)
        self._keep_turns(result.mixture, old.best.x)
        return result

    def find_accepted(
        self, mixture: GaussianSum, reading: Measurements, inputs: Array
    ) -> npt.NDArray[np.bool_]:
        """Return True where a component of a group accepts a measurement (components, groups)."""
        result = np.zeros((len(mixture.beliefs), len(self.layout.groups)), dtype=bool)
        assert self.outliers is not None
        for component, belief in enumerate(mixture.beliefs):
            groups = mixture.groups(component, self._measured_groups(reading))
            indices = [i for n in groups for i in self.layout.groups[n].observation_indices]
            out = self.residuals.evaluate(belief.x, inputs)
            for i, (error, _) in self.residuals.errors(out, reading, indices).items():
                scale = float(reading.log_scale[i])
                log_density = self.outliers.log_density(self.layout.observations[i], scale)
                weight, _ = self.outliers.weigh(float(error @ error), scale, log_density)
                result[component, self.layout.group_of[i]] |= weight > 0.5
        return result

    def _explain(
        self, belief: InformationState, reading: Measurements, inputs: Array, groups: list[int], is_best: bool
    ) -> tuple[list[Candidate], int]:
        """Return candidates for one component: without outliers, with outliers, and all outliers."""
        if self.outliers is None:
            results = [self.solve(belief, reading, inputs, groups)]
        else:
            robust = self.solve(belief, reading, inputs, groups, "cauchy").prior
            results = [self.solve(start, reading, inputs, groups, "mixture") for start in (belief, robust)]
        candidates = [self._relinearised(belief, result, reading, inputs, groups) for result in results]
        rounds, result = max(result.rounds for result in results), results[-1]
        if is_best:
            wrong = {*self._group_of[reading.mask & (result.weights < 0.5)].tolist()}
            rejected = [n for n in groups if n in wrong]
            beyond = find_unexplained(result)
            unexplained = {*self._find_unobserved(belief, result, beyond), *rejected}
            again = [n for n in groups if n in unexplained]
            starts = [(start, again) for start in restart_states(self, belief, result.belief, again, inputs)]
            turned = beyond if self.outliers is None else rejected
            starts += turned_states(self, belief, result.belief, reading, inputs, turned)
            candidates += itertools.chain.from_iterable(
                self._restart_from(start, reading, inputs, some) for start, some in starts
            )
        if self.outliers is None:
            return candidates, rounds
        all_outliers, none = belief.copy(), np.zeros(len(self.layout.groups))
        log_density = np.where(reading.mask, self.solver.outlier_densities(reading) - reading.log_scale, 0.0)
        for number in groups:
            all_outliers.evidence[number] += log_density[self._group_of == number].sum()
        candidates.append(Candidate(all_outliers, np.zeros(len(reading.mask)), none, none, groups))
        return candidates, rounds

    def _find_unobserved(
        self, before: InformationState, result: MapResult, groups: Iterable[int]
    ) -> list[int]:
        """Return those of some groups that have, or had, unobservable directions."""
        records, is_in = before.records, self.unobservable.is_in
        return [n for n in groups if records[n] is not None or is_in(n, result.belief)]


def _require_finite(*arrays: Array) -> None:
    if not all(np.isfinite(one).all() for one in arrays):
        raise InvalidValueError(
            "The step leads beyond floating point: measurements or covariances are too large or too small."
        )
