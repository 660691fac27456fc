"""Identified families of the cases, sequential or on all cores."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kineverse.estimation import identify, pose_covariance
from kineverse.estimation.identification.result import SURE, NoiseDeviations
from kineverse.estimation.identification.solver import solver
from kineverse.lie import Array
from kineverse_studies.experiments.joint_types.samples import JointCase, draw_case
from kineverse_studies.experiments.registry import Progress
from kineverse_studies.experiments.worker_pool import worker_pool

CASES = 1000

# Number of cases that a process identifies at a time.
_CHUNK = 10


@dataclass(frozen=True)
class Setting:
    """Observations and noise that the estimator is given of a case."""

    poses: bool  # true for poses of the child, False for its positions
    stated: bool  # true if the noise is stated

    @property
    def title(self) -> str:
        """Title of the setting."""
        return f"{'poses' if self.poses else 'positions'}, noise {'stated' if self.stated else 'unknown'}"


SETTINGS = tuple(Setting(poses, stated) for poses in (True, False) for stated in (False, True))


@dataclass(frozen=True, eq=False)
class TypeAnswer:
    """Identified family of a case."""

    number: int
    true: str  # true and most probable family
    family: str
    probability: float
    is_ambiguous: bool  # true if the answer is not sure for another reason, too
    count: int  # number of observations
    truth: NoiseDeviations  # true standard deviations of the noise
    noise: NoiseDeviations | None  # estimated ones; None if the noise was stated

    @property
    def is_right(self) -> bool:
        """True if the most probable family is the true one."""
        return self.family == self.true

    @property
    def is_sure(self) -> bool:
        """True if the answer is unambiguous and more probable than 95 %."""
        return self.probability > SURE and not self.is_ambiguous


def identify_case(number: int, setting: Setting) -> TypeAnswer:
    """Identify the family of a case."""
    case = draw_case(number)
    noise = pose_covariance(case.position, case.orientation) if setting.stated else None
    child: Array = case.child if setting.poses else case.child[:, :3, 3]
    found = identify(case.parent, child, noise=noise)
    return TypeAnswer(
        number=number,
        true=case.joint,
        family=found.best.family,
        probability=found.best.probability,
        is_ambiguous=found.is_ambiguous,
        count=len(child),
        truth=_true_noise(case, setting),
        noise=found.noise,
    )


def identify_cases(
    count: int, progress: Progress, workers: int | None = None
) -> dict[Setting, list[TypeAnswer]]:
    """Identify the families of the first cases in all settings."""
    workers = workers or os.cpu_count() or 1
    chunks = [range(k, min(k + _CHUNK, count)) for k in range(0, count, _CHUNK)]
    if workers == 1:
        found = [_identify_chunk(chunk) for chunk in progress(chunks, "joint-types", "chunk")]
    else:
        with worker_pool(workers) as pool:
            jobs = [pool.submit(_identify_chunk, chunk) for chunk in chunks]
            found = [job.result() for job in progress(jobs, "joint-types", "chunk")]
    return {setting: [answer for chunk in found for answer in chunk[k]] for k, setting in enumerate(SETTINGS)}


def _identify_chunk(numbers: Sequence[int]) -> list[list[TypeAnswer]]:
    solver.prepare(wait=True)
    return [[identify_case(number, setting) for number in numbers] for setting in SETTINGS]


def _true_noise(case: JointCase, setting: Setting) -> NoiseDeviations:
    has_orientation = setting.poses or case.parent is not None
    return NoiseDeviations(case.position, case.orientation if has_orientation else np.nan)
