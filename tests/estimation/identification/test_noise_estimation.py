"""Noise that is not stated: its sizes are estimated and integrated out, and sure answers are right."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic_recordings import recording

from kineverse.errors import KineverseError
from kineverse.estimation import Identifier, identify, pose_covariance
from kineverse.estimation.identification.initial_guess import MotionStatistics, initial_guesses
from kineverse.estimation.identification.joint_identification import WEIGHTS
from kineverse.estimation.identification.least_squares import InitialGuess
from kineverse.estimation.identification.model_selection import prepare_data, solve_with_inliers
from kineverse.estimation.identification.native import library
from kineverse.estimation.identification.noise_estimation import scale_noise
from kineverse.estimation.identification.observations import check_observations
from kineverse.estimation.identification.result import NoiseDeviations
from kineverse.estimation.identification.solver import solver
from kineverse.estimation.noise import UNKNOWN_NOISE
from kineverse.lie import transform
from kineverse_studies.experiments.joint_types import (
    Setting,
    TypeAnswer,
    draw_case,
    identify_case,
    report_answers,
)

DEG = math.pi / 180
NOISE = pose_covariance(0.005, 0.02)


@pytest.fixture(autouse=True, scope="module")
def _compiled() -> None:
    solver.prepare(wait=True)


@pytest.mark.parametrize("family", ["prismatic", "revolute"])
@pytest.mark.parametrize(
    ("position", "orientation"), [(0.016, 0.4), (0.04, 1.0), (0.0025, 4.0), (0.001, 1.6)]
)
@pytest.mark.sampled(2)
def test_noise_of_any_ratio_is_estimated(family: str, position: float, orientation: float) -> None:
    measured = recording(family, count=40, position=position, orientation=orientation * DEG, seed=1)
    identified = identify(measured.parent, measured.child)
    assert identified.best.family == family
    assert not identified.is_ambiguous
    assert identified.noise == pytest.approx((position, orientation * DEG), rel=0.35)
    known = identify(measured.parent, measured.child, noise=pose_covariance(position, orientation * DEG))
    assert known.noise is None
    assert identified.best.deviation("axis.x") == pytest.approx(known.best.deviation("axis.x"), rel=0.35)


def test_noise_of_positions_alone_has_no_orientation() -> None:
    measured = recording("revolute", count=40, position=0.02, orientation=DEG, seed=3)
    identified = identify(
        None, measured.true_relative[:, :3, 3] + np.random.default_rng(0).normal(0, 0.02, (40, 3))
    )
    assert identified.best.family == "revolute"
    assert identified.noise is not None
    assert identified.noise.position == pytest.approx(0.02, rel=0.3)
    assert math.isnan(identified.noise.orientation)


@pytest.mark.parametrize("family", ["prismatic", "revolute"])
def test_evidence_is_that_of_a_sum_over_noises_with_a_solution_for_each(family: str) -> None:
    measured = recording(family, count=12, position=0.02, orientation=0.3 * DEG, seed=5)
    unknown = pose_covariance(*UNKNOWN_NOISE)
    data = prepare_data(
        check_observations(measured.parent, measured.child, unknown, unknown), False, None, False, unit=1.0
    )
    one = solve_with_inliers(data, {family: WEIGHTS[family]})[family]
    solution, spread, step = one.scored.solution, math.log(5.0), 0.1
    axis, total = np.arange(-1.0, 1.01, step), []
    for shift in itertools.product(axis, axis):
        logs = np.log(one.noise.factors) + shift
        identified = solver.continue_from(
            scale_noise(data.observations, np.exp(logs)),
            InitialGuess(solution.motion, solution.values),
            solution.parent,
            solution.joint_prior,
        )
        prior = -0.5 * float(logs @ logs) / spread**2 - math.log(math.tau * spread**2)
        total.append(identified.log_evidence + prior)
    assert one.log_evidence == pytest.approx(np.logaddexp.reduce(total) + 2 * math.log(step), abs=0.05)


@pytest.mark.compiler
def test_unknown_noise_in_c_agrees_with_numpy(monkeypatch: pytest.MonkeyPatch) -> None:
    measured = recording("revolute", count=8, position=0.02, orientation=0.3 * DEG, seed=5)
    families = ["prismatic", "revolute"]
    fast = identify(measured.parent, measured.child, families=families)
    monkeypatch.setattr(library, "_code", None)
    monkeypatch.setattr(library, "error", "there is none")
    slow = identify(measured.parent, measured.child, families=families)
    assert slow.noise == pytest.approx(fast.noise, rel=1e-3)
    for fit in slow:
        assert fit.log_evidence == pytest.approx(fast[fit.family].log_evidence, abs=1e-2)


def test_arcs_of_positions_that_look_straight_are_solved_with_long_levers() -> None:
    """The circle through noisy points is small, and no step leads from it to the arc."""
    random = np.random.default_rng(1)
    angle = random.uniform(-0.3, 0.3, 100)
    arc = 0.3 * np.column_stack([np.sin(angle), 1 - np.cos(angle), 0 * angle])
    points = check_observations(None, arc + random.normal(0, 0.02, arc.shape), None, 0.02**2 * np.eye(3))
    starts = [*initial_guesses("revolute", MotionStatistics(points))]
    identified = solver.maximise_marginal_likelihood(
        points, solver.maximum_likelihood(points, starts).solution
    )
    assert np.ptp(identified.solution.values) < 2.0


@pytest.mark.parametrize(
    ("cases", "right", "sure"), [(6, 5, 3), pytest.param(16, 14, 12, marks=pytest.mark.long)]
)
def test_sure_answers_without_stated_noise_are_right(cases: int, right: int, sure: int) -> None:
    setting = Setting(poses=True, stated=False)
    answers = [identify_case(number, draw_case(number), setting) for number in range(cases)]
    assert not [answer for answer in answers if answer.is_sure and not answer.is_right]
    assert sum(answer.is_right for answer in answers) >= right
    assert sum(answer.is_sure for answer in answers) >= sure


def test_the_report_counts_right_answers_and_sure_errors() -> None:
    noise = NoiseDeviations(0.005, DEG)
    answers = [
        TypeAnswer(0, "revolute", "revolute", 0.99, False, 20, noise, noise),
        TypeAnswer(1, "revolute", "rigid", 0.97, False, 20, noise, noise),
        TypeAnswer(2, "prismatic", "rigid", 0.97, True, 20, noise, NoiseDeviations(0.01, DEG)),
        TypeAnswer(3, "prismatic", "prismatic", 0.6, True, 20, noise, noise),
    ]
    report = report_answers({Setting(True, False): answers})
    assert report.tables[0].rows[0][1:4] == (50.0, 50.0, 25.0)
    assert report.tables[0].rows[0][-1] == "no"
    assert [row[1] for row in report.tables[1].rows][1:] == ["100.0 of 1 (0)", "-", "33.3 of 3 (1)", "-"]


RANDOM = np.random.default_rng(0)
ANYWHERE = transform(Rotation.random(24, random_state=RANDOM).as_matrix(), RANDOM.uniform(-1.0, 1.0, (24, 3)))
EQUAL = np.tile(ANYWHERE[0], (10, 1, 1))
# Observations without information: parent and child.
NOTHING = {
    "two poses": (None, ANYWHERE[:2]),
    "two positions": (None, ANYWHERE[:2, :3, 3]),
    "three positions": (None, ANYWHERE[:3, :3, 3]),
    "equal poses": (None, EQUAL),
    "equal poses of both": (np.tile(ANYWHERE[1], (10, 1, 1)), EQUAL),
    "equal positions": (None, EQUAL[:, :3, 3]),
    "outliers": (None, ANYWHERE[:8]),
    "outliers of both": (ANYWHERE[8:16], ANYWHERE[:8]),
    "outliers among positions": (ANYWHERE[8:16], ANYWHERE[:8, :3, 3]),
}


def identify_online(parent, child, noise, outliers):
    identifier = Identifier(noise=noise, outliers=outliers)
    for k, pose in enumerate(child):
        identifier.add(None if parent is None else parent[k], pose)
    return identifier.result


# These take seconds.
LONG = ("outliers of both", "outliers among positions")


@pytest.mark.sampled(2)
@pytest.mark.parametrize(
    "case", [pytest.param(case, marks=pytest.mark.long if case in LONG else ()) for case in NOTHING]
)
@pytest.mark.parametrize("noise", [None, NOISE], ids=["unknown", "stated"])
def test_observations_without_information_have_no_sure_answer(case: str, noise) -> None:
    parent, child = NOTHING[case]
    for outliers in (None, True):
        if case.startswith("outliers") and noise is not None and outliers is None:
            continue  # with a stated noise and no outliers such a part is free
        for identified in (
            identify(parent, child, noise=noise, outliers=outliers),
            identify_online(parent, child, noise, outliers),
        ):
            assert identified.is_ambiguous
            assert all(np.isfinite(fit.log_evidence) for fit in identified)
            assert np.isfinite(list(identified.probabilities.values())).all()


@pytest.mark.parametrize("noise", [None, NOISE], ids=["unknown", "stated"])
@pytest.mark.parametrize("outliers", [None, True])
def test_invalid_observations_are_refused(noise, outliers) -> None:
    missing, stretched = ANYWHERE[:5].copy(), ANYWHERE[:5].copy()
    missing[3], stretched[3, :3, :3] = np.nan, 1.1 * stretched[3, :3, :3]
    for child, message in (
        (missing, "Leave out"),
        (stretched, "unit length"),
        (ANYWHERE[:1], "at least two"),
        (ANYWHERE[:0], "at least two"),
    ):
        for find in (
            lambda child: identify(None, child, noise=noise, outliers=outliers),
            lambda child: identify_online(None, child, noise, outliers),
        ):
            with pytest.raises(KineverseError, match=message):
                find(child)


def test_identifier_refuses_poses_with_and_without_covariance() -> None:
    identifier = Identifier()
    identifier.add(None, ANYWHERE[0])
    with pytest.raises(KineverseError, match="noise= for the rest"):
        identifier.add(None, ANYWHERE[1], child_covariance=NOISE)
    assert len(identifier) == 1


@pytest.mark.parametrize("family", ["prismatic", "revolute"])
def test_swapped_parts_have_the_same_family(family: str) -> None:
    measured = recording(family, count=20, position=0.02, orientation=0.3 * DEG, seed=2)
    assert identify(measured.child, measured.parent).best.family == family


def test_identifier_without_stated_noise_agrees_with_identify() -> None:
    measured = recording("revolute", count=30, position=0.02, orientation=0.3 * DEG, seed=2)
    identifier = Identifier(sequential=False)
    for k, (parent, child) in enumerate(zip(measured.parent, measured.child, strict=True), start=1):
        identifier.add(parent, child)
        if k not in (12, 13, 21, 30):
            continue
        identified, whole = identifier.result, identify(measured.parent[:k], measured.child[:k])
        assert identified.best.family == whole.best.family
        assert identified.best.probability == pytest.approx(whole.best.probability, abs=0.05)
        assert identified.noise == pytest.approx(whole.noise, rel=0.15)
