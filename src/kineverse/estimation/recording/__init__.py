"""Tables of poses: what a camera saw of parts, read from text files."""

from .correlation import independent_count
from .recording import Pair, Recording, Track, evenly
from .tables import read_recording

__all__ = ["Pair", "Recording", "Track", "evenly", "independent_count", "read_recording"]
