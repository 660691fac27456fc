"""Recordings of poses and their text tables."""

from .reader import read_recording
from .recording import RecordedPair, RecordedTrack, Recording, effective_sample_size, spaced_indices

__all__ = [
    "RecordedPair",
    "RecordedTrack",
    "Recording",
    "effective_sample_size",
    "read_recording",
    "spaced_indices",
]
