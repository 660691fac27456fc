"""Figures."""

from __future__ import annotations

from collections.abc import Sequence

from kineverse.experiments.manipulation.trials import Trial
from kineverse.experiments.report import Figure


def make_pictures(trials: Sequence[Trial]) -> dict[str, Figure]:
    """Return the pictures."""
    return {}
