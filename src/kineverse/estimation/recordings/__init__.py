"""Recordings of poses, their text tables, and joints identified from them."""

from typing import TYPE_CHECKING

from kineverse._lazy import lazy_face

if TYPE_CHECKING:
    from .reader import read_recording as read_recording
    from .recorded_joint import (
        Assumption as Assumption,
        ObservationNoise as ObservationNoise,
        RecordedJoint as RecordedJoint,
        identify_recorded_joint as identify_recorded_joint,
        make_joint_model as make_joint_model,
    )
    from .recording import (
        RecordedPair as RecordedPair,
        RecordedTrack as RecordedTrack,
        Recording as Recording,
    )

lazy_face(__name__)
