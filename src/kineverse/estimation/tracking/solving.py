"""The most probable state: Gauss-Newton on belief and observations, inside the limits.

Minimised is ½ξᵀΛξ - ηᵀξ + ½ Σ |W r|² over the state. Every group takes its own steps, but the model is
evaluated for all of them at once. A step that makes the cost larger is taken back and damped (Levenberg,
Marquardt).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kineverse.errors import ModelError
from kineverse.estimation.noise import Array

from .belief import Belief, Quadratic, inverse
from .charted import Charted
from .layout import Layout
from .limits import Limits
from .quadratic import smallest_between
from .reading import Reading
from .residuals import Residuals

# A step of so many standard deviations is the last.
_CONVERGED = 1e-5
_MOST_ROUNDS = 50
_MOST_DAMPING = 1e9


@dataclass(slots=True, eq=False)
class Found:
    """What an update found.

    Attributes
    ----------
    belief
        After it.
    nis, dof
        For each group the normalised innovation squared, and of how many numbers.
    rounds
        How many times the model was evaluated.
    """

    belief: Belief
    nis: Array
    dof: Array
    rounds: int


@dataclass(slots=True, eq=False)
class _Work:
    """A group on its way: where it is, where it tries to go, and what is known at both.

    Attributes
    ----------
    x, prior, posterior, cost
        The best place so far: coordinates, belief without and with what was seen, and the cost.
    trial, trial_prior
        Where it is evaluated next.
    """

    x: Array
    prior: Quadratic
    posterior: Quadratic
    cost: float
    trial: Array
    trial_prior: Quadratic
    between: tuple[Array, Array, Array] | None = None
    damping: float = 0.0
    is_done: bool = False


class Solver:
    """What makes of a belief and a reading another belief.

    Parameters
    ----------
    layout, residuals, charted, limits
        The parts of a tracker.
    """

    def __init__(self, layout: Layout, residuals: Residuals, charted: Charted, limits: Limits) -> None:
        self._layout, self._residuals, self._charted, self._limits = layout, residuals, charted, limits
        self._boxes = [_Box(number, layout, limits) for number in range(len(layout.groups))]

    def update(self, belief: Belief, reading: Reading, known: Array, groups: Sequence[int]) -> Found:
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

        Raises
        ------
        ValueRejectedError
            If the model says nothing finite where it is asked.
        ModelError
            If limits leave nothing between them.
        """
        works = {number: self._begun(belief, number) for number in groups}
        x, rounds = belief.x.copy(), 0
        while rounds < _MOST_ROUNDS and not all(work.is_done for work in works.values()):
            for number, work in works.items():
                x[self._layout.groups[number].x] = work.trial
            out = self._residuals.evaluate(x, known)
            rounds += 1
            for number, work in works.items():
                if not work.is_done:
                    self._judge(number, work, out, reading)
                    self._go_on(number, work, known)
        return self._found(belief, works, reading, rounds)

    def inside(self, belief: Belief, known: Array) -> Belief:
        """Return the same belief, about the most probable point inside the limits."""
        nothing = Reading([None] * len(self._layout.observations), [], np.empty(0))
        return self.update(belief, nothing, known, range(len(self._layout.groups))).belief

    def _begun(self, belief: Belief, number: int) -> _Work:
        group = self._layout.groups[number]
        prior = belief.part(group.t)
        x = belief.x[group.x]
        return _Work(x, prior, prior, np.inf, x, prior)

    def _judge(self, number: int, work: _Work, out: Array, reading: Reading) -> None:
        """Make the trial the best place, if it is better."""
        group = self._layout.groups[number]
        with np.errstate(invalid="ignore"):  # a trial may be where a slope is infinite; it is not taken
            seen = self._residuals.errors(out, reading, group.seen)
        cost = work.trial_prior.cost + sum(float(e @ e) for e, _ in seen.values()) / 2
        is_finite = np.isfinite(cost) and all(np.isfinite(s).all() for _, s in seen.values())
        if not is_finite and work.between is None:
            self._residuals.check(out, group.seen)
        if not is_finite or cost > work.cost + 1e-10 * (1 + abs(work.cost)):
            work.damping = max(10 * work.damping, 1e-3)
            return
        work.x, work.prior, work.cost = work.trial, work.trial_prior, cost
        work.posterior = work.prior.with_seen(seen.values())
        work.between = self._boxes[number].between(work.x, out)
        work.damping = work.damping / 10 if work.damping > 1e-6 else 0.0

    def _go_on(self, number: int, work: _Work, known: Array) -> None:
        """Find the next trial, or settle where it is."""
        assert work.between is not None
        matrix = work.posterior.matrix
        if work.damping:
            matrix = matrix + work.damping * np.diag(np.diag(matrix))
        step = smallest_between(inverse(matrix), -work.posterior.vector, *work.between)
        if step is None:
            names = ", ".join(map(str, self._layout.groups[number].coordinates))
            raise ModelError(f"The limits of {names} leave no state between them.")
        x, turn = self._charted.step(number, work.x, step, known)
        x = self._boxes[number].clipped(x)
        if float(step @ matrix @ step) <= _CONVERGED**2 or work.damping > _MOST_DAMPING:
            work.x, work.posterior = x, work.posterior.carried(step, turn)
            work.is_done = True
        else:
            work.trial, work.trial_prior = x, work.prior.carried(step, turn)

    def _found(self, belief: Belief, works: dict[int, _Work], reading: Reading, rounds: int) -> Found:
        after = belief.copy()
        count = len(self._layout.groups)
        nis, dof = np.zeros(count), np.zeros(count)
        for number, work in works.items():
            group = self._layout.groups[number]
            seen = [i for i in group.seen if reading.values[i] is not None]
            before, posterior = belief.part(group.t), work.posterior
            after.x[group.x] = work.x
            after.put(group.t, posterior)
            # What the cost would be without limits; for what is linear, this is the innovation in S⁻¹.
            nis[number] = max(2 * posterior.least, 0.0)
            dof[number] = sum(self._layout.observations[i].size for i in seen)
            after.evidence[number] += (
                -posterior.least
                + (before.log_determinant - posterior.log_determinant) / 2
                - sum(reading.log_scale[i] for i in seen)
            )
        return Found(after, nis, dof, rounds)


class _Box:
    """The limits of one group, as rows in its tangent."""

    def __init__(self, number: int, layout: Layout, limits: Limits) -> None:
        group = layout.groups[number]
        by_speeds = layout.chart.by_speeds
        self._own = [k for k, x in enumerate(group.coordinates) if x not in by_speeds]
        places = group.x[self._own]
        self._lower, self._upper = limits.lower[places], limits.upper[places]
        self._curved = [layout.limit_slices[k] for k in group.limits]
        self._rows = np.zeros((len(self._own), len(group.tangent)))
        for row, k in enumerate(self._own):
            self._rows[row, group.tangent.index(group.coordinates[k].derivative())] = 1.0

    def between(self, x: Array, out: Array) -> tuple[Array, Array, Array]:
        """Return rows, and between what they may change, at a place."""
        own = x[self._own]
        rows, lower, upper = self._rows, self._lower - own, self._upper - own
        if self._curved:
            curved = np.stack([out[where] for where in self._curved])
            rows = np.concatenate([rows, curved[:, 3:]])
            lower = np.concatenate([lower, curved[:, 1] - curved[:, 0]])
            upper = np.concatenate([upper, curved[:, 2] - curved[:, 0]])
        return rows, lower, upper

    def clipped(self, x: Array) -> Array:
        """Return a place that rounding has not led out of the bounds of single coordinates."""
        x[self._own] = np.clip(x[self._own], self._lower, self._upper)
        return x
