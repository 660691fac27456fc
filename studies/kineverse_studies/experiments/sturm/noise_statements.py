"""Joints of the whole recordings, under right and wrong statements of the noise.

Each recording is identified by all of its poses, as ``kineverse fit`` does. The noise is estimated, or it is
stated: as large as the residuals of the labelled joint, as a guess, and half and twice the residuals.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from kineverse.estimation import identify
from kineverse.estimation.recordings import ObservationNoise, RecordedPair, identify_recorded_joint
from kineverse.estimation.recordings.recorded_joint import residual_noise
from kineverse_studies.experiments.report import ReportTable
from kineverse_studies.experiments.sturm.recordings import Label

GUESS = (0.005, math.radians(1.0))
"""Guessed noise of positions [m] and orientations [rad]."""

STATEMENTS: Mapping[str, str] = MappingProxyType(
    {
        "estimated": "estimated",
        "residuals": "stated, as large as the residuals of the labelled joint",
        "guess": "stated, 5 mm and 1 deg for all",
        "half": "stated, half of the residuals",
        "twice": "stated, twice the residuals",
    }
)
"""Statements of the noise by name."""


@dataclass(frozen=True)
class StatementAnswer:
    """Answer for a recording under a statement of the noise."""

    name: str  # name and label of the recording
    label: Label
    statement: str  # one of :data:`STATEMENTS`
    family: str  # most probable family
    is_sure: bool  # true if the joint is told, False for "cannot tell"

    @property
    def verdict(self) -> str:
        """``right``, ``wrong`` or ``cannot tell``."""
        if not self.is_sure:
            return "cannot tell"
        return "right" if self.family == self.label else "wrong"


def answer_statements(name: str, label: Label, pair: RecordedPair) -> list[StatementAnswer]:
    """Return the answers for a recording under all statements of the noise."""
    labelled = identify(pair.parent_poses, pair.child_poses, families=label, outliers=True).best
    noise = residual_noise(labelled)
    stated = {
        "estimated": None,
        "residuals": noise,
        "guess": ObservationNoise(GUESS[0], GUESS[1] if pair.has_orientation else None, True),
        "half": noise.scaled(0.5),
        "twice": noise.scaled(2.0),
    }
    answers = []
    for statement in STATEMENTS:
        joint = identify_recorded_joint(pair, stated[statement])
        family = joint.found.best.family
        answers.append(StatementAnswer(name, label, statement, family, not joint.is_ambiguous))
    return answers


def statement_table(answers: Sequence[StatementAnswer]) -> ReportTable:
    """Return the table with the number of right, wrong and ambiguous answers for each statement."""
    return ReportTable(
        "All poses of each recording, as kineverse fit takes them",
        ("noise", "right", "sure and wrong", "cannot tell"),
        tuple((STATEMENTS[name], *map(float, counts)) for name, counts in _counts(answers).items()),
    )


def statement_numbers(answers: Sequence[StatementAnswer]) -> dict[str, Any]:
    """Return the numbers of :func:`statement_table`, and the recordings that are wrong or ambiguous."""
    return {
        name: {
            "right": right,
            "wrong": wrong,
            "cannot_tell": ambiguous,
            "not_right": {
                one.name: f"{one.family}, {one.verdict}"
                for one in answers
                if one.statement == name and one.verdict != "right"
            },
        }
        for name, (right, wrong, ambiguous) in _counts(answers).items()
    }


def _counts(answers: Sequence[StatementAnswer]) -> dict[str, tuple[int, ...]]:
    return {
        name: tuple(
            sum(one.statement == name and one.verdict == verdict for one in answers)
            for verdict in ("right", "wrong", "cannot tell")
        )
        for name in STATEMENTS
    }
