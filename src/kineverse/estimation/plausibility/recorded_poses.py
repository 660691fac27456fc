"""Recent poses that a tracker keeps."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol, runtime_checkable

from kineverse.estimation.identification.observations import PosesLike
from kineverse.lie import Array
from kineverse.model.model import Model


@runtime_checkable
class RecordedPoses(Protocol):
    """Model with a record of recent poses of its frames, such as a tracker.

    Attributes
    ----------
    model
        The model that is tracked.
    recent
        Poses in order of time by name of the frame, (N, 4, 4); NaN where missing.
    recent_times
        Times of the poses (N,) [s]; None without.
    recent_covariances
        Covariances of the poses by name of the frame, (6, 6) or (N, 6, 6).
    """

    @property
    def model(self) -> Model:
        """The model."""

    @property
    def recent(self) -> Mapping[str, Array]:
        """Recent poses by name of the frame."""

    @property
    def recent_times(self) -> Array | None:
        """Times of the poses."""

    @property
    def recent_covariances(self) -> Mapping[str, Array]:
        """Covariances by name of the frame."""


def recorded_observations(record: RecordedPoses) -> dict[str, PosesLike]:
    """Return recorded poses with their covariances, by name of the frame."""
    return {name: (poses, record.recent_covariances[name]) for name, poses in record.recent.items()}
