"""Sure answers where the truth is no hinge and no slider, and joint values with honest deviations."""

from __future__ import annotations

import numpy as np
import pytest
from synthetic_recordings import recording

from kineverse.estimation import identify, pose_covariance
from kineverse.estimation.identification.solver import solver
from kineverse_studies.experiments.joint_families import draw_family_case, is_right
from kineverse_studies.experiments.joint_types import Setting, identify_case


@pytest.mark.parametrize(
    ("truth", "number", "setting"),
    [
        ("cylindrical", 1, Setting(poses=False, stated=True)),
        ("planar", 5, Setting(poses=False, stated=True)),
        ("screw", 10, Setting(poses=False, stated=True)),
        ("screw", 18, Setting(poses=True, stated=False)),
        ("free", 11, Setting(poses=True, stated=False)),
        ("walk", 10, Setting(poses=True, stated=False)),
    ],
)
def test_a_sure_answer_is_right(truth: str, number: int, setting: Setting) -> None:
    solver.prepare(wait=True)
    answer = identify_case(number, draw_family_case(truth, 0, number), setting)
    assert is_right(answer) or not answer.is_sure


def test_a_cylinder_is_found_in_positions() -> None:
    random = np.random.default_rng(0)
    for _ in range(3):
        angle, along = random.uniform(-3.0, 3.0, 60), random.uniform(-0.5, 0.5, 60)
        points = np.stack([np.cos(angle), np.sin(angle), along], axis=1)
        found = identify(None, points + random.normal(0.0, 0.003, points.shape), noise=(0.003, 0.02))
        assert (found.best.family, found.is_ambiguous) == ("cylindrical", False)
        assert found.misfit == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize("rows", [6, 3], ids=["poses", "positions"])
def test_deviations_of_joint_values_include_the_uncertainty_of_the_joint(rows: int) -> None:
    squares = []
    for seed in range(25):
        data = recording("revolute", count=12, position=0.003, orientation=0.01, seed=seed)
        child = data.child if rows == 6 else data.child[:, :3, 3]
        noise = pose_covariance(0.003, 0.01)
        fit = identify(data.parent, child, noise=noise, families=["revolute"]).best
        true, found = (values - values.mean() for values in (data.values[:, 0], fit.joint_values[:, 0]))
        off = found * np.sign(found @ true) - true
        squares.append(np.mean((off / fit.deviations[:, 0]) ** 2))
    assert 0.7 < np.mean(squares) < 1.3
