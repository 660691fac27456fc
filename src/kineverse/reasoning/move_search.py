"""Search for moves from cell to cell: relaxed reachability, breadth-first and best-first search."""

from __future__ import annotations

import heapq
import math
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import count
from typing import Literal, TypeAlias

from .cell_graph import CellGraph, CellStep, Move, MoveRule

Verdict: TypeAlias = Literal["found", "refuted", "undecided"]
Parents: TypeAlias = dict[
    int, tuple[int, list[Move]] | None
]  # by state: the one before, and the moves from it
Edge: TypeAlias = tuple[int, int, int, CellStep]  # coordinate, bits of a cell and its neighbour, step
_EXHAUSTED_AT_MOST = 50_000  # largest number of states for which the shortest sequence is searched
_PRUNED_AT_MOST = 300


@dataclass(frozen=True)
class MoveSearchResult:
    """Moves to the goal, or the reason why there are none."""

    verdict: Verdict  # "found", "refuted", or "undecided" after the budget
    moves: tuple[Move, ...] = ()  # moves to the goal if it was found
    shortest: bool = False  # True if there are no fewer moves
    explored: int = 0  # number of states
    reached: int = 0  # bits of all cells that were reached, or for a refutation an upper bound of them
    regions: tuple[int, ...] = ()  # for a refutation, sets of states that no move leaves together
    following: tuple[tuple[int, ...], ...] = ()


@dataclass(frozen=True)
class MoveSearch:
    """Search on a graph of cells."""

    graph: CellGraph
    is_late: Callable[[], bool] = field(default=lambda: False)

    def run(self) -> MoveSearchResult:
        """Return the moves to the goal, the shortest ones if the graph is small."""
        graph = self.graph
        reached = self._reach
        if graph.goal & ~reached:
            return MoveSearchResult("refuted", explored=1, reached=reached, regions=(reached,))
        if all(self._best[k] is not None for k in range(len(graph.coordinates))):
            return self.search_best_first()
        rests = ((graph.rests & graph.field(k)).bit_count() for k in range(len(graph.coordinates)))
        if math.prod(rests) <= _EXHAUSTED_AT_MOST:
            return self.search_breadth_first()
        return self.search_best_first()

    # -- relaxation ----------------------------------------------------------------------------------------

    def relax(self, state: int) -> tuple[int, dict[int, Edge]]:
        """Return the cells that are reached if coordinates never leave a cell again, and the steps to them.

        The steps are in the order in which they become possible. Cells that are not among them are out of
        reach.
        """
        reached, by = state, dict[int, Edge]()
        waiting = self._edges
        while True:
            # A round sees the cells of the round before, so that the steps come by their distance.
            before, later = reached, []
            for edge in waiting:
                _, here, there, step = edge
                if reached & there:
                    continue
                if before & here and all(map(before.__and__, step.needs)):
                    reached |= there
                    by[there] = edge
                else:
                    later.append(edge)
            if reached == before:
                return reached, by
            waiting = later

    @cached_property
    def _reach(self) -> int:
        return self.relax(self.graph.start)[0]

    def estimate(self, state: int) -> tuple[float, int]:
        """Return the number of moves of a relaxed plan, infinite if there is none, and the bits it visits."""
        reached, by = self.relax(state)
        if self.graph.goal & ~reached:
            return math.inf, 0
        place = {bit: n for n, bit in enumerate(by)}
        visited, sources = state, set[int]()
        waiting = list(_bits(self.graph.goal & ~state))
        while waiting:
            there = waiting.pop()
            if visited & there:
                continue
            visited |= there
            coordinate, here, _, step = by[there]
            sources.add(coordinate)
            if not visited & here:
                waiting.append(here)
            unmet = (mask & reached for mask in step.needs if not mask & visited)
            waiting += [min(_bits(mask), key=place.__getitem__) for mask in unmet]
        return (visited & ~state).bit_count(), visited

    @cached_property
    def _edges(self) -> list[Edge]:
        graph, edges = self.graph, list[Edge]()
        for k, own in enumerate(graph.steps):
            for direction, steps in zip((1, -1), own, strict=True):
                for cell, step in enumerate(steps):
                    if step is not None and 0 not in step.needs:
                        edges.append((k, graph.bit(k, cell), graph.bit(k, cell + direction), step))
        return edges

    # -- moves that never harm -----------------------------------------------------------------------------

    @cached_property
    def _wanted(self) -> list[list[int]]:
        """For each coordinate the distinct sets of its cells that the steps of others, or the goal, want."""
        graph = self.graph
        masks = {mask for *_, step in self._edges for mask in step.needs} | set(_bits(graph.goal))
        return [
            sorted({mask & graph.field(k) & self._reach for mask in masks} - {0})
            for k in range(len(graph.coordinates))
        ]

    @cached_property
    def _best(self) -> list[int | None]:
        """The cell of each coordinate that serves all others at least as well as any other cell, or None.

        It is the nearest one to the start.
        """
        graph, best = self.graph, list[int | None]()
        for k, wanted in enumerate(self._wanted):
            common = graph.field(k) & (graph.rests | graph.start)
            for mask in wanted:
                common &= mask
            start, first = graph.cell_of(graph.start, k), graph.first[k]
            cells = (bit.bit_length() - 1 - first for bit in _bits(common))
            best.append(min(cells, key=lambda cell: abs(cell - start), default=None))
        return best

    @cached_property
    def _harmless(self) -> list[frozenset[int]]:
        """For each coordinate with a best cell, the cells from which there is no reason to go back.

        These are cells that serve others at least as well as all that are farther away from the best one on
        the same side; on the way to the best cell every state passes them. So whatever can be reached with
        the coordinate farther away can also be reached from there. All other cells may have to be left
        backwards before the best one can be reached.
        """
        graph, result = self.graph, list[frozenset[int]]()
        for k, best in enumerate(self._best):
            cells = range(len(graph.cells[k]))
            serves = [
                frozenset(n for n, mask in enumerate(self._wanted[k]) if mask & graph.bit(k, cell))
                for cell in cells
            ]
            fine = set[int]()
            if best is not None:
                for cell in cells:
                    beyond = range(cell) if cell <= best else range(cell + 1, len(cells))
                    if cell == best or all(serves[cell] >= serves[other] for other in beyond):
                        fine.add(cell)
            result.append(frozenset(fine))
        return result

    def advance(self, state: int) -> tuple[int, list[Move]]:
        """Move all coordinates that have a best cell towards it, as far as that never harms."""
        graph, moves = self.graph, list[Move]()
        todo = [k for k, best in enumerate(self._best) if best is not None]
        while True:
            moved = False
            for k in todo:
                best, cell = self._best[k], graph.cell_of(state, k)
                if best is None or cell == best:
                    continue
                chosen = None
                for reached, after in graph.sweep(state, k, 1 if best > cell else -1):
                    if reached in self._harmless[k]:
                        chosen = reached, after
                    if reached == best:
                        break
                if chosen is not None:
                    moves.append((k, chosen[0]))
                    state, moved = chosen[1], True
            if not moved:
                return state, moves

    # -- searches ------------------------------------------------------------------------------------------

    def search_breadth_first(self) -> MoveSearchResult:
        """Return the shortest sequence of moves; every state is reached at most once."""
        graph, every = self.graph, (1, -1)
        parents: Parents = {graph.start: None}
        waiting, reached = deque([graph.start]), graph.start
        if graph.is_goal(graph.start):
            return MoveSearchResult("found", (), True, 1, reached)
        while waiting:
            if self.is_late():
                return MoveSearchResult("undecided", explored=len(parents), reached=reached)
            state = waiting.popleft()
            for k in range(len(graph.coordinates)):
                for move, after in self._moves(state, k, every):
                    if after in parents:
                        continue
                    parents[after] = state, [move]
                    reached |= after
                    if graph.is_goal(after):
                        moves = tuple(_trace(parents, after))
                        return MoveSearchResult("found", moves, True, len(parents), reached)
                    waiting.append(after)
        return MoveSearchResult("refuted", explored=len(parents), reached=reached, regions=tuple(parents))

    def search_best_first(self) -> MoveSearchResult:
        """Return a sequence of moves without superfluous ones, or prove that there is none.

        Coordinates with a best cell move towards it as far as that never harms; moves that cannot help are
        left out. States are expanded by the length of a relaxed plan; those without one are left out.
        """
        graph = self.graph
        start, first = self.advance(graph.start)
        parents: Parents = {start: None}
        length, _ = self.estimate(start)
        queue, numbers, reached = [(length, 0, start)], count(1), start
        following: dict[int, list[int]] = {}
        while queue:
            if self.is_late():
                return MoveSearchResult("undecided", explored=len(parents), reached=reached)
            length, _, state = heapq.heappop(queue)
            if graph.is_goal(state):
                moves = [*first, *_trace(parents, state)]
                return MoveSearchResult("found", self.prune(moves), False, len(parents), reached)
            following[state] = []
            for k in range(len(graph.coordinates)):
                for move, moved in self._moves(state, k, self._useful_ways(state, k)):
                    after, more = self.advance(moved)
                    following[state].append(after)
                    if after in parents:
                        continue
                    parents[after] = state, [move, *more]
                    reached |= after
                    length, _ = self.estimate(after)
                    if length < math.inf:
                        heapq.heappush(queue, (length, next(numbers), after))
        place = {state: n for n, state in enumerate(parents)}
        regions = [self._dominated(state) for state in parents]
        for n, state in enumerate(parents):
            if state not in following:
                regions[n], _ = self.relax(regions[n])
        return MoveSearchResult(
            "refuted",
            explored=len(parents),
            reached=reached,
            regions=tuple(regions),
            following=tuple(tuple(place[s] for s in following.get(state, ())) for state in parents),
        )

    def _useful_ways(self, state: int, k: int) -> tuple[int, ...]:
        """Return the directions in which a coordinate may have to move from a state."""
        best, cell = self._best[k], self.graph.cell_of(state, k)
        if best is None or cell not in self._harmless[k]:
            return (1, -1)
        return () if cell == best else (1,) if best > cell else (-1,)

    def _dominated(self, state: int) -> int:
        """Return the bits of the cells from which no more can be reached than from a state."""
        graph, every = self.graph, self._reach
        for k, best in enumerate(self._best):
            cell = graph.cell_of(state, k)
            if best is None or cell not in self._harmless[k]:
                continue
            below = (graph.bit(k, cell) << 1) - 1
            beyond = -1 if cell == best else below if cell < best else ~(below >> 1)
            state |= graph.field(k) & every & beyond
        return state

    def _moves(self, state: int, k: int, directions: Sequence[int]) -> Iterator[tuple[Move, int]]:
        for direction in directions:
            for cell, after in self.graph.sweep(state, k, direction):
                yield (k, cell), after

    def prune(self, moves: Sequence[Move]) -> tuple[Move, ...]:
        """Return the moves without those that are not needed, the last ones tried first."""
        kept = list(moves)
        if len(kept) > _PRUNED_AT_MOST:
            return tuple(kept)
        for n in reversed(range(len(kept))):
            fewer = kept[:n] + kept[n + 1 :]
            state: int | None = self.graph.start
            for move in fewer:
                state = None if state is None else self.graph.apply(state, move)
            if state is not None and self.graph.is_goal(state):
                kept = fewer
        return tuple(kept)


def find_circle(graph: CellGraph, reached: int) -> tuple[tuple[MoveRule, ...], bool]:
    """Return rules that keep a goal out of reach, each because of the next, and whether they are a circle."""
    wanted = next(_bits(graph.goal & ~reached), 0)
    chain: list[MoveRule] = []
    seen: dict[int, int] = {}
    while wanted:
        concerned = [k for k in range(len(graph.coordinates)) if graph.field(k) & wanted]
        closing = next((k for k in concerned if k in seen), None)
        if closing is not None:
            return tuple(chain[seen[closing] :]), True
        # Of several exits, one that a lock closes explains more than one whose coordinate does not move.
        result = ((k, _blocking_rule(graph, k, graph.field(k) & wanted, reached)) for k in concerned)
        blocked = next(((k, one) for k, one in result if one is not None), None)
        if blocked is None:
            break
        k, (rule, wanted) = blocked
        seen[k] = len(chain)
        chain.append(rule)
    return tuple(chain), False


def _blocking_rule(graph: CellGraph, k: int, wanted: int, reached: int) -> tuple[MoveRule, int] | None:
    """Return the rule that stops a coordinate on its way to a cell, and the mask that releases it."""
    target = wanted.bit_length() - 1 - graph.first[k]
    cell = graph.cell_of(graph.start, k)
    direction = 1 if target > cell else -1
    while cell != target:
        step = graph.step(k, cell, direction)
        if step is None:
            return None
        for mask, rule in zip(step.needs, step.rules, strict=True):
            if not mask & reached:
                return rule, mask
        cell += direction
    return None


def _bits(mask: int) -> Iterator[int]:
    while mask:
        low = mask & -mask
        yield low
        mask ^= low


def _trace(parents: Parents, state: int) -> list[Move]:
    moves = list[Move]()
    while (link := parents[state]) is not None:
        state, own = link
        moves += reversed(own)
    return moves[::-1]
