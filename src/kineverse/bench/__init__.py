"""Layer 7: speed, measured beside the peers."""

from collections.abc import Sequence

from kineverse.errors import KineverseError


def run(words: Sequence[str]) -> int:
    """Run the named benchmarks.

    Raises
    ------
    KineverseError
        In this version, always: there are none yet.
    """
    raise KineverseError("This version has no benchmarks yet; they come with the next one.")
