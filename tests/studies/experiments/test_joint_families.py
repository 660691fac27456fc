"""Experiment on families that are no hinge and no slider: cases, and the reduced experiment."""

from __future__ import annotations

import json

import numpy as np
import pytest

from kineverse.lie import inverse, rotation_angle
from kineverse_studies.experiments import Options, joint_families
from kineverse_studies.experiments.joint_families import (
    TRUTHS,
    draw_family_case,
    identify_family_cases,
    report_families,
)
from kineverse_studies.experiments.joint_types import SETTINGS, JointCase


def relative_poses(case: JointCase) -> np.ndarray:
    return case.child if case.parent is None else inverse(case.parent) @ case.child


def test_cases_move_as_their_truth_up_to_the_noise() -> None:
    for number in range(10):
        for truth in TRUTHS:
            case = draw_family_case(truth, 1, number)
            poses, margin = relative_poses(case), 14.0 * (case.position + case.orientation)
            turned = rotation_angle(inverse(poses[:1])[:, :3, :3] @ poses[:, :3, :3])
            assert np.ptp(poses[:, :3, 3], axis=0).max() > 0.02
            assert turned.max() > 0.2
            if truth == "planar":
                off = poses[:, :3, 3] - poses[:, :3, 3].mean(axis=0)
                assert np.linalg.svd(off)[1][2] < margin * np.sqrt(len(poses))


def test_the_report_of_a_case_has_all_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(joint_families, "TRUTHS", {"screw": TRUTHS["screw"]})
    found = report_families(
        0, identify_family_cases(0, 1, lambda items, what, unit: items, Options(processes=1))
    )
    assert len(found.tables[0].rows) == len(SETTINGS)
    assert len(json.loads(json.dumps(found.numbers))["answers"]) == len(SETTINGS)
