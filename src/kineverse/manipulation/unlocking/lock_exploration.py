"""Exploration of unknown locks: parts are tried, conditions hypothesised, and written into the model.

The model has the parts and their limits, and not their locks. What the tries leave open is decided in favour
of what takes the fewest tries: each refusal is explained by the key that is most easily moved away. These
conditions are edited into the model, a plan for it is made, and its moves are tried until one contradicts it.
Parts are moved to their limits, where each condition on one side of a threshold holds or fails for certain.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from kineverse._checks import as_count
from kineverse.expressions.printing import format_number
from kineverse.model.model import Model
from kineverse.reasoning import Interlock, UnlockingPlan, plan_unlocking
from kineverse.state import State, StateLike, as_state
from kineverse.symbols import Symbol

from .lock_hypothesis import Configuration, KeySide, Side
from .lock_model import SAME, LockModel

MoveFunction = Callable[[Symbol, float], float]

_MOST_DOUBTS = 12  # number of plans that are made by other hypotheses if one is refuted
_MOST_CONFIGURATIONS = 3000


@dataclass(frozen=True, slots=True)
class LockTry:
    """Try to move a part.

    Attributes
    ----------
    coordinate, target
        The coordinate, and where it was to go [m] or [rad].
    moved
        Whether it arrived.

    See Also
    --------
    kineverse.manipulation.explore_locks
    """

    coordinate: Symbol
    target: float
    moved: bool

    def as_data(self) -> dict[str, Any]:
        """Return the try as data for JSON."""
        return {"coordinate": str(self.coordinate), "target": self.target, "moved": self.moved}


@dataclass(frozen=True, slots=True)
class LearnedLock:
    """Lock of a coordinate in one direction, as it was learned.

    Attributes
    ----------
    coordinate, way
        The coordinate, and the direction that is locked, 1 or -1.
    moved, refused
        Numbers of configurations in which it moved, and in which it did not.
    certain
        Conditions of every conjunction of thresholds that agrees with the tries: the key, its side (1 above
        the threshold, -1 below it), and the interval in which the threshold is.
    possible
        Further conditions, which held whenever the part moved.
    is_conjunction
        False if no conjunction agrees with the tries; then nothing is certain.

    See Also
    --------
    kineverse.manipulation.explore_locks
    """

    coordinate: Symbol
    way: Side
    moved: int
    refused: int
    certain: tuple[tuple[Symbol, Side, tuple[float, float]], ...]
    possible: tuple[tuple[Symbol, Side], ...]
    is_conjunction: bool

    def __str__(self) -> str:
        verb = "increase" if self.way > 0 else "decrease"
        if not self.refused:
            return f"{self.coordinate} was free to {verb}"
        if not self.moved:
            return f"{self.coordinate} never did {verb}"
        needs = [
            f"{key} {'>' if side > 0 else '<'} {format_number(low, 4)} to {format_number(high, 4)}"
            for key, side, (low, high) in self.certain
        ]
        further = ", ".join(f"{key} {'up' if side > 0 else 'down'}" for key, side in self.possible)
        needs += [f"perhaps {further}"] if further else []
        return f"{self.coordinate} can {verb} if {' and '.join(needs)}"


@dataclass(frozen=True)
class LockExploration:
    """Exploration of a mechanism, true if the goal was reached.

    Attributes
    ----------
    done
        Whether the goal was reached.
    tries
        All tries, moves of parts that are known to be free included.
    locks
        Locks of all parts that were tried.
    plan
        The last plan, by the model as it was learned.
    state
        Positions at the end.

    See Also
    --------
    kineverse.manipulation.explore_locks
    """

    done: bool
    tries: tuple[LockTry, ...]
    locks: tuple[LearnedLock, ...]
    plan: UnlockingPlan
    state: State

    def __bool__(self) -> bool:
        return self.done


def explore_locks(
    model: Model,
    goal: Mapping[Symbol, float] | Mapping[str, float],
    move: MoveFunction,
    state: StateLike | None = None,
    *,
    most: int = 1000,
    seed: int = 0,
) -> LockExploration:
    """Reach a goal in a mechanism whose locks are unknown, with as few tries as hypotheses allow.

    Locks are taken to be conjunctions of thresholds, one for each key, or alternatives of such conjunctions,
    and to be shut at the start more often than open. Afterwards the model has constraints ``NAME/learned``,
    so that :func:`kineverse.reasoning.plan_unlocking` and controllers know them: parts that were tried are
    free under the conditions under which they were seen to move.

    Parameters
    ----------
    model
        Model of the parts and their limits; it is edited.
    goal
        Positions to reach, by coordinate or its name [m] or [rad].
    move
        Function that tries to move a coordinate to a position, and returns the position where it ends, such
        as :meth:`.PartMover.move` with a snapshot of the model.
    state
        Positions at the start, by default those of :meth:`.Model.default_state`.
    most
        Largest number of tries.
    seed
        Seed of the order in which keys are tried that are equally promising.

    Raises
    ------
    UnknownNameError, InvalidValueError
        As :func:`kineverse.reasoning.plan_unlocking`; also for coordinates without limits.

    Examples
    --------
    >>> lid, bolt = kv.position("lid"), kv.position("bolt")
    >>> unknown = kv.Model()
    >>> with unknown.edit() as edit:
    ...     edit.apply(kv.Prismatic(name="lid", parent="world", child="lid", lower=0, upper=1))
    ...     edit.apply(kv.Prismatic(name="bolt", parent="world", child="bolt", lower=0, upper=1))
    'joint lid'
    'joint bolt'
    >>> truth = unknown.copy()
    >>> with truth.edit() as edit:
    ...     edit.constrain("lock", *kv.articulations.speed_lock(lid, open_if=bolt > 0.5))
    'constraint lock'
    >>> session = kv.manipulation.Session(kv.worlds.MechanismWorld(truth), dt=0.05)
    >>> mover = kv.manipulation.PartMover(unknown.snapshot(), session)
    >>> explored = kv.manipulation.explore_locks(unknown, {"lid": 0.8}, mover.move)
    >>> explored.done, [one.coordinate for one in explored.tries]
    (True, [lid, bolt, lid])
    """
    goals = {model.degree_of_freedom(name): float(value) for name, value in goal.items()}
    return _Explorer(model, state, move, as_count("seed", seed, 0)).run(goals, as_count("most", most, 1))


class _Explorer:
    def __init__(self, model: Model, state: StateLike | None, move: MoveFunction, seed: int) -> None:
        given = dict(model.default_state())
        if state is not None:
            given |= dict(as_state(state, model.symbols))
        self.state, self._move = State(given), move
        self.known = LockModel(model, self.state, seed)
        self.tries = list[LockTry]()

    @property
    def here(self) -> Configuration:
        return self.known.read(self.state)

    @property
    def erratic(self) -> set[Symbol]:
        """Coordinates that moved at one time, and did not at another one in the same configuration."""
        known = self.known
        return {known.coordinates[move.key] for move, lock in known.locks.items() if lock.is_erratic}

    def run(self, goal: dict[Symbol, float], most: int) -> LockExploration:
        while True:
            plan = self.plan(goal)
            done = plan.verdict == "found" and not plan.steps
            if done or len(self.tries) >= most:
                break
            moves = self.read_moves(plan)
            if not moves or not self.known.locks[moves[0][0]].probability(self.here):
                moves = [(move, self.known.end(move)) for move in self.find_unexplored()]
            if not moves:
                break
            for move, target in moves:
                first = self.find_deferring(move, goal)
                if first is not None:
                    self.attempt(first, self.known.end(first))
                    break
                if not self.attempt(move, target) or len(self.tries) >= most:
                    break
        self.known.write_results()
        return LockExploration(done, tuple(self.tries), self.list_locks(), plan, self.state)

    def near(self, goal: Mapping[Symbol, float]) -> State:
        """Return the state with positions that are as good as limits or goals at these."""
        known = self.known
        values = dict(zip(known.coordinates, self.here, strict=True))
        for s, wanted in goal.items():
            lower, upper = (ends[known.coordinates.index(s)] for ends in known.limits)
            if abs(self.state[s] - wanted) <= SAME * (upper - lower):
                values[s] = wanted
        return self.state.updated(values)

    def plan(self, goal: dict[Symbol, float]) -> UnlockingPlan:
        """Return a plan by hypotheses that do not contradict each other, if there are any."""
        known, here = self.known, self.here
        known.forget_doubts()
        for _ in range(_MOST_DOUBTS):
            costs = known.expected_tries(here)
            known.write_hypotheses(here, costs)
            plan = plan_unlocking(known.model, goal, self.near(goal), fixed=self.erratic)
            blocking = (lock for lock in plan.blocking if isinstance(lock, Interlock))
            if not known.doubt({name for lock in blocking for name in lock.constraints}, here, costs):
                break
        return plan

    def read_moves(self, plan: UnlockingPlan) -> list[tuple[KeySide, float]]:
        """Return the moves of a plan with their targets: limits, unless the target is a goal."""
        moves = []
        for step in plan.steps:
            k = self.known.coordinates.index(step.coordinate)
            move = KeySide(k, 1 if step.target > step.start else -1)
            moves.append((move, step.target if step.threshold is None else self.known.end(move)))
        return moves

    def find_deferring(self, move: KeySide, goal: Mapping[Symbol, float]) -> KeySide | None:
        """Return the move that is tried before that of a goal which was refused; None if there is none.

        A box hides its goal behind the other parts, so those that never moved and might be free come first.
        """
        known, here = self.known, self.here
        lock = known.locks[move]
        if known.coordinates[move.key] not in goal or not lock.refused or lock.probability(here) == 1.0:
            return None
        seen = {one.key for one, other in known.locks.items() if other.moved}
        chances = {
            one: other.probability(here)
            for one, other in known.locks.items()
            if one.key not in seen
            and known.coordinates[one.key] not in goal
            and here[one.key] != known.end(one)
        }
        likely = max(chances, key=lambda one: (chances[one], -known.priority[one.key]), default=None)
        return likely if likely is not None and chances[likely] > 0.0 else None

    def attempt(self, move: KeySide, target: float) -> bool:
        before, symbol = self.here, self.known.coordinates[move.key]
        reached = self._move(symbol, target)
        self.state = self.state.updated({symbol: reached})
        lower, upper = (ends[move.key] for ends in self.known.limits)
        arrived = abs(reached - target) <= SAME * (upper - lower)
        self.known.locks[move].observe(before, arrived)
        self.tries.append(LockTry(symbol, target, arrived))
        return arrived

    def find_unexplored(self) -> list[KeySide]:
        """Return the fewest known moves to a try of unknown result, and that try; none if there is none."""
        known, erratic = self.known, self.erratic
        paths: dict[Configuration, list[KeySide]] = {self.here: []}
        waiting = deque(paths)
        while waiting and len(paths) < _MOST_CONFIGURATIONS:
            here = waiting.popleft()
            chances = {
                move: lock.probability(here)
                for move, lock in known.locks.items()
                if here[move.key] != known.end(move) and known.coordinates[move.key] not in erratic
            }
            unknown = {move: chance for move, chance in chances.items() if 0.0 < chance < 1.0}
            if unknown:
                return [*paths[here], max(unknown, key=unknown.__getitem__)]
            for move in (move for move, chance in chances.items() if chance == 1.0):
                there = (*here[: move.key], known.end(move), *here[move.key + 1 :])
                if there not in paths:
                    paths[there] = [*paths[here], move]
                    waiting.append(there)
        return []

    def list_locks(self) -> tuple[LearnedLock, ...]:
        names, result = self.known.coordinates, list[LearnedLock]()
        for move, lock in self.known.locks.items():
            if lock.is_tried:
                certain = lock.necessary()
                further = {s for one in lock.sufficient() for s in one if lock.refused and s not in certain}
                result.append(
                    LearnedLock(
                        names[move.key],
                        move.side,
                        len(lock.moved),
                        len(lock.refused),
                        tuple((names[s.key], s.side, ends) for s, ends in certain.items()),
                        tuple((names[s.key], s.side) for s in sorted(further)),
                        lock.is_conjunction,
                    )
                )
        return tuple(result)
