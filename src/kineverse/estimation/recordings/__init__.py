"""Recordings of poses, their text tables, and joints identified from them."""

from kineverse.estimation.correlation import correlation_time, effective_sample_size

from .reader import read_recording
from .recorded_joint import Assumption, ObservationNoise, RecordedJoint, identify_recorded_joint
from .recording import RecordedPair, RecordedTrack, Recording, spaced_indices

__all__ = [
    "Assumption",
    "ObservationNoise",
    "RecordedJoint",
    "RecordedPair",
    "RecordedTrack",
    "Recording",
    "correlation_time",
    "effective_sample_size",
    "identify_recorded_joint",
    "read_recording",
    "spaced_indices",
]
