"""RRT-Connect of OMPL, with a scene of this library as the checker of configurations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from time import perf_counter

import numpy as np
import ompl.base as ob
import ompl.geometric as og
import ompl.util as ou

from kineverse.lie import Array
from kineverse_studies.bench.planning_problems import CHECKS_PER_RADIAN, Attempt

RANGE = 1.0  # longest edge of the trees [rad], [m]


class OmplRrtConnect:
    def __init__(self, check: Callable[[Sequence[float]], bool], lower: Array, upper: Array) -> None:
        ou.setLogLevel(ou.LOG_NONE)
        self._check, self._size = check, len(lower)
        self._space = ob.RealVectorStateSpace(len(lower))
        bounds = ob.RealVectorBounds(len(lower))
        for k, (low, high) in enumerate(zip(lower.tolist(), upper.tolist(), strict=True)):
            bounds.setLow(k, low)
            bounds.setHigh(k, high)
        self._space.setBounds(bounds)
        extent = float(np.linalg.norm(upper - lower))
        self._resolution = 1.0 / (CHECKS_PER_RADIAN * extent)

    def plan(self, start: Array, goal: Array, seconds: float, seed: int) -> Attempt:
        check, size = self._check, self._size
        # Of generators that are made after this.
        ou.RNG.setSeed(seed + 1)
        begin = perf_counter()
        information = ob.SpaceInformation(self._space)
        information.setStateValidityChecker(lambda state: check(state[0:size]))
        information.setStateValidityCheckingResolution(self._resolution)
        information.setup()
        problem = ob.ProblemDefinition(information)
        ends = [information.allocState(), information.allocState()]
        for end, q in zip(ends, (start, goal), strict=True):
            end[0:size] = q.tolist()
        problem.setStartAndGoalStates(*ends, 1e-6)
        planner = og.RRTConnect(information)
        planner.setRange(RANGE)
        planner.setProblemDefinition(problem)
        planner.setup()
        status = planner.solve(seconds)
        spent = perf_counter() - begin
        if not problem.hasExactSolution():
            return Attempt(False, spent, spent, why=str(status))
        states = problem.getSolutionPath().getStates()
        points = np.array([state[0:size] for state in states])
        return Attempt(True, spent, spent, points, str(status))
