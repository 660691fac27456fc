"""Plans of moves that unlock what interlocks hold, or the locks that make it impossible."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from time import perf_counter
from types import MappingProxyType
from typing import Any

from kineverse._checks import finite_number
from kineverse.errors import InvalidValueError
from kineverse.expressions.printing import format_number
from kineverse.model.model_view import ModelView, find_symbols
from kineverse.state import StateLike
from kineverse.symbols import Symbol

from .boxes import Interval
from .cell_graph import CellGraph, Move, MoveRule, make_graph, make_rules, relevant_rules
from .constraint_evaluation import start_point
from .find_interlocks import constant_limits, interlocks
from .interlock_records import Interlock, Interlocks, Undecided
from .move_search import MoveSearch, MoveSearchResult, Verdict, find_circle
from .plan_verification import InvariantSet, Region, plan_violations, refutation_gaps

BUDGET = 10.0  # default budget of a plan [s]
_BEYOND = 0.05  # largest distance by which a move goes beyond a threshold [m] or [rad]


@dataclass(frozen=True)
class UnlockingStep:
    """Move of one coordinate, and its purpose.

    Attributes
    ----------
    start, target
        Its positions before and after the move [m] or [rad].
    threshold
        Position that has to be passed; None if the target is a goal.
    releases
        Interlocks that hold later moves unless this one is made.

    See Also
    --------
    kineverse.reasoning.plan_unlocking
    """

    coordinate: Symbol
    start: float
    target: float
    threshold: float | None
    releases: tuple[Interlock, ...] = ()

    @property
    def reason(self) -> str:
        """Purpose of the move."""
        if self.threshold is None:
            return "it is the goal"
        symbols = (s.position for lock in self.releases for s in lock.held.symbols)
        held = dict.fromkeys(str(s) for s in symbols if s != self.coordinate)
        return f"it holds {_list_words(held)}" if held else "it clears the way"

    def as_data(self) -> dict[str, Any]:
        """Return the step as data for JSON."""
        return {
            "coordinate": str(self.coordinate),
            "from": self.start,
            "to": self.target,
            "threshold": self.threshold,
            "releases": sorted({name for lock in self.releases for name in lock.constraints}),
            "reason": self.reason,
        }

    def __str__(self) -> str:
        verb = "raise" if self.target > self.start else "lower"
        if self.threshold is None:
            return f"{verb} {self.coordinate} to {format_number(self.target, 6)}: {self.reason}"
        side = "above" if self.target > self.start else "below"
        return f"{verb} {self.coordinate} {side} {format_number(self.threshold, 6)}: {self.reason}"


@dataclass(frozen=True)
class UnlockingPlan:
    """Order of moves that reaches a goal, or a refutation.

    Attributes
    ----------
    goal
        Positions to reach, by coordinate.
    verdict
        ``"found"``, if :func:`.plan_violations` finds nothing wrong with the steps; ``"refuted"``, if
        :func:`.refutation_gaps` finds no exit from ``invariant``; otherwise ``"undecided"``.
    steps
        The moves, empty unless found.
    shortest
        True if there are no fewer moves.
    blocking
        Interlocks that keep the goal out of reach, each because of the next one, or all of them together.
    is_circle
        True if the last of these depends on the first one.
    unread
        Interlocks, and undecided constraints, that count as shut because they could not be read completely.
    fixed
        Coordinates that do not move, as stated.
    explored
        Number of combinations of intervals that were examined.
    reason
        Reason why it is undecided.
    invariant
        Positions without the goal that no move of one coordinate at a time leaves, for a refutation.

    See Also
    --------
    kineverse.reasoning.plan_unlocking
    """

    goal: Mapping[Symbol, float]
    verdict: Verdict
    steps: tuple[UnlockingStep, ...] = ()
    shortest: bool = False
    blocking: tuple[Interlock | Undecided, ...] = ()
    is_circle: bool = False
    unread: tuple[Interlock | Undecided, ...] = ()
    fixed: tuple[Symbol, ...] = ()
    explored: int = 0
    reason: str = ""
    invariant: InvariantSet | None = field(default=None, repr=False)

    def as_data(self) -> dict[str, Any]:
        """Return the plan as data for JSON: lists, mappings, texts and numbers."""
        return {
            "goal": {str(s): value for s, value in self.goal.items()},
            "verdict": self.verdict,
            "steps": [step.as_data() for step in self.steps],
            "shortest": self.shortest,
            "blocking": [str(lock) for lock in self.blocking],
            "circle": self.is_circle,
            "unread": [str(lock) for lock in self.unread],
            "still": [str(s) for s in self.fixed],
            "explored": self.explored,
            "reason": self.reason,
        }

    def __str__(self) -> str:
        if self.verdict == "found":
            if not self.steps:
                return "nothing has to move"
            lines = [f"{n}. {step}" for n, step in enumerate(self.steps, 1)]
        else:
            goal = _list_words(f"{s} = {format_number(value, 6)}" for s, value in self.goal.items())
            lines = [f"{goal}: {self._explain()}"]
            lines += [f"  {lock}" for lock in self.blocking]
        if self.unread:
            lines.append("treated as shut, since they could not be read:")
            lines += [f"  {lock}" for lock in self.unread]
        return "\n".join(lines)

    def _explain(self) -> str:
        if self.verdict == "undecided":
            return f"undecided, since {self.reason}"
        without = f" without {_list_words(map(str, self.fixed))}" if self.fixed else ""
        if not self.blocking:
            return f"cannot be reached{without}"
        how = "lock each other in a circle" if self.is_circle else "keep it out of reach"
        return f"cannot be reached{without}, since these {how}"


def plan_unlocking(
    model: ModelView,
    goal: Mapping[Symbol, float] | Mapping[str, float],
    state: StateLike | None = None,
    *,
    found: Interlocks | None = None,
    fixed: Collection[Symbol | str] = (),
    budget: float = BUDGET,
) -> UnlockingPlan:
    """Return the order in which coordinates have to move so that a goal is reached, or a refutation.

    One coordinate moves at a time, along its axis, from one interval between thresholds to another, back and
    forth as often as it takes. If all locks want their keys on one side, the plan has no superfluous move.
    Otherwise, up to 50 000 combinations of intervals, it has the fewest possible ones.

    Both answers are checked by evaluation of the constraints, without the code that found them: steps by
    :func:`.plan_violations`, a refutation by :func:`.refutation_gaps`. It holds for positions off the
    thresholds: there, comparisons are neither true nor false. Interlocks whose conditions are not intervals
    of single coordinates, and undecided constraints, count as shut in a plan, and as open in a refutation.
    They are listed if they may matter.

    Parameters
    ----------
    model
        A model or a snapshot.
    goal
        Positions to reach, by coordinate or its name [m] or [rad].
    state
        Positions at the start, by default :meth:`.Model.default_state`; missing ones are those there, and
        positions beyond limits count as at the limit.
    found
        Interlocks of the model if they are known, see :func:`.interlocks`.
    fixed
        Coordinates that do not move, such as those that did not move when they should have.
    budget
        Time for the search [s], after which the verdict is ``"undecided"``. Reading the interlocks takes time
        of its own.

    Raises
    ------
    InvalidValueError
        For a goal beyond its limits, no goal, a number that is not finite, a budget that is not positive, or
        a parameter in the state with another value than its own.

    Examples
    --------
    >>> model = kv.load("articulations/garage_door")
    >>> plan = kv.reasoning.plan_unlocking(model, {"garage_door/garage/door": 1.0})
    >>> plan.verdict, [step.coordinate for step in plan.steps]
    ('found', [garage_door/garage/bolt, garage_door/garage/door])
    """
    if not (isinstance(budget, int | float) and budget > 0):
        raise InvalidValueError(f"The budget of a plan is a positive time in seconds, not {budget!r}.")
    if not goal:
        raise InvalidValueError("A plan has a goal, such as {'garage/door': 1.5}.")
    limits = constant_limits(dict(model.constraints.items()))
    goals = {model.degree_of_freedom(name): value for name, value in goal.items()}
    goals = {s: _check_goal(s, value, limits.get(s, Interval())) for s, value in goals.items()}
    resting = tuple(model.degree_of_freedom(s) for s in find_symbols(model, fixed, "fixed="))
    known = interlocks(model) if found is None else found
    end = perf_counter() + budget
    coordinates, rules = relevant_rules(make_rules(model, known), goals)
    given = start_point(model, state)
    start = {}
    for s in coordinates:
        limit = limits.get(s, Interval())
        start[s] = min(max(float(given.get(s, 0.0)), float(limit.lower)), float(limit.upper))

    def search(some: Sequence[MoveRule]) -> tuple[CellGraph, MoveSearchResult]:
        graph = make_graph(coordinates, some, limits, start, goals, resting)
        return graph, MoveSearch(graph, lambda: perf_counter() > end).run()

    graph, result = search(rules)
    unread = tuple(dict.fromkeys(rule.lock for rule in rules if not rule.is_exact))
    plan = UnlockingPlan(
        MappingProxyType(goals), result.verdict, unread=unread, fixed=resting, explored=result.explored
    )
    if result.verdict == "found":
        steps = _make_steps(graph, result.moves, {s: given.get(s, 0.0) for s in coordinates}, goals)
        plan = replace(plan, steps=steps, shortest=result.shortest)
        wrong = plan_violations(model, plan, state)
        return replace(plan, verdict="undecided", steps=(), reason=_say_wrong(wrong)) if wrong else plan
    if result.verdict == "undecided":
        return replace(plan, reason=f"the budget was spent after {result.explored} combinations of intervals")
    chain, is_circle = find_circle(graph, result.reached)
    if not chain:
        # Each lock could be opened, but not all that are needed at once.
        chain = _find_conflict(rules, search)
    plan = replace(plan, blocking=tuple(dict.fromkeys(rule.lock for rule in chain)), is_circle=is_circle)
    if unread:
        graph, result = search([rule for rule in rules if rule.is_exact])
        if result.verdict != "refuted":
            return replace(plan, verdict="undecided", reason="a lock that could not be read may be open")
    plan = replace(plan, invariant=_make_invariant(graph, result))
    gaps = refutation_gaps(model, plan, state)
    return replace(plan, verdict="undecided", reason=_say_wrong(gaps)) if gaps else plan


def _say_wrong(found: Sequence[str]) -> str:
    more = f", and {len(found) - 1} more" if len(found) > 1 else ""
    return f"the constraints do not confirm the answer: {found[0]}{more}"


def _find_conflict(
    rules: Sequence[MoveRule], search: Callable[[Sequence[MoveRule]], tuple[CellGraph, MoveSearchResult]]
) -> tuple[MoveRule, ...]:
    """Return rules that are in conflict, without those that are not needed for it, as far as time allows."""
    kept = list(rules)
    for lock in dict.fromkeys(rule.lock for rule in rules):
        fewer = [rule for rule in kept if rule.lock != lock]
        if search(fewer)[1].verdict == "refuted":
            kept = fewer
    return tuple(kept)


def _make_invariant(graph: CellGraph, result: MoveSearchResult) -> InvariantSet:
    count = range(len(graph.coordinates))

    def region(states: int) -> Region:
        fields = ((states & graph.field(k)) >> graph.first[k] for k in count)
        return tuple(((field & -field).bit_length() - 1, field.bit_length() - 1) for field in fields)

    return InvariantSet(
        graph.coordinates,
        graph.cells,
        tuple(tuple(bool(graph.rests & graph.bit(k, n)) for n in range(len(graph.cells[k]))) for k in count),
        tuple(map(region, result.regions)),
        result.following,
    )


def _make_steps(
    graph: CellGraph, moves: tuple[Move, ...], start: Mapping[Symbol, float], goals: Mapping[Symbol, float]
) -> tuple[UnlockingStep, ...]:
    states = [graph.start]
    for move in moves:
        after = graph.apply(states[-1], move)
        assert after is not None  # the search takes free moves only
        states.append(after)
    following = _next_moves(moves)
    position, steps = dict(start), list[UnlockingStep]()
    for n, (k, cell) in enumerate(moves):
        symbol, side = graph.coordinates[k], graph.cells[k][cell]
        direction = 1 if cell > graph.cell_of(states[n], k) else -1
        ends = symbol in goals and goals[symbol] in side
        bound, room = float(side.lower if direction > 0 else side.upper), float(side.upper - side.lower)
        target = goals[symbol] if ends else bound + direction * min(_BEYOND, room / 2)
        last = following[n] == len(moves)
        releases = _released(graph, moves, states, n, following[n])
        threshold = None if ends and last else bound
        steps.append(UnlockingStep(symbol, position[symbol], target, threshold, releases))
        position[symbol] = target
    return tuple(steps)


def _next_moves(moves: tuple[Move, ...]) -> list[int]:
    """Return for each move the number of the next one of the same coordinate, or the number of moves."""
    following, seen = [len(moves)] * len(moves), dict[int, int]()
    for n in reversed(range(len(moves))):
        following[n] = seen.get(moves[n][0], len(moves))
        seen[moves[n][0]] = n
    return following


def _released(
    graph: CellGraph, moves: tuple[Move, ...], states: list[int], n: int, until: int
) -> tuple[Interlock, ...]:
    """Return the interlocks that would stop later moves if this one were not made."""
    k = moves[n][0]
    before, result = states[n] & graph.field(k), dict[Interlock, None]()
    for later in range(n + 1, until):
        for at, step in graph.path(states[later] & ~graph.field(k) | before, moves[later]):
            if step is not None:
                blocked = (r for m, r in zip(step.needs, step.rules, strict=True) if not m & at)
                result |= dict.fromkeys(r.lock for r in blocked if isinstance(r.lock, Interlock))
    return tuple(result)


def _check_goal(symbol: Symbol, value: object, limit: Interval) -> float:
    number = finite_number(value)
    if number is None:
        raise InvalidValueError(f"The goal of '{symbol}' is a finite number, not {value!r}.")
    if number not in limit:
        raise InvalidValueError(
            f"The goal {symbol} = {format_number(number, 6)} is beyond its limits "
            f"[{format_number(float(limit.lower))}, {format_number(float(limit.upper))}]."
        )
    return number


def _list_words(words: Any) -> str:
    listed = list(words)
    return listed[0] if len(listed) == 1 else f"{', '.join(listed[:-1])} and {listed[-1]}"
