"""Model of a mechanism with hypothesised locks, chosen so that moves take the fewest tries."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import reduce
from itertools import count
from operator import and_, or_
from typing import TypeAlias

import numpy as np

from kineverse.errors import InvalidValueError
from kineverse.expressions.expression import Expression, as_expression
from kineverse.logic import less
from kineverse.model.model import Model
from kineverse.state import State

from .lock_hypothesis import SIDES, Configuration, Enclosure, KeySide, LockHypothesis

Costs: TypeAlias = dict[KeySide, float]
Option: TypeAlias = tuple[float, KeySide, float]
"""Condition that explains a refusal: its rank, the condition, and the tries that it takes to fulfil it."""

SAME = 1e-3  # difference of positions that counts as none, as a share of a coordinate's range
_SPEED = 1.0  # speed limit of a learned lock where the model has none [m/s] or [rad/s]
_DOUBT = 5.0  # tries by which a condition counts as more costly after a plan was refuted because of it
_MOST_CHOICES = 500


class LockModel:
    """Hypotheses about the locks of all coordinates in both directions, as constraints of a model."""

    def __init__(self, model: Model, start: State, seed: int) -> None:
        self.model, self.coordinates = model, model.degrees_of_freedom
        ends = [model.limits(s) for s in self.coordinates]
        for s, (low, high) in zip(self.coordinates, ends, strict=True):
            if not (math.isfinite(low) and math.isfinite(high) and low < high):
                raise InvalidValueError(
                    f"'{s}' has no limits, so it is unknown how far to move it when locks are explored. Give "
                    f"it some: edit.constrain('{s} range', lower, model.symbol('{s}'), upper)."
                )
        self.limits = Enclosure(tuple(low for low, _ in ends), tuple(high for _, high in ends))
        here = self.read(start)
        self.locks = {
            KeySide(k, direction): LockHypothesis(k, self.limits, here)
            for k in range(len(ends))
            for direction in SIDES
        }
        self.priority: list[int] = np.random.default_rng(seed).permutation(len(ends)).tolist()
        self._doubts = dict[tuple[KeySide, KeySide], float]()
        self._written: Mapping[int, object] = {}

    def read(self, state: State) -> Configuration:
        """Return the configuration of a state, with positions near a limit at the limit."""
        result = []
        for s, low, high in zip(self.coordinates, *self.limits, strict=True):
            step = SAME * (high - low)
            result.append(min(max(low + step * round((state[s] - low) / step), low), high))
        return tuple(result)

    def end(self, move: KeySide) -> float:
        """Return the limit of a coordinate in a direction."""
        return self.limits[move.side > 0][move.key]

    # -- what moves are expected to take -------------------------------------------------------------------

    def expected_tries(self, here: Configuration) -> Costs:
        """Return how many tries it is expected to take to move each coordinate in each direction."""
        costs = dict.fromkeys(self.locks, math.inf)
        able = [move for move in self.locks if here[move.key] != self.end(move)]
        for _ in self.coordinates:
            before = dict(costs)
            for move in able:
                costs[move] = min(costs[move], self._estimate(move, here, costs)[0])
            if costs == before:
                break
        return costs

    def conditions(self, move: KeySide, here: Configuration, costs: Costs) -> list[dict[KeySide, None]]:
        """Return the conditions of a lock that explain all refusals, for each of its alternatives."""
        return self._estimate(move, here, costs)[1]

    def _estimate(
        self, move: KeySide, here: Configuration, costs: Costs
    ) -> tuple[float, list[dict[KeySide, None]]]:
        lock, best, result = self.locks[move], math.inf, list[dict[KeySide, None]]()
        for box in lock.alternatives:
            refusals = [(q, lock.suspects(q, box)) for q in reversed(lock.refused)]
            chosen = _explain(
                [self._rank(move, here, q, suspects, costs) for q, suspects in refusals],
                {},
                count(_MOST_CHOICES, -1),
            )
            if chosen is None:
                continue
            there = list(here)
            for s, tries in chosen.values():
                if tries:
                    there[s.key] = self.end(s)
            chance = lock.probability(tuple(there), box)
            if chance:
                # Not 1 / chance: a try that fails is not made again, since it teaches something.
                best = min(best, sum(tries for _, tries in chosen.values()) + 1 / math.sqrt(chance))
            result.append(dict.fromkeys(s for s, _ in chosen.values()))
        return best, result

    def _rank(
        self, move: KeySide, here: Configuration, q: Configuration, suspects: list[KeySide], costs: Costs
    ) -> list[Option]:
        """Return the possible reasons of a refusal, the one that is cleared most easily first."""
        lock, result = self.locks[move], list[Option]()
        total = sum(map(lock.weight, suspects))
        for s in suspects:
            tries = 0.0 if s.side * (here[s.key] - q[s.key]) > 0 else costs[s]
            if math.isfinite(tries):
                rank = tries + total / lock.weight(s) + self._doubts.get((move, s), 0.0)
                result.append((rank, s, tries))
        return sorted(result, key=lambda option: (option[0], self.priority[option[1].key]))

    # -- constraints of the model --------------------------------------------------------------------------

    def write_hypotheses(self, here: Configuration, costs: Costs) -> None:
        """Edit the conditions that explain all refusals into the model."""
        self._write({move: self.conditions(move, here, costs) or [{}] for move in self.locks})

    def write_results(self) -> None:
        """Edit the conditions under which parts were seen to move into the model.

        A lock that was never seen open is shut, and parts that were not tried are free.
        """
        self._write({move: lock.sufficient() if lock.is_tried else [{}] for move, lock in self.locks.items()})

    def _write(self, conditions: Mapping[KeySide, Sequence[Collection[KeySide]]]) -> None:
        """Edit the conditions of all locks into the model, for each alternative; an empty one is open."""
        wanted = {}
        for k in range(len(self.coordinates)):
            moves = (KeySide(k, 1), KeySide(k, -1))
            if not all(any(not one for one in conditions[move]) for move in moves):
                wanted[k] = tuple(tuple(map(tuple, conditions[move])) for move in moves)
        changed = [k for k in (*wanted, *self._written) if wanted.get(k) != self._written.get(k)]
        if not changed:
            return
        with self.model.edit() as edit:
            for k in dict.fromkeys(changed):
                name = self.constraint_name(k)
                if k in self._written:
                    edit.remove(name)
                if k in wanted:
                    upper, lower = (
                        self._bound(KeySide(k, direction), conditions[KeySide(k, direction)])
                        for direction in SIDES
                    )
                    edit.constrain(name, lower, self.coordinates[k].derivative(), upper, tag=name)
        self._written = wanted

    def constraint_name(self, k: int) -> str:
        """Return the name of the learned constraint of a coordinate."""
        return f"{self.coordinates[k]}/learned"

    def _bound(self, move: KeySide, conditions: Sequence[Collection[KeySide]]) -> Expression:
        limit = abs(self.model.limits(self.coordinates[move.key].derivative())[move.side > 0])
        most = move.side * (limit if 0.0 < limit < math.inf else _SPEED)
        if not conditions:
            return as_expression(0.0)
        if any(not one for one in conditions):
            return as_expression(most)
        alternatives = zip(conditions, self.locks[move].alternatives, strict=True)
        return (
            reduce(or_, (reduce(and_, (self._compare(s, box) for s in one)) for one, box in alternatives))
            * most
        )

    def _compare(self, s: KeySide, box: Enclosure) -> Expression:
        """Return a condition, with a threshold just before the positions at which it is known to hold."""
        q = self.coordinates[s.key]
        margin = SAME * (self.limits.upper[s.key] - self.limits.lower[s.key])
        return less(box.lower[s.key] - margin, q) if s.side > 0 else less(q, box.upper[s.key] + margin)

    def doubt(self, names: Collection[str], here: Configuration, costs: Costs) -> bool:
        """Make the uncertain conditions of learned constraints less attractive; return if there are any."""
        result = False
        for move, lock in self.locks.items():
            if self.constraint_name(move.key) in names:
                certain = lock.necessary()
                for s in {s for one in self.conditions(move, here, costs) for s in one if s not in certain}:
                    self._doubts[move, s] = self._doubts.get((move, s), 0.0) + _DOUBT
                    result = True
        return result

    def forget_doubts(self) -> None:
        """Forget all doubts."""
        self._doubts.clear()


def _explain(
    refusals: Sequence[list[Option]], chosen: dict[int, tuple[KeySide, float]], left: Iterator[int]
) -> dict[int, tuple[KeySide, float]] | None:
    """Return for some keys the side and its tries, so that all refusals have a reason; None if none do."""
    for n, options in enumerate(refusals):
        if any(s.key in chosen and chosen[s.key][0] == s for _, s, _ in options):
            continue
        for _, s, tries in options:
            if s.key not in chosen and next(left) > 0:
                result = _explain(refusals[n + 1 :], {**chosen, s.key: (s, tries)}, left)
                if result is not None:
                    return result
        return None
    return chosen
