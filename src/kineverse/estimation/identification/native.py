"""The solver in C, or the same in numpy where there is none yet."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import numpy as np

from .groups import PITCHES, REACH, GroupMotion
from .library import ARRAYS, Problem, library, linear_of, packed, problem_of, unpacked
from .motion import Member
from .observations import Observations
from .rigid import Array
from .solving import CLOSE, FIRST_STEPS, STEPS, Belief, Solution, Start, solve, solve_first


class Solver:
    """Solves in C, once that is compiled."""

    @property
    def is_native(self) -> bool:
        """Whether C does the work."""
        return library.is_native

    def prepare(self, wait: bool = False) -> bool:
        """Have C compiled, see :meth:`.library.Library.prepare`."""
        return library.prepare(wait)

    def solve(
        self,
        seen: Observations,
        motion: Member,
        values: Array,
        parent: Array | None = None,
        belief: Belief | None = None,
        steps: int = STEPS,
    ) -> Solution[Member]:
        """Do what :func:`.solving.solve` does."""
        if library.code is None or not isinstance(motion, GroupMotion):
            return solve(seen, motion, values, parent, belief, steps)
        return self._settled(seen, [(motion, values)], parent, belief, steps)

    def solve_first(self, seen: Observations, starts: Sequence[Start]) -> Solution[Member]:
        """Do what :func:`.solving.solve_first` does."""
        groups = [(s.motion, s.values) for s in starts if isinstance(s.motion, GroupMotion)]
        if library.code is None or len(groups) < len(starts):
            return solve_first(seen, starts)
        return self._settled(seen, groups, None, None, STEPS)

    def _settled(
        self,
        seen: Observations,
        starts: Sequence[tuple[GroupMotion, Array]],
        parent: Array | None,
        belief: Belief | None,
        steps: int,
    ) -> Solution[Member]:
        motion = starts[0][0]
        count, rows, joints, size = len(seen), seen.rows, motion.joints, motion.size
        belief = belief or Belief.vague(joints)
        moved = np.array([packed(start) for start, _ in starts])
        values = np.array([v for _, v in starts], dtype=np.float64, order="C")
        parents = np.array(seen.parent if parent is None else parent, order="C")
        cost = ctypes.c_double()
        residuals, covariances = np.empty((count, rows)), np.empty((count, rows, rows))
        linear = linear_of(count, rows, size, joints)
        problem = _problem(seen, motion, belief)
        converged = library.code.solve(
            ctypes.addressof(problem),
            len(starts),
            moved.ctypes.data,
            values.ctypes.data,
            parents.ctypes.data,
            FIRST_STEPS,
            steps,
            ctypes.addressof(cost),
            *(array.ctypes.data for array in (residuals, covariances, *linear)),
        )
        if converged < 0:
            raise MemoryError("There is no memory for so many observations.")
        settled = converged == 1
        motion = unpacked(motion, moved[0])
        return Solution(
            motion, values[0], cost.value, residuals, covariances, linear, parents, belief, settled
        )


def _problem(seen: Observations, motion: GroupMotion, belief: Belief) -> Problem:
    problem = Problem.from_buffer_copy(problem_of(motion.group, motion.rows))
    problem.count, problem.known = len(seen), seen.parent_covariance is None
    for name in ARRAYS:
        array = getattr(seen, name)
        setattr(problem, name, None if array is None else array.ctypes.data)
    problem.reach_scale, problem.pitch_scale, problem.close = REACH, PITCHES, CLOSE
    problem.marginal = belief.marginal
    problem.mean[: motion.joints] = belief.mean.tolist()
    problem.precision[: motion.joints] = belief.precision.tolist()
    return problem


solver = Solver()
