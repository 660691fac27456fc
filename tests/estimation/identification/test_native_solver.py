"""The solver in C takes the steps of the one in numpy."""

from __future__ import annotations

import numpy as np
import pytest
from part_recordings import JOINTS, recording

from kineverse.estimation import identify
from kineverse.estimation.identification.evidence import evidence
from kineverse.estimation.identification.groups import GroupMotion
from kineverse.estimation.identification.library import library
from kineverse.estimation.identification.native import solver
from kineverse.estimation.identification.observations import Observations, observations
from kineverse.estimation.identification.sliding import slid
from kineverse.estimation.identification.solving import Belief, solve, solve_first
from kineverse.estimation.identification.starts import Overview, starts
from kineverse.estimation.identification.widths import alone, widths


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


@pytest.mark.compiler
@pytest.mark.parametrize("family", [f for f in JOINTS if f not in ("rigid", "free")])
@pytest.mark.parametrize("how", ["both noisy", "parent known", "positions"])
def test_steps_with_joint_values_integrated_out_agree(family: str, how: str) -> None:
    assert solver.prepare(wait=True)
    seen = seen_as(how, family)
    start = next(starts(family, Overview(seen)))
    near = solve(seen, start.motion, start.values)
    # C has derivatives in closed form, and numpy takes differences.
    belief = Belief(near.values.mean(axis=0), np.full(near.motion.joints, 0.3**-2), marginal=True)
    slow = solve(seen, near.motion, near.values, near.parent, belief, steps=1)
    fast = solver.solve(seen, near.motion, near.values, near.parent, belief, steps=1)
    assert fast.cost == pytest.approx(slow.cost, rel=1e-6, abs=1e-6)
    np.testing.assert_allclose(fast.linear.pose, slow.linear.pose, atol=1e-6)


@pytest.mark.compiler
@pytest.mark.parametrize("family", ["revolute", "planar"])
def test_the_best_of_several_starts_goes_on(family: str) -> None:
    assert solver.prepare(wait=True)
    seen = seen_as("both noisy", family)
    begin = [*starts(family, Overview(seen))]
    assert len(begin) > 1
    slow, fast = solve_first(seen, begin), solver.solve_first(seen, begin)
    assert slow.converged
    assert fast.converged
    np.testing.assert_allclose(slow.residuals, fast.residuals, atol=1e-4)


@pytest.mark.compiler
@pytest.mark.parametrize("family", [f for f in JOINTS if f != "rigid"])
@pytest.mark.parametrize("how", ["both noisy", "positions"])
def test_widths_agree(family: str, how: str) -> None:
    assert solver.prepare(wait=True)
    seen = seen_as(how, family)
    solution = solve_first(seen, [*starts(family, Overview(seen))])
    slow, fast = alone(solution, native=False), alone(solution)
    np.testing.assert_allclose(slow.values, fast.values, rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(slow.covariances, fast.covariances, rtol=1e-8, atol=1e-12)
    assert fast.log_likelihood == pytest.approx(slow.log_likelihood, rel=1e-10)
    wide, width = widths(solution.motion, slow, native=False), widths(solution.motion, slow)
    np.testing.assert_allclose(wide.deviations, width.deviations, rtol=1e-8)
    np.testing.assert_allclose(wide.mean, width.mean, rtol=1e-8, atol=1e-10)
    assert width.log_density == pytest.approx(wide.log_density, rel=1e-10)


@pytest.mark.compiler
@pytest.mark.parametrize("family", [*JOINTS])
@pytest.mark.parametrize("how", ["both noisy", "positions"])
def test_poses_agree(family: str, how: str) -> None:
    assert solver.prepare(wait=True)
    start = next(starts(family, Overview(seen_as(how, family))))
    assert isinstance(start.motion, GroupMotion)
    for slow, fast in zip(
        start.motion.at(start.values, native=False), start.motion.at(start.values), strict=True
    ):
        np.testing.assert_allclose(slow, fast, atol=1e-13)


@pytest.mark.compiler
@pytest.mark.parametrize("family", ["planar", "free"])
def test_points_that_slide_agree(family: str) -> None:
    assert solver.prepare(wait=True)
    seen = seen_as("both noisy", family)
    solution = solver.solve_first(seen, [*starts(family, Overview(seen))])
    slow, fast = slid(solution, native=False), slid(solution)
    assert np.abs(slow.values - solution.values).max() > 1e-3
    np.testing.assert_allclose(slow.values, fast.values, atol=1e-9)
    for a, b in zip(slow.linear, fast.linear, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-9)


@pytest.mark.compiler
@pytest.mark.parametrize("family", [*JOINTS])
@pytest.mark.parametrize("how", ["both noisy", "positions"])
def test_evidence_agrees(family: str, how: str) -> None:
    assert solver.prepare(wait=True)
    seen = seen_as(how, family)
    solution = solver.solve_first(seen, [*starts(family, Overview(seen))])
    slow, fast = evidence(solution, native=False), evidence(solution)
    assert fast.log_evidence == pytest.approx(slow.log_evidence, rel=1e-9)
    np.testing.assert_allclose(slow.covariance, fast.covariance, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(slow.joint_values, fast.joint_values, atol=1e-9)
    np.testing.assert_allclose(slow.joint_covariances, fast.joint_covariances, atol=1e-12)


@pytest.mark.compiler
@pytest.mark.parametrize("family", ["prismatic", "revolute", "planar"])
def test_without_a_compiler_the_same_is_found(family: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert solver.prepare(wait=True)
    seen = recording(family, count=12, position=0.02, orientation=0.05, seed=1)
    fast = identify(seen.parent, seen.child, noise=seen.covariance)
    with monkeypatch.context() as patched:
        patched.setattr(library, "_code", None)
        patched.setattr(library, "_hopeless", True)
        slow = identify(seen.parent, seen.child, noise=seen.covariance)
        assert not solver.is_native
        best = slow.best
    assert fast.probabilities == pytest.approx(slow.probabilities, rel=0.02, abs=1e-4)
    assert fast.best.family == best.family
    np.testing.assert_allclose(fast.best.covariance, best.covariance, rtol=0.05, atol=1e-6)
    np.testing.assert_allclose(fast.best.joint_values, best.joint_values, atol=0.02 * best.deviations.max())
