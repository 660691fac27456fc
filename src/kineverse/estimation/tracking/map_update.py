"""Iterated Gauss-Newton MAP update within bounds.

Minimised is ½ξᵀΛξ - ηᵀξ + ½ Σ |W r|² over the state. Every group takes its own steps, but the model is
evaluated for all of them at once. A step that makes the cost larger is taken back and damped (Levenberg,
Marquardt). Where observations may be wrong, each square is weighted anew at each place, and what is minimised
is their density with outliers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from kineverse.errors import ModelError
from kineverse.estimation.robust import Outliers, cauchy_weight
from kineverse.lie import Array

from .bounds import BoundRows, GroupBounds, StateBounds
from .gaussian import InformationState, QuadraticCost, inverse_spd
from .layout import Layout
from .process_model import ProcessModel
from .quadratic_program import solve_bounded_qp
from .residuals import Measurements, Residuals

# A step of so many standard deviations is the last.
_CONVERGED = 1e-5
_MOST_ROUNDS = 50
_MOST_DAMPING = 1e9
_OUTSIDE = 1e-9

Trust: TypeAlias = Outliers | Literal["all", "most"]
"""Who is believed: all, most of them (heavy tails), or each as far as it is no outlier."""


@dataclass(slots=True, eq=False)
class MapResult:
    """What an update found.

    Attributes
    ----------
    belief
        After it.
    nis, dof
        For each group the normalised innovation squared, and of how many numbers.
    rounds
        How many times the model was evaluated.
    weights
        How far each observation was believed; None if all were.
    squares
        Of the whitened errors of what was seen; None if nobody has kept them.
    priors
        For each group what was believed before, in the tangent at the place after it; None as well.
    """

    belief: InformationState
    nis: Array
    dof: Array
    rounds: int
    weights: Array | None = None
    squares: Array | None = None
    priors: Mapping[int, QuadraticCost] | None = None


@dataclass(slots=True, eq=False)
class _Work:
    """A group on its way: where it is, where it tries to go, and what is known at both.

    Attributes
    ----------
    x, prior, posterior, cost
        The best place so far: coordinates, belief without and with what was seen, and the cost.
    beyond
        By how much the cost is more than that of the posterior, which has weighted squares.
    trial, trial_prior
        Where it is evaluated next.
    room
        What the limits allow at the best place; None before there is one.
    outside
        What the limits cost before anything is seen, where they keep the belief from its mean.
    """

    x: Array
    prior: QuadraticCost
    posterior: QuadraticCost
    trial: Array
    trial_prior: QuadraticCost
    outside: float = 0.0
    cost: float = np.inf
    beyond: float = 0.0
    room: BoundRows | None = None
    damping: float = 0.0
    settled: QuadraticCost | None = None


class MapSolver:
    """What makes of a belief and a reading another belief.

    Parameters
    ----------
    layout, residuals, charted, limits
        The parts of a tracker.

    Attributes
    ----------
    boxes
        The limits of each group.
    """

    def __init__(
        self, layout: Layout, residuals: Residuals, charted: ProcessModel, limits: StateBounds
    ) -> None:
        self._layout, self._residuals, self._charted = layout, residuals, charted
        self.boxes = [GroupBounds(number, layout, limits) for number in range(len(layout.groups))]

    def update(
        self,
        belief: InformationState,
        reading: Measurements,
        known: Array,
        groups: Sequence[int],
        trust: Trust = "all",
    ) -> MapResult:
        """Return the belief after a reading; what is handed in stays as it is.

        Parameters
        ----------
        belief
            Before.
        reading
            What was seen.
        known
            Values of what is known.
        groups
            The numbers of the groups that take part.
        trust
            Who is believed.

        Raises
        ------
        InvalidValueError
            If the model says nothing finite where it is asked.
        ModelError
            If limits leave nothing between them.
        """
        works, weights, rounds = self._run(belief, reading, known, groups, trust)
        return self._found(belief, works, reading, rounds, trust, weights)

    def inside(self, belief: InformationState, nothing: Measurements, known: Array) -> InformationState:
        """Return the same belief, about the most probable point inside the limits."""
        return self.update(belief, nothing, known, range(len(self._layout.groups))).belief

    def where_most_agree(
        self, belief: InformationState, reading: Measurements, known: Array, groups: Sequence[int]
    ) -> InformationState:
        """Return the same belief, about a point from which outliers look like outliers."""
        works, *_ = self._run(belief, reading, known, groups, "most")
        moved = belief.copy()
        for number, work in works.items():
            group = self._layout.groups[number]
            moved.x[group.x] = work.x
            moved.put(group.t, work.prior)
        return moved

    def room(self, number: int, x: Array, out: Array) -> BoundRows:
        """Return what limits allow a group at a place where the model was evaluated."""
        return self.boxes[number].room(x, out)

    def _run(
        self,
        belief: InformationState,
        reading: Measurements,
        known: Array,
        groups: Sequence[int],
        trust: Trust,
    ) -> tuple[dict[int, _Work], Array, int]:
        """Take steps until all groups have settled; return them, weights and the number of evaluations."""
        works = {number: self._begun(belief, number) for number in groups}
        weights = np.ones(len(self._layout.observations))
        x, rounds = belief.x.copy(), 0
        while rounds < _MOST_ROUNDS and any(work.settled is None for work in works.values()):
            for number, work in works.items():
                x[self._layout.groups[number].x] = work.trial
            out = self._residuals.evaluate(x, known)
            rounds += 1
            for number, work in works.items():
                if work.settled is None:
                    self._judge(number, work, out, reading, trust, weights)
                    self._go_on(number, work, known)
        return works, weights, rounds

    def _begun(self, belief: InformationState, number: int) -> _Work:
        group = self._layout.groups[number]
        prior, x = belief.part(group.t), belief.x[group.x]
        return _Work(x, prior, prior, x, prior)

    def _judge(
        self, number: int, work: _Work, out: Array, reading: Measurements, trust: Trust, weights: Array
    ) -> None:
        """Make the trial the best place, if it is better."""
        group = self._layout.groups[number]
        with np.errstate(invalid="ignore"):  # a trial may be where a slope is infinite; it is not taken
            seen = self._residuals.errors(out, reading, group.seen)
        squares = {i: float(e @ e) for i, (e, _) in seen.items()}
        judged = {i: self._trusted(i, square, reading, trust) for i, square in squares.items()}
        cost = work.trial_prior.cost + sum(each for _, each in judged.values())
        is_finite = np.isfinite(cost) and all(np.isfinite(s).all() for _, s in seen.values())
        if not is_finite and work.room is None:
            self._residuals.check(out, group.seen)
        room = self.boxes[number].room(work.trial, out)
        if not is_finite or not _is_better(work, cost, room):
            work.damping = max(10 * work.damping, 1e-3)
            return
        if work.room is None:
            work.outside = _least_inside(work.prior, room)
        work.x, work.prior, work.cost, work.room = work.trial, work.trial_prior, cost, room
        weights[list(judged)] = [weight for weight, _ in judged.values()]
        work.posterior = work.prior.with_seen((e, s, judged[i][0]) for i, (e, s) in seen.items())
        work.beyond = cost - work.posterior.cost
        work.damping = work.damping / 10 if work.damping > 1e-6 else 0.0

    def _trusted(self, i: int, square: float, reading: Measurements, trust: Trust) -> tuple[float, float]:
        """Return how much an observation counts, and what it costs."""
        if trust == "all" or not np.isfinite(square):
            return 1.0, square / 2
        if trust == "most":
            size = self._layout.observations[i].size
            return cauchy_weight(square, size), (1 + size) / 2 * float(np.log1p(square))
        density = trust.log_density(self._layout.observations[i])
        return trust.judge(square, float(reading.log_scale[i]), density)

    def _go_on(self, number: int, work: _Work, known: Array) -> None:
        """Find the next trial, or settle where it is."""
        assert work.room is not None
        matrix = work.posterior.matrix
        if work.damping:
            matrix = matrix + work.damping * np.diag(np.diag(matrix))
        step = solve_bounded_qp(inverse_spd(matrix), -work.posterior.vector, *work.room)
        if step is None:
            names = ", ".join(map(str, self._layout.groups[number].coordinates))
            raise ModelError(f"The limits of {names} leave no state between them.")
        turned = float(np.abs(step[self._layout.groups[number].driven]).max(initial=0.0))
        if turned > np.pi:
            step = step * (np.pi / turned)  # half a turn: beyond, what is linear leads anywhere
        x, turn = self._charted.step(number, work.x, step, known)
        x = self.boxes[number].clipped(x)
        if float(step @ matrix @ step) <= _CONVERGED**2 or work.damping > _MOST_DAMPING:
            work.x, work.settled = x, work.posterior.carried(step, turn)
            work.prior = work.prior.carried(step, turn)
        else:
            work.trial, work.trial_prior = x, work.prior.carried(step, turn)

    def _found(
        self,
        belief: InformationState,
        works: dict[int, _Work],
        reading: Measurements,
        rounds: int,
        trust: Trust,
        weights: Array,
    ) -> MapResult:
        after = belief.copy()
        count = len(self._layout.groups)
        nis, dof = np.zeros(count), np.zeros(count)
        for number, work in works.items():
            group = self._layout.groups[number]
            seen = [i for i in group.seen if reading.seen[i]]
            after.x[group.x] = work.x
            posterior = work.settled or work.posterior
            after.put(group.t, posterior)
            # What the cost would be without limits; for what is linear, this is the innovation in S⁻¹.
            nis[number] = max(2 * posterior.least, 0.0)
            dof[number] = sum(self._layout.observations[i].size for i in seen if weights[i] >= 0.5)
            after.evidence[number] += (
                (work.prior.log_determinant - posterior.log_determinant) / 2
                - (posterior.cost - work.outside)
                - work.beyond
                - float(reading.log_scale[seen].sum())
            )
        priors = {number: work.prior for number, work in works.items()}
        return MapResult(after, nis, dof, rounds, None if trust == "all" else weights, priors=priors)


def _least_inside(belief: QuadraticCost, room: BoundRows) -> float:
    """Return the least cost of a belief inside the limits; 0 if nothing is, which others find out."""
    step = solve_bounded_qp(inverse_spd(belief.matrix), -belief.vector, *room)
    return 0.0 if step is None else belief.carried(step, None).cost


def _is_better(work: _Work, cost: float, room: BoundRows) -> bool:
    """Whether a trial is better than the best place: nearer to the limits it is outside of, or cheaper."""
    if work.room is not None and work.room.violation > _OUTSIDE:
        if room.violation < work.room.violation / 2:
            return True
    return cost <= work.cost + 1e-10 * (1 + abs(work.cost))
