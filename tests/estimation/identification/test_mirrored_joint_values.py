"""Mirrored joint values for positions that are much more precise than orientations."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from synthetic_recordings import recording, transform

from kineverse.estimation.identification.families import JOINT_FAMILIES, GroupMotion
from kineverse.estimation.identification.joint_values import (
    choose_mirrored_values,
    evaluate_each_observation,
    mirrored_values,
)
from kineverse.estimation.identification.least_squares import JointValuePrior, levenberg_marquardt
from kineverse.estimation.identification.marginal_likelihood import evidence_excess
from kineverse.estimation.identification.observations import check_observations


@pytest.mark.parametrize("family", ["prismatic", "revolute"])
def test_mirrored_joint_values_are_corrected(family: str) -> None:
    seen = recording(
        family, count=40, position=1e-3, orientation=math.radians(5.0), seed=3, extent=0.4, radius=0.5
    )
    problem = check_observations(seen.parent, seen.child, seen.covariance, seen.covariance)
    assert problem.softened
    motion = GroupMotion(JOINT_FAMILIES[family], 6, seen.left, seen.right)
    joint_prior = JointValuePrior(np.zeros(1), np.full(1, 0.12**-2.0), marginal=True)
    good = levenberg_marquardt(problem, motion, seen.values, seen.true_parent, joint_prior)
    parent = good.parent.copy()
    there = evaluate_each_observation(
        problem, good.motion, mirrored_values(good.motion, good.values, joint_prior), parent, joint_prior
    )
    parent[:10, :3, :3] = there.orientation[:10]
    bad = levenberg_marquardt(
        problem, good.motion, np.concatenate([there.values[:10], good.values[10:]]), parent, joint_prior
    )
    assert bad.cost > good.cost + 1.0
    assert choose_mirrored_values(problem, bad).cost < good.cost + 0.1 * (bad.cost - good.cost)


def test_evidence_of_an_unconverged_solution_is_reduced() -> None:
    seen = recording("planar", count=20, position=1e-3, orientation=0.05, seed=3)
    problem = check_observations(seen.parent, seen.child, seen.covariance, seen.covariance)
    motion = GroupMotion(JOINT_FAMILIES["planar"], 6, seen.left, seen.right)
    joint_prior = JointValuePrior(np.zeros(3), np.full(3, 0.3**-2.0), marginal=True)
    early = levenberg_marquardt(problem, motion, seen.values, None, joint_prior, steps=1)
    assert not early.converged
    assert evidence_excess(early) > 1.0
    late = levenberg_marquardt(problem, motion, seen.values, None, joint_prior)
    assert evidence_excess(late) == 0.0
    # At the end of all steps the quadratic keeps what it promises.
    assert evidence_excess(replace(late, converged=False)) < 0.1


@pytest.mark.parametrize("family", ["prismatic", "revolute"])
def test_single_observation_agrees_with_scipys_least_squares(family: str) -> None:
    seen = recording(family, count=5, position=0.01, orientation=0.05, seed=2)
    problem = check_observations(seen.parent, seen.child, seen.covariance, seen.covariance)
    motion = GroupMotion(JOINT_FAMILIES[family], 6, seen.left, seen.right)
    joint_prior = JointValuePrior(np.zeros(1), np.full(1, 0.2**-2.0))
    found = evaluate_each_observation(problem, motion, seen.values, seen.parent, joint_prior)
    deviation = np.sqrt(np.diag(seen.covariance))

    def errors(unknown: np.ndarray, k: int) -> np.ndarray:
        there = transform(Rotation.from_rotvec(unknown[4:]), unknown[1:4])
        result = [unknown[:1] / 0.2]
        for pose, true in (
            (seen.parent[k], there),
            (seen.child[k], there @ motion.linearise(unknown[None, :1]).pose[0]),
        ):
            turned = Rotation.from_matrix(pose[:3, :3] @ true[:3, :3].T).as_rotvec()
            result.append(np.concatenate([pose[:3, 3] - true[:3, 3], turned]) / deviation)
        return np.concatenate(result)

    for k, parent in enumerate(seen.true_parent):
        start = [seen.values[k, 0], *parent[:3, 3], *Rotation.from_matrix(parent[:3, :3]).as_rotvec()]
        theirs = least_squares(errors, start, args=(k,))
        assert found.values[k, 0] == pytest.approx(theirs.x[0], abs=1e-3)
        turned = Rotation.from_matrix(found.orientation[k]) * Rotation.from_rotvec(theirs.x[4:]).inv()
        assert turned.magnitude() < 1e-3
