"""Stages of identification in C, with the numpy path where there is no compiler."""

from __future__ import annotations

import ctypes
import functools
import math
import threading
from collections.abc import Callable, Sequence
from typing import TypeGuard
from weakref import WeakKeyDictionary

import numpy as np

from kineverse.lie import Array

from . import ambiguities, maximum_likelihood, optimise, range_prior
from . import evidence as integrated
from .bindings import MOTION_SIZE, Given, Problem, library, pack_motion, problem_of, unpack_motion
from .evidence import Evidence
from .families import PITCHES, REACH, GroupMotion, JointFamily
from .maximum_likelihood import Scored
from .motion_model import FamilyMember, LinearisedPoses
from .observations import Observations
from .optimise import InitialGuess, JointValuePrior, Solution

# Numbers behind those of the motion. Mean and precision of what is believed are for six joint values at most.
_COST, _CONVERGED, _MARGINAL, _LOG = range(MOTION_SIZE, MOTION_SIZE + 4)
_MEAN, _PRECISION, _HEAD = MOTION_SIZE + 4, MOTION_SIZE + 10, MOTION_SIZE + 16


class SolutionBuffer:
    """All numbers of a solution, and the arrays that they are.

    Parameters
    ----------
    motion
        A member of the family.
    joint_prior
        What is believed of joint values.
    values, parents
        Joint values (N, k) and true poses of the parent (N, 4, 4) to begin with.
    """

    __slots__ = ("_covariances", "_linear", "_motion", "_parents", "_residuals", "_values", "numbers")

    def __init__(
        self, motion: GroupMotion, joint_prior: JointValuePrior, values: Array, parents: Array
    ) -> None:
        count, rows, joints, size = len(parents), motion.rows, motion.joints, motion.size
        shapes = ((joints,), (4, 4), (rows,), (rows, rows), (4, 4), (rows, size), (rows, joints))
        lengths = [count * math.prod(shape) for shape in shapes]
        self.numbers = np.empty(_HEAD + sum(lengths))
        arrays, at = [], _HEAD
        for shape, length in zip(shapes, lengths, strict=True):
            arrays.append(self.numbers[at : at + length].reshape(count, *shape))
            at += length
        self._values, self._parents, self._residuals, self._covariances, *linear = arrays
        self._linear = LinearisedPoses(*linear)
        self._motion = motion
        self._values[:] = values
        self._parents[:] = parents
        head = self.numbers
        head[:MOTION_SIZE] = pack_motion(motion)
        head[_MARGINAL] = joint_prior.marginal
        head[_MEAN : _MEAN + joints] = joint_prior.mean
        head[_PRECISION : _PRECISION + joints] = joint_prior.precision

    @staticmethod
    def from_solution(solution: Solution[GroupMotion]) -> SolutionBuffer:
        """Return a solution in memory of its own."""
        answer = SolutionBuffer(solution.motion, solution.joint_prior, solution.values, solution.parent)
        answer.numbers[_COST], answer.numbers[_CONVERGED] = solution.cost, solution.converged
        answer._residuals[:] = solution.residuals
        answer._covariances[:] = solution.covariance
        for to, array in zip(answer._linear, solution.linear, strict=True):
            to[:] = array
        return answer

    @property
    def log_evidence(self) -> float:
        """The logarithm of the evidence."""
        return float(self.numbers[_LOG])

    @property
    def solution(self) -> Solution[GroupMotion]:
        """What C has left here. It shares this memory."""
        head, joints = self.numbers, self._values.shape[1]
        return Solution(
            motion=unpack_motion(self._motion, head),
            values=self._values,
            cost=float(head[_COST]),
            residuals=self._residuals,
            covariance=self._covariances,
            linear=self._linear,
            parent=self._parents,
            joint_prior=JointValuePrior(
                head[_MEAN : _MEAN + joints],
                head[_PRECISION : _PRECISION + joints],
                bool(head[_MARGINAL]),
            ),
            converged=bool(head[_CONVERGED]),
        )


_CONSTANTS = {
    "reach_scale": REACH,
    "pitch_scale": PITCHES,
    "close": optimise.CLOSE,
    "steps": optimise.STEPS,
    "first_steps": optimise.FIRST_STEPS,
    "little": range_prior.LITTLE,
    "widths": len(range_prior.GRID),
    "grid": range_prior.GRID.ctypes.data,
    "slid": ambiguities.SLIDING_TOLERANCE,
    "sliding_turns": ambiguities.SLIDING_TURNS,
    "better": ambiguities.BETTER,
    "mirrored_turns": ambiguities.MIRROR_TURNS,
    "mirrored_steps": ambiguities.MIRROR_STEPS,
    "narrowest": maximum_likelihood.NARROWEST,
    "settled": maximum_likelihood.SETTLED,
    "turns": maximum_likelihood.TURNS,
}
# Memory of more numbers than this is given back after each stage.
_KEPT = 4_000_000


class IdentificationSolver:
    """Does what :mod:`.refining` and :mod:`.evidence` do, in C once that is compiled."""

    @property
    def is_native(self) -> bool:
        """Whether C does the work."""
        return library.is_native

    def prepare(self, wait: bool = False) -> bool:
        """Have C compiled, see :meth:`.SourceLibrary.prepare`."""
        return library.prepare(wait)

    def solve(
        self,
        observations: Observations,
        start: InitialGuess,
        parent: Array,
        joint_prior: JointValuePrior,
        steps: int = optimise.STEPS,
    ) -> Solution[FamilyMember]:
        """Do what :func:`.optimise.levenberg_marquardt` does."""
        motion = start.motion
        if not _is_for_c(motion):
            return optimise.levenberg_marquardt(
                observations, motion, start.values, parent, joint_prior, steps
            )
        problem, answer = (
            _problem(observations, motion),
            SolutionBuffer(motion, joint_prior, start.values, parent),
        )
        problem.steps = steps
        _run(library.code.solve, problem, answer)
        return answer.solution

    def maximum_likelihood(self, observations: Observations, starts: Sequence[InitialGuess]) -> Scored:
        """Do what :func:`.maximum_likelihood.maximum_likelihood` does."""
        motions = [start.motion for start in starts if _is_for_c(start.motion)]
        if len(motions) < len(starts):
            return maximum_likelihood.maximum_likelihood(observations, starts)
        motion = motions[0]
        answer = SolutionBuffer(
            motion, JointValuePrior.vague(motion.joints), starts[0].values, observations.parent
        )
        begin, values = (
            np.array([pack_motion(m) for m in motions]),
            np.array([start.values for start in starts]),
        )
        given = len(starts), begin.ctypes.data, values.ctypes.data
        _run(library.code.likeliest, _problem(observations, motion), answer, given)
        return Scored(answer.solution, answer.log_evidence)

    def maximise_marginal_likelihood(
        self, observations: Observations, solution: Solution[FamilyMember]
    ) -> Scored:
        """Do what :func:`.maximum_likelihood.maximise_marginal_likelihood` does."""
        if not _is_of_c(solution):
            return maximum_likelihood.maximise_marginal_likelihood(observations, solution)
        answer = SolutionBuffer.from_solution(solution)
        _run(library.code.refine, _problem(observations, solution.motion), answer)
        return Scored(answer.solution, answer.log_evidence)

    def continue_from(
        self,
        observations: Observations,
        start: InitialGuess,
        parent: Array,
        joint_prior: JointValuePrior,
        known: int,
    ) -> Scored:
        """Do what :func:`.maximum_likelihood.continue_from` does."""
        motion = start.motion
        if not _is_for_c(motion):
            return maximum_likelihood.continue_from(observations, start, parent, joint_prior, known)
        problem, answer = (
            _problem(observations, motion),
            SolutionBuffer(motion, joint_prior, start.values, parent),
        )
        problem.given.fresh = len(observations) - known
        _run(library.code.carry_on, problem, answer)
        return Scored(answer.solution, answer.log_evidence)

    def evidence(self, solution: Solution[FamilyMember], scale: float = 1.0) -> Evidence:
        """Do what :func:`.evidence.laplace_evidence` does, for noise that is larger by a factor."""
        if not _is_of_c(solution):
            return integrated.laplace_evidence(solution.scaled(scale))
        logs, *rest = _rated(solution, np.array([scale]))
        values, covariances, information = rest
        return Evidence.from_information(
            float(logs[0]), information, solution.motion.size, values, covariances
        )

    def log_evidences(self, solution: Solution[FamilyMember], scales: Array) -> Array:
        """Return the logarithm of the evidence for noise that is larger by several factors."""
        if not _is_of_c(solution):
            return np.array([integrated.laplace_evidence(solution.scaled(c)).log_evidence for c in scales])
        return _rated(solution, scales)[0]


solver = IdentificationSolver()


def _is_for_c(motion: FamilyMember) -> TypeGuard[GroupMotion]:
    return library.is_native and isinstance(motion, GroupMotion) and motion.is_plain


def _is_of_c(solution: Solution[FamilyMember]) -> TypeGuard[Solution[GroupMotion]]:
    return _is_for_c(solution.motion)


def _run(
    stage: Callable[..., None],
    problem: Problem,
    answer: SolutionBuffer,
    given: Sequence[int] = (),
    results: Sequence[Array] = (),
) -> None:
    """Run a stage: what it is given comes before its memory, and its results after the answer."""
    where = ctypes.addressof(problem)
    memory = _memory.reserve(library.code.memory_of(where))
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
    _run(
        library.code.rate,
        problem,
        SolutionBuffer.from_solution(solution),
        (len(scales), scales.ctypes.data),
        results,
    )
    return results


def _problem(observations: Observations, motion: GroupMotion) -> Problem:
    problem = Problem.from_buffer_copy(_family(motion.group, motion.rows))
    problem.given = _given(observations)
    return problem


@functools.cache
def _family(group: JointFamily, rows: int) -> Problem:
    problem = Problem.from_buffer_copy(problem_of(group, rows))
    for name, value in _CONSTANTS.items():
        setattr(problem, name, value)
    return problem


_known: WeakKeyDictionary[Observations, Given] = WeakKeyDictionary()


def _given(observations: Observations) -> Given:
    """Return observations as C has them; they are the same for all families."""
    given = _known.get(observations)
    if given is None:
        given = Given(
            count=len(observations),
            known=observations.parent_covariance is None,
            softer=len(observations.softness),
        )
        arrays = {
            "parent": observations.parent,
            "child": observations.child,
            "parent_covariance": observations.parent_covariance,
            "child_covariance": observations.child_covariance,
            "softness": np.array(observations.softness),
        }
        # Kept with it, as C only knows where they are.
        given.arrays = [np.ascontiguousarray(a) for a in arrays.values() if a is not None]
        there = iter(given.arrays)
        for name, array in arrays.items():
            setattr(given, name, None if array is None else next(there).ctypes.data)
        _known[observations] = given
    return given


class _Memory(threading.local):
    """What C works in, kept from stage to stage."""

    def __init__(self) -> None:
        self._numbers = np.empty(0)

    def reserve(self, size: int) -> Array:
        """Return so many numbers at least."""
        if len(self._numbers) >= size:
            return self._numbers
        numbers = np.empty(size)
        if size <= _KEPT:
            self._numbers = numbers
        return numbers


_memory = _Memory()
