"""Joint-type experiment: observations of the cases, and the reduced experiment."""

from __future__ import annotations

import json

import numpy as np
import pytest

from kineverse.lie import inverse, rotation_angle
from kineverse_studies.experiments import Options
from kineverse_studies.experiments.joint_types import (
    COUNTS,
    LEVERS,
    MOVING,
    POSITIONS,
    RANGES,
    SETTINGS,
    draw_case,
    identify_cases,
    report_answers,
)


def test_cases_are_within_their_ranges() -> None:
    cases = [draw_case(number) for number in range(300)]
    assert {case.joint for case in cases} == set(RANGES)
    assert np.mean([case.parent is not None for case in cases]) == pytest.approx(MOVING, abs=0.1)
    for case in cases:
        assert COUNTS[0] <= len(case.child) <= COUNTS[1]
        assert POSITIONS[0] <= case.position <= POSITIONS[1]
        assert RANGES[case.joint][0] <= case.range <= RANGES[case.joint][1]


def test_relative_poses_are_those_of_the_joint_up_to_the_noise() -> None:
    for number in range(40):
        case = draw_case(number)
        relative = case.child if case.parent is None else inverse(case.parent) @ case.child
        turned = rotation_angle(relative[0, :3, :3].T @ relative[:, :3, :3])
        distance = np.linalg.norm(relative[:, :3, 3], axis=1)
        margin = 14.0 * (case.position + case.orientation)
        if case.joint == "revolute":
            assert turned.max() <= case.range + 14.0 * case.orientation
            assert LEVERS[0] - margin < distance.min()
            assert distance.max() < LEVERS[1] + margin
        else:
            assert turned.max() < 14.0 * case.orientation
            assert distance.max() < case.range + margin


def test_the_report_of_a_few_cases_has_all_settings() -> None:
    found = report_answers(identify_cases(3, lambda items, what, unit: items, Options(processes=1)))
    assert len(found.tables[0].rows) == len(SETTINGS)
    assert len(json.loads(json.dumps(found.numbers))["answers"][SETTINGS[0].title]) == 3
