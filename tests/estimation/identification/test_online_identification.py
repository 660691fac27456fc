"""Online identification compared with identification of all poses."""

from __future__ import annotations

import numpy as np
import pytest
from synthetic_recordings import recording

from kineverse.estimation import Identifier, identify
from kineverse.estimation.identification.solver import solver


@pytest.mark.parametrize(
    ("family", "count"),
    [
        ("revolute", 18),
        pytest.param("revolute", 48, marks=pytest.mark.long),
        ("prismatic", 18),
        ("planar", 12),
        *(pytest.param(family, 48, marks=pytest.mark.long) for family in ("prismatic", "planar")),
    ],
)
def test_identifier_result_agrees_with_identify_at_every_step(family: str, count: int) -> None:
    data = recording(family, count=count, position=0.02, orientation=0.03, seed=2)
    solver.prepare(wait=True)
    identifier = Identifier(noise=data.covariance)
    for k, (a, b) in enumerate(zip(data.parent, data.child, strict=True), start=1):
        identifier.add(a, b)
        if k < 12:
            continue
        identified = identifier.result
        if k % 6:
            continue
        whole = identify(data.parent[:k], data.child[:k], noise=data.covariance)
        assert identified.best.family == whole.best.family
        assert identified.best.log_evidence == pytest.approx(whole.best.log_evidence, abs=0.05)
        for fit in identified:
            assert fit.probability == pytest.approx(whole[fit.family].probability, abs=0.02)
            assert len(fit.joint_values) == k
            if fit.probability > 1e-4:
                assert fit.log_evidence == pytest.approx(whole[fit.family].log_evidence, abs=1.0)


def test_a_surprising_pose_updates_all_families() -> None:
    data = recording("revolute", count=41, position=0.005, orientation=0.01, seed=4)
    identifier = Identifier(noise=data.covariance, families=["rigid", "revolute", "cylindrical"])
    for a, b in zip(data.parent[:40], data.child[:40], strict=True):
        identifier.add(a, b)
        if len(identifier) > 20:
            assert identifier.result.best.family == "revolute"
    assert 1e-6 < identifier.result.probabilities["cylindrical"] < 0.01
    along = np.eye(4)
    along[2, 3] = 0.1
    there = data.left @ along @ np.linalg.inv(data.left) @ data.true_relative[40]
    identifier.add(data.true_parent[40], data.true_parent[40] @ there)
    assert identifier.result.best.family == "cylindrical"
