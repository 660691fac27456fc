"""What the system says about processes."""

from __future__ import annotations

from pathlib import Path


def states_of_group(number: int) -> list[str]:
    """Return the states of all processes of a group; Z is a dead one that nobody has asked about."""
    states = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, group = path.read_text().rpartition(")")[2].split()[:3]
        except OSError:
            continue
        if int(group) == number:
            states.append(state)
    return states
