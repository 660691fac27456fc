"""The solver in C takes the steps of the one in numpy."""

from __future__ import annotations

import numpy as np
import pytest
from part_recordings import JOINTS, recording

from kineverse.estimation.identification.native import solver
from kineverse.estimation.identification.observations import Observations, observations
from kineverse.estimation.identification.solving import solve
from kineverse.estimation.identification.starts import Overview, starts


def seen_as(how: str, family: str) -> Observations:
    seen = recording(family, count=12, position=0.02, orientation=0.05, seed=1)
    c = seen.covariance
    if how == "both noisy":
        return observations(seen.parent, seen.child, c, c)
    if how == "parent known":
        return observations(seen.true_parent, seen.child, None, c)
    return observations(seen.parent, seen.child[:, :3, 3], c, c)


@pytest.mark.compiler
@pytest.mark.parametrize("family", [*JOINTS])
@pytest.mark.parametrize("how", ["both noisy", "parent known", "positions"])
def test_c_and_numpy_agree(family: str, how: str) -> None:
    assert solver.prepare(wait=True)
    seen = seen_as(how, family)
    start = next(starts(family, Overview(seen)))
    slow = solve(seen, start.motion, start.values)
    fast = solver.solve(seen, start.motion, start.values)
    assert fast.cost == pytest.approx(slow.cost, rel=1e-6, abs=1e-6)
    if slow.converged and fast.converged:
        for a, b in zip(slow.motion.at(slow.values), fast.motion.at(fast.values), strict=True):
            np.testing.assert_allclose(a, b, atol=1e-4)
        np.testing.assert_allclose(slow.residuals, fast.residuals, atol=1e-4)
