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
from kineverse_studies.experiments.registry import Progress
from kineverse_studies.experiments.worker_pool import worker_pool

from .samples import JointCase, draw_case

CASES = 1000

# Number of cases that a process identifies at a time.
_CHUNK = 10


@dataclass(frozen=True)
class Setting:
    """Observations and noise that the estimator is given of a case.

    Attributes
    ----------
    poses
        True for poses of the child, False for its positions.
    stated
        True if the noise is stated.
    """

    poses: bool
    stated: bool

    @property
    def title(self) -> str:
        """Title of the setting."""
        return f"{'poses' if self.poses else 'positions'}, noise {'stated' if self.stated else 'unknown'}"


SETTINGS = tuple(Setting(poses, stated) for poses in (True, False) for stated in (False, True))


@dataclass(frozen=True, eq=False)
class TypeAnswer:
    """Identified family of a case.

    Attributes
    ----------
    number
        Number of the case.
    true, family
        True and most probable family.
    probability
        Its probability.
    is_ambiguous
        True if the answer is not sure for another reason, too.
    count
        Number of observations.
    truth
        True standard deviations of the noise.
    noise
        Estimated ones; None if the noise was stated.
    """

    number: int
    true: str
    family: str
    probability: float
    is_ambiguous: bool
    count: int
    truth: NoiseDeviations
    noise: NoiseDeviations | None

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
    """Identify the families of the first cases in all settings.

    Parameters
    ----------
    count
        Number of cases.
    progress
        Progress reporter.
    workers
        Number of processes; None for one on each core.
    """
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
