"""Stages of identification in C, or the same in numpy where there is none yet."""

from __future__ import annotations

import ctypes
import functools
import threading
from collections.abc import Callable, Sequence
from typing import TypeGuard
from weakref import WeakKeyDictionary

import numpy as np

from . import evidence as integrated
from . import mirrored, refining, sliding, solving, widths
from .answer import Answer
from .evidence import Evidence
from .groups import PITCHES, REACH, Group, GroupMotion
from .library import Given, Problem, library, packed, problem_of
from .motion import Member
from .observations import Observations
from .refining import Rated
from .rigid import Array
from .solving import Belief, Solution, Start

_CONSTANTS = {
    "reach_scale": REACH,
    "pitch_scale": PITCHES,
    "close": solving.CLOSE,
    "steps": solving.STEPS,
    "first_steps": solving.FIRST_STEPS,
    "little": widths.LITTLE,
    "widths": len(widths.GRID),
    "grid": widths.GRID.ctypes.data,
    "slid": sliding.CLOSE,
    "sliding_turns": sliding.TURNS,
    "better": mirrored.BETTER,
    "mirrored_turns": mirrored.TURNS,
    "mirrored_steps": mirrored.STEPS,
    "narrowest": refining.NARROWEST,
    "settled": refining.SETTLED,
    "turns": refining.TURNS,
}
# Memory of more numbers than this is given back after each stage.
_KEPT = 4_000_000


class Solver:
    """Does what :mod:`.refining` and :mod:`.evidence` do, in C once that is compiled."""

    @property
    def is_native(self) -> bool:
        """Whether C does the work."""
        return library.is_native

    def prepare(self, wait: bool = False) -> bool:
        """Have C compiled, see :meth:`.SourceLibrary.prepare`."""
        return library.prepare(wait)

    def solve(
        self, seen: Observations, start: Start, parent: Array, belief: Belief, steps: int = solving.STEPS
    ) -> Solution[Member]:
        """Do what :func:`.solving.solve` does."""
        motion = start.motion
        if not _is_for_c(motion):
            return solving.solve(seen, motion, start.values, parent, belief, steps)
        problem, answer = _problem(seen, motion), Answer(motion, belief, start.values, parent)
        problem.steps = steps
        _run(library.code.solve, problem, answer)
        return answer.solution

    def likeliest(self, seen: Observations, starts: Sequence[Start]) -> Rated:
        """Do what :func:`.refining.likeliest` does."""
        motions = [start.motion for start in starts if _is_for_c(start.motion)]
        if len(motions) < len(starts):
            return refining.likeliest(seen, starts)
        motion = motions[0]
        answer = Answer(motion, Belief.vague(motion.joints), starts[0].values, seen.parent)
        begin, values = np.array([packed(m) for m in motions]), np.array([start.values for start in starts])
        given = len(starts), begin.ctypes.data, values.ctypes.data
        _run(library.code.likeliest, _problem(seen, motion), answer, given)
        return Rated(answer.solution, answer.log_evidence)

    def refined(self, seen: Observations, solution: Solution[Member]) -> Rated:
        """Do what :func:`.refining.refined` does."""
        if not _is_of_c(solution):
            return refining.refined(seen, solution)
        answer = Answer.of(solution)
        _run(library.code.refine, _problem(seen, solution.motion), answer)
        return Rated(answer.solution, answer.log_evidence)

    def continued(self, seen: Observations, start: Start, parent: Array, belief: Belief, known: int) -> Rated:
        """Do what :func:`.refining.continued` does."""
        motion = start.motion
        if not _is_for_c(motion):
            return refining.continued(seen, start, parent, belief, known)
        problem, answer = _problem(seen, motion), Answer(motion, belief, start.values, parent)
        problem.given.fresh = len(seen) - known
        _run(library.code.carry_on, problem, answer)
        return Rated(answer.solution, answer.log_evidence)

    def evidence(self, solution: Solution[Member], scale: float = 1.0) -> Evidence:
        """Do what :func:`.evidence.evidence` does, for noise that is larger by a factor."""
        if not _is_of_c(solution):
            return integrated.evidence(solution.scaled(scale))
        logs, *rest = _rated(solution, np.array([scale]))
        values, covariances, information = rest
        return Evidence.of(float(logs[0]), information, solution.motion.size, values, covariances)

    def log_evidences(self, solution: Solution[Member], scales: Array) -> Array:
        """Return the logarithm of the evidence for noise that is larger by several factors."""
        if not _is_of_c(solution):
            return np.array([integrated.evidence(solution.scaled(c)).log_evidence for c in scales])
        return _rated(solution, scales)[0]


solver = Solver()


def _is_for_c(motion: Member) -> TypeGuard[GroupMotion]:
    return library.is_native and isinstance(motion, GroupMotion) and motion.is_plain


def _is_of_c(solution: Solution[Member]) -> TypeGuard[Solution[GroupMotion]]:
    return _is_for_c(solution.motion)


def _run(
    stage: Callable[..., None],
    problem: Problem,
    answer: Answer,
    given: Sequence[int] = (),
    results: Sequence[Array] = (),
) -> None:
    """Run a stage: what it is given comes before its memory, and its results after the answer."""
    where = ctypes.addressof(problem)
    memory = _memory.of(library.code.memory_of(where))
    addresses = (array.ctypes.data for array in (memory, answer.numbers, *results))
    stage(where, *given, *addresses)


def _rated(solution: Solution[GroupMotion], scales: Array) -> tuple[Array, ...]:
    """Return the logarithms of the evidence; of the last also joint values, covariances and information."""
    motion, (count, joints) = solution.motion, solution.values.shape
    problem = Problem.from_buffer_copy(_family(motion.group, motion.rows))
    problem.given.count = count
    unknowns = motion.size + joints + motion.slides
    shapes = (len(scales),), (count, joints), (count, joints, joints), (unknowns, unknowns)
    results = tuple(np.empty(shape) for shape in shapes)
    _run(library.code.rate, problem, Answer.of(solution), (len(scales), scales.ctypes.data), results)
    return results


def _problem(seen: Observations, motion: GroupMotion) -> Problem:
    problem = Problem.from_buffer_copy(_family(motion.group, motion.rows))
    problem.given = _given(seen)
    return problem


@functools.cache
def _family(group: Group, rows: int) -> Problem:
    problem = Problem.from_buffer_copy(problem_of(group, rows))
    for name, value in _CONSTANTS.items():
        setattr(problem, name, value)
    return problem


_known: WeakKeyDictionary[Observations, Given] = WeakKeyDictionary()


def _given(seen: Observations) -> Given:
    """Return observations as C has them; they are the same for all families."""
    given = _known.get(seen)
    if given is None:
        given = Given(count=len(seen), known=seen.parent_covariance is None, softer=len(seen.softness))
        arrays = {
            "parent": seen.parent,
            "child": seen.child,
            "parent_covariance": seen.parent_covariance,
            "child_covariance": seen.child_covariance,
            "softness": np.array(seen.softness),
        }
        # Kept with it, as C only knows where they are.
        given.arrays = [np.ascontiguousarray(a) for a in arrays.values() if a is not None]
        there = iter(given.arrays)
        for name, array in arrays.items():
            setattr(given, name, None if array is None else next(there).ctypes.data)
        _known[seen] = given
    return given


class _Memory(threading.local):
    """What C works in, kept from stage to stage."""

    def __init__(self) -> None:
        self._numbers = np.empty(0)

    def of(self, size: int) -> Array:
        """Return so many numbers at least."""
        if len(self._numbers) >= size:
            return self._numbers
        numbers = np.empty(size)
        if size <= _KEPT:
            self._numbers = numbers
        return numbers


_memory = _Memory()
