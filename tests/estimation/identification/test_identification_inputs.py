"""Invalid, uninformative and degenerate input of identification."""

from __future__ import annotations

import numpy as np
import pytest
from synthetic_recordings import recording

import kineverse as kv
from kineverse.estimation import Identifier, identify, linear_algebra, pose_covariance
from kineverse.estimation.identification import least_squares
from kineverse.estimation.identification.initial_guess import MotionStatistics, initial_guesses
from kineverse.estimation.identification.observations import check_observations
from kineverse.estimation.identification.solver import solver

NOISE = pose_covariance(0.01, 0.02)
SEEN = recording("revolute", count=6, position=0.01, orientation=0.02, seed=0)


def with_entry(poses: np.ndarray, value: float) -> np.ndarray:
    changed = poses.copy()
    changed[3, 0, 0] = value
    return changed


@pytest.mark.parametrize(
    ("parent", "child", "noise", "message"),
    [
        (SEEN.parent, with_entry(SEEN.child, np.nan), NOISE, "Pose 3 of the child is not finite"),
        (with_entry(SEEN.parent, 2.0), SEEN.child, NOISE, "Pose 3 of the parent is no rigid transform"),
        (SEEN.parent, 1.01 * SEEN.child, NOISE, "unit length"),
        (SEEN.parent, SEEN.child * [[1, 1, -1, 1]], NOISE, "mirrors"),
        (SEEN.parent[:1], SEEN.child[:1], NOISE, "one pose"),
        (SEEN.parent[:0], SEEN.child[:0], NOISE, "no poses"),
        (SEEN.parent[:4], SEEN.child, NOISE, "4 poses of the parent and 6"),
        (SEEN.parent, SEEN.child[:, :3, :3], NOISE, "shape"),
        (SEEN.parent, SEEN.child, -NOISE, "not positive definite"),
        (SEEN.parent, SEEN.child, 0 * NOISE, "not positive definite"),
        (SEEN.parent, SEEN.child, NOISE + np.eye(6, k=1), "not symmetric"),
        (SEEN.parent, SEEN.child, NOISE[:4, :4], "shape"),
        (SEEN.parent, SEEN.child, 0.01, "pair of standard deviations"),
        (SEEN.parent, SEEN.child, (0.01, -0.02), "positive and finite"),
        (SEEN.parent, "poses", NOISE, "no array of numbers"),
        (SEEN.parent, SEEN.child + 0j, NOISE, "no array of numbers"),
        (
            SEEN.parent,
            SEEN.child + 1e200 * np.eye(4, k=3),
            NOISE,
            "Pose 0 of the child has a number of 1e.200",
        ),
        (SEEN.parent, SEEN.child, 1e-18 * NOISE, "deviation of 1e-11"),
    ],
)
def test_identify_refuses_invalid_poses(
    parent: object, child: object, noise: np.ndarray, message: str
) -> None:
    with pytest.raises(kv.KineverseError, match=message):
        identify(parent, child, noise=noise)


def test_identify_takes_a_covariance_in_short_forms() -> None:
    for child in (SEEN.child, SEEN.child[:, :3, 3]):
        expected = identify(SEEN.parent, child, noise=NOISE)
        for noise in ((0.01, 0.02), np.diag(NOISE), np.tile(NOISE, (6, 1, 1))):
            assert identify(SEEN.parent, child, noise=noise).probabilities == expected.probabilities


def test_identify_refuses_invalid_covariances_and_families() -> None:
    with pytest.raises(kv.errors.InvalidValueError, match="One part has a covariance"):
        identify(SEEN.parent, SEEN.child, parent_covariance=NOISE)
    with pytest.raises(kv.errors.UnknownNameError, match="revolute"):
        identify(SEEN.parent, SEEN.child, noise=NOISE, families=["revolut"])
    with pytest.raises(kv.errors.InvalidValueError, match="no family"):
        identify(SEEN.parent, SEEN.child, noise=NOISE, families=[])
    with pytest.raises(kv.errors.UnknownNameError, match="not tried"):
        identify(SEEN.parent, SEEN.child, noise=NOISE, families=["rigid"])["screw"]


@pytest.mark.parametrize("count", [2, 3, 10])
def test_identical_poses_are_rigid_and_determine_no_axis(count: int) -> None:
    identified = identify(
        np.tile(SEEN.parent[0], (count, 1, 1)), np.tile(SEEN.child[0], (count, 1, 1)), noise=NOISE
    )
    assert identified.best.family == "rigid"
    assert not identified["revolute"].is_determined
    assert all(np.isfinite(fit.log_evidence) for fit in identified)


def test_two_poses_leave_doubt() -> None:
    identified = identify(SEEN.parent[:2], SEEN.child[:2], noise=NOISE)
    assert identified.is_ambiguous or identified.best.probability < 1.0
    assert str(identified)


def test_positions_distinguish_a_circle_from_a_line() -> None:
    for family in ("revolute", "prismatic"):
        data = recording(family, count=25, position=0.003, orientation=0.003, seed=2)
        identified = identify(data.parent, data.child[:, :3, 3], noise=data.covariance)
        assert identified.best.family == family
        with pytest.raises(kv.errors.InvalidValueError, match="Only positions"):
            identified.best.operation("door", "body")


def test_identify_without_parent_poses_has_the_world_as_parent() -> None:
    data = recording("revolute", count=15, position=0.005, orientation=0.01, seed=5)
    identified = identify(None, np.linalg.inv(data.true_parent) @ data.child, noise=data.covariance)
    assert identified.best.family == "revolute"


def test_a_refused_pose_leaves_an_identifier_unchanged() -> None:
    identifier = Identifier(noise=NOISE)
    with pytest.raises(kv.errors.InvalidValueError, match="no poses so far"):
        _ = identifier.result
    identifier.add(SEEN.parent[0], SEEN.child[0])
    with pytest.raises(kv.errors.InvalidValueError, match="not finite"):
        identifier.add(SEEN.parent[1], np.nan * SEEN.child[1])
    with pytest.raises(kv.errors.ShapeError, match="mix"):
        identifier.add(SEEN.parent[1], SEEN.child[1, :3, 3])
    identifier.add(SEEN.parent[1], SEEN.child[1])
    assert len(identifier) == 2
    assert identifier.result.fits


@pytest.mark.parametrize("count", [2, 3])
def test_a_fit_with_as_many_unknowns_as_measurements_is_not_determined(count: int) -> None:
    """Two positions are on a line and three on a circle, however the part moves."""
    data = recording("free", count=count, position=0.003, orientation=0.003, seed=2)
    identified = identify(None, data.true_relative[:, :3, 3], noise=data.covariance)
    assert identified.is_ambiguous
    assert not identified["prismatic" if count == 2 else "revolute"].is_determined


@pytest.mark.parametrize("stated", [True, pytest.param(False, marks=pytest.mark.long)])
def test_repeated_observations_count_once_with_their_correlation_time(stated: bool) -> None:
    """Each observation five times, with a correlation time of five, is as good as each once."""
    data = recording("revolute", count=20, position=0.005, orientation=0.01, seed=6)
    noise = data.covariance if stated else None
    once = identify(data.parent, data.child, noise=noise)
    parents, children = np.repeat(data.parent, 5, axis=0), np.repeat(data.child, 5, axis=0)
    five = identify(parents, children, noise=noise, correlation_time=5.0)
    sure = identify(parents, children, noise=noise)
    if not stated:
        np.testing.assert_allclose(five.noise, once.noise, rtol=0.02)
    for name, probability in once.probabilities.items():
        assert five.probabilities[name] == pytest.approx(probability, rel=0.1, abs=1e-6)
    np.testing.assert_allclose(five.best.covariance, once.best.covariance, rtol=0.05, atol=1e-9)
    np.testing.assert_allclose(
        5.0 * sure["revolute"].deviation("axis.x") ** 2, once.best.deviation("axis.x") ** 2, rtol=0.1
    )
    for wrong in (0.5, np.nan, np.inf):
        with pytest.raises(kv.errors.InvalidValueError, match="at least 1"):
            identify(parents, children, noise=noise, correlation_time=wrong)


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
    data = poses(POSITIONS[where]) if whole else POSITIONS[where]
    identified = identify(None, data, noise=pose_covariance(0.01, 0.09))
    for fit in identified:
        assert np.isfinite(fit.log_evidence)
        assert np.isfinite(fit.covariance).all()
        assert (np.diag(fit.covariance) >= 0).all()
    if where.startswith("on a l"):
        assert identified.best.family == "prismatic"
    if where == "in one place":
        assert identified.is_ambiguous or identified.best.family == "rigid"


@pytest.mark.parametrize("family", ["revolute", "screw"])
def test_marginal_likelihood_of_three_positions_is_finite(family):
    data = recording("spherical", count=3, position=0.1, orientation=0.02, seed=3)
    problem = check_observations(data.parent, data.child[:, :3, 3], data.covariance, data.covariance)
    likeliest = solver.maximum_likelihood(problem, [*initial_guesses(family, MotionStatistics(problem))])
    assert np.isfinite(solver.maximise_marginal_likelihood(problem, likeliest.solution).log_evidence)


def test_step_to_a_singular_covariance_is_shortened(monkeypatch):
    data = recording("revolute", count=8, position=0.01, orientation=0.02, seed=3)
    problem = check_observations(data.parent, data.child, data.covariance, data.covariance)
    start = next(iter(initial_guesses("revolute", MotionStatistics(problem))))
    usual = least_squares.levenberg_marquardt(problem, *start)
    calls = []

    def invert(matrices):
        calls.append(matrices.shape)
        if len(calls) == 3:  # at the start, in the step, and where it leads
            raise kv.errors.InvalidValueError("singular")
        return linear_algebra.invert_matrices(matrices)

    monkeypatch.setattr(least_squares, "invert_matrices", invert)
    assert least_squares.levenberg_marquardt(problem, *start).cost == pytest.approx(usual.cost, rel=1e-6)
