"""One prediction and update of all Gaussian-sum components."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt

from kineverse.errors import InvalidValueError, KineverseError
from kineverse.estimation.noise import Outliers
from kineverse.lie import Array
from kineverse.symbols import Symbol

from .bounds import StateBounds
from .covariance import CovarianceInflation, RidgeCovariance
from .gaussian_sum import Candidate, GaussianSum, MergeCriterion
from .information_state import InformationState
from .map_update import MapResult, MapSolver
from .native import NativeInlierSolver, NativeMapSolver, native_library
from .observability import (
    Components,
    StaticBatch,
    StationaryPoints,
    UnobservableDirections,
    find_unexplained,
    move_origin,
)
from .process_model import ProcessModel, Speeds
from .residuals import MeasurementReader, Measurements, Residuals
from .speed_process import SpeedProcess
from .state_space import Layout


@dataclass(slots=True, eq=False)
class StepResult:
    """Result of an update of all components."""

    mixture: GaussianSum  # gaussian sum after the update
    nis: Array  # normalised innovation squared of each group
    dof: Array  # its degrees of freedom, without rejected measurements
    outliers: tuple[int, ...]  # numbers of the observations with an inlier probability below one half
    rounds: int  # number of model evaluations, the largest of all candidates


_OUTSIDE = 1e-9
_SETTLED = 1e-5  # a belief closer to its mean, in deviations, is about its mean, as after an update


class UpdateStep:
    """Prediction and update of all components of a tracker."""

    def __init__(self, layout: Layout, limits: StateBounds, outliers: Outliers | None) -> None:
        self.layout, self.limits, self.outliers = layout, limits, outliers
        self.function = layout.compile_function()
        self.process_model = ProcessModel(layout)
        self.velocity: SpeedProcess | None = None
        self.residuals = Residuals(layout, self.function)
        self.reader = MeasurementReader(layout)
        self.solver = MapSolver(layout, self.residuals, self.process_model, limits)
        self.unobservable = UnobservableDirections(layout)
        shared = layout, self.residuals, self.process_model, self.reader
        components = Components(*shared, self.solver.group_bounds, self.unobservable)
        self.static_batch = StaticBatch(components, self.solver, self._map_update)
        self.ridge_covariance, self.inflation = RidgeCovariance(components), CovarianceInflation(components)
        self.merge_criterion = MergeCriterion(components, self.ridge_covariance)
        self.stationary_points = StationaryPoints(components)
        self.native = (
            NativeMapSolver(layout, limits, self.function, self.process_model)
            if NativeMapSolver.suits(layout)
            else None
        )
        self.inlier_solver = (
            NativeInlierSolver(layout, self.native, outliers) if self.native and outliers else None
        )
        self.periods: Mapping[Symbol, float] = {}
        self.counted: frozenset[Symbol] = frozenset()
        if self.native:
            native_library.prepare()

    @property
    def is_native(self) -> bool:
        """True if unambiguous updates run in compiled C."""
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
        if len(mixture.beliefs) > 1 or self.outliers is not None:
            return self._update_mixture(mixture, reading, inputs)
        before = mixture.best
        result = self._map_update(before, reading, inputs)
        self.static_batch.relinearise(before, result, reading, inputs)
        _require_finite(result.belief.numbers)
        after = GaussianSum(self.layout, [result.belief], mixture.alive)
        unexplained = self.stationary_points.unexplained(before, result)
        candidates = self._restart(before, result, reading, inputs, unexplained) if unexplained else []
        if self.counted and (turned := find_unexplained(result)):
            candidates += self._try_other_turns(before, result, reading, inputs, turned)
            unexplained = sorted({*unexplained, *turned})
        if not candidates:
            return StepResult(after, result.nis, result.dof, (), result.rounds)
        first = self._candidate(result, unexplained, inputs)
        should_merge = partial(self.merge_criterion.should_merge, inputs, self.periods)
        after, best = after.select([first, *candidates], should_merge)
        for number, candidate in enumerate(best):
            if candidate:
                result.nis[number] = candidate.nis[number]
        return StepResult(after, result.nis, result.dof, (), result.rounds)

    def _map_update(
        self, belief: InformationState, reading: Measurements, inputs: Array, groups: list[int] | None = None
    ) -> MapResult:
        if self.native is not None and self.native.is_ready:
            if (result := self.native.update(belief, reading, inputs)) is not None:
                return result
        groups = self._measured_groups(reading) if groups is None else groups
        return self.solver.update(belief, reading, inputs, groups)

    def _restart(
        self,
        old: InformationState,
        result: MapResult,
        reading: Measurements,
        inputs: Array,
        groups: list[int],
    ) -> list[Candidate]:
        starts = self.stationary_points.restart_states(old, result.belief, groups, inputs)
        return [one for start in starts for one in self._restart_from(start, reading, inputs, groups)]

    def _try_other_turns(
        self,
        old: InformationState,
        result: MapResult,
        reading: Measurements,
        inputs: Array,
        groups: list[int],
    ) -> list[Candidate]:
        """Return candidates on other turns of counted coordinates, such as a pinion on its rack."""
        candidates: list[Candidate] = []
        for x in self.counted:
            i = self.layout.tangent_space.coordinates.index(x)
            number = next(n for n, group in enumerate(self.layout.groups) if i in group.x)
            group = self.layout.groups[number]
            if number not in groups or group.by_speeds:
                continue
            place, off = result.belief.x.copy(), []
            for turn in (0.0, math.tau):
                place[i] = result.belief.x[i] + turn
                out = self.residuals.evaluate(place, inputs)
                errors = self.residuals.errors(out, reading, group.observation_indices)
                off.append(np.concatenate([error for error, _ in errors.values()]))
            change = off[1] - off[0]
            turns = round(-float(off[0] @ change) / max(float(change @ change), np.finfo(float).tiny))
            if turns:
                place[i] = result.belief.x[i] + turns * math.tau
                start = old.copy()
                there = place[group.x]
                move_origin(start, number, group, there, there - old.x[group.x], None)
                candidates += self._restart_from(start, reading, inputs, [number])
        return candidates

    def _restart_from(
        self, start: InformationState, reading: Measurements, inputs: Array, groups: list[int]
    ) -> list[Candidate]:
        try:
            if self.outliers is not None:
                start = self.solver.find_robust_start(start, reading, inputs, groups)
            result = self.solver.update(start, reading, inputs, groups, self.outliers or "gaussian")
            candidate = self._relinearised(start, result, reading, inputs, groups)
        except KineverseError:
            return []
        kept = [n for n in groups if self.outliers is None and start.records[n] is not None]
        if kept:
            # The stored measurements belong to another branch: the present residuals decide.
            candidate.nis[kept] = 0.0
            measured = [i for i, n in enumerate(self.layout.group_of) if n in kept and reading.mask[i]]
            for i, (e, _) in self.residuals.errors(candidate.predicted, reading, measured).items():
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
        return self._candidate(result, groups, inputs)

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
                self.inflation.inflate(number, wide)
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
        recorded = [n for n in moving if belief.records[n] is not None]
        noise_only = [n for n in recorded if self.process_model.is_noise_only(n, speeds)]
        belief = self._inflated(belief, set(moving).difference(noise_only))
        moved = None
        if self.native is not None and self.native.is_ready and not self.process_model.has_rates:
            tangent = self.layout.tangent_space.tangent
            motion = (np.array([by.get(v, 0.0) for v in tangent]) * dt for by in (speeds, noise))
            moved = self.native.predict(belief, *motion)
        if moved is None:
            moved = belief.copy()
            self.process_model.predict(moved, inputs, dt, speeds, noise)
            moved = self.constrained(moved, inputs)
        for number in noise_only:
            # A straight posterior is Gaussian; its prediction is exact.
            if self.inflation.is_straight(number, belief):
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
        inflated = set(velocity.groups) - velocity.redundant
        result = self._inflated(belief, inflated).copy()
        for number in velocity.redundant:
            result.records[number] = None
        velocity.periods = self.periods
        velocity.predict(result, inputs, dt, speeds, noise)
        moments = [m for one in result.speeds if one for m in (one.mean, one.gain, one.covariance)]
        _require_finite(result.numbers, *moments)
        result = self.constrained(result, inputs)
        _require_finite(result.numbers)
        return result

    def constrained(self, belief: InformationState, inputs: Array) -> InformationState:
        """Return the same belief about its most probable point inside the limits."""
        is_inside = (belief.x >= self.limits.lower).all() and (belief.x <= self.limits.upper).all()
        if is_inside and not self.layout.limits:
            if float(belief.vector @ np.linalg.solve(belief.information, belief.vector)) < _SETTLED**2:
                return belief
        if self.native is not None and self.native.is_ready and not self.process_model.has_rates:
            none = np.zeros(len(belief.vector))
            # C leaves out groups without motion; so little noise changes no number.
            if (result := self.native.predict(belief, none, none + np.finfo(float).tiny)) is not None:
                return result
        return self.solver.constrain(belief, self.reader.empty(), inputs)

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
        groups = enumerate(self.layout.groups)
        return [n for n, group in groups if reading.mask[list(group.observation_indices)].any()]

    def _keep_turns(self, mixture: GaussianSum, predicted: Array) -> None:
        """Take periodic coordinates to the turn nearest to their prediction (n,), in place."""
        for x, period in self.periods.items():
            i = self.layout.tangent_space.coordinates.index(x)
            for belief in mixture.beliefs:
                belief.x[i] -= period * round((belief.x[i] - predicted[i]) / period)

    def _update_mixture(self, mixture: GaussianSum, reading: Measurements, inputs: Array) -> StepResult:
        measured = self._measured_groups(reading)
        candidates, rounds = self._solve_inliers(mixture, reading, inputs, measured)
        solved = {number for candidate in candidates for number in candidate.groups}
        remaining = [number for number in measured if number not in solved]
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
        should_merge = partial(self.merge_criterion.should_merge, inputs, self.periods)
        after, best = mixture.select(candidates, should_merge)
        nis = np.array([c.nis[n] if c else 0.0 for n, c in enumerate(best)])
        dof = np.array([c.dof[n] if c else 0.0 for n, c in enumerate(best)])
        weights = [None if c is None else c.weights for c in best]
        of_group = [(i, weights[n]) for i, n in enumerate(self.layout.group_of) if reading.mask[i]]
        rejected = [i for i, w in of_group if w is not None and w[i] < 0.5]
        return StepResult(after, nis, dof, tuple(rejected), rounds)

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

    def _solve_inliers(
        self, mixture: GaussianSum, reading: Measurements, inputs: Array, groups: list[int]
    ) -> tuple[list[Candidate], int]:
        if self.inlier_solver is None or not self.is_native:
            return [], 0
        result, rounds = self.inlier_solver.solve(mixture, reading, inputs, groups)
        for candidate in result:
            as_found = MapResult(candidate.belief, candidate.nis, candidate.dof, rounds, candidate.weights)
            self.static_batch.relinearise(mixture.best, as_found, reading, inputs, candidate.groups)
            _require_finite(candidate.belief.numbers)
        return result, rounds

    def _explain(
        self, belief: InformationState, reading: Measurements, inputs: Array, groups: list[int], is_best: bool
    ) -> tuple[list[Candidate], int]:
        """Return candidates for one component: without outliers, with outliers, and all outliers."""
        if self.outliers is None:
            results = [(belief, self._map_update(belief, reading, inputs, groups))]
        else:
            starts = belief, self.solver.find_robust_start(belief, reading, inputs, groups)
            results = [(s, self.solver.update(s, reading, inputs, groups, self.outliers)) for s in starts]
        candidates = [self._relinearised(s, result, reading, inputs, groups) for s, result in results]
        rounds, result = max(result.rounds for _, result in results), results[-1][1]
        if is_best:
            rejected = self._with_rejected(result, reading, groups)
            unexplained = {*self.stationary_points.unexplained(belief, result), *rejected}
            if again := [n for n in groups if n in unexplained]:
                candidates += self._restart(belief, result, reading, inputs, again)
            if self.counted:
                turned = find_unexplained(result) if self.outliers is None else rejected
                candidates += self._try_other_turns(belief, result, reading, inputs, turned)
        if self.outliers is None:
            return candidates, rounds
        all_outliers = belief.copy()
        none = np.zeros(len(self.layout.groups))
        for i in np.flatnonzero(reading.mask).tolist():
            if self.layout.group_of[i] in groups:
                log = self.outliers.log_density(self.layout.observations[i], float(reading.log_scale[i]))
                all_outliers.evidence[self.layout.group_of[i]] += log
        weights = np.zeros(len(self.layout.observations))
        candidates.append(self._candidate(MapResult(all_outliers, none, none, 0, weights), groups, inputs))
        return candidates, rounds

    def _with_rejected(self, result: MapResult, reading: Measurements, groups: list[int]) -> list[int]:
        if result.weights is None:
            return []
        rejected = reading.mask & (result.weights < 0.5)
        return [n for n in groups if rejected[list(self.layout.groups[n].observation_indices)].any()]

    def _candidate(self, result: MapResult, groups: list[int], inputs: Array) -> Candidate:
        predicted = self.residuals.evaluate(result.belief.x, inputs)
        return Candidate(result.belief, predicted, result.weights, result.nis, result.dof, groups)


def _require_finite(*arrays: Array) -> None:
    if not all(np.isfinite(one).all() for one in arrays):
        raise InvalidValueError(
            "The step leads beyond floating point: measurements or covariances are too large or too small."
        )
