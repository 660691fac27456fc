"""Revolutions of joint values, and evidence without convergence."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic_recordings import Array, angle_between, noisy, recording, transform

import kineverse as kv
from kineverse.estimation import IdentificationResult, Identifier, identify, pose_covariance
from kineverse.estimation.identification.families import JOINT_FAMILIES, GroupMotion
from kineverse.estimation.identification.least_squares import JointValuePrior, levenberg_marquardt
from kineverse.estimation.identification.marginal_likelihood import evidence_excess
from kineverse.estimation.identification.observations import check_observations

COVARIANCE = pose_covariance(0.002, 0.02)
LEFT = transform(Rotation.from_rotvec([0.3, -0.4, 0.2]), (0.3, 0.1, 0.5))


def turning_poses(turns: float, lead: float, count: int, seed: int = 0, start: float = 0.0) -> Array:
    """Return poses of a screw with some revolutions and a pitch [m]."""
    turn = kv.position("turn")
    along = kv.translation(0, 0, lead / math.tau * turn)
    pose = kv.compile([along @ kv.rotation_z(turn) @ kv.translation(0.1, 0.0, 0.0)])
    true = LEFT @ pose.batch(start + np.linspace(0.0, turns * math.tau, count)[:, None])[0]
    return noisy(true, 0.002, 0.02, np.random.default_rng(seed))


def identify_data(data: Array, **options: object) -> IdentificationResult:
    return identify(None, data, noise=COVARIANCE, **options)


@pytest.mark.parametrize("turns", [2.3, 5.0, 20.0])
def test_revolutions_of_a_crank_are_counted(turns: float) -> None:
    data = turning_poses(turns, 0.0, int(10 * turns))
    fit = identify_data(data, sequential=True).best
    assert fit.family == "revolute"
    assert np.ptp(fit.range) == pytest.approx(turns * math.tau, abs=0.1)
    assert fit.largest_turn == pytest.approx(turns * math.tau / (len(data) - 1), abs=0.1)
    np.testing.assert_allclose(fit.poses, data, atol=0.12)
    # Without the order, turns are unknown.
    assert np.ptp(identify_data(data).best.range) < math.tau
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(fit.operation("crank", "world"))
    limits = model.constraints["crank/position"]
    assert float(limits.upper) - float(limits.lower) == pytest.approx(turns * math.tau, abs=0.1)


@pytest.mark.parametrize("lead", [0.002, 0.005, -0.01])
def test_the_lead_of_a_screw_is_found_by_counted_revolutions(lead: float) -> None:
    for seed in range(3):
        identified = identify_data(turning_poses(5.0, lead, 60, seed), sequential=True)
        assert identified.best.family == "screw"
        axis = identified.best.parameters["axis"]
        pitch = identified.best.parameters["pitch"] * np.sign(axis @ LEFT[:3, 2]) ** 2
        assert abs(pitch - lead) < 4 * identified.best.deviation("pitch")
        assert identified.best.deviation("pitch") < 3e-4
        assert np.ptp(identified.best.range) == pytest.approx(5 * math.tau, abs=0.1)
        assert angle_between(axis, LEFT[:3, 2]) < 0.03


def test_less_than_a_revolution_agrees_with_unordered_poses() -> None:
    for start in (0.0, 4.0):
        data = turning_poses(0.9, 0.0, 30, start=start)
        one, other = identify_data(data), identify_data(data, sequential=True)
        assert one.best.family == other.best.family == "revolute"
        for fit in one:
            # Without order a screw may have turned anyhow to follow the noise, which pays for its turns.
            if fit.family != "screw":
                assert other[fit.family].log_evidence == pytest.approx(fit.log_evidence, abs=1e-6)
        assert other["screw"].log_evidence < other["revolute"].log_evidence
        np.testing.assert_allclose(one.best.range, other.best.range, atol=1e-6)


def test_revolutions_are_counted_across_outliers() -> None:
    random, data = np.random.default_rng(3), turning_poses(5.0, 0.004, 80)
    wrong = np.sort(random.choice(80, 12, replace=False))
    data[wrong] = transform(Rotation.random(12, random_state=random), random.uniform(-1, 1, (12, 3)))
    fit = identify_data(data, sequential=True, outliers=True).best
    assert fit.family == "screw"
    assert fit.outliers == tuple(wrong)
    assert np.ptp(fit.range) == pytest.approx(5 * math.tau, abs=0.2)
    assert fit.parameters["pitch"] == pytest.approx(0.004, abs=5e-4)


def test_revolutions_are_counted_from_positions() -> None:
    data = turning_poses(4.0, 0.02, 60)[:, :3, 3]
    identified = identify(None, data, noise=COVARIANCE[:3, :3], sequential=True)
    assert identified.best.family == "screw"
    assert identified.best.parameters["pitch"] == pytest.approx(0.02, abs=1e-3)
    round_and_round = turning_poses(4.0, 0.0, 60)[:, :3, 3]
    fit = identify(None, round_and_round, noise=COVARIANCE[:3, :3], sequential=True)["revolute"]
    assert np.ptp(fit.range) == pytest.approx(4 * math.tau, abs=0.1)


@pytest.mark.parametrize(("lead", "family"), [(0.0, "revolute"), (0.005, "screw")])
def test_identifier_counts_revolutions(lead: float, family: str) -> None:
    identifier = Identifier(noise=COVARIANCE)
    for k, pose in enumerate(turning_poses(4.0, lead, 45)):
        identifier.add(None, pose)
        if k > 20 and k % 4 == 0:
            assert identifier.result
    fit = identifier.result.best
    assert fit.family == family
    assert np.ptp(fit.range) == pytest.approx(4 * math.tau, abs=0.1)


def test_evidence_of_an_unconverged_solution_is_reduced() -> None:
    data = recording("planar", count=20, position=1e-3, orientation=0.05, seed=3)
    problem = check_observations(data.parent, data.child, data.covariance, data.covariance)
    motion = GroupMotion(JOINT_FAMILIES["planar"], 6, data.left, data.right)
    joint_prior = JointValuePrior(np.zeros(3), np.full(3, 0.3**-2.0), marginal=True)
    early = levenberg_marquardt(problem, motion, data.values, None, joint_prior, steps=1)
    assert not early.converged
    assert evidence_excess(early) > 1.0
    late = levenberg_marquardt(problem, motion, data.values, None, joint_prior)
    assert evidence_excess(late) == 0.0
    # At the last step the quadratic approximation holds.
    assert evidence_excess(replace(late, converged=False)) < 0.1
