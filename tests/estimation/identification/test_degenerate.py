"""Degenerate observations: points on a line, identical points, or only two of them."""

from __future__ import annotations

import numpy as np
import pytest
from synthetic_recordings import recording

from kineverse.estimation import identify, pose_covariance
from kineverse.estimation.identification import marginal_likelihood
from kineverse.estimation.identification.initial_guess import MotionStatistics, initial_guesses
from kineverse.estimation.identification.observations import check_observations

LINE = np.arange(20)[:, None] * [0.0, 0.0, 1.0]
POSITIONS = {
    "on a line": LINE,
    "on a short line": 1e-3 * LINE,
    "on a long line": 1e4 * LINE,
    "in one place": np.full((10, 3), 0.1),
    "two": LINE[:2],
}


def poses(positions):
    made = np.tile(np.eye(4), (len(positions), 1, 1))
    made[:, :3, 3] = positions
    return made


@pytest.mark.parametrize("where", POSITIONS)
@pytest.mark.parametrize("whole", [True, False], ids=["poses", "positions"])
def test_identify_of_degenerate_positions_is_finite(where, whole):
    seen = poses(POSITIONS[where]) if whole else POSITIONS[where]
    found = identify(None, seen, noise=pose_covariance(0.01, 0.09))
    for fit in found:
        assert np.isfinite(fit.log_evidence)
        assert np.isfinite(fit.covariance).all()
        assert (np.diag(fit.covariance) >= 0).all()
    if where.startswith("on a l"):
        assert found.best.family == "prismatic"
    if where == "in one place":
        assert found.is_ambiguous or found.best.family == "rigid"


@pytest.mark.parametrize("family", ["revolute", "screw"])
def test_marginal_likelihood_of_three_positions_is_finite(family):
    seen = recording("spherical", count=3, position=0.1, orientation=0.02, seed=3)
    problem = check_observations(seen.parent, seen.child[:, :3, 3], seen.covariance, seen.covariance)
    likeliest = marginal_likelihood.maximum_likelihood(
        problem, [*initial_guesses(family, MotionStatistics(problem))]
    ).solution
    assert np.isfinite(marginal_likelihood.maximise_marginal_likelihood(problem, likeliest).log_evidence)
