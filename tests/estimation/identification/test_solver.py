"""C stages of identification compared with numpy."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from synthetic_recordings import JOINTS, recording

from kineverse.errors import ShapeError
from kineverse.estimation import identify
from kineverse.estimation.identification import marginal_likelihood
from kineverse.estimation.identification import solver as native
from kineverse.estimation.identification.families import JOINT_FAMILIES, GroupMotion, Parametrisation
from kineverse.estimation.identification.initial_guess import MotionStatistics, initial_guesses
from kineverse.estimation.identification.least_squares import (
    InitialGuess,
    JointValuePrior,
    levenberg_marquardt,
    solve_from_best_start,
)
from kineverse.estimation.identification.marginal_likelihood import Scored, evidence_excess, laplace_evidence
from kineverse.estimation.identification.native import library
from kineverse.estimation.identification.observations import Observations, check_observations
from kineverse.estimation.identification.solver import solver

HOW = ("both noisy", "parent known", "positions", "each with another noise")
MOVING = [family for family in JOINTS if family not in ("rigid", "free")]


def record_joint(how: str, family: str) -> Observations:
    data = recording(family, count=12, position=0.02, orientation=0.05, seed=1)
    c = data.covariance
    if how == "both noisy":
        return check_observations(data.parent, data.child, c, c)
    if how == "parent known":
        return check_observations(data.true_parent, data.child, None, c)
    if how == "positions":
        return check_observations(data.parent, data.child[:, :3, 3], c, c)
    factors = np.linspace(0.8, 1.3, 12)[:, None, None]
    return check_observations(data.parent, data.child, factors * c, c / factors)


def precise(family: str, whole: bool) -> Observations:
    """Return positions so precise that steps have to be led to them."""
    data = recording(family, count=12, position=0.001, orientation=0.1, seed=1)
    child = data.child if whole else data.child[:, :3, 3]
    result = check_observations(data.parent, child, data.covariance, data.covariance)
    assert len(result.softened) > 1
    return result


def same(slow: Scored, fast: Scored, atol: float = 1e-4, log: float = 0.05) -> None:
    one, other = slow.solution, fast.solution
    # Steps end where they promise little, which is not the same place to the last digit.
    assert fast.log_evidence == pytest.approx(slow.log_evidence, abs=log)
    assert other.cost == pytest.approx(one.cost, abs=log)
    assert other.joint_prior.marginal == one.joint_prior.marginal
    np.testing.assert_allclose(other.joint_prior.precision, one.joint_prior.precision, rtol=0.05)
    columns = slice(None) if one.motion.rows == 6 else 3  # the orientation of a point is arbitrary
    np.testing.assert_allclose(other.linear.pose[:, :3, columns], one.linear.pose[:, :3, columns], atol=atol)
    np.testing.assert_allclose(other.residuals, one.residuals, atol=atol)
    # All of it belongs together.
    for a, b in zip(other.linear, other.motion.linearise(other.values), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-12)


@pytest.fixture(autouse=True)
def compiled() -> None:
    assert solver.prepare(wait=True)


@pytest.mark.compiler
@pytest.mark.parametrize("family", [*JOINTS])
@pytest.mark.parametrize("how", HOW)
def test_levenberg_marquardt_in_c_agrees_with_numpy(family: str, how: str) -> None:
    data = record_joint(how, family)
    start = next(initial_guesses(family, MotionStatistics(data)))
    slow = levenberg_marquardt(data, *start)
    fast = solver.solve(data, start, data.parent, slow.joint_prior)
    assert fast.cost == pytest.approx(slow.cost, rel=1e-6, abs=1e-6)
    if slow.converged and fast.converged:
        for a, b in zip(slow.motion.linearise(slow.values), fast.motion.linearise(fast.values), strict=True):
            np.testing.assert_allclose(a, b, atol=1e-4)
        np.testing.assert_allclose(slow.residuals, fast.residuals, atol=1e-4)


@pytest.mark.compiler
@pytest.mark.parametrize("family", MOVING)
@pytest.mark.parametrize("how", HOW)
def test_marginal_steps_in_c_agree_with_numpy(family: str, how: str) -> None:
    data = record_joint(how, family)
    start = next(initial_guesses(family, MotionStatistics(data)))
    near = levenberg_marquardt(data, start.motion, start.values)
    # C has derivatives in closed form, and numpy takes differences.
    joint_prior = JointValuePrior(
        near.values.mean(axis=0), np.full(near.motion.joints, 0.3**-2), marginal=True
    )
    slow = levenberg_marquardt(data, near.motion, near.values, near.parent, joint_prior, steps=1)
    fast = solver.solve(data, InitialGuess(near.motion, near.values), near.parent, joint_prior, steps=1)
    assert fast.cost == pytest.approx(slow.cost, rel=1e-6, abs=1e-6)
    np.testing.assert_allclose(fast.linear.pose, slow.linear.pose, atol=1e-6)


@pytest.mark.compiler
@pytest.mark.parametrize("family", [*JOINTS])
@pytest.mark.parametrize("how", HOW)
def test_linearised_poses_in_c_agree_with_numpy(family: str, how: str) -> None:
    start = next(initial_guesses(family, MotionStatistics(record_joint(how, family))))
    assert isinstance(start.motion, GroupMotion)
    for slow, fast in zip(
        start.motion.linearise(start.values, native=False), start.motion.linearise(start.values), strict=True
    ):
        np.testing.assert_allclose(slow, fast, atol=1e-13)


@pytest.mark.compiler
@pytest.mark.parametrize("family", [*JOINTS])
@pytest.mark.parametrize("how", HOW)
def test_maximum_likelihood_in_c_agrees_with_numpy(family: str, how: str) -> None:
    data = record_joint(how, family)
    begin = [*initial_guesses(family, MotionStatistics(data))]
    same(marginal_likelihood.maximum_likelihood(data, begin), solver.maximum_likelihood(data, begin))


@pytest.mark.compiler
@pytest.mark.parametrize("family", MOVING)
@pytest.mark.parametrize("how", ["both noisy", "parent known"])
def test_marginal_likelihood_in_c_agrees_with_numpy(family: str, how: str) -> None:
    data = record_joint(how, family)
    near = solve_from_best_start(data, [*initial_guesses(family, MotionStatistics(data))])
    slow, fast = (
        marginal_likelihood.maximise_marginal_likelihood(data, near),
        solver.maximise_marginal_likelihood(data, near),
    )
    assert slow.solution.joint_prior.marginal
    same(slow, fast, atol=0.02)
    # One more observation, and the first ones are where they were.
    part = data.select(slice(0, 10))
    before = marginal_likelihood.maximise_marginal_likelihood(
        part, solve_from_best_start(part, [*initial_guesses(family, MotionStatistics(part))])
    ).solution
    start = InitialGuess(before.motion, np.concatenate([before.values, slow.solution.values[10:]]))
    arguments = data, start, np.concatenate([before.parent, data.parent[10:]]), before.joint_prior, 10
    same(marginal_likelihood.continue_from(*arguments), solver.continue_from(*arguments), atol=0.02)


@pytest.mark.sampled(2)
@pytest.mark.compiler
@pytest.mark.parametrize(
    ("family", "whole"), [("prismatic", True), ("revolute", True), ("spherical", True), ("revolute", False)]
)
def test_precise_positions_in_c_agree_with_numpy(family: str, whole: bool) -> None:
    data = precise(family, whole)
    begin = [*initial_guesses(family, MotionStatistics(data))]
    slow, fast = marginal_likelihood.maximum_likelihood(data, begin), solver.maximum_likelihood(data, begin)
    same(slow, fast, atol=0.02)
    near = slow.solution
    same(
        marginal_likelihood.maximise_marginal_likelihood(data, near),
        solver.maximise_marginal_likelihood(data, near),
        atol=0.02,
        log=0.2,
    )


@pytest.mark.compiler
@pytest.mark.parametrize("family", [*JOINTS])
@pytest.mark.parametrize("how", [*HOW, "precise"])
def test_c_stays_within_its_work_memory(family: str, how: str, monkeypatch: pytest.MonkeyPatch) -> None:
    lent = []

    def lend(size: int) -> np.ndarray:
        lent.append(np.full(size + 64, 12345.0))
        return lent[-1][:size]

    monkeypatch.setattr(native._memory, "reserve", lend)
    data = precise(family, True) if how == "precise" else record_joint(how, family)
    identified = solver.maximum_likelihood(data, [*initial_guesses(family, MotionStatistics(data))]).solution
    identified = solver.maximise_marginal_likelihood(data, identified).solution
    solver.continue_from(
        data, InitialGuess(identified.motion, identified.values), identified.parent, identified.joint_prior, 2
    )
    solver.evidence(identified)
    assert len(lent) == 4
    assert all((memory[-64:] == 12345.0).all() for memory in lent)


@pytest.mark.compiler
@pytest.mark.parametrize("family", [*JOINTS])
@pytest.mark.parametrize("how", HOW)
def test_evidence_in_c_agrees_with_numpy(family: str, how: str) -> None:
    data = record_joint(how, family)
    solution = solver.maximum_likelihood(data, [*initial_guesses(family, MotionStatistics(data))]).solution
    parts = np.stack([0.3 * solution.covariance, 0.7 * solution.covariance])
    factors = np.array([[1.0, 1.0], [3.0, 3.0], [2.0, 0.5]])
    for weight in (1.0, 0.1):
        logs = solver.log_evidences(solution, factors, parts, weight)
        for log, size in zip(logs, [1.0, 9.0, 0.3 * 4.0 + 0.7 * 0.25], strict=True):
            larger = replace(solution, covariance=size * solution.covariance)
            slow, fast = laplace_evidence(larger, weight), solver.evidence(larger, weight)
            assert fast.log_evidence == pytest.approx(slow.log_evidence, rel=1e-9)
            assert log == pytest.approx(slow.log_evidence, rel=1e-9)
        np.testing.assert_allclose(slow.covariance, fast.covariance, rtol=1e-6, atol=1e-12)
        np.testing.assert_allclose(slow.joint_values, fast.joint_values, atol=1e-9)
        np.testing.assert_allclose(slow.joint_covariances, fast.joint_covariances, atol=1e-12)


@pytest.mark.compiler
@pytest.mark.parametrize("family", ["revolute", "planar"])
def test_evidence_of_an_unconverged_solution_is_reduced_in_c(family: str) -> None:
    data = record_joint("both noisy", family)
    near = solver.maximum_likelihood(data, [*initial_guesses(family, MotionStatistics(data))])
    reached = solver.maximise_marginal_likelihood(data, near.solution)
    early = replace(reached.solution, converged=False, cost=reached.solution.cost + 20.0)
    # Its widths have settled, so no step is taken.
    slow, fast = (
        marginal_likelihood.maximise_marginal_likelihood(data, early),
        solver.maximise_marginal_likelihood(data, early),
    )
    assert evidence_excess(early) == pytest.approx(10.0, abs=0.5)
    assert fast.log_evidence == pytest.approx(slow.log_evidence, abs=1e-6)
    assert fast.log_evidence == pytest.approx(reached.log_evidence - evidence_excess(early), abs=1e-3)


@dataclass(frozen=True)
class Pinned(GroupMotion):
    """A hinge of which only the axis is unknown."""

    @property
    def parametrisation(self) -> Parametrisation:
        return Parametrisation((5,), (3, 4), ())


@pytest.mark.compiler
def test_a_subclass_of_a_motion_is_solved_in_numpy() -> None:
    data = record_joint("both noisy", "revolute")
    start = next(initial_guesses("revolute", MotionStatistics(data)))
    pinned = Pinned(JOINT_FAMILIES["revolute"], 6, start.motion.left, start.motion.right)
    begin = InitialGuess(pinned, start.values)
    assert not pinned.is_plain
    assert pinned.linearise(start.values).by_parameters.shape == (12, 6, 2)
    identified = solver.maximum_likelihood(data, [begin]).solution
    assert identified.cost == pytest.approx(levenberg_marquardt(data, *begin).cost)
    assert solver.evidence(identified).covariance.shape == (2, 2)


@pytest.mark.compiler
@pytest.mark.parametrize(
    "freedom",
    [
        Parametrisation((5,), tuple(range(6)), tuple(range(6))),
        Parametrisation((5,), (0, 1, 2, 3, 4, 5, 0), ()),
        Parametrisation((6,), (), ()),
    ],
    ids=["too many", "more than there are", "no such component"],
)
def test_a_family_too_large_for_the_kernel_is_not_accepted(freedom: Parametrisation) -> None:
    group = replace(JOINT_FAMILIES["revolute"], poses=freedom, positions=freedom)
    assert not GroupMotion(group, 6, np.eye(4), np.eye(4)).is_plain
    assert GroupMotion(JOINT_FAMILIES["revolute"], 6, np.eye(4), np.eye(4)).is_plain


@pytest.mark.compiler
def test_linearise_refuses_joint_values_of_another_shape() -> None:
    motion = GroupMotion(JOINT_FAMILIES["revolute"], 6, np.eye(4), np.eye(4))
    with pytest.raises(ShapeError, match=r"\(N, 1\), not \(4, 2\)"):
        motion.linearise(np.zeros((4, 2)))


@pytest.mark.compiler
@pytest.mark.parametrize("family", [pytest.param("prismatic", marks=pytest.mark.long), "revolute", "planar"])
def test_identify_without_a_compiler_agrees(family: str, monkeypatch: pytest.MonkeyPatch) -> None:
    data = recording(family, count=12, position=0.02, orientation=0.05, seed=1)
    fast = identify(data.parent, data.child, noise=data.covariance)
    with monkeypatch.context() as patched:
        patched.setattr(library, "_code", None)
        patched.setattr(library, "error", "there is none")
        slow = identify(data.parent, data.child, noise=data.covariance)
        assert not solver.is_native
        best = slow.best
    assert fast.probabilities == pytest.approx(slow.probabilities, rel=0.02, abs=1e-4)
    assert fast.best.family == best.family
    np.testing.assert_allclose(fast.best.covariance, best.covariance, rtol=0.05, atol=1e-6)
    np.testing.assert_allclose(fast.best.joint_values, best.joint_values, atol=0.02 * best.deviations.max())
