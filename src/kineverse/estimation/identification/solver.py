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
from typing import Any

import numpy as np

from kineverse.compilation.interruption import raise_signal
from kineverse.lie import Array

from . import joint_values, native
from .families import prepare_functions
from .joint_values import PerObservation, has_sliding_point, narrow_translations
from .least_squares import CLOSE, STEPS, InitialGuess, JointValuePrior, Solution, levenberg_marquardt
from .marginal_likelihood import (
    Evidence,
    IntegratedValues,
    Scored,
    evidence_excess,
    evidence_of,
    integrate_joint_values,
)
from .motion_functions import GeneratedMotion, MotionForm
from .motion_model import FamilyMember, FixedMotion, LinearisedPoses, MotionModel
from .native import Problem, library
from .observations import Observations

_FIRST_STEPS = 2  # steps of each of several starts, before the best of them continues
_TURNS, _SETTLED = 8, 0.01  # rounds of ranges and solutions, and change of the log widths at convergence
_NARROWEST = 1e-4  # least width of a range [m], [rad]
_KEPT = 4_000_000  # largest number of doubles of a work memory that is kept between calls
_ONE = np.ones((1, 2))
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
        motion, values = start
        problem = _problem(motion)
        if problem is None:
            return levenberg_marquardt(observations, motion, values, parent, joint_prior, steps)
        return _solve(problem, observations, motion, values, parent, joint_prior, steps)

    def maximum_likelihood(self, observations: Observations, starts: Sequence[InitialGuess]) -> Scored:
        """Return the maximum of the likelihood in a family, from the start that is best after a few steps."""
        first, *softer = [*observations.softened, observations]
        joint_prior = JointValuePrior.vague(starts[0].motion.joints)
        steps = _FIRST_STEPS if len(starts) > 1 else STEPS
        begun = [self.solve(first, start, first.parent, joint_prior, steps) for start in starts]
        solution = min(begun, key=lambda each: each.cost)
        for narrower in ([] if solution.converged or steps == STEPS else [first]) + softer:
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
            solution = self._proceed(observations, solution, prior)
        return self._score(solution, integrated)

    def continue_from(
        self,
        observations: Observations,
        start: InitialGuess,
        parent: Array,
        joint_prior: JointValuePrior,
        known: int,
    ) -> Scored:
        """Return the solution of more observations than ``known``, continued from an earlier one."""
        motion, values = start
        if known < len(observations):
            new, values, parent = slice(known, None), values.copy(), parent.copy()
            fixed = InitialGuess(FixedMotion(motion), values[new])  # type: ignore[arg-type]
            projected = self.solve(observations.select(new), fixed, parent[new], joint_prior)
            values[new], parent[new] = projected.values, projected.parent
        solution = self._narrow(self.solve(observations, InitialGuess(motion, values), parent, joint_prior))
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
        self, observations: Observations, solution: Solution[FamilyMember], joint_prior: JointValuePrior
    ) -> Solution[FamilyMember]:
        start = InitialGuess(solution.motion, solution.values)
        return self.solve(observations, start, solution.parent, joint_prior)

    def _score(self, solution: Solution[FamilyMember], integrated: IntegratedValues | None = None) -> Scored:
        integrated = integrated or self._integrate(solution)
        return Scored(solution, float(integrated.logs[-1]) - evidence_excess(solution, integrated.alone))

    def _integrate(self, solution: Solution[FamilyMember], weight: float = 1.0) -> IntegratedValues:
        problem = _problem(solution.motion)
        if problem is None:
            return integrate_joint_values(solution, weight)
        return _integrate(problem, solution, weight)


solver = IdentificationSolver()


def _problem(motion: MotionModel) -> Problem | None:
    """Return the C structure of a motion's family; None for numpy."""
    form: MotionForm | None = getattr(motion, "form", None)
    problem = None if form is None or not library.is_native else native.problem_of(form)
    return None if problem is None else Problem.from_buffer_copy(problem)


def _solve(
    problem: Problem,
    observations: Observations,
    motion: FamilyMember,
    values: Array,
    parent: Array,
    joint_prior: JointValuePrior,
    steps: int,
) -> Solution[FamilyMember]:
    assert isinstance(motion, (GeneratedMotion, FixedMotion))  # others have no C structure
    count, joints = len(observations), problem.joints
    problem.count, problem.close, problem.marginal = count, CLOSE, joint_prior.marginal
    given = [(name, getattr(observations, name)) for name in _GIVEN]
    kept = [(name, np.ascontiguousarray(array)) for name, array in given if array is not None]
    for name, array in kept:
        setattr(problem, name, array.ctypes.data)
    problem.mean[:joints], problem.precision[:joints] = joint_prior.mean, joint_prior.precision
    size, states, *parts = _layout(count, problem.states, problem.rows, problem.size, joints)
    answer = np.empty(size)
    answer[states] = motion.state
    arrays = [answer[part].reshape(shape) for part, shape in parts]
    arrays[0][:], arrays[1][:] = values, parent
    _call(library.code.solve, problem, steps, _memory.reserve(count), answer)
    values, parent, residuals, covariance, *linear = arrays
    return Solution(
        motion=motion.with_state(answer[states]),
        values=values,
        cost=float(answer[0]),
        residuals=residuals,
        covariance=covariance,
        linear=LinearisedPoses(*linear),
        parent=parent,
        joint_prior=joint_prior,
        converged=bool(answer[1]),
    )


@functools.lru_cache(maxsize=256)
def _layout(count: int, states: int, rows: int, size: int, joints: int) -> tuple[Any, ...]:
    """Return the size of a solution in C, the slice of its state, and slices and shapes of its arrays."""
    each = (joints,), (4, 4), (rows,), (rows, rows), (4, 4), (rows, size), (rows, joints)
    shapes = [(count, *shape) for shape in each]
    ends = [*itertools.accumulate(map(math.prod, shapes), initial=2 + states)]
    parts = (slice(*pair) for pair in itertools.pairwise(ends))
    return ends[-1], slice(2, 2 + states), *zip(parts, shapes, strict=True)


def _integrate(
    problem: Problem,
    solution: Solution[FamilyMember],
    weight: float,
    factors: Array = _ONE,
    parts: Array | None = None,
) -> IntegratedValues:
    motion, (count, k), grid = solution.motion, solution.values.shape, joint_values.GRID
    assert isinstance(motion, GeneratedMotion)  # others have no C structure
    problem.count, problem.little = count, joint_values.LITTLE
    problem.widths, problem.grid = len(grid), grid.ctypes.data
    n = problem.size + k
    ends = [*itertools.accumulate((k, k, n * n, *(count * k,) * 2, *(count * k * k,) * 2), initial=1)]
    logs, numbers = np.empty(len(factors)), np.empty(ends[-1])
    given = motion.state, solution.values, solution.residuals, solution.covariance, solution.linear.by_joints
    memory = _memory.reserve(count)
    _call(library.code.rate, problem, len(factors), factors, parts, weight, memory, *given, logs, numbers)
    parted = (numbers[slice(*pair)] for pair in itertools.pairwise(ends))
    deviations, mean, information, *values = parted
    alone, posterior, alone_covariances, covariances = (
        each.reshape(shape)
        for each, shape in zip(values, [(count, k)] * 2 + [(count, k, k)] * 2, strict=True)
    )
    return IntegratedValues(
        logs + motion.log_density(), deviations, mean, information.reshape(n, n),
        PerObservation(alone, alone_covariances, float(numbers[0])), posterior, covariances,
    )  # fmt: skip


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
