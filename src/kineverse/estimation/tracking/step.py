"""One prediction and update of all Gaussian-sum components."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np

from kineverse.errors import InvalidValueError, KineverseError
from kineverse.estimation.robust import Outliers
from kineverse.lie import Array
from kineverse.symbols import Symbol

from .bindings import NativeInlierSolver, NativeMapSolver, native_library
from .bounds import StateBounds
from .covariance import CovarianceInflation, RidgeCovariance
from .gaussian import InformationState
from .gaussian_sum import Candidate, GaussianSum, MergeCriterion
from .layout import Layout
from .map_update import MapResult, MapSolver
from .observability import StationaryPoints, UnobservableDirections
from .process_model import ProcessModel
from .residuals import MeasurementReader, Measurements, Residuals
from .static_batch import StaticBatch


@dataclass(slots=True, eq=False)
class StepResult:
    """What an update found.

    Attributes
    ----------
    modes
        After it.
    nis, dof
        The normalised innovation squared, and of how many numbers it is the sum.
    outliers
        The numbers of the observations that were not believed.
    rounds
        How many times the model was evaluated, at most for one explanation.
    """

    modes: GaussianSum
    nis: float
    dof: int
    outliers: tuple[int, ...]
    rounds: int


_OUTSIDE = 1e-9
# So few deviations from its mean a belief is about that, as after an update.
_SETTLED = 1e-5


class UpdateStep:
    """What is fixed about a tracker.

    Parameters
    ----------
    layout, limits
        What is estimated.
    outliers
        How observations may be wrong; None if they never are.

    Attributes
    ----------
    turns
        The coordinates that come back after a turn.
    """

    def __init__(self, layout: Layout, limits: StateBounds, outliers: Outliers | None) -> None:
        self.layout, self.limits, self.outliers = layout, limits, outliers
        self.function = layout.compiled()
        self.charted = ProcessModel(layout)
        self.residuals = Residuals(layout, self.function)
        self.reader = MeasurementReader(layout)
        self.solver = MapSolver(layout, self.residuals, self.charted, limits)
        self.openness = UnobservableDirections(layout)
        self.memory = StaticBatch(
            layout, self.residuals, self.reader, self.solver, self.openness, self._found
        )
        boxes = self.solver.boxes
        parts = (layout, self.residuals, self.charted, self.reader, boxes, self.openness)
        self.ridge, self.widening = RidgeCovariance(*parts), CovarianceInflation(*parts)
        self.likeness = MergeCriterion(layout, self.residuals, self.reader, self.charted, self.ridge)
        self.saddles = StationaryPoints(layout, self.charted, self.openness, boxes)
        self.native = (
            NativeMapSolver(layout, limits, self.function, self.charted)
            if NativeMapSolver.suits(layout)
            else None
        )
        self.undoubted = (
            NativeInlierSolver(layout, self.native, outliers) if self.native and outliers else None
        )
        self.turns: frozenset[Symbol] = frozenset()
        if self.native:
            native_library.prepare()

    @property
    def is_native(self) -> bool:
        """Whether C does the work where nothing is ambiguous."""
        return self.native is not None and self.native.is_ready

    def update(self, modes: GaussianSum, reading: Measurements, known: Array) -> StepResult:
        """Return what is believed after a reading; see :meth:`.solving.Solver.update`."""
        modes = self._at_other_values(modes, known)
        if not modes.is_single or self.outliers is not None:
            return self._weighed(modes, reading, known)
        before = modes.best
        found = self._found(before, reading, known)
        self.memory.remember(before, found, reading, known)
        self._settle(found.belief)
        after = GaussianSum(self.layout, [found.belief], modes.alive)
        stuck = self.saddles.unexplained(before, found)
        explained = self._freed(before, found, reading, known, stuck) if stuck else []
        if not explained:
            return StepResult(after, float(found.nis.sum()), int(found.dof.sum()), (), found.rounds)
        first = self._candidate(found.belief, None, found.nis, found.dof, stuck, known)
        after, best = after.ranked([first, *explained], partial(self.likeness.is_same, known, self.turns))
        for number, candidate in enumerate(best):
            if candidate:
                found.nis[number] = candidate.nis[number]
        return StepResult(after, float(found.nis.sum()), int(found.dof.sum()), (), found.rounds)

    def _found(
        self, belief: InformationState, reading: Measurements, known: Array, groups: list[int] | None = None
    ) -> MapResult:
        """Return what follows if everything is right; for all groups that are seen, if none are given."""
        found = None
        if self.native is not None and self.native.is_ready:
            found = self.native.update(belief, reading, known)
        if found is None:
            groups = self._seen(reading) if groups is None else groups
            found = self.solver.update(belief, reading, known, groups)
        return found

    def _freed(
        self,
        before: InformationState,
        found: MapResult,
        reading: Measurements,
        known: Array,
        groups: list[int],
    ) -> list[Candidate]:
        """Return other explanations of groups that are where nothing that was seen has a slope."""
        candidates = []
        for start in self.saddles.aside(before, found.belief, groups, known):
            try:
                candidates.append(self._from_aside(start, reading, known, groups))
            except KineverseError:  # it leads nowhere
                continue
        return candidates

    def _from_aside(
        self, start: InformationState, reading: Measurements, known: Array, groups: list[int]
    ) -> Candidate:
        if self.outliers is not None:
            start = self.solver.where_most_agree(start, reading, known, groups)
        found = self.solver.update(start, reading, known, groups, self.outliers or "all")
        candidate = self._explained(start, found, reading, known, groups)
        if self.outliers is None:
            # Where all that is remembered was another's, what remains unexplained is what counts.
            errors = self.residuals.errors(candidate.said, reading, np.flatnonzero(reading.seen).tolist())
            for number in groups:
                if start.standing[number] is not None:
                    squares = (
                        float(e @ e) for i, (e, _) in errors.items() if self.layout.group_of[i] == number
                    )
                    candidate.nis[number] = sum(squares)
        return candidate

    def _explained(
        self,
        before: InformationState,
        found: MapResult,
        reading: Measurements,
        known: Array,
        groups: list[int],
    ) -> Candidate:
        self.memory.remember(before, found, reading, known, groups)
        self._settle(found.belief)
        return self._candidate(found.belief, found.weights, found.nis, found.dof, groups, known)

    def _at_other_values(self, modes: GaussianSum, known: Array) -> GaussianSum:
        """Return the same beliefs, which remember nothing that was seen at other values of what is known."""

        def changed(belief: InformationState) -> InformationState:
            groups = [
                number
                for number, standing in enumerate(belief.standing)
                if standing is not None and not np.array_equal(standing.known, known)
            ]
            return self._widened(belief, groups)

        return modes.each(changed) if len(known) else modes

    def _widened(self, belief: InformationState, groups: Iterable[int]) -> InformationState:
        wide = belief
        for number in groups:
            if belief.standing[number] is not None:
                wide = belief.copy() if wide is belief else wide
                self.widening.widen(number, wide)
        return wide

    def predict(
        self,
        belief: InformationState,
        known: Array,
        dt: float,
        speeds: Mapping[Symbol, float],
        noise: Mapping[Symbol, float],
    ) -> InformationState:
        """Return a belief ``dt`` seconds later, about the most probable point inside the limits.

        Speeds are commanded; noise is variances by second that add to that.
        """
        moving = self.charted.moving(speeds, noise)
        shaken = [n for n in moving if belief.standing[n] is not None and self.charted.only_shakes(n, speeds)]
        belief = self._widened(belief, set(moving).difference(shaken))
        found = None
        if self.native is not None and self.native.is_ready and not self.charted.is_driven:
            tangent = self.layout.chart.tangent
            moved, grown = (np.array([by.get(v, 0.0) for v in tangent]) * dt for by in (speeds, noise))
            found = self.native.predict(belief, moved, grown)
        if found is None:
            found = belief.copy()
            self.charted.predict(found, known, dt, speeds, noise)
            if not self._is_at_top(found):
                found = self.solver.inside(found, self.reader.nothing(), known)
        for number in shaken:
            # What is straight is a Gaussian, which has gone on as it should.
            if self.widening.is_straight(number, belief):
                found.standing[number] = None
                continue
            group = self.layout.groups[number]
            grown = np.array([noise.get(v, 0.0) for v in group.tangent]) * dt
            self.memory.add_noise(number, belief, found, grown)
        self._settle(found)
        return found

    def _is_at_top(self, belief: InformationState) -> bool:
        """Whether a belief is about its own mean, inside limits that are easily looked at."""
        limits = self.limits
        if self.layout.limits or (belief.x < limits.lower).any() or (belief.x > limits.upper).any():
            return False
        return float(belief.vector @ np.linalg.solve(belief.information, belief.vector)) < _SETTLED**2

    def is_possible(self, number: int, belief: InformationState, known: Array) -> bool:
        """Whether a group can be at a place: inside its limits, and where the model says something."""
        try:
            out = self.residuals.evaluate(belief.x, known)
        except KineverseError:
            return False
        group = self.layout.groups[number]
        spoken = [
            out[where]
            for i in group.seen
            for where in (self.layout.value_slices[i], self.layout.slope_slices[i])
        ]
        if not all(np.isfinite(each).all() for each in spoken):
            return False
        return self.solver.room(number, belief.x[group.x], out).violation < _OUTSIDE

    def _seen(self, reading: Measurements) -> list[int]:
        return [n for n, group in enumerate(self.layout.groups) if reading.seen[list(group.seen)].any()]

    def _settle(self, belief: InformationState) -> None:
        """Bring back what has gone more than half a turn.

        Raises
        ------
        InvalidValueError
            If there are numbers that are not finite: nobody is ever told such.
        """
        if not np.isfinite(belief.numbers).all():
            raise InvalidValueError(
                "The step leads to numbers that are not finite, as what was seen or the covariances are too "
                "large or too small for floating point. The belief stays as it was."
            )
        for x in self.turns:
            i = self.layout.chart.coordinates.index(x)
            belief.x[i] = math.remainder(belief.x[i], 2 * math.pi)

    def _weighed(self, modes: GaussianSum, reading: Measurements, known: Array) -> StepResult:
        """Explain a reading in all ways, and keep the best."""
        seen = self._seen(reading)
        candidates, rounds = self._undoubted(modes, reading, known, seen)
        sure = {number for candidate in candidates for number in candidate.groups}
        left = [number for number in seen if number not in sure]
        for mode, belief in enumerate(modes.beliefs):
            groups = modes.groups(mode, left)
            if not groups:
                continue
            try:
                new, took = self._explanations(belief, reading, known, groups, mode == 0)
            except KineverseError:
                # The best one has to be explained; another that leads nowhere is given up.
                if mode == 0:
                    raise
                continue
            candidates += new
            rounds = max(rounds, took)
        after, best = modes.ranked(candidates, partial(self.likeness.is_same, known, self.turns))
        nis = sum(float(c.nis[n]) for n, c in enumerate(best) if c)
        dof = sum(int(c.dof[n]) for n, c in enumerate(best) if c)
        doubted = [
            i
            for i, number in enumerate(self.layout.group_of)
            if reading.seen[i] and (c := best[number]) and c.weights is not None and c.weights[i] < 0.5
        ]
        return StepResult(after, nis, dof, tuple(doubted), rounds)

    def _undoubted(
        self, modes: GaussianSum, reading: Measurements, known: Array, groups: list[int]
    ) -> tuple[list[Candidate], int]:
        """Return what C finds of groups that can be explained in one way only."""
        if self.undoubted is None or not self.is_native:
            return [], 0
        found, rounds = self.undoubted.explained(modes, reading, known, groups)
        for candidate in found:
            as_found = MapResult(candidate.belief, candidate.nis, candidate.dof, rounds, candidate.weights)
            self.memory.remember(modes.best, as_found, reading, known, candidate.groups)
            self._settle(candidate.belief)
        return found, rounds

    def _explanations(
        self, belief: InformationState, reading: Measurements, known: Array, groups: list[int], is_best: bool
    ) -> tuple[list[Candidate], int]:
        """Return a belief after a reading: if all is right, and in ways in which some of it is wrong."""
        if self.outliers is None:
            found = self._found(belief, reading, known, groups)
            explained = [self._explained(belief, found, reading, known, groups)]
            if is_best and (stuck := self._stuck(belief, found, reading, groups)):
                explained += self._freed(belief, found, reading, known, stuck)
            return explained, found.rounds
        nearby = self.solver.where_most_agree(belief, reading, known, groups)
        explained, rounds = [], 0
        for start in (belief, nearby):
            found = self.solver.update(start, reading, known, groups, self.outliers)
            explained.append(self._explained(start, found, reading, known, groups))
            rounds = max(rounds, found.rounds)
        if is_best and (stuck := self._stuck(belief, found, reading, groups)):
            explained += self._freed(belief, found, reading, known, stuck)
        nothing = belief.copy()
        none = np.zeros(len(self.layout.groups))
        for number in groups:
            seen = [i for i in self.layout.groups[number].seen if reading.seen[i]]
            wrong = sum(self.outliers.log_density(self.layout.observations[i]) for i in seen)
            nothing.evidence[number] += wrong
        weights = np.zeros(len(self.layout.observations))
        explained.append(self._candidate(nothing, weights, none, none, groups, known))
        return explained, rounds

    def _stuck(
        self, belief: InformationState, found: MapResult, reading: Measurements, groups: list[int]
    ) -> list[int]:
        """Return the groups of which something is not explained, or taken for wrong."""
        stuck = set(self.saddles.unexplained(belief, found))
        if found.weights is not None:
            doubted = reading.seen & (found.weights < 0.5)
            stuck |= {n for n in groups if doubted[list(self.layout.groups[n].seen)].any()}
        return [n for n in groups if n in stuck]

    def _candidate(
        self,
        belief: InformationState,
        weights: Array | None,
        nis: Array,
        dof: Array,
        groups: list[int],
        known: Array,
    ) -> Candidate:
        return Candidate(belief, self.residuals.evaluate(belief.x, known), weights, nis, dof, groups)
