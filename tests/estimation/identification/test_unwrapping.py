"""Counting of revolutions in sequential observations."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic_recordings import Array, angle_between, noisy, transform

import kineverse as kv
from kineverse.estimation import IdentificationResult, Identifier, identify, pose_covariance

COVARIANCE = pose_covariance(0.002, 0.02)
LEFT = transform(Rotation.from_rotvec([0.3, -0.4, 0.2]), (0.3, 0.1, 0.5))


def seen_turning(turns: float, lead: float, count: int, seed: int = 0, start: float = 0.0) -> Array:
    """Return poses of what goes round so often and moves by so much with every turn [m]."""
    turn = kv.position("turn")
    along = kv.translation(0, 0, lead / math.tau * turn)
    pose = kv.compile([along @ kv.rotation_z(turn) @ kv.translation(0.1, 0.0, 0.0)])
    true = LEFT @ pose.batch(start + np.linspace(0.0, turns * math.tau, count)[:, None])[0]
    return noisy(true, 0.002, 0.02, np.random.default_rng(seed))


def found_of(seen: Array, **options: object) -> IdentificationResult:
    return identify(None, seen, noise=COVARIANCE, **options)


@pytest.mark.parametrize("turns", [2.3, 5.0, 20.0])
def test_revolutions_of_a_crank_are_counted(turns: float) -> None:
    seen = seen_turning(turns, 0.0, int(10 * turns))
    fit = found_of(seen, sequential=True).best
    assert fit.family == "revolute"
    assert np.ptp(fit.range) == pytest.approx(turns * math.tau, abs=0.1)
    assert fit.largest_turn == pytest.approx(turns * math.tau / (len(seen) - 1), abs=0.1)
    np.testing.assert_allclose(fit.poses, seen, atol=0.12)
    # Nobody knows about turns without the order.
    assert np.ptp(found_of(seen).best.range) < math.tau
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(fit.operation("crank", "world"))
    limits = model.constraints["crank/position"]
    assert float(limits.upper) - float(limits.lower) == pytest.approx(turns * math.tau, abs=0.1)


@pytest.mark.parametrize("lead", [0.002, 0.005, -0.01])
def test_the_lead_of_a_screw_is_found_by_counted_revolutions(lead: float) -> None:
    for seed in range(3):
        found = found_of(seen_turning(5.0, lead, 60, seed), sequential=True)
        assert found.best.family == "screw"
        axis = found.best.parameters["axis"]
        pitch = found.best.parameters["pitch"] * np.sign(axis @ LEFT[:3, 2]) ** 2
        assert abs(pitch - lead) < 4 * found.best.deviation("pitch")
        assert found.best.deviation("pitch") < 3e-4
        assert np.ptp(found.best.range) == pytest.approx(5 * math.tau, abs=0.1)
        assert angle_between(axis, LEFT[:3, 2]) < 0.03


def test_less_than_a_revolution_agrees_with_unordered_poses() -> None:
    for start in (0.0, 4.0):
        seen = seen_turning(0.9, 0.0, 30, start=start)
        one, other = found_of(seen), found_of(seen, sequential=True)
        assert one.best.family == other.best.family == "revolute"
        for fit in one:
            # Without order a screw may have turned anyhow to follow the noise, which pays for its turns.
            if fit.family != "screw":
                assert other[fit.family].log_evidence == pytest.approx(fit.log_evidence, abs=1e-6)
        assert other["screw"].log_evidence < other["revolute"].log_evidence
        np.testing.assert_allclose(one.best.range, other.best.range, atol=1e-6)


def test_revolutions_are_counted_across_outliers() -> None:
    random = np.random.default_rng(3)
    seen = seen_turning(5.0, 0.004, 80)
    wrong = np.sort(random.choice(80, 12, replace=False))
    seen[wrong] = transform(Rotation.random(12, random_state=random), random.uniform(-1, 1, (12, 3)))
    fit = found_of(seen, sequential=True, outliers=True).best
    assert fit.family == "screw"
    assert fit.outliers == tuple(wrong)
    assert np.ptp(fit.range) == pytest.approx(5 * math.tau, abs=0.2)
    assert fit.parameters["pitch"] == pytest.approx(0.004, abs=5e-4)


def test_revolutions_are_counted_from_positions() -> None:
    seen = seen_turning(4.0, 0.02, 60)[:, :3, 3]
    found = identify(None, seen, noise=COVARIANCE[:3, :3], sequential=True)
    assert found.best.family == "screw"
    assert found.best.parameters["pitch"] == pytest.approx(0.02, abs=1e-3)
    round_and_round = seen_turning(4.0, 0.0, 60)[:, :3, 3]
    fit = identify(None, round_and_round, noise=COVARIANCE[:3, :3], sequential=True)["revolute"]
    assert np.ptp(fit.range) == pytest.approx(4 * math.tau, abs=0.1)


@pytest.mark.parametrize(("lead", "family"), [(0.0, "revolute"), (0.005, "screw")])
def test_identifier_counts_revolutions(lead: float, family: str) -> None:
    identifier = Identifier(noise=COVARIANCE)
    for k, pose in enumerate(seen_turning(4.0, lead, 45)):
        identifier.add(None, pose)
        if k > 20 and k % 4 == 0:
            assert identifier.result
    fit = identifier.result.best
    assert fit.family == family
    assert np.ptp(fit.range) == pytest.approx(4 * math.tau, abs=0.1)
