"""A recording, and what it was taken for."""

from __future__ import annotations

from dataclasses import dataclass

from kineverse.estimation import identify
from kineverse.estimation.identification.fit import Found
from kineverse.experiments.sturm.recordings import Labelled


@dataclass(frozen=True, eq=False)
class Judged:
    """A recording and what it was taken for.

    Attributes
    ----------
    recording
        What was seen.
    found
        All families with their probabilities.
    """

    recording: Labelled
    found: Found

    @property
    def called(self) -> str:
        """The most probable family."""
        return self.found.best.family

    @property
    def right(self) -> bool:
        """Whether that is the label."""
        return self.called == self.recording.label


def judge(recording: Labelled) -> Judged:
    """Identify what one recording shows."""
    return Judged(recording, identify(None, recording.poses, covariance_b=recording.covariance))
