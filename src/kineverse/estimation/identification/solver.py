"""Stages of identification in C, with the numpy path where there is no compiler."""

from __future__ import annotations

import ctypes
import functools
import math
import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeGuard
from weakref import WeakKeyDictionary

import numpy as np

from kineverse.compilation.interruption import raise_signal
from kineverse.lie import Array

from . import joint_values, least_squares, marginal_likelihood
from .families import PITCHES, REACH, GroupMotion, JointFamily
from .least_squares import InitialGuess, JointValuePrior, Solution
from .marginal_likelihood import Evidence, Scored, laplace_evidence
from .motion_model import FamilyMember, LinearisedPoses
from .native import MOTION_SIZE, Given, Problem, library, pack_motion, problem_of, unpack_motion
from .observations import Observations

# Header entries after those of the motion. Prior mean and precision have room for six joint values.
_COST, _CONVERGED, _MARGINAL, _LOG = range(MOTION_SIZE, MOTION_SIZE + 4)
_MEAN, _PRECISION, _HEAD = MOTION_SIZE + 4, MOTION_SIZE + 10, MOTION_SIZE + 16


class SolutionBuffer:
    """Contiguous memory of a solution, shared with C, and views of it as arrays."""

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
        """Return a copy of a solution in a new buffer."""
        buffer = SolutionBuffer(solution.motion, solution.joint_prior, solution.values, solution.parent)
        buffer.numbers[_COST], buffer.numbers[_CONVERGED] = solution.cost, solution.converged
        buffer._residuals[:] = solution.residuals
        buffer._covariances[:] = solution.covariance
        for to, array in zip(buffer._linear, solution.linear, strict=True):
            to[:] = array
        return buffer

    @property
    def scored(self) -> Scored:
        """Solution in the buffer and its log evidence."""
        return Scored(self.solution, float(self.numbers[_LOG]))

    @property
    def solution(self) -> Solution[GroupMotion]:
        """Solution in the buffer. Its arrays share the memory."""
        head, joints = self.numbers, self._values.shape[1]
        mean, precision = head[_MEAN : _MEAN + joints], head[_PRECISION : _PRECISION + joints]
        return Solution(
            motion=unpack_motion(self._motion, head),
            values=self._values,
            cost=float(head[_COST]),
            residuals=self._residuals,
            covariance=self._covariances,
            linear=self._linear,
            parent=self._parents,
            joint_prior=JointValuePrior(mean, precision, bool(head[_MARGINAL])),
            converged=bool(head[_CONVERGED]),
        )


_CONSTANTS = {
    "reach_scale": REACH,
    "pitch_scale": PITCHES,
    "close": least_squares.CLOSE,
    "steps": least_squares.STEPS,
    "first_steps": least_squares.FIRST_STEPS,
    "little": joint_values.LITTLE,
    "widths": len(joint_values.GRID),
    "grid": joint_values.GRID.ctypes.data,
    "slid": joint_values.SLIDING_TOLERANCE,
    "sliding_turns": joint_values.SLIDING_TURNS,
    "better": joint_values.BETTER,
    "mirrored_turns": joint_values.MIRROR_TURNS,
    "mirrored_steps": joint_values.MIRROR_STEPS,
    "narrowest": marginal_likelihood.NARROWEST,
    "settled": marginal_likelihood.SETTLED,
    "turns": marginal_likelihood.TURNS,
    "weight": 1.0,
}
_KEPT = 4_000_000  # largest number of doubles of a work memory that is kept between stages


class IdentificationSolver:
    """Stages of :mod:`.marginal_likelihood`, in C once it is compiled, else in numpy."""

    @property
    def is_native(self) -> bool:
        """True if the C kernels are loaded."""
        return library.is_native

    def prepare(self, wait: bool = False) -> bool:
        """Compile the C kernels in the background, see :meth:`.SourceLibrary.prepare`."""
        return library.prepare(wait)

    def solve(
        self,
        observations: Observations,
        start: InitialGuess,
        parent: Array,
        joint_prior: JointValuePrior,
        steps: int = least_squares.STEPS,
    ) -> Solution[FamilyMember]:
        """Run :func:`.least_squares.levenberg_marquardt`."""
        motion = start.motion
        if not _has_kernel(motion):
            return least_squares.levenberg_marquardt(observations, *start, parent, joint_prior, steps)
        problem = _problem(observations, motion)
        buffer = SolutionBuffer(motion, joint_prior, start.values, parent)
        problem.steps = steps
        _run(library.code.solve, problem, buffer)
        return buffer.solution

    def maximum_likelihood(self, observations: Observations, starts: Sequence[InitialGuess]) -> Scored:
        """Run :func:`.marginal_likelihood.maximum_likelihood`."""
        motions = [start.motion for start in starts if _has_kernel(start.motion)]
        if len(motions) < len(starts):
            return marginal_likelihood.maximum_likelihood(observations, starts)
        motion, vague = motions[0], JointValuePrior.vague(motions[0].joints)
        buffer = SolutionBuffer(motion, vague, starts[0].values, observations.parent)
        packed = np.array([pack_motion(m) for m in motions])
        values = np.array([start.values for start in starts])
        arguments = len(starts), packed.ctypes.data, values.ctypes.data
        _run(library.code.likeliest, _problem(observations, motion), buffer, arguments)
        return buffer.scored

    def maximise_marginal_likelihood(
        self, observations: Observations, solution: Solution[FamilyMember]
    ) -> Scored:
        """Run :func:`.marginal_likelihood.maximise_marginal_likelihood`."""
        if not _is_kernel_solution(solution):
            return marginal_likelihood.maximise_marginal_likelihood(observations, solution)
        buffer = SolutionBuffer.from_solution(solution)
        _run(library.code.refine, _problem(observations, solution.motion), buffer)
        return buffer.scored

    def continue_from(
        self,
        observations: Observations,
        start: InitialGuess,
        parent: Array,
        joint_prior: JointValuePrior,
        known: int,
    ) -> Scored:
        """Run :func:`.marginal_likelihood.continue_from`."""
        motion = start.motion
        if not _has_kernel(motion):
            return marginal_likelihood.continue_from(observations, start, parent, joint_prior, known)
        problem = _problem(observations, motion)
        buffer = SolutionBuffer(motion, joint_prior, start.values, parent)
        problem.given.fresh = len(observations) - known
        _run(library.code.carry_on, problem, buffer)
        return buffer.scored

    def evidence(self, solution: Solution[FamilyMember], weight: float = 1.0) -> Evidence:
        """Run :func:`.marginal_likelihood.laplace_evidence`."""
        if not _is_kernel_solution(solution):
            return laplace_evidence(solution, weight)
        logs, *of_joints, information = _evaluate_evidence(solution, np.ones((1, 2)), weight=weight)
        return Evidence.from_information(float(logs[0]), information, solution.motion.size, *of_joints)

    def log_evidences(
        self, solution: Solution[FamilyMember], factors: Array, parts: Array, weight: float = 1.0
    ) -> Array:
        """Return the log evidence for each of several sizes of the noise."""
        if _is_kernel_solution(solution):
            return _evaluate_evidence(solution, factors, parts, weight)[0]
        covariances = (np.tensordot(each**2, parts, axes=1) for each in factors)
        scaled = (replace(solution, covariance=covariance) for covariance in covariances)
        return np.array([laplace_evidence(each, weight).log_evidence for each in scaled])


solver = IdentificationSolver()


def _has_kernel(motion: FamilyMember) -> TypeGuard[GroupMotion]:
    return library.is_native and isinstance(motion, GroupMotion) and motion.is_plain


def _is_kernel_solution(solution: Solution[FamilyMember]) -> TypeGuard[Solution[GroupMotion]]:
    return _has_kernel(solution.motion)


def _run(
    stage: Callable[..., None],
    problem: Problem,
    buffer: SolutionBuffer,
    arguments: Sequence[int] = (),
    results: Sequence[Array] = (),
) -> None:
    address = ctypes.addressof(problem)
    memory = _memory.reserve(library.code.memory_of(address))
    stage(address, *arguments, *(array.ctypes.data for array in (memory, buffer.numbers, *results)))
    raise_signal()


def _evaluate_evidence(
    solution: Solution[GroupMotion], factors: Array, parts: Array | None = None, weight: float = 1.0
) -> tuple[Array, ...]:
    """Return the log evidence by size of the noise; joint values, covariances, information of the last."""
    motion, (count, joints) = solution.motion, solution.values.shape
    problem = Problem.from_buffer_copy(_family(motion.group, motion.rows))
    problem.given.count, problem.weight = count, weight
    unknowns = motion.size + joints + motion.slides
    shapes = (len(factors),), (count, joints), (count, joints, joints), (unknowns, unknowns)
    results = tuple(np.empty(shape) for shape in shapes)
    factors = np.ascontiguousarray(factors)
    arguments = len(factors), factors.ctypes.data, 0 if parts is None else parts.ctypes.data
    _run(library.code.rate, problem, SolutionBuffer.from_solution(solution), arguments, results)
    return results


def _problem(observations: Observations, motion: GroupMotion) -> Problem:
    problem = Problem.from_buffer_copy(_family(motion.group, motion.rows))
    problem.given = _observations_structure(observations)
    return problem


@functools.cache
def _family(group: JointFamily, rows: int) -> Problem:
    problem = Problem.from_buffer_copy(problem_of(group, rows))
    for name, value in _CONSTANTS.items():
        setattr(problem, name, value)
    return problem


_structures: WeakKeyDictionary[Observations, Given] = WeakKeyDictionary()


def _observations_structure(observations: Observations) -> Given:
    """Return the C structure of observations. All families share it, so it is cached."""
    structure = _structures.get(observations)
    if structure is None:
        is_known, softer = observations.parent_covariance is None, len(observations.softness)
        structure = Given(count=len(observations), known=is_known, softer=softer)
        # The structure holds bare addresses, so it has to keep the arrays alive.
        structure.arrays = []
        for name in ("parent", "child", "parent_covariance", "child_covariance", "softness"):
            if (array := getattr(observations, name)) is not None:
                structure.arrays.append(np.ascontiguousarray(array, dtype=np.float64))
                setattr(structure, name, structure.arrays[-1].ctypes.data)
        _structures[observations] = structure
    return structure


class _Memory(threading.local):
    """Work memory of the C stages, one for each thread, reused between stages."""

    def __init__(self) -> None:
        self._numbers = np.empty(0)

    def reserve(self, size: int) -> Array:
        """Return memory of at least ``size`` numbers."""
        if len(self._numbers) >= size:
            return self._numbers
        numbers = np.empty(size)
        if size <= _KEPT:
            self._numbers = numbers
        return numbers


_memory = _Memory()
