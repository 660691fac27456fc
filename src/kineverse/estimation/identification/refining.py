"""From the maximum of the likelihood to the maximum with joint values integrated out.

Where a motion is short beside the noise, the likelihood prefers joint values that are noise: its maximum is
then several times as far from the truth as need be. So joint values are believed as wide as the motion is,
see :mod:`.evidence`, and are integrated out; how wide that is follows from what was seen, in turns with the
rest.
"""

from __future__ import annotations

import numpy as np

from .evidence import evidence
from .mirrored import straightened
from .motion import Member
from .native import solver
from .observations import Observations
from .rigid import Array
from .sliding import slid
from .solving import Belief, Solution
from .widths import alone, widths

_TURNS = 8
# A width that changes by less has settled.
_SETTLED = 0.01
_NARROWEST = 1e-4


def refined(seen: Observations, solution: Solution[Member]) -> Solution[Member]:
    """Return the solution with joint values integrated out."""
    if not solution.motion.joints or not solution.motion.size:
        return solution
    result = _settled(seen, solution)
    softened = seen.softened()
    if solution.belief.marginal or not softened:
        return result
    # The maximum of the likelihood is no good start where positions are that precise: it has bent the motion
    # so that each joint value has a place on it. With widths believed while the valley narrows, it has not.
    for softer in (*softened, seen):
        solution = solver.solve(softer, solution.motion, solution.values, solution.parent, solution.belief)
        solution = _settled(softer, straightened(softer, solution))
    return max(result, solution, key=lambda each: evidence(each).log_evidence)


def _settled(seen: Observations, solution: Solution[Member]) -> Solution[Member]:
    known = solution.belief
    before: Array | None = known.precision**-0.5 if known.marginal else None
    for _ in range(_TURNS):
        solution = slid(solution)
        found = widths(solution.motion, alone(solution))
        wide = np.maximum(found.deviations, _NARROWEST)
        if before is not None and np.all(np.abs(np.log(wide / before)) < _SETTLED):
            break
        before = wide
        belief = Belief(found.mean, wide**-2.0, marginal=True)
        solution = solver.solve(seen, solution.motion, solution.values, solution.parent, belief)
        solution = straightened(seen, solution)
    return solution
