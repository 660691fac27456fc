"""Stages of identification over two primitives: Levenberg-Marquardt, and integration of the joint values.

The primitives run in C once it is compiled, with the functions of the motion, else in numpy.
"""

from __future__ import annotations

import ctypes
import functools
import itertools
import math
import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, TypeAlias

import numpy as np

from kineverse.compilation.interruption import raise_signal
from kineverse.lie import Array

from . import marginal_likelihood, native
from .families import prepare_functions
from .least_squares import CLOSE, ROUGH, STEPS, InitialGuess, JointValuePrior, Solution, levenberg_marquardt
from .marginal_likelihood import (
    Evidence,
    IntegratedValues,
    PerObservation,
    Scored,
    evidence_excess,
    evidence_of,
    has_sliding_point,
    integrate_joint_values,
    narrow_translations,
)
from .motion_functions import FamilyMember, GeneratedMotion, MotionForm, MotionModel
from .native import LinearisedPoses, Problem, library
from .observations import Observations

_FIRST_STEPS = 2  # steps of each of several starts, before the best of them continues
# Rounds of ranges and solutions, steps of each, and change of the log widths at convergence.
_TURNS, _TURN_STEPS, _SETTLED = 8, 10, 0.03
_NARROWEST = 1e-4  # least width of a range [m], [rad]
_KEPT = 4_000_000  # largest number of doubles of a work memory that is kept between calls
_ONE = np.ones((1, 2))
Shapes: TypeAlias = tuple[tuple[int, ...], ...]
_GIVEN = "parent", "child", "parent_covariance", "child_covariance"


class IdentificationSolver:
    """Stages of the solution of a family."""

    @property
    def is_native(self) -> bool:
        """True if the C library is loaded."""
        return library.is_native

    def prepare(self, wait: bool = False) -> bool:
        """Compile the C library and the functions of joint families in the background, or wait for them."""
        prepare_functions(wait)
        return native.prepare(wait)

    def solve(
        self,
        observations: Observations,
        start: InitialGuess,
        parent: Array,
        joint_prior: JointValuePrior,
        steps: int = STEPS,
    ) -> Solution[FamilyMember]:
        """Return the maximum of the likelihood, from a start."""
        return _solve(observations, [start], parent, joint_prior, steps)

    def maximum_likelihood(self, observations: Observations, starts: Sequence[InitialGuess]) -> Scored:
        """Return the maximum of the likelihood in a family, from the start that is best after a few steps."""
        first, *softer = [*observations.softened, observations]
        joint_prior = JointValuePrior.vague(starts[0].motion.joints)
        solution = _solve(first, starts, first.parent, joint_prior, close=ROUGH)
        for narrower in softer:
            solution = self._proceed(narrower, solution, joint_prior)
        return self._score(self._narrow(solution))

    def maximise_marginal_likelihood(
        self, observations: Observations, solution: Solution[FamilyMember]
    ) -> Scored:
        """Return the maximum of the marginal likelihood, in which the joint values are integrated out."""
        if not solution.motion.joints or not solution.motion.size:
            return self._score(solution)
        is_first = not solution.joint_prior.marginal
        best = self._widen(observations, solution)
        if is_first and observations.softened:
            # With positions this precise the maximum of the likelihood is a poor start: its motion is
            # distorted to fit each joint value. A prior on the ranges during the continuation prevents that.
            for softer in (*observations.softened, observations):
                solution = self._proceed(softer, solution, solution.joint_prior)
                other = self._widen(softer, solution)
                solution = other.solution
            best = max(best, other, key=lambda each: each.log_evidence)
        return best

    def _widen(self, observations: Observations, solution: Solution[FamilyMember]) -> Scored:
        """Alternate between the ranges of joint values and the other unknowns until the ranges converge."""
        prior = solution.joint_prior
        before: Array | None = prior.precision**-0.5 if prior.marginal else None
        for turn in range(_TURNS + 1):
            integrated = self._integrate(solution)
            widths = np.maximum(integrated.deviations, _NARROWEST)
            is_settled = before is not None and float(np.abs(np.log(widths / before)).max()) < _SETTLED
            if is_settled or turn == _TURNS:
                break
            before = widths
            prior = JointValuePrior(integrated.mean, widths**-2.0, marginal=True)
            solution = self._proceed(observations, solution, prior, _TURN_STEPS)
        return self._score(solution, integrated)

    def continue_from(
        self, observations: Observations, start: InitialGuess, parent: Array, joint_prior: JointValuePrior
    ) -> Scored:
        """Return the solution that continues an earlier one."""
        solution = self._narrow(self.solve(observations, start, parent, joint_prior))
        if joint_prior.marginal:
            return self.maximise_marginal_likelihood(observations, solution)
        return self._score(solution)

    def evidence(self, solution: Solution[FamilyMember], weight: float = 1.0) -> Evidence:
        """Return the evidence of a solution, for a weight of each observation's log likelihood."""
        return evidence_of(solution.motion, self._integrate(solution, weight))

    def log_evidences(
        self, solution: Solution[FamilyMember], factors: Array, parts: Array, weight: float = 1.0
    ) -> Array:
        """Return the log evidence for several sizes of the noise.

        The covariances of the residuals are the sum of two parts (2, N, m, m), times the squares of the
        factors (M, 2).
        """
        problem = _problem(solution.motion)
        if problem is not None:
            return _integrate(problem, solution, weight, factors, parts).logs
        covariances = (np.tensordot(each**2, parts, axes=1) for each in factors)
        scaled = (replace(solution, covariance=covariance) for covariance in covariances)
        return np.concatenate([integrate_joint_values(each, weight).logs for each in scaled])

    def _narrow(self, solution: Solution[FamilyMember]) -> Solution[FamilyMember]:
        if not has_sliding_point(solution.motion):
            return solution
        return narrow_translations(solution, self._integrate(solution).alone)

    def _proceed(
        self,
        observations: Observations,
        solution: Solution[FamilyMember],
        joint_prior: JointValuePrior,
        steps: int = STEPS,
    ) -> Solution[FamilyMember]:
        start = InitialGuess(solution.motion, solution.values)
        return _solve(observations, [start], solution.parent, joint_prior, steps)

    def _score(self, solution: Solution[FamilyMember], integrated: IntegratedValues | None = None) -> Scored:
        integrated = integrated or self._integrate(solution)
        return Scored(solution, float(integrated.logs[-1]) - evidence_excess(solution, integrated.alone))

    def _integrate(self, solution: Solution[FamilyMember], weight: float = 1.0) -> IntegratedValues:
        if weight == 1.0 and solution.integrated is not None:
            return solution.integrated
        problem = _problem(solution.motion)
        if problem is None:
            return integrate_joint_values(solution, weight)
        return _integrate(problem, solution, weight)


solver = IdentificationSolver()


def _problem(motion: MotionModel) -> Problem | None:
    """Return the C structure of a motion's family; None for numpy."""
    form: MotionForm | None = getattr(motion, "form", None)
    known = None if form is None or not library.is_native else native.problem_of(form)
    if known is None:
        return None
    problem, grid = Problem.from_buffer_copy(known), marginal_likelihood.GRID
    problem.little, problem.widths, problem.grid = marginal_likelihood.LITTLE, len(grid), grid.ctypes.data
    return problem


def _solve(
    observations: Observations,
    starts: Sequence[InitialGuess],
    parent: Array,
    joint_prior: JointValuePrior,
    steps: int = STEPS,
    close: float = CLOSE,
) -> Solution[FamilyMember]:
    """Return the maximum of the likelihood, from the start that is best after a few steps."""
    motion: Any = starts[0].motion
    problem = _problem(motion)
    if problem is None:
        run = partial(levenberg_marquardt, observations, joint_prior=joint_prior, close=close)
        few = _FIRST_STEPS if len(starts) > 1 else steps
        solutions = [run(*start, parent, steps=few) for start in starts]
        best = min(solutions, key=lambda each: each.cost)
        if len(starts) == 1 or best.converged:
            return best
        return run(best.motion, best.values, best.parent, steps=steps)
    count, joints = len(observations), problem.joints
    problem.count, problem.close, problem.marginal = count, close, joint_prior.marginal
    given = [(name, getattr(observations, name)) for name in _GIVEN]
    kept = [(name, np.ascontiguousarray(array)) for name, array in given if array is not None]
    for name, array in kept:
        setattr(problem, name, array.ctypes.data)
    problem.mean[:joints] = joint_prior.mean.tolist()
    problem.precision[:joints] = joint_prior.precision.tolist()
    generated: Sequence[tuple[Any, Array]] = starts
    begin = np.concatenate([part for each, values in generated for part in (each.state, values.ravel())])
    memory = _memory.reserve(count)
    shapes = _shapes(count, problem.states, problem.rows, problem.size, joints)
    answer, arrays = _reserve(shapes)
    head, state, values, at_end, residuals, covariance, *linear, logs = arrays[:10]
    at_end[:] = parent
    _call(library.code.solve, problem, len(starts), begin, _FIRST_STEPS, steps, memory, answer)
    motion = motion.with_state(state)
    rest = residuals, covariance, LinearisedPoses(*linear), at_end, joint_prior, bool(head[1])
    solution = Solution(motion, values, float(head[0]), *rest)
    solution.__dict__["integrated"] = _integrated(motion, logs, arrays[10:])
    return solution


@functools.lru_cache(maxsize=256)
def _shapes(count: int, states: int, rows: int, size: int, joints: int) -> Shapes:
    """Return shapes of a solution in C: two numbers, state, seven of observations, and its integral."""
    each = (joints,), (4, 4), (rows,), (rows, rows), (4, 4), (rows, size), (rows, joints)
    n = size + joints
    integral = (1,), (joints,), (joints,), (n, n), *((count, joints),) * 2, *((count, joints, joints),) * 2
    return (2,), (states,), *((count, *shape) for shape in each), (1,), *integral


@functools.lru_cache(maxsize=256)
def _slices(shapes: Shapes) -> tuple[slice, ...]:
    ends = itertools.accumulate(map(math.prod, shapes), initial=0)
    return tuple(slice(*pair) for pair in itertools.pairwise(ends))


def _reserve(shapes: Shapes) -> tuple[Array, list[Array]]:
    """Return memory, and the arrays in it."""
    parts = _slices(shapes)
    numbers = np.empty(parts[-1].stop)
    return numbers, [numbers[part].reshape(shape) for part, shape in zip(parts, shapes, strict=True)]


def _integrate(
    problem: Problem,
    solution: Solution[FamilyMember],
    weight: float,
    factors: Array = _ONE,
    covariances: Array | None = None,
) -> IntegratedValues:
    motion, problem.count = solution.motion, len(solution.values)
    assert isinstance(motion, GeneratedMotion)  # others have no C structure
    shapes = _shapes(problem.count, problem.states, problem.rows, problem.size, problem.joints)
    answer, arrays = _reserve(shapes[10:])
    logs = np.empty(len(factors))
    given = motion.state, solution.values, solution.residuals, solution.covariance, solution.linear.by_joints
    work = weight, _memory.reserve(problem.count)
    _call(library.code.rate, problem, len(factors), factors, covariances, *work, *given, logs, answer)
    return _integrated(motion, logs, arrays)


def _integrated(motion: GeneratedMotion, logs: Array, arrays: Sequence[Array]) -> IntegratedValues:
    log_likelihood, deviations, mean, information, alone, values, covariances, posterior = arrays
    single = PerObservation(alone, covariances, float(log_likelihood[0]))
    logs = logs + motion.log_density()
    return IntegratedValues(logs, deviations, mean, information, single, values, posterior)


def _call(function: Callable[..., None], problem: Problem, *arguments: Array | float | None) -> None:
    # C takes rows one after the other.
    kept = [np.ascontiguousarray(each) if isinstance(each, np.ndarray) else each for each in arguments]
    addresses = (each.ctypes.data if isinstance(each, np.ndarray) else each for each in kept)
    function(ctypes.addressof(problem), *addresses)
    raise_signal()


class _Memory(threading.local):
    """Work memory of C, one for each thread, reused between calls."""

    def __init__(self) -> None:
        self._numbers = np.empty(0)

    def reserve(self, count: int) -> Array:
        """Return memory for a number of observations."""
        size = library.code.memory_of(count)
        if len(self._numbers) >= size:
            return self._numbers
        numbers = np.empty(size)
        if size <= _KEPT:
            self._numbers = numbers
        return numbers


_memory = _Memory()
