"""Identification in C compared with numpy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic_recordings import JOINTS, noisy, recording

import kineverse as kv
from kineverse.errors import ShapeError
from kineverse.estimation import Family, FamilyParameter, identify, pose_covariance
from kineverse.estimation.identification import solver as native
from kineverse.estimation.identification.families import JOINT_FAMILIES, GroupMotion, family_starts
from kineverse.estimation.identification.initial_guess import MotionStatistics, initial_guesses
from kineverse.estimation.identification.least_squares import InitialGuess, JointValuePrior
from kineverse.estimation.identification.native import library, problem_of
from kineverse.estimation.identification.observations import Observations, check_observations
from kineverse.estimation.identification.solver import solver

HOW = ("both noisy", "parent known", "positions", "each with another noise")


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


@pytest.fixture(autouse=True)
def compiled() -> None:
    assert solver.prepare(wait=True)


def without_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(library, "_code", None)
    monkeypatch.setattr(library, "error", "there is none")


@pytest.mark.compiler
@pytest.mark.parametrize("family", [*JOINTS])
@pytest.mark.parametrize("how", HOW)
def test_c_agrees_with_numpy(family: str, how: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Poses and derivatives, a step of both kinds, and what is integrated after it."""
    data = record_joint(how, family)
    start = next(initial_guesses(family, MotionStatistics(data)))
    k, solutions = start.motion.joints, []
    priors = [JointValuePrior.vague(k)]
    if k:
        priors.append(JointValuePrior(np.zeros(k), np.full(k, 0.3**-2), marginal=True))
    for in_c in (True, False):
        with monkeypatch.context() as patched:
            if not in_c:
                without_compiler(patched)
            linear = start.motion.linearise(start.values)
            steps = [solver.solve(data, start, data.parent, prior, steps=1) for prior in priors]
            numbers = [number for one in steps for number in (one.cost, one.residuals, *one.linear[1:])]
            for one in steps:
                factors = np.array([[1.0, 1.0], [2.0, 0.5]])
                parts = np.stack([0.3 * one.covariance, 0.7 * one.covariance])
                posterior = solver.evidence(one, 0.1)
                numbers += [solver.log_evidences(one, factors, parts), *vars(posterior).values()]
            solutions.append([*linear, *numbers])
    for fast, slow in zip(*solutions, strict=True):
        np.testing.assert_allclose(fast, slow, rtol=1e-6, atol=1e-9)


@pytest.mark.compiler
@pytest.mark.parametrize("family", [*JOINTS])
def test_gradients_of_the_marginal_likelihood_agree_with_differences(family: str) -> None:
    data = record_joint("both noisy", family)
    start = next(initial_guesses(family, MotionStatistics(data)))
    motion, values, random = start.motion, start.values, np.random.default_rng(0)
    gains, lever = random.normal(size=(12, motion.joints, 6)), random.normal(size=(12, 3))

    def weighted(step: np.ndarray, change: np.ndarray) -> np.ndarray:
        linear = motion.retract(step).linearise(values + change)
        of_lever = np.sum(lever * linear.pose[:, :3, 3], axis=1)
        return np.einsum("nkr,nrk->n", gains, linear.by_joints) + of_lever

    by_step, by_values = motion.slope(values, gains, lever)
    for count, derivatives, is_step in ((motion.size, by_step, True), (motion.joints, by_values, False)):
        for i in range(count):
            unit = 1e-6 * np.eye(count)[i]
            none = np.zeros(motion.joints if is_step else motion.size)
            ends = [weighted(u, none) if is_step else weighted(none, u) for u in (unit, -unit)]
            np.testing.assert_allclose((ends[0] - ends[1]) / 2e-6, derivatives[:, i], rtol=1e-5, atol=1e-6)


@pytest.mark.compiler
@pytest.mark.parametrize("family", [*JOINTS])
@pytest.mark.parametrize("how", HOW)
def test_c_stays_within_its_work_memory(family: str, how: str, monkeypatch: pytest.MonkeyPatch) -> None:
    lent = []

    def lend(count: int) -> np.ndarray:
        size = library.code.memory_of(count)
        lent.append(np.full(size + 64, 12345.0))
        return lent[-1][:size]

    monkeypatch.setattr(native._memory, "reserve", lend)
    data = record_joint(how, family)
    identified = solver.maximum_likelihood(data, [*initial_guesses(family, MotionStatistics(data))]).solution
    identified = solver.maximise_marginal_likelihood(data, identified).solution
    solver.evidence(identified, 0.5)
    assert len(lent) > 1
    assert all((memory[-64:] == 12345.0).all() for memory in lent)


X, Y = kv.position("bar/x"), kv.position("bar/y")
A, B = kv.parameter("bar/length", 0.5), kv.parameter("bar/height", 0.1)
GANTRY = Family(
    "gantry",
    kv.translation(X, Y, B) @ kv.rotation_z(X * A),
    {X: (-1.0, 1.0), Y: (-1.0, 1.0)},
    {A: (0.5, 0.2), B: FamilyParameter(0.1, 0.2, 0.0, 0.3)},
)


@pytest.mark.compiler
def test_a_custom_family_is_solved_in_c(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also up to the bounds of its parameters and joint values."""
    GANTRY.functions.wait()
    random = np.random.default_rng(0)
    values = random.uniform(-1.01, 1.01, (20, 2))
    poses = np.stack([GANTRY.transform({X: x, Y: y, A: 0.6, B: 0.32}) for x, y in values])
    covariance = pose_covariance(0.01, 0.02)
    data = check_observations(None, noisy(poses, 0.01, 0.02, random), None, covariance)
    start = InitialGuess(*next(family_starts(GANTRY, data, 1.0)))
    assert problem_of(start.motion.form) is not None
    fast = solver.maximise_marginal_likelihood(data, solver.maximum_likelihood(data, [start]).solution)
    without_compiler(monkeypatch)
    slow = solver.maximise_marginal_likelihood(data, solver.maximum_likelihood(data, [start]).solution)
    assert fast.log_evidence == pytest.approx(slow.log_evidence, rel=1e-3)
    np.testing.assert_allclose(fast.solution.motion.parameters, slow.solution.motion.parameters, atol=1e-3)
    assert fast.solution.motion.parameters[0] == pytest.approx(0.6, abs=0.03)
    assert fast.solution.motion.parameters[1] == 0.3
    assert np.abs(fast.solution.values).max() <= 1.0


@pytest.mark.compiler
def test_a_family_too_large_for_c_is_solved_in_numpy() -> None:
    form = GroupMotion(JOINT_FAMILIES["revolute"], 6, np.eye(4), np.eye(4)).form
    assert problem_of(form) is not None
    assert problem_of(replace(form, parameters=(*range(13),), precision=np.zeros(14))) is None


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
        without_compiler(patched)
        slow = identify(data.parent, data.child, noise=data.covariance)
        assert not solver.is_native
        best = slow.best
    assert fast.probabilities == pytest.approx(slow.probabilities, rel=0.02, abs=1e-4)
    assert fast.best.family == best.family
    np.testing.assert_allclose(fast.best.covariance, best.covariance, rtol=0.05, atol=1e-6)
    np.testing.assert_allclose(fast.best.joint_values, best.joint_values, atol=0.02 * best.deviations.max())
