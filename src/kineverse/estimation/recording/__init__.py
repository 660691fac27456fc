"""Tables of poses: what a camera saw of parts, read from text files."""

from .recording import Pair, Recording, Track
from .tables import read_recording

__all__ = ["Pair", "Recording", "Track", "read_recording"]
